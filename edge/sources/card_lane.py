# SPDX-License-Identifier: Apache-2.0
"""One radar's way from its capture card's receiver to numbered frames, as ``edge/sources/live_cards.py`` keeps it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from edge.drivers.dca1000.assembler import Assembled
from edge.drivers.single_chip import SingleChipDriver
from edge.frames import Layout, LossCause, RadarFrame
from edge.sources.base import Loss
from edge.sources.frame_clock import FrameClock


@dataclass(slots=True)
class Lane:
    """One radar's way from receiver to numbers.

    Args:
        driver: of the radar.
        layout: of its frames.
        clock: of the present recording.
        recording: of the receiver; older ones' frames are nobody's.
        base: number of the recording's frame 0; None: not known yet.
        early: came before ``base`` was known.
        ready: numbered, not yet given, with the instant at which each became ready.
        last_t_ns: of the latest that was numbered; 0: none.
        reached: highest number that was numbered.
    """

    driver: SingleChipDriver
    layout: Layout
    clock: FrameClock
    recording: int = 0
    base: int | None = None
    early: deque[Assembled] = field(default_factory=deque)
    ready: deque[tuple[RadarFrame | Loss, int]] = field(default_factory=deque)
    last_t_ns: int = 0
    reached: int = -1


def time_of(item: RadarFrame | Loss) -> int:
    """Instant of a frame or loss, CLOCK_MONOTONIC in ns."""
    return item.t_ns if isinstance(item, Loss) else item.t_first_chirp_ns


def cause_of(item: Assembled, size: int) -> tuple[LossCause, str]:
    """Why an assembled frame is none."""
    if item.overflow:
        return LossCause.OVERFLOW, "nobody took it in time"
    if item.data is None:
        return LossCause.GAP, "no packet of it came"
    whole = "" if item.whole_chirps is None else f", {item.whole_chirps.sum()} of {len(item.whole_chirps)} chirps whole"
    return LossCause.TRUNCATED, f"{item.missing_bytes} of {size} bytes missing{whole}"
