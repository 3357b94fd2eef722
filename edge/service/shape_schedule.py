# SPDX-License-Identifier: Apache-2.0
"""Which objects are completed when: at most so many shapes a second of each, and a final one when it has left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from edge.frames import ObjectCloud

NS_PER_S = 1_000_000_000
SHAPES_HZ = 4.0
LEFT_S = 0.6
"""An object that two segmentations in a row do not show has left."""
FADING = 0.5
"""Below this share of the most points it had, an object is leaving the window and shows nothing new."""


@dataclass(slots=True)
class _Seen:
    best: ObjectCloud
    seen_ns: int
    asked_ns: int | None = None


class ShapeSchedule:
    """Follows the objects of successive segmentations; all times are those of the measurement, so a replay asks alike.

    Args:
        rate_hz: shapes a second of one object.
        left_s: unseen for so long, an object has left.
    """

    def __init__(self, rate_hz: float = SHAPES_HZ, left_s: float = LEFT_S) -> None:
        self._period_ns, self._left_ns = round(NS_PER_S / rate_hz), round(left_s * NS_PER_S)
        self._seen: dict[int, _Seen] = {}
        self._segmented_ns: int | None = None

    def __len__(self) -> int:
        return len(self._seen)

    @property
    def identities(self) -> list[int]:
        """Objects in view."""
        return list(self._seen)

    def due(self, t_ns: int, slower: int = 1) -> bool:
        """Whether the newest travel should be segmented at this frame.

        Args:
            t_ns: instant of the frame.
            slower: factor on the period.
        """
        return self._segmented_ns is None or not 0 <= t_ns - self._segmented_ns < slower * self._period_ns

    def see(self, objects: Sequence[ObjectCloud], t_ns: int, slower: int = 1) -> list[ObjectCloud]:
        """Take one segmentation.

        Args:
            objects: what it found.
            t_ns: end of its window.
            slower: factor on the period.
        Returns:
            What is to be completed now; ``final`` for objects that have left, made of their richest window.
        """
        self._segmented_ns = t_ns
        asked = []
        for cloud in objects:
            seen = self._seen.setdefault(cloud.identity, _Seen(cloud, t_ns))
            seen.seen_ns = t_ns
            if len(cloud) >= len(seen.best):
                seen.best = cloud
            early = seen.asked_ns is not None and t_ns - seen.asked_ns < slower * self._period_ns
            if not early and len(cloud) >= FADING * len(seen.best):
                seen.asked_ns = t_ns
                asked.append(cloud)
        left = [i for i, seen in self._seen.items() if t_ns - seen.seen_ns > slower * self._left_ns]
        return asked + [self._final(identity) for identity in left]

    def leave(self) -> list[ObjectCloud]:
        """Nothing more will come of what is in view: the final ones of all."""
        self._segmented_ns = None
        return [self._final(identity) for identity in list(self._seen)]

    def _final(self, identity: int) -> ObjectCloud:
        return replace(self._seen.pop(identity).best, final=True)
