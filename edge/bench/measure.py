# SPDX-License-Identifier: Apache-2.0
"""Timing of calls that compete in one process: every one gets the same time, spread over the whole measurement."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

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
        median_ms, p99_ms: over all repetitions.
        after_others_ms: median of the first repetitions of a burst, when other calls have just used the caches.
        repetitions: how many.
    """

    median_ms: float
    p99_ms: float
    after_others_ms: float
    repetitions: int

    @property
    def spread(self) -> float:
        """p99 over median."""
        return self.p99_ms / self.median_ms if self.median_ms > 0 else float("inf")


def measure(calls: Mapping[str, Callable[[], object]], budget_s: float) -> dict[str, Timing]:
    """Time bursts of whichever call has had the least time, until the budget is spent and each ran three times.

    Args:
        calls: name -> call without arguments; each is run once before the clock starts.
        budget_s: time for all of them together.
    """
    for call in calls.values():
        call()
    spent: dict[str, list[int]] = {name: [] for name in calls}
    first: dict[str, list[int]] = {name: [] for name in calls}
    used = dict.fromkeys(calls, 0)
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        end_ns = time.perf_counter_ns() + round(budget_s * 1e9)
        while time.perf_counter_ns() < end_ns or min(map(len, spent.values())) < FEWEST:
            name = min(used, key=used.__getitem__)
            burst = _burst(calls[name])
            spent[name] += burst
            first[name].append(burst[0])
            used[name] += sum(burst)
    finally:
        if was_enabled:
            gc.enable()
    return {name: _timing(spent[name], first[name]) for name in calls}


def _burst(call: Callable[[], object]) -> list[int]:
    """Nanoseconds of up to ``BURST`` repetitions."""
    taken: list[int] = []
    while len(taken) < BURST:
        start_ns = time.perf_counter_ns()
        call()
        taken.append(max(time.perf_counter_ns() - start_ns, 1))
        if taken[-1] > SLOW_NS:
            break
    return taken


def _timing(taken_ns: list[int], first_ns: list[int]) -> Timing:
    ms = np.asarray(taken_ns) / 1e6
    return Timing(
        float(np.median(ms)), float(np.percentile(ms, 99)), float(np.median(np.asarray(first_ns)) / 1e6), len(ms)
    )
