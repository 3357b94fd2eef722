# SPDX-License-Identifier: Apache-2.0
"""Another clock in terms of ours: a straight line under noisy arrivals, robust against queueing delay.

A message stamped by its sender arrives later, never earlier: every pair (remote stamp, local arrival) bounds the true
line from above, and the tightest line below all of them has the clock's drift and the smallest delay as its error.
Pairs from a handshake, which also know when the question left, bound the line from below; then the middle is taken.

Source: S. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock skew from network delay measurements", IEEE
INFOCOM 1999: the line that minimises the summed distance below all points is the edge of their lower convex hull that
spans the mean of the abscissae.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

from edge.config import require

NS_PER_S = 1_000_000_000
WINDOW_S = 120.0
"""Pairs older than this are forgotten: crystals keep their drift to 1 ppm for about so long while they warm up."""
BIN_S = 1.0
"""Of the pairs of so long a time only the tightest is kept."""
REFIT_S = 2.0
"""The slope is found anew so often; a tighter pair in between moves the line, parallel, at once."""
MOST_BINS = 256
"""Twice what the window holds: pairs out of order cannot grow it."""
LARGEST_DRIFT = 500e-6
"""Seconds a second; crystals are within 100 ppm, and a discipline (NTP) slews by up to 500 ppm."""
LEAST_SPAN_S = 5.0
"""Over a shorter time the drift is taken as 0: 1 ms of delay would look like 200 ppm."""
STEP_S = 0.05
"""An arrival so much before what the line says is impossible: the remote clock was set, or its host restarted."""
LATE_S, LATE_FOR_S = 2.0, 5.0
"""All pairs of so long a time this late are no queue, which would have emptied: the remote clock was set back."""


@dataclass(slots=True)
class _Line:
    """Bounds of one side; the tightest of each bin, as (remote, local - remote), both counted from the first pair."""

    sign: int  # +1: bounds from above, the least offset is the tightest; -1: from below
    points: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=MOST_BINS))
    first_in_bin: int = 0
    slope: float = 0.0
    offset: float = 0.0
    fitted_at: int = 0
    stale: bool = True

    def add(self, remote: int, offset: int) -> None:
        if self.points and 0 <= remote - self.first_in_bin < BIN_S * NS_PER_S:
            if self.sign * (offset - self.points[-1][1]) >= 0:
                return
            self.points.pop()
        else:
            self.first_in_bin = remote
            while self.points and remote - self.points[0][0] > WINDOW_S * NS_PER_S:
                self.points.popleft()
        self.points.append((remote, offset))
        if len(self.points) < 2 or abs(remote - self.fitted_at) >= REFIT_S * NS_PER_S:
            self.fitted_at, self.stale = remote, True
        elif not self.stale:
            bounds = self.sign * self.offset, self.sign * (offset - self.slope * remote)
            self.offset = self.sign * min(bounds)

    def at(self, remote: int) -> float:
        """Offset there, in ns."""
        if self.stale:
            self.slope, self.offset = self._fit()
            self.stale = False
        return self.offset + self.slope * remote

    def _fit(self) -> tuple[float, float]:
        points = [(x, self.sign * y) for x, y in sorted(self.points)]
        slope = 0.0
        if points[-1][0] - points[0][0] >= LEAST_SPAN_S * NS_PER_S:
            slope = min(LARGEST_DRIFT, max(-LARGEST_DRIFT, _edge_slope(_lower_hull(points), points)))
        offset = min(y - slope * x for x, y in points)
        return self.sign * slope, self.sign * offset


class ClockFit:
    """Maps times of a remote clock to ours. Costs O(1) a pair and a fit of 120 points every 2 s.

    Without ``add_exchange`` the smallest delay of the way stays in the result: poses look that much too late.

    Attributes:
        pairs: accepted so far.
        steps: how often the remote clock turned out to be another one, so that the fit began anew.
    """

    def __init__(self) -> None:
        self.pairs = self.steps = 0
        self._clear()

    def _clear(self) -> None:
        self._origin_remote = self._origin_local = self._last = 0
        self._late_since_ns: int | None = None
        self._above, self._below = _Line(+1), _Line(-1)

    @property
    def ready(self) -> bool:
        """Whether a time can be mapped."""
        return bool(self._above.points)

    @property
    def span_s(self) -> float:
        """Time that the pairs of the fit cover."""
        points = self._above.points
        return (self._last - points[0][0]) / NS_PER_S if points else 0.0

    @property
    def drift(self) -> float:
        """How much faster our clock runs than the remote one, s/s; 0 until ``LEAST_SPAN_S`` are covered."""
        if not self.ready:
            return 0.0
        ahead = NS_PER_S
        return (self._offset(self._last + ahead) - self._offset(self._last)) / ahead

    @property
    def uncertainty_ns(self) -> int | None:
        """Half the gap between the bounds at the newest pair; None without a handshake: the least delay is unknown."""
        if not (self._above.points and self._below.points):
            return None
        return max(0, round((self._above.at(self._last) - self._below.at(self._last)) / 2))

    def add(self, remote_ns: int, arrival_ns: int) -> bool:
        """A message stamped ``remote_ns`` by the remote clock arrived at ``arrival_ns`` of ours.

        Returns:
            False when this pair cannot be of the clock so far, which was set or restarted: the fit begins anew with it.
        """
        same = self._same_clock(remote_ns, arrival_ns)
        if not same:
            self.steps += 1
            self._clear()
        if not self.ready:
            self._origin_remote, self._origin_local = remote_ns, arrival_ns
        remote = remote_ns - self._origin_remote
        self._above.add(remote, arrival_ns - self._origin_local - remote)
        self._last = max(self._last, remote)
        self.pairs += 1
        return same

    def add_exchange(self, sent_ns: int, remote_ns: int, answered_ns: int) -> bool:
        """A question left at ``sent_ns`` of ours, was stamped ``remote_ns``, and its answer arrived at ``answered_ns``.

        Returns:
            As ``add``.
        Raises:
            ConfigError: answered before it was asked.
        """
        require(sent_ns <= answered_ns, "handshake answered at", answered_ns, f">= {sent_ns} ns, when it was sent")
        same = self.add(remote_ns, answered_ns)
        remote = remote_ns - self._origin_remote
        self._below.add(remote, sent_ns - self._origin_local - remote)
        return same

    def to_local_ns(self, remote_ns: int) -> int:
        """Our time of a remote instant.

        Raises:
            ConfigError: no pair yet.
        """
        require(self.ready, "clock fit", 0, "a pair of times before the first instant is mapped")
        remote = remote_ns - self._origin_remote
        return self._origin_local + remote + round(self._offset(remote))

    def _offset(self, remote: int) -> float:
        above = self._above.at(remote)
        return (above + self._below.at(remote)) / 2 if self._below.points else above

    def _same_clock(self, remote_ns: int, arrival_ns: int) -> bool:
        """Whether the pair can be of the clock fitted so far."""
        if not self.ready:
            return True
        late_ns = arrival_ns - self.to_local_ns(remote_ns)
        allowed_ns = LARGEST_DRIFT * max(0, remote_ns - self._origin_remote - self._last)
        if late_ns <= LATE_S * NS_PER_S:
            self._late_since_ns = None
            return late_ns >= -(STEP_S * NS_PER_S + allowed_ns)
        if self._late_since_ns is None:
            self._late_since_ns = arrival_ns
        return arrival_ns - self._late_since_ns < LATE_FOR_S * NS_PER_S


def _lower_hull(points: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Lower convex hull of points in ascending order (A. Andrew 1979, monotone chain); integers, so exact."""
    hull: list[tuple[int, int]] = []
    for x, y in points:
        if hull and hull[-1][0] == x:
            if hull[-1][1] <= y:
                continue
            hull.pop()
        while len(hull) >= 2:
            (ax, ay), (bx, by) = hull[-2], hull[-1]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            hull.pop()
        hull.append((x, y))
    return hull


def _edge_slope(hull: list[tuple[int, int]], points: list[tuple[int, int]]) -> float:
    """Slope of the hull's edge over the mean abscissa."""
    mean = sum(x for x, _ in points) / len(points)
    for (ax, ay), (bx, by) in pairwise(hull):
        if bx >= mean:
            return (by - ay) / (bx - ax)
    return 0.0
