# SPDX-License-Identifier: Apache-2.0
"""When the frames of a live radar began, from arrivals of their first packets that are late by varying amounts.

Frames are periodic and packets are only ever late. Of many arrivals the ones that are least late against an even beat
therefore show the beat: a line through the least late frame of the older and of the newer half of a few seconds, whose
slope is how the radar's clock differs from this host's. Single late arrivals move nothing.
"""

from __future__ import annotations

from collections import deque

from edge.errors import ConfigError

SPAN = 240
"""Frames of the fit: four seconds at 60 frames/s."""
LEAST_FOR_SLOPE = 60
LARGEST_DRIFT = 500e-6
"""Crystals differ by 40e-6; a line with more slope than this is a disturbance."""


class FrameClock:
    """Times of the frames of one recording.

    Args:
        period_s: frame to frame, by the schedule.
        delay_ns: from the first chirp to the arrival of the first packet, at the least.
        span: frames that the fit looks back.
    Raises:
        ConfigError: no period.
    """

    def __init__(self, period_s: float, delay_ns: int = 0, span: int = SPAN) -> None:
        if period_s <= 0 or span < 2:
            raise ConfigError("no frame clock", value=(period_s, span), allowed="period above 0, span of 2 or more")
        self._period_ns, self._delay_ns, self._span = 1e9 * period_s, delay_ns, span
        self.clear()

    def clear(self) -> None:
        """Another recording."""
        self._late: deque[tuple[int, float]] = deque()
        self._origin_ns, self._index, self._offset_ns, self._slope_ns = 0, 0, 0.0, 0.0

    @property
    def known(self) -> bool:
        """Whether a frame has been added."""
        return bool(self._late)

    @property
    def drift(self) -> float:
        """Seconds per second by which the radar's period is longer than the schedule's, by this host's clock."""
        return self._slope_ns / self._period_ns

    def add(self, index: int, arrival_ns: int) -> None:
        """Arrival of the first packet of frame ``index``; indices ascend."""
        if not self._late:
            self._origin_ns = arrival_ns - round(index * self._period_ns)
        self._late.append((index, arrival_ns - self._origin_ns - index * self._period_ns))
        while self._late[0][0] <= index - self._span:
            self._late.popleft()
        self._fit(index)

    def at(self, index: int) -> int:
        """Instant of the first chirp of frame ``index`` on CLOCK_MONOTONIC.

        Raises:
            ConfigError: no frame has been added.
        """
        if not self._late:
            raise ConfigError("a frame clock without frames has no time")
        late_ns = self._offset_ns + self._slope_ns * (index - self._index)
        newest, newest_late_ns = self._late[-1]
        if index == newest:
            late_ns = min(late_ns, newest_late_ns)
        return self._origin_ns + round(index * self._period_ns + late_ns) - self._delay_ns

    def _fit(self, newest: int) -> None:
        oldest = self._late[0][0]
        middle = 0.5 * (oldest + newest)
        index, late_ns = min(self._late, key=lambda frame: frame[1])
        self._index, self._offset_ns, self._slope_ns = index, late_ns, 0.0
        if newest - oldest < LEAST_FOR_SLOPE:
            return
        older = min((frame for frame in self._late if frame[0] <= middle), key=lambda frame: frame[1], default=None)
        newer = min((frame for frame in self._late if frame[0] > middle), key=lambda frame: frame[1], default=None)
        if older is None or newer is None or 4 * (newer[0] - older[0]) < newest - oldest:
            return
        slope_ns = (newer[1] - older[1]) / (newer[0] - older[0])
        if abs(slope_ns) <= LARGEST_DRIFT * self._period_ns:
            self._index, self._offset_ns, self._slope_ns = newer[0], newer[1], slope_ns
