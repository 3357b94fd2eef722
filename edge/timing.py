# SPDX-License-Identifier: Apache-2.0
"""How long each stage takes: percentiles of its last few thousand measurements, and a histogram since the start."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

KEPT = 4096
BOUNDS_US = tuple(float(digit * 10**power) for power in range(1, 7) for digit in (1, 2, 5))
"""Upper bounds of the histogram's buckets: 10 us to 5 s in steps of 1, 2, 5; one bucket more takes the rest."""


@dataclass(frozen=True, slots=True)
class StageTime:
    """Summary of one stage.

    Args:
        count: measurements since the start.
        p50_us, p99_us: percentiles of the last 4096 measurements, microseconds.
        max_us: longest since the start.
    """

    count: int
    p50_us: float
    p99_us: float
    max_us: float


@dataclass(frozen=True, slots=True)
class Histogram:
    """Distribution of one stage's durations since the start.

    Args:
        counts: measurements in every bucket, one more than ``BOUNDS_US``; bound i is the last that bucket i takes.
        sum_us: sum of all measurements, microseconds.
    """

    counts: tuple[int, ...]
    sum_us: float


class StageTimes:
    """Wall-clock time of named stages; memory is bounded whatever the run's length."""

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}
        self._count: dict[str, int] = {}
        self._max: dict[str, float] = {}
        self._buckets: dict[str, list[int]] = {}
        self._sum: dict[str, float] = {}
        self.last_us: dict[str, int] = {}
        """Last measurement of every stage, whole microseconds."""

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Time the body as one measurement of ``stage``; a body that raises is not counted."""
        start_ns = time.perf_counter_ns()
        yield
        self.record(stage, (time.perf_counter_ns() - start_ns) / 1e3)

    def record(self, stage: str, duration_us: float) -> None:
        """Add one measurement in microseconds."""
        kept = self._kept.setdefault(stage, np.zeros(KEPT, dtype=np.float32))
        count = self._count.get(stage, 0)
        kept[count % KEPT] = duration_us
        self._count[stage] = count + 1
        self._max[stage] = max(self._max.get(stage, 0.0), duration_us)
        self._sum[stage] = self._sum.get(stage, 0.0) + duration_us
        self._buckets.setdefault(stage, [0] * (len(BOUNDS_US) + 1))[bisect_left(BOUNDS_US, duration_us)] += 1
        self.last_us[stage] = round(duration_us)

    def summary(self) -> dict[str, StageTime]:
        """Stage name -> summary, in the order in which the stages were first seen."""
        result = {}
        for stage, kept in self._kept.items():
            count = self._count[stage]
            p50_us, p99_us = np.percentile(kept[: min(count, KEPT)], (50, 99))
            result[stage] = StageTime(count, float(p50_us), float(p99_us), self._max[stage])
        return result

    def histograms(self) -> dict[str, Histogram]:
        """Stage name -> distribution since the start."""
        return {stage: Histogram(tuple(counts), self._sum[stage]) for stage, counts in list(self._buckets.items())}
