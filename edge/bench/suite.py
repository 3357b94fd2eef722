# SPDX-License-Identifier: Apache-2.0
"""Runs the whole benchmark and gives its result as plain data, as ``rfconstruct bench --json`` prints it."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict
from importlib import metadata
from typing import Any

from edge.bench.cases import Case, Contender, Scene, stages, whole_frames
from edge.bench.ceilings import Ceilings, Work, ceilings, heatmap_work, ring_work
from edge.bench.measure import Timing, measure, processor
from edge.bench.startup import start
from edge.frames import RADARS
from edge.rig import Rig
from edge.two_cores import TwoCores

PACKAGES = ("numpy", "numba", "scipy")
FRAME_SHARE = 0.75
"""Of the time, for whole frames; the rest is for stages."""
WARM_S, COLD_S, KERNELS_MB, SPREAD = 2.0, 20.0, 250.0, 2.0
"""Goals: start with and without compiled kernels, memory of the kernels' process, p99 over median."""


def run_suite(rig: Rig, seconds: float, cold: bool) -> dict[str, Any]:
    """Measure everything.

    Args:
        rig: two cascades.
        seconds: time for the repetitions; making the peers and starting processes comes on top.
        cold: measure a start that compiles all kernels, too.
    Returns:
        machine, frames, stages, hand_off_us, ceilings, work, starts, not_measured.
    """
    errors: dict[str, str] = {}
    about = machine(rig)
    with TwoCores() as cores:
        frames = whole_frames(rig, cores, errors)
        frame_times = _measured(frames, FRAME_SHARE * seconds)
        hand_off = measure({"": lambda: cores.both(_nothing, _nothing)}, 0.02 * seconds)[""]
    parts = stages(rig)
    part_times = _measured(parts, (1.0 - FRAME_SHARE) * seconds)
    top = ceilings()
    medians = {case.name: part_times[_key(case)].median_ms for case in parts}
    start(rig.name, "pipeline")  # fills the cache, if it was not
    starts = [("kernels", False), ("pipeline", False), *([("pipeline", True)] if cold else [])]
    return {
        "machine": about,
        "frames": [_as_dict(case, frame_times) for case in frames],
        "stages": [_as_dict(case, part_times) for case in parts],
        "hand_off_us": 1e3 * hand_off.wall_ms,
        "ceilings": asdict(top),
        "work": _work(rig, medians, top),
        "starts": [
            {"part": part, "cold": is_cold, **asdict(start(rig.name, part, is_cold))}  # type: ignore[arg-type]
            for part, is_cold in starts
        ],
        "not_measured": errors,
    }


def machine(rig: Rig) -> dict[str, Any]:
    """What the figures depend on."""
    layout = rig.radars[RADARS[0]].schedule.layout
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return {
        "processor": processor(),
        "cores": os.cpu_count() or 1,
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        **versions,
        "rig": rig.name,
        "frame": f"{layout.slots} TX x {layout.devices * layout.rx} RX x {layout.samples} samples",
    }


def _nothing() -> None:
    """Stands for work that takes no time."""


def _key(case: Case, peer: Contender | None = None) -> str:
    return case.name if peer is None else f"{case.name}\n{peer.name}"


def _measured(cases: list[Case], seconds: float) -> dict[str, Timing]:
    calls = {_key(case): case.call for case in cases}
    calls |= {_key(case, peer): peer.call for case in cases for peer in case.peers}
    times = measure(calls, seconds)
    return times | {_key(case): times[_key(case)].by_wall() for case in cases if case.cores > 1}


def _as_dict(case: Case, times: dict[str, Timing]) -> dict[str, Any]:
    """Case with its timings; unknown numbers are None."""
    ours = times[_key(case)]
    peers = []
    for peer in case.peers:
        timing = times[_key(case, peer)]
        peers.append(
            {
                "name": peer.name,
                "differences": peer.differences,
                **asdict(timing),
                "ratio": timing.median_ms / ours.median_ms,
                "goal_ratio": peer.goal,
                "covered": _known(peer.covered),
                "ours": _known(peer.ours),
                "detections": _known(peer.detections),
                "found": _known(peer.found),
                "points": _known(peer.points),
            }
        )
    return {
        "name": case.name,
        **asdict(ours),
        "goal_ms": case.goal_ms,
        "found": _known(case.found),
        "points": _known(case.points),
        "peers": peers,
    }


def _known(count: int) -> int | None:
    return None if count < 0 else count


def _work(rig: Rig, medians: dict[str, float], top: Ceilings) -> list[dict[str, Any]]:
    """Bytes and flops of the two stages that everything hangs on, per second and as shares of the ceilings."""
    board = Scene(rig, 1).rig.radars[RADARS[0]]
    bins, points = rig.settings.heatmap.angle_bins, board.schedule.layout.samples
    asked: dict[str, Work] = {
        "heatmap": heatmap_work(board, rig.settings.heatmap, points),
        "CFAR CA with peaks": ring_work(rig.settings.cfar, bins, points),
    }
    rows = []
    for name, work in asked.items():
        gb_s, gflop_s = work.bytes / medians[name] / 1e6, work.flops / medians[name] / 1e6
        rows.append(
            {
                "stage": name,
                "megabytes": work.bytes / 1e6,
                "gb_s": gb_s,
                "share_of_copy": gb_s / top.cache_gb_s,
                "megaflop": work.flops / 1e6,
                "gflop_s": gflop_s,
                "share_of_peak": gflop_s / top.gflop_s,
            }
        )
    return rows
