# SPDX-License-Identifier: Apache-2.0
"""How two radars that take turns stand to each other: the window of allowed offsets, and a watch on offset and drift.

The two boards run by their own crystals, so the offset between their bursts drifts: 40 ppm close a guard of 4 ms in a
hundred seconds. Limits: ``edge/constraints.py``.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from edge.constraints import RANGE_BIN_TOLERANCE, guard_s, start_offset_s
from edge.errors import ConfigError
from edge.frames import RADARS, RadarId
from edge.rig import Rig
from edge.waveform import Schedule

NS_PER_S = 1e9
REARM_LEAD_S = 5.0
"""A re-arm is due so long before the guard can close: stop and start take 0.1 s (demo) to 3 s (cascade)."""
FIT_S = 20.0
"""Frames of this span give the line; 1 ms of jitter at 60 frames/s then leaves 5 ppm of drift."""
LEAST_ERROR = 5e-6
"""Of a drift: times of live frames come from a fit themselves, so that their errors last for seconds (20 ppm were seen
on a busy computer between clocks that were equal)."""
LEAST_FRAMES = 30
"""Fewer give no offset: half a second at 60 frames/s."""


@dataclass(frozen=True, slots=True)
class OffsetWindow:
    """Offsets of the second radar's bursts after the first one's at which they never meet.

    Args:
        period_s: of both radars, as their registers have it.
        burst_first_s, burst_second_s: first to last chirp.
        guard_s: least silence between two bursts.
    """

    period_s: float
    burst_first_s: float
    burst_second_s: float
    guard_s: float

    @property
    def earliest_s(self) -> float:
        """Lower edge: the first radar's burst and the guard are over."""
        return self.burst_first_s + self.guard_s

    @property
    def latest_s(self) -> float:
        """Upper edge: the second radar's burst and the guard still fit before the first radar's next burst."""
        return self.period_s - self.burst_second_s - self.guard_s

    @property
    def target_s(self) -> float:
        """The middle; half a period for equal bursts."""
        return 0.5 * (self.earliest_s + self.latest_s)

    def contains(self, low_s: float, high_s: float) -> bool:
        """Whether all offsets between the two, taken modulo the period, lie inside."""
        start_s = low_s % self.period_s
        return self.earliest_s <= start_s and start_s + (high_s - low_s) <= self.latest_s

    def overlap_s(self, offset_s: float) -> float:
        """Time that both radars transmit at once in every period; 0: never."""
        offset_s %= self.period_s
        first = self.burst_first_s - offset_s
        second = offset_s + self.burst_second_s - self.period_s
        return max(0.0, min(first, self.burst_second_s)) + max(0.0, min(second, self.burst_first_s))


def window_of(rig: Rig, hold_s: float | None = None) -> OffsetWindow:
    """The window of a rig of two radars.

    Args:
        rig: both schedules and the interleave settings.
        hold_s: the guard holds for so long against the largest drift; 0: for now; None: until the rig's next re-arm.
    Raises:
        ConfigError: one radar; different periods or range bins; bursts that do not fit.
    """
    if len(rig.radars) < len(RADARS):
        raise ConfigError(f"rig {rig.name} has one radar: nothing to interleave", value=list(rig.radars))
    first, second = (rig.radars[radar].schedule for radar in RADARS)
    bins = first.profile.range_bin_m, second.profile.range_bin_m
    if abs(bins[0] - bins[1]) > RANGE_BIN_TOLERANCE * min(bins):
        raise ConfigError(
            f"the radars of rig {rig.name} have different range bins",
            value=f"{100 * bins[0]:.3f} and {100 * bins[1]:.3f} cm",
            allowed="within 1 %",
            action="give both radars the same slope, samples and sample rate",
        )
    if first.frame_registers().period != second.frame_registers().period:
        raise ConfigError(f"the radars of rig {rig.name} have different periods", action="give both the same one")
    held_s = rig.interleave.rearm_s if hold_s is None else min(hold_s, rig.interleave.rearm_s)
    return _window(first, second, guard_s(rig.interleave.drift_s_per_s, held_s))


def _window(first: Schedule, second: Schedule, guard: float) -> OffsetWindow:
    window = OffsetWindow(first.frame_period_s_actual, first.burst_s, second.burst_s, guard)
    if window.latest_s < window.earliest_s:
        raise ConfigError(
            "two bursts and their guards do not fit into one period",
            value=f"{1e3 * (first.burst_s + second.burst_s + 2 * guard):.3f} ms",
            allowed=f"{1e3 * window.period_s:.3f} ms",
            action="fewer loops, a longer period or re-arming more often",
        )
    assert math.isclose(window.target_s, start_offset_s(first, second), rel_tol=1e-9)
    return window


class PhaseLine:
    """Line through (frame number, instant), by least squares over the last ``span_s``; sums are exact integers.

    Args:
        span_s: frames older than the newest by more are forgotten.
    """

    def __init__(self, span_s: float = FIT_S) -> None:
        self._span_ns = round(span_s * NS_PER_S)
        self.clear()

    def clear(self) -> None:
        """Forget all frames: the radar was started anew."""
        self._frames: deque[tuple[int, int]] = deque()
        self._origin = (0, 0)
        self._sums = [0, 0, 0, 0, 0]
        """Of 1, n, t, n n, n t, and below of t t: relative to the origin."""
        self._t_t = 0

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def newest(self) -> tuple[int, int]:
        """Number and instant of the newest frame."""
        return self._frames[-1]

    def add(self, number: int, t_ns: int) -> None:
        """One frame; numbers ascend."""
        if not self._frames:
            self._origin = (number, t_ns)
        self._frames.append((number, t_ns))
        self._count(number, t_ns, 1)
        while t_ns - self._frames[0][1] > self._span_ns:
            self._count(*self._frames.popleft(), -1)

    def fit(self) -> tuple[float, float, float]:
        """Instant of the newest number in ns after the origin's, ns per number, standard error of the latter."""
        count, n, t, n_n, n_t = self._sums
        spread = count * n_n - n * n
        slope = (count * n_t - n * t) / spread
        newest = self._frames[-1][0] - self._origin[0]
        value = (t + slope * (count * newest - n)) / count
        residual = (count * self._t_t - t * t) / count - slope * slope * spread / count
        error = math.sqrt(max(residual, 0.0) / max(count - 2, 1) * count / spread)
        return value, slope, error

    @property
    def origin_ns(self) -> int:
        """Instant that ``fit`` counts from."""
        return self._origin[1]

    def _count(self, number: int, t_ns: int, sign: int) -> None:
        n, t = number - self._origin[0], t_ns - self._origin[1]
        for index, value in enumerate((1, n, t, n * n, n * t)):
            self._sums[index] += sign * value
        self._t_t += sign * t * t


@dataclass(frozen=True, slots=True)
class Offset:
    """How two radars stand to each other.

    Args:
        offset_s: second after first, modulo the period.
        drift: of the offset, seconds per second; positive: the second radar's clock is the slower one.
        drift_error: its standard error.
        closes_in_s: time until the least guard can be used up, with three standard errors of drift (5 ppm at least);
            0: it is used up.
        overlap_s: time that both transmit at once in every period.
    """

    offset_s: float
    drift: float
    drift_error: float
    closes_in_s: float
    overlap_s: float

    def text(self) -> str:
        """For people."""
        drift = f"{1e6 * self.drift:+.1f} ppm +- {1e6 * self.drift_error:.1f}"
        closes = "never" if math.isinf(self.closes_in_s) else f"{self.closes_in_s:.0f} s"
        hit = f", OVERLAP {1e3 * self.overlap_s:.2f} ms" if self.overlap_s > 0 else ""
        return f"offset {1e3 * self.offset_s:.2f} ms, drift {drift}, guard closes in {closes}{hit}"


class OffsetWatch:
    """Measures the offset from the instants of both radars' frames.

    Args:
        rig: of two radars.
    Attributes:
        last: newest measurement; None: too few frames yet.
        overlaps: measurements at which bursts met.
    Raises:
        ConfigError: as ``window_of``.
    """

    def __init__(self, rig: Rig) -> None:
        self.window = window_of(rig, hold_s=0.0)
        self.last: Offset | None = None
        self._largest_drift = rig.interleave.drift_s_per_s
        self._lines: dict[RadarId, PhaseLine] = {radar: PhaseLine() for radar in RADARS}
        self.overlaps = 0

    def add(self, radar: RadarId, number: int, t_first_chirp_ns: int) -> None:
        """One frame, by this host's clock."""
        self._lines[radar].add(number, t_first_chirp_ns)

    def restarted(self, radar: RadarId) -> None:
        """A radar was started anew: its frames begin another line."""
        self._lines[radar].clear()
        self.last = None

    def measure(self) -> Offset | None:
        """The offset now; None: too few frames."""
        first, second = (self._lines[radar] for radar in RADARS)
        if min(len(first), len(second)) < LEAST_FRAMES:
            return self.last
        at_first, step_first, error_first = first.fit()
        at_second, step_second, error_second = second.fit()
        behind_ns = (at_second - at_first) + (second.origin_ns - first.origin_ns)
        periods = behind_ns / step_first
        offset_s = (periods - math.floor(periods)) * self.window.period_s
        drift = (step_second - step_first) / step_first
        error = math.hypot(error_first, error_second) / step_first
        overlap_s = self.window.overlap_s(offset_s)
        self.overlaps += overlap_s > 0
        self.last = Offset(offset_s, drift, error, self._closes_in_s(offset_s, drift, error), overlap_s)
        return self.last

    @property
    def rearm_due(self) -> bool:
        """Whether the second radar should be started anew, before the guard closes; of the last measurement."""
        return self.last is not None and self.last.closes_in_s <= REARM_LEAD_S

    @property
    def overlap(self) -> bool:
        """Whether both radars transmit at once; of the last measurement."""
        return self.last is not None and self.last.overlap_s > 0.0

    def _closes_in_s(self, offset_s: float, drift: float, error: float) -> float:
        """Until an edge of the window is reached; before the drift is known, with the largest that the rig allows."""
        if 3 * error > self._largest_drift:
            drift, error = 0.0, self._largest_drift / 3
        error = max(error, LEAST_ERROR)
        up, down = drift + 3 * error, -drift + 3 * error
        above, below = self.window.latest_s - offset_s, offset_s - self.window.earliest_s
        if above <= 0 or below <= 0:
            return 0.0
        return min(above / up if up > 0 else math.inf, below / down if down > 0 else math.inf)
