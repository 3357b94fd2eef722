# SPDX-License-Identifier: Apache-2.0
"""Runs the simulator's benchmark and gives its result as plain data: speed, error against the oracle, memory."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from edge.bench.measure import Timing, measure, processor
from edge.frames import RADARS
from train.simulate.bench_peer import direct_delays, direct_frame
from train.simulate.front_end import FrontEnd, FrontEndSettings
from train.simulate.oracle import direct_sum
from train.simulate.scatterers import Scatterers
from train.simulate.synthesis import SHAPES, Synthesizer

if TYPE_CHECKING:
    from edge.rig import Radar, Rig

SCATTERERS = 1000
FRAME_GOAL_MS, BOTH_GOAL_MS, ERROR_GOAL_DB = 1.5, 5.0, -75.0
SPEED_M_S = 0.5
FAST_M_S = 10.0
BURST_SPEEDS_M_S = (0.5, 1.5, 3.0)
LEVEL_LSB = 30.0
MEMORY_FRAMES = 300
PEER_CASE, PEER = "1000 scatterers, one radar, one loop", "HawkEye's method"


@dataclass(frozen=True, slots=True)
class Case:
    """One call to time.

    Args:
        name: row of the table.
        call: without arguments.
        goal_ms: of the median CPU time; None: none.
    """

    name: str
    call: Callable[[], object]
    goal_ms: float | None = None


def scene(radar: Radar, count: int = SCATTERERS, speed_m_s: float = 0.0, seed: int = 0) -> Scatterers:
    """Random points in front of the rig from 3 m to the radar's reach, moving together as a static scene does."""
    rng = np.random.default_rng(seed)
    range_m = rng.uniform(3.0, radar.schedule.profile.usable_range_m - 0.5, count)
    azimuth, elevation = rng.uniform(-1.0, 1.0, count), rng.uniform(-0.2, 0.3, count)
    across = np.cos(elevation)
    direction = np.stack((across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)), axis=1)
    level = LEVEL_LSB * (rng.standard_normal(count) + 1j * rng.standard_normal(count))
    velocity = speed_m_s * np.array([0.2, -1.0, 0.0]) / np.hypot(0.2, 1.0)
    return Scatterers.direct(direction * range_m[:, None], level.astype(np.complex64), velocity)


def with_loops(radar: Radar, loops: int) -> Radar:
    """The radar with another number of loops."""
    return replace(radar, schedule=replace(radar.schedule, loops=loops))


def frame_cases(rig: Rig) -> list[Case]:
    """Frames of one and of both radars."""
    one = with_loops(rig.radars["horizontal"], 1)
    cases = [
        Case(PEER_CASE, framing([one], SCATTERERS), FRAME_GOAL_MS),
        Case("the same, 6 cells to either side", framing([one], SCATTERERS, width=6), FRAME_GOAL_MS),
        Case("the same, moving", framing([one], SCATTERERS, SPEED_M_S)),
        Case("3000 scatterers, one radar, one loop", framing([one], 3 * SCATTERERS)),
    ]
    boards = [with_loops(rig.radars[radar], 8) for radar in RADARS]
    cases.append(Case("1000 scatterers, both radars, 8 loops", framing(boards, SCATTERERS), BOTH_GOAL_MS))
    cases.append(Case("the same, 8 loops moving", framing(boards, SCATTERERS, SPEED_M_S)))
    return cases


def framing(radars: list[Radar], count: int, speed_m_s: float = 0.0, width: int = 4) -> Callable[[], object]:
    """Call that makes a new frame of every radar, with all default faults of the front end."""
    parts = []
    for radar in radars:
        out = np.empty(radar.schedule.layout.shape, dtype=np.int16)
        front_end = FrontEnd(radar, FrontEndSettings(), 0)
        parts.append((Synthesizer(radar, width), scene(radar, count, speed_m_s), front_end, out))
    number = 0

    def call() -> None:
        nonlocal number
        number += 1
        for synthesizer, scatterers, front_end, out in parts:
            synthesizer.frame(scatterers, front_end, number, 0, out=out)

    return call


def run_suite(rig: Rig, seconds: float, builders: tuple[Callable[[Rig], list[Case]], ...] = ()) -> dict[str, Any]:
    """Measure everything.

    Args:
        rig: two cascades.
        seconds: time for the repetitions; compiling, the peer's and the oracle's frames come on top.
        builders: further cases.
    Returns:
        machine, cases, peer, errors, memory.
    """
    cases = [case for build in (frame_cases, *builders) for case in build(rig)]
    one = with_loops(rig.radars["horizontal"], 1)
    rng, points = np.random.default_rng(0), scene(one)
    about = {"processor": processor(), "cores": os.cpu_count() or 1, "load": os.getloadavg()[0], "rig": rig.name}
    times = measure({case.name: case.call for case in cases}, seconds)
    peer = measure({PEER: lambda: direct_frame(one, points, 25.0, rng)}, 0.0)[PEER]
    return {
        "machine": about | {"python": platform.python_version(), "numpy": np.__version__},
        "cases": [{"name": c.name, "goal_ms": c.goal_ms, **asdict(times[c.name])} for c in cases],
        "peer": _peer(one, points, times[PEER_CASE], peer),
        "errors": errors(rig),
        "memory": memory(one),
    }


def _peer(radar: Radar, points: Scatterers, ours: Timing, theirs: Timing) -> dict[str, Any]:
    expected = direct_sum(radar, points)
    return {
        "name": PEER,
        **asdict(theirs),
        "ratio": theirs.median_ms / ours.median_ms,
        "error_db": _rms_db(direct_delays(radar, points)[None], expected),
    }


def errors(rig: Rig) -> list[dict[str, Any]]:
    """Difference to the oracle by width and motion: power over the signal's, and largest sample over the largest."""
    rows = []
    scenes = [(0.0, 1), (SPEED_M_S, 1), (FAST_M_S, 1), *((speed_m_s, 8) for speed_m_s in BURST_SPEEDS_M_S)]
    for speed_m_s, loops in scenes:
        one = with_loops(rig.radars["horizontal"], loops)
        points = scene(one, SCATTERERS // loops, speed_m_s)
        name = f"{len(points)} at {speed_m_s:g} m/s, {loops} loop{'s' * (loops > 1)}" if speed_m_s else "still"
        expected = direct_sum(one, points)
        for width in SHAPES:
            found = Synthesizer(one, width).beat(points)
            largest_db = 20.0 * np.log10(np.abs(found - expected).max() / np.abs(expected).max())
            row = {"scene": name, "width": width, "rms_db": _rms_db(found, expected), "largest_db": float(largest_db)}
            rows.append(row | {"goal_db": ERROR_GOAL_DB})
    return rows


def _rms_db(found: Any, expected: Any) -> float:
    return float(20.0 * np.log10(np.linalg.norm(found - expected) / np.linalg.norm(expected)))


def memory(radar: Radar) -> dict[str, Any]:
    """Resident memory before and after many frames."""
    call = framing([radar], SCATTERERS, SPEED_M_S)
    call()
    before_mb = resident_mb()
    for _ in range(MEMORY_FRAMES):
        call()
    return {"frames": MEMORY_FRAMES, "before_mb": before_mb, "after_mb": resident_mb()}


def resident_mb() -> float:
    """Resident memory of this process."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
