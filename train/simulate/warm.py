# SPDX-License-Identifier: Apache-2.0
"""First start on two cores: another process compiles the simulator's kernels while this one compiles the pipeline's.

Numba compiles in one thread of a process; both processes fill the same cache.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from edge import numba_cache
from edge.rig import load_rig

LAST_KERNEL = "kernels_transform.*.nbi"
"""Of the simulator; where it is, so are the others."""
LONGEST_S = 300.0


def is_cold() -> bool:
    """Whether the simulator's kernels must be compiled."""
    return next(Path(numba_cache.enable()).rglob(LAST_KERNEL), None) is None


def warm_both(rig_name: str) -> float:
    """Compile everything that the showcase needs; the other process's failure costs only its help.

    Args:
        rig_name: name or folder.
    Returns:
        Seconds that it took.
    """
    start_s = time.monotonic()
    words = [sys.executable, "-m", "train.simulate.warm", rig_name]
    helper = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        from edge.pipeline import Pipeline
        from edge.warm import warm_up

        rig = load_rig(rig_name)
        warm_up(rig, Pipeline(rig, None, []))
        helper.wait(LONGEST_S)
    except subprocess.TimeoutExpired:
        pass
    finally:
        if helper.poll() is None:
            helper.terminate()
            helper.wait()
    return time.monotonic() - start_s


def simulator(rig_name: str) -> None:
    """Compile the simulator's kernels and the search for nearest points by using them.

    Args:
        rig_name: name or folder.
    """
    from train.nearest import nearest_index
    from train.simulate.street import make_street

    drive = make_street(load_rig(rig_name)).drive
    for radar in drive.rig.radars:
        drive.frame(radar, 0)
    points_m = np.zeros((1, 3), np.float32)
    nearest_index(points_m, points_m)


if __name__ == "__main__":
    simulator(sys.argv[1])
