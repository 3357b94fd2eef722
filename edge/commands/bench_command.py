# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct bench``: stages and the whole two-radar frame beside NumPy in the same process."""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from edge.bench.measure import Timing, measure, processor
from edge.bench.numpy_peer import NumpyImager, ca_decisions
from edge.commands.arguments import seconds
from edge.config import CfarSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import ConfigError, ExitCode
from edge.frames import RADARS, Float32, Heatmap, RadarFrame, RadarId
from edge.fusion.association import Associator
from edge.reference.point_targets import make_frame
from edge.rig import Rig, load_rig

PEER = "numpy float32"
TARGETS = 24
NOISE_LSB = 25.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("--rig", default="cascade_demo", help="rig with two radars (default: %(default)s, one loop)")
    parser.add_argument("--seconds", type=seconds, default=12.0, help="time to spend measuring (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Measure and print a table, or JSON."""
    rig = load_rig(args.rig)
    if len(rig.radars) != len(RADARS) or rig.radars["horizontal"].schedule.layout.kind != "cascade":
        raise ConfigError(
            f"rig {rig.name} cannot be benched", allowed="two cascade radars", action="--rig cascade_pair"
        )
    timings = measure(calls(rig), args.seconds)
    layout = rig.radars["horizontal"].schedule.layout
    head: dict[str, Any] = {
        "processor": processor(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "rig": rig.name,
        "frame": f"{layout.slots} TX, {layout.devices * layout.rx} RX, {layout.samples} samples, {layout.loops} loops",
        "threads": 1,
    }
    if args.json:
        print(json.dumps({**head, "calls": {name: asdict(timing) for name, timing in timings.items()}}, indent=2))
    else:
        print("\n".join(table(head, timings)))
    return ExitCode.OK


def calls(rig: Rig) -> dict[str, Callable[[], object]]:
    """Name of a measured call -> the call; a peer's name ends in "(numpy float32)"."""
    settings, frames = rig.settings, _frames(rig)
    cfar = replace(settings.cfar, kind="ca")
    imagers = {r: Imager(rig.radars[r], settings.heatmap, settings.antenna) for r in RADARS}
    peers = {r: NumpyImager(rig.radars[r], settings.heatmap, settings.antenna) for r in RADARS}
    detectors = {r: Detector(rig.radars[r], cfar) for r in RADARS}
    ordered = Detector(rig.radars["horizontal"], replace(cfar, kind="os"))
    associator = Associator(rig)
    heatmaps = {r: _kept(imagers[r].process(frames[r])) for r in RADARS}
    found = {r: detectors[r].process(heatmaps[r]) for r in RADARS}
    first = int(np.searchsorted(heatmaps["horizontal"].range_m, cfar.min_range_m))

    def whole() -> object:
        both = {r: detectors[r].process(imagers[r].process(frames[r])) for r in RADARS}
        return associator.process(both["horizontal"], both["vertical"], None)

    def whole_peer() -> object:
        return [ca_peaks(peers[r].process(frames[r]), first, cfar) for r in RADARS]

    one: RadarId = "horizontal"
    frame, heatmap = frames[one], heatmaps[one]
    return {
        "heatmap, one radar": lambda: imagers[one].process(frame),
        f"heatmap, one radar ({PEER})": lambda: peers[one].process(frame),
        "CFAR CA, one radar": lambda: detectors[one].process(heatmap),
        f"CFAR CA, one radar ({PEER})": lambda: ca_peaks(heatmap.power, first, cfar),
        "CFAR OS, one radar": lambda: ordered.process(heatmap),
        "association": lambda: associator.process(found["horizontal"], found["vertical"], None),
        "two-radar frame to 3-D points": whole,
        f"two-radar frame to 3-D points ({PEER})": whole_peer,
    }


def ca_peaks(power: Float32, first: int, settings: CfarSettings) -> tuple[np.ndarray, np.ndarray]:
    """The peer's detections: cells above the threshold that are larger than their eight neighbours."""
    decided = ca_decisions(power, first, settings)
    decided[:, 0] = decided[:, -1] = False
    angle, cell = np.nonzero(decided)
    here, peak = power[angle, cell], np.ones(len(angle), dtype=np.bool_)
    for da in (-1, 0, 1):
        for dr in (-1, 0, 1):
            if da or dr:
                peak &= here > power[(angle + da) % len(power), cell + dr]
    return angle[peak], cell[peak]


def table(head: dict[str, Any], timings: dict[str, Timing]) -> list[str]:
    """Lines of the human-readable report."""
    lines = [f"{head['processor']}, one thread, Python {head['python']}, NumPy {head['numpy']}"]
    lines += [f"rig {head['rig']}: {head['frame']} per radar", ""]
    lines += [f"{'':46s} {'median ms':>10s} {'p99 ms':>9s} {'ratio to ' + PEER:>24s}"]
    for name, timing in timings.items():
        peer = timings.get(f"{name} ({PEER})")
        ratio = f"{peer.median_ms / timing.median_ms:.1f} x faster" if peer else ""
        lines.append(f"{name:46s} {timing.median_ms:10.3f} {timing.p99_ms:9.3f} {ratio:>24s}")
    return lines


def _frames(rig: Rig) -> dict[RadarId, RadarFrame]:
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(2, 12, TARGETS), rng.uniform(-4, 4, TARGETS), rng.uniform(-0.7, 2, TARGETS)]
    amplitude = rng.uniform(20, 200, TARGETS)
    return {r: make_frame(rig.radars[r], points, amplitude, 0, 0, noise_lsb=NOISE_LSB, rng=rng) for r in RADARS}


def _kept(heatmap: Heatmap) -> Heatmap:
    return replace(heatmap, power=heatmap.power.copy())
