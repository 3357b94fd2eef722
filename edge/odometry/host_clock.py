# SPDX-License-Identifier: Apache-2.0
"""This host's clocks against CLOCK_MONOTONIC, and whether something (PTP, GPS, NTP) keeps its UTC right."""

from __future__ import annotations

import ctypes
import time
from dataclasses import dataclass
from typing import Literal

HostClock = Literal["monotonic", "realtime", "tai"]
SAMPLES = 5
"""Brackets of which the narrowest counts: one of five is not interrupted."""
_CLOCKS: dict[str, int] = {"realtime": time.CLOCK_REALTIME, "tai": getattr(time, "CLOCK_TAI", 11)}
_TIMEX_BYTES = 512  # struct timex is 208 bytes on 64-bit Linux
_TIME_ERROR = 5  # adjtimex(2): clock not synchronised


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Difference of a clock of this host and CLOCK_MONOTONIC at one instant.

    Args:
        offset_ns: add to that clock's time to get CLOCK_MONOTONIC.
        uncertainty_ns: half the time between the two readings around it.
    """

    offset_ns: int
    uncertainty_ns: int


def offset_to_monotonic(clock: HostClock) -> ClockOffset:
    """The clock read between two readings of CLOCK_MONOTONIC; exact 0 for "monotonic" itself."""
    if clock == "monotonic":
        return ClockOffset(0, 0)
    best: ClockOffset | None = None
    for _ in range(SAMPLES):
        before_ns = time.monotonic_ns()
        other_ns = time.clock_gettime_ns(_CLOCKS[clock])
        after_ns = time.monotonic_ns()
        half_ns = (after_ns - before_ns + 1) // 2
        if best is None or half_ns < best.uncertainty_ns:
            best = ClockOffset(before_ns + half_ns - other_ns, half_ns)
    assert best is not None
    return best


def utc_synchronised() -> bool:
    """Whether the kernel holds its UTC to be synchronised; False where that cannot be asked."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        state = int(libc.adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)))
    except (OSError, AttributeError):
        return False
    return 0 <= state < _TIME_ERROR


def tai_is_set() -> bool:
    """Whether the kernel knows TAI - UTC (37 s since 2017): without PTP or a leap second file CLOCK_TAI equals UTC."""
    tai_ns, utc_ns = time.clock_gettime_ns(_CLOCKS["tai"]), time.time_ns()
    return tai_ns - utc_ns > 1_000_000_000
