# SPDX-License-Identifier: Apache-2.0
"""How long each stage takes: the last few thousand measurements of every stage, and their percentiles."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

KEPT = 4096


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


class StageTimes:
    """Wall-clock time of named stages; memory is bounded whatever the run's length."""

    def __init__(self) -> None:
        self._kept: dict[str, np.ndarray] = {}
        self._count: dict[str, int] = {}
        self._max: dict[str, float] = {}
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
        self.last_us[stage] = round(duration_us)

    def summary(self) -> dict[str, StageTime]:
        """Stage name -> summary, in the order in which the stages were first seen."""
        result = {}
        for stage, kept in self._kept.items():
            count = self._count[stage]
            p50_us, p99_us = np.percentile(kept[: min(count, KEPT)], (50, 99))
            result[stage] = StageTime(count, float(p50_us), float(p99_us), self._max[stage])
        return result
