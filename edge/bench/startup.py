# SPDX-License-Identifier: Apache-2.0
"""Start of a process until its kernels are ready, and its memory then; each start is measured from outside.

``python -m edge.bench.startup RIG PART`` is the process: it prints its resident memory in bytes when it is ready.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from edge.config import CompletionSettings
from edge.errors import RfconstructError
from edge.numba_cache import VARIABLE

Part = Literal["kernels", "pipeline", "completion"]
TIMEOUT_S = 300.0


@dataclass(frozen=True, slots=True)
class Start:
    """Of one process.

    Args:
        seconds: from its creation until its kernels are ready and its first frames have passed.
        cpu_s: CPU time of the whole process, which other processes of a shared machine do not lengthen.
        resident_mb: memory when it was ready, 1e6 bytes.
    """

    seconds: float
    cpu_s: float
    resident_mb: float


def start(rig_name: str, part: Part, cold: bool = False) -> Start:
    """Measure one start.

    Args:
        rig_name: whose kernels.
        part: "kernels": imager, detector and association alone; "pipeline": the whole road with ONNX Runtime;
            "completion": that with the rig's model loaded, after a cloud of the largest size.
        cold: with an empty cache of kernels.
    Raises:
        RfconstructError: the process failed.
    """
    with tempfile.TemporaryDirectory() as empty:
        environment = {**os.environ, VARIABLE: empty} if cold else dict(os.environ)
        command = [sys.executable, "-m", "edge.bench.startup", rig_name, part]
        begin_s, begin_cpu_s = time.monotonic(), _children_cpu_s()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
            assert process.stdout is not None
            line = process.stdout.readline()
            seconds = time.monotonic() - begin_s
            process.wait(TIMEOUT_S)
    if not line.strip().isdigit():
        raise RfconstructError(f"a start of {part} failed", value=process.returncode, action="run " + " ".join(command))
    return Start(seconds, _children_cpu_s() - begin_cpu_s, int(line) / 1e6)


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def resident_bytes() -> int:
    """Memory of this process that is in RAM."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _be_ready(rig_name: str, part: str) -> None:
    from edge.rig import load_rig

    rig = load_rig(rig_name)
    if part in ("pipeline", "completion"):
        from edge.warm import warm_up

        warm_up(rig)
        if part == "completion":
            _complete(rig.settings.completion)
        return
    from edge.dsp.detector import Detector
    from edge.dsp.imager import Imager
    from edge.frames import RADARS
    from edge.fusion.association import Associator
    from edge.warm_frames import noise_frames

    frames = noise_frames(rig, 0, 0)
    found = []
    for radar in RADARS:
        imager = Imager(rig.radars[radar], rig.settings.heatmap, rig.settings.antenna)
        found.append(Detector(rig.radars[radar], rig.settings.cfar).process(imager.process(frames[radar])))
    Associator(rig).process(found[0], found[1], None)


def _complete(settings: CompletionSettings) -> None:
    import numpy as np

    from edge.completion.manifest import find_model
    from edge.completion.model import CompletionModel

    model = CompletionModel.load(find_model(settings.model), settings)
    cloud = np.random.default_rng(0).normal(size=(settings.max_points, model.manifest.columns)).astype(np.float32)
    model.run(cloud)


if __name__ == "__main__":
    _be_ready(sys.argv[1], sys.argv[2])
    print(resident_bytes(), flush=True)
