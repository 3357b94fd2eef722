# SPDX-License-Identifier: Apache-2.0
"""Sheds load in stated steps when the machine cannot follow, and takes it back later than it gave it up.

The sign of overload is a standing queue: the least delay of an interval, not its largest, since a queue that only now
and then fills does no harm (Nichols and Jacobson, Controlling Queue Delay, ACM Queue 2012).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Step(IntEnum):
    """What is left out; every step includes those before it."""

    NOTHING = 0
    VIEWER = 1
    """No heatmaps are published, and every fourth frame's detections only."""
    HALF_SHAPES = 2
    """Objects are segmented and completed half as often."""
    HALF_PAIRS = 3
    """Every second frame pair is lost by cause ``shed``."""
    DETECTIONS_ONLY = 4
    """Nothing is associated, fused, segmented or completed."""


@dataclass(frozen=True, slots=True)
class ShedSettings:
    """Thresholds.

    Args:
        high_fill, low_fill: of the fullest queue, 0..1: overloaded above, calm below.
        high_delay_s, low_delay_s: least delay from a pair's last byte to its points, likewise.
        high_shape_s: delay of a shape that counts as overload up to step HALF_SHAPES; half of it is calm.
        up_s: overloaded for so long without a break: one step more.
        down_s: calm for so long without a break: one step less.
    """

    high_fill: float = 0.5
    low_fill: float = 0.2
    high_delay_s: float = 0.050
    low_delay_s: float = 0.025
    high_shape_s: float = 0.3
    up_s: float = 0.5
    down_s: float = 3.0


class LoadShedder:
    """Decides the step; knows no clock but the times it is given.

    Args:
        settings: thresholds.
    Attributes:
        step: now.
        changes: times it changed.
    """

    def __init__(self, settings: ShedSettings | None = None) -> None:
        self._settings = settings or ShedSettings()
        self.step, self.changes = Step.NOTHING, 0
        self._overloaded_since_s: float | None = None
        self._calm_since_s: float | None = None

    def update(self, now_s: float, fill: float, delay_s: float | None, shape_s: float | None = None) -> Step:
        """Take one observation.

        Args:
            now_s: its instant; never falls.
            fill: of the fullest queue, 0..1.
            delay_s: least delay of the pairs since the last observation; None: there was no pair.
            shape_s: least delay of the shapes since then; None: there was no shape.
        Returns:
            The step that holds from now on.
        """
        limits = self._settings
        delay_s, shape_s = delay_s or 0.0, shape_s or 0.0
        high = fill > limits.high_fill or delay_s > limits.high_delay_s
        high |= shape_s > limits.high_shape_s and self.step < Step.HALF_SHAPES
        calm = fill < limits.low_fill and delay_s < limits.low_delay_s and shape_s < limits.high_shape_s / 2
        self._overloaded_since_s = (
            (self._overloaded_since_s if self._overloaded_since_s is not None else now_s) if high else None
        )
        self._calm_since_s = (self._calm_since_s if self._calm_since_s is not None else now_s) if calm else None
        if self._overloaded_since_s is not None and now_s - self._overloaded_since_s >= limits.up_s:
            self._move(min(self.step + 1, max(Step)))
        elif self._calm_since_s is not None and now_s - self._calm_since_s >= limits.down_s:
            self._move(max(self.step - 1, min(Step)))
        return self.step

    def _move(self, step: int) -> None:
        """One step; the next one takes its whole time again."""
        self._overloaded_since_s = self._calm_since_s = None
        if step != self.step:
            self.step = Step(step)
            self.changes += 1
