# SPDX-License-Identifier: Apache-2.0
"""Timing of calls that compete in one process: every one gets the same time, spread over the whole measurement."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from edge.numba_cache import processor as processor

BURST = 5
"""Repetitions in a row, so that most of them find their data in the caches; slow calls are repeated one by one."""
SLOW_NS = 20_000_000
FEWEST = 3


@dataclass(frozen=True, slots=True)
class Timing:
    """Of one call.

    Args:
        median_ms: CPU time of the calling thread over all repetitions: other processes do not count.
        p99_ms: the same without the first repetitions of the bursts, unless a call is so slow that it has no others.
        after_others_ms: median of the first repetitions of a burst, when other calls have just used the caches.
        wall_ms, wall_p99_ms: the same by the wall clock.
        repetitions: how many.
    """

    median_ms: float
    p99_ms: float
    after_others_ms: float
    wall_ms: float
    wall_p99_ms: float
    repetitions: int

    def by_wall(self) -> Timing:
        """For calls that use more than their own thread."""
        return replace(self, median_ms=self.wall_ms, p99_ms=self.wall_p99_ms, after_others_ms=self.wall_ms)


def measure(calls: Mapping[str, Callable[[], object]], budget_s: float) -> dict[str, Timing]:
    """Time bursts of whichever call has had the least time, until the budget is spent and each ran three times.

    Args:
        calls: name -> call without arguments; each is run once before the clock starts.
        budget_s: time for all of them together.
    """
    for call in calls.values():
        call()
    bursts: dict[str, list[list[tuple[int, int]]]] = {name: [] for name in calls}
    used = dict.fromkeys(calls, 0)
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        end_ns = time.perf_counter_ns() + round(budget_s * 1e9)
        while time.perf_counter_ns() < end_ns or min(map(len, bursts.values())) < FEWEST:
            name = min(used, key=used.__getitem__)
            burst = _burst(calls[name])
            bursts[name].append(burst)
            used[name] += sum(wall_ns for _, wall_ns in burst)
    finally:
        if was_enabled:
            gc.enable()
    return {name: _timing(bursts[name]) for name in calls}


def _burst(call: Callable[[], object]) -> list[tuple[int, int]]:
    """Nanoseconds of CPU and by the wall of up to ``BURST`` repetitions."""
    taken: list[tuple[int, int]] = []
    while len(taken) < BURST:
        start_ns, start_cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        call()
        cpu_ns, wall_ns = time.thread_time_ns() - start_cpu_ns, time.perf_counter_ns() - start_ns
        taken.append((max(cpu_ns, 1), max(wall_ns, 1)))
        if wall_ns > SLOW_NS:
            break
    return taken


def _timing(bursts: list[list[tuple[int, int]]]) -> Timing:
    ms = np.array([one for burst in bursts for one in burst]) / 1e6
    repeated = [one for burst in bursts for one in burst[1:]]
    cpu_ms, wall_ms = np.median(ms, axis=0)
    cpu_p99_ms, wall_p99_ms = np.percentile(np.array(repeated) / 1e6 if repeated else ms, 99, axis=0)
    first_ms = np.median([burst[0][0] for burst in bursts]) / 1e6
    return Timing(
        float(cpu_ms), float(cpu_p99_ms), float(first_ms), float(wall_ms), float(wall_p99_ms), repetitions=len(ms)
    )
