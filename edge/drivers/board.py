# SPDX-License-Identifier: Apache-2.0
"""What every radar board can be asked to do, whatever its protocol."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from edge.frames import RadarId

Progress = Callable[[str, int, int], None]
"""Called with what is being done, steps done and steps in all."""


@dataclass(frozen=True, slots=True)
class StartTimes:
    """When a board was started, on this host's CLOCK_MONOTONIC.

    Args:
        sent_ns: the start command had left.
        answered_ns: its answer was there; the first chirp lies between the two, or a constant delay after them.
        frame_ready_ns: the board's own report that frames run was there; None: it gives none.
    """

    sent_ns: int
    answered_ns: int
    frame_ready_ns: int | None = None


@runtime_checkable
class Board(Protocol):
    """One radar with what captures its samples. Methods are called from one thread, in the order of this list.

    Every method ends within a stated time. All but ``plan`` and ``close`` raise DeviceError: LinkError (no answer, or
    too late), RefusalError (the board said no, and why), FirmwareError.
    """

    radar: RadarId

    def plan(self) -> list[str]:
        """Every byte and line that ``connect`` to ``stop`` send, in order, readable; nothing is opened."""

    def connect(self) -> None:
        """Reach the board, and see that it is the one that the rig describes."""

    def configure(self, progress: Progress) -> list[str]:
        """Write the schedule to it; notes for the log: versions, calibration status, temperatures."""

    def arm(self, frames: int) -> None:
        """Everything up to the moment before frames start; ``frames`` 0: until they are stopped."""

    def start(self) -> StartTimes:
        """The one call whose instant matters."""

    def stop(self) -> None:
        """End frames and recording; ``arm`` may follow."""

    def close(self) -> None:
        """Let go of the board; never raises, never hangs."""
