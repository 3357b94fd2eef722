# SPDX-License-Identifier: Apache-2.0
"""Starts the second radar half a period after the first, on a monotonic clock, until measured times say that it is so.

Source of the procedure: TI SWRA662A (staggering in time); limits: ``edge/constraints.py``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from edge.drivers.board import Board, StartTimes
from edge.drivers.offset import NS_PER_S, window_of
from edge.drivers.offset import OffsetWatch as OffsetWatch
from edge.errors import LinkError
from edge.frames import RadarId
from edge.rig import Rig

SPIN_S = 5e-3
"""Before the instant of a start the clock is polled for so long: on two busy cores a sleep ended up to 4 ms late."""
ATTEMPTS = 8
"""Starts of both radars before they are given up; a host that is busy for once misses one or two."""
LEAD_PERIODS = 3
"""Whole periods between now and the earliest instant for the second radar."""


class Clock(Protocol):
    """What is needed of a clock; ``MonotonicClock`` is the real one."""

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC."""

    def sleep_until(self, t_ns: int) -> None:
        """Return at this instant, or as soon after it as the host can."""


class MonotonicClock:
    """The host's clock: sleeps, then polls."""

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def sleep_until(self, t_ns: int) -> None:
        """Sleep until 5 ms before, then poll."""
        rest_s = (t_ns - time.monotonic_ns()) / NS_PER_S - SPIN_S
        if rest_s > 0:
            time.sleep(rest_s)
        while time.monotonic_ns() < t_ns:
            pass


@dataclass(frozen=True, slots=True)
class InterleavedStart:
    """How the two radars were started.

    Args:
        times: of each radar.
        offset_s: second after first, modulo the period: middle of what the answers allow.
        spread_s: width of what they allow.
        attempts: starts of both.
    """

    times: dict[RadarId, StartTimes]
    offset_s: float
    spread_s: float
    attempts: int

    def text(self) -> str:
        """For people."""
        again = "" if self.attempts == 1 else f", after {self.attempts} attempts"
        return f"offset {1e3 * self.offset_s:.2f} ms +- {500 * self.spread_s:.2f} ms{again}"


class InterleaveStarter:
    """Starts two armed boards.

    The frames of a board begin a constant delay after its start command, which is the same for boards of one kind. The
    differences of the two boards' send times, of their answers and of their frame reports are therefore three measures
    of one offset; how far they differ is how much the latencies vary. All of them must lie inside the window.

    Args:
        rig: of two radars.
        clock: None: the host's.
        hold_s: as for ``window_of``: duration of a segment, for example.
    Attributes:
        by_hardware: pulses start the frames; both boards are only made to wait for them.
    Raises:
        ConfigError: as ``window_of``.
    """

    def __init__(self, rig: Rig, clock: Clock | None = None, hold_s: float | None = None) -> None:
        self.window = window_of(rig, hold_s)
        self.by_hardware = all(radar.schedule.hardware_trigger for radar in rig.radars.values())
        self._clock: Clock = clock or MonotonicClock()

    def start(self, first: Board, second: Board, rearm: Callable[[], None]) -> InterleavedStart:
        """Start both.

        Args:
            first, second: armed.
            rearm: arms both again after a start that missed the window; they are stopped before. Both, because the
                first one's answer may be what was late.
        Raises:
            DeviceError: of the boards; LinkError: the window was missed in every attempt.
        """
        tried: list[str] = []
        for attempt in range(1, ATTEMPTS + 1):
            reference = first.start()
            if self.by_hardware:
                both: dict[RadarId, StartTimes] = {first.radar: reference, second.radar: second.start()}
                return InterleavedStart(both, self.window.target_s, 0.0, attempt)
            started = self._try(reference, second, first.radar, attempt, tried)
            if started is not None:
                return started
            second.stop()
            first.stop()
            if attempt < ATTEMPTS:
                rearm()
        raise LinkError(
            f"{second.radar} radar could not be started between the bursts of the {first.radar} one",
            value="offsets and their spread " + ", ".join(tried),
            allowed=f"{1e3 * self.window.earliest_s:.2f}..{1e3 * self.window.latest_s:.2f} ms",
            action="the answers of the boards vary too much: end other work on this computer, use a direct cable",
        )

    def _try(
        self, reference: StartTimes, second: Board, reference_radar: RadarId, attempt: int, tried: list[str]
    ) -> InterleavedStart | None:
        """Start the second board once; None: what was measured allows offsets outside the window."""
        self._clock.sleep_until(self._next_start_ns(reference.sent_ns))
        times = second.start()
        low_s, high_s = self._allowed_s(reference, times)
        if not self.window.contains(low_s, high_s):
            tried.append(f"{1e3 * (low_s % self.window.period_s):.2f} + {1e3 * (high_s - low_s):.2f} ms")
            return None
        both: dict[RadarId, StartTimes] = {reference_radar: reference, second.radar: times}
        return InterleavedStart(both, (0.5 * (low_s + high_s)) % self.window.period_s, high_s - low_s, attempt)

    def _next_start_ns(self, reference_ns: int) -> int:
        """Earliest instant at the target offset that leaves time to get ready."""
        period_ns, target_ns = self.window.period_s * NS_PER_S, self.window.target_s * NS_PER_S
        ahead = (self._clock.now_ns() - reference_ns - target_ns) / period_ns
        return reference_ns + round((math.floor(ahead) + LEAD_PERIODS) * period_ns + target_ns)

    @staticmethod
    def _allowed_s(first: StartTimes, second: StartTimes) -> tuple[float, float]:
        """Least and largest offset that the measured instants allow, not modulo the period."""
        offsets = [second.sent_ns - first.sent_ns, second.answered_ns - first.answered_ns]
        if first.frame_ready_ns is not None and second.frame_ready_ns is not None:
            offsets.append(second.frame_ready_ns - first.frame_ready_ns)
        return min(offsets) / NS_PER_S, max(offsets) / NS_PER_S
