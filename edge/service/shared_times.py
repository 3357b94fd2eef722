# SPDX-License-Identifier: Apache-2.0
"""Times of stages that several threads measure, and the least of an interval for the load shedder."""

from __future__ import annotations

import threading

from edge.timing import Histogram, StageTime, StageTimes


class SharedTimes(StageTimes):
    """``StageTimes`` for many threads."""

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()
        self._least_us: dict[str, float] = {}

    def record(self, stage: str, duration_us: float) -> None:
        """Add one measurement in microseconds."""
        with self._lock:
            super().record(stage, duration_us)
            self._least_us[stage] = min(self._least_us.get(stage, duration_us), duration_us)

    def take_least_s(self, stage: str) -> float | None:
        """Least measurement of a stage since the last call, seconds; None: there was none."""
        with self._lock:
            least_us = self._least_us.pop(stage, None)
        return None if least_us is None else least_us / 1e6

    def summary(self) -> dict[str, StageTime]:
        """Stage name -> summary, in the order in which the stages were first seen."""
        with self._lock:
            return super().summary()

    def histograms(self) -> dict[str, Histogram]:
        """Stage name -> distribution since the start."""
        with self._lock:
            return super().histograms()
