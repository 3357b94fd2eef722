# SPDX-License-Identifier: Apache-2.0
"""Exact accounting of frames: ``frames_in = frames_ok + sum(lost[cause])``, per radar, always."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from edge.errors import RfconstructError
from edge.frames import LossCause, RadarId


@dataclass(frozen=True, slots=True)
class LedgerSnapshot:
    """The counters of one radar at one instant.

    Args:
        radar: whose frames.
        frames_in: frames that came, and frames that were known to be missing.
        frames_ok: frames that became a result.
        lost: frames that did not, by cause; causes that never occurred are absent.
    """

    radar: RadarId
    frames_in: int
    frames_ok: int
    lost: Mapping[LossCause, int]

    @property
    def frames_lost(self) -> int:
        """Sum over all causes."""
        return sum(self.lost.values())

    @property
    def pending(self) -> int:
        """Frames that are still under way."""
        return self.frames_in - self.frames_ok - self.frames_lost

    @property
    def balanced(self) -> bool:
        """True when nothing is under way: ``frames_in = frames_ok + sum(lost)``."""
        return self.pending == 0

    def check(self) -> None:
        """Raise RfconstructError unless the ledger is balanced."""
        if not self.balanced:
            raise RfconstructError(
                f"{self.radar}: frames do not add up, {self.pending} unaccounted for",
                value=self.as_dict(),
                allowed="frames_in = frames_ok + sum of lost",
                action="this is a defect of the software: report it with the recording",
            )

    def as_dict(self) -> dict[str, object]:
        """Plain numbers for JSON and the status message."""
        return {
            "radar": self.radar,
            "frames_in": self.frames_in,
            "frames_ok": self.frames_ok,
            "frames_lost": self.frames_lost,
            "frames_pending": self.pending,
            "lost": {cause.value: count for cause, count in self.lost.items()},
        }


class FrameLedger:
    """Counts what became of one radar's frames; any thread may write, each frame is closed exactly once.

    Args:
        radar: whose frames.
    """

    def __init__(self, radar: RadarId) -> None:
        self.radar = radar
        self._lock = threading.Lock()
        self._frames_in = 0
        self._frames_ok = 0
        self._lost: Counter[LossCause] = Counter()

    def frame_in(self, count: int = 1) -> None:
        """``count`` frames came in."""
        with self._lock:
            self._frames_in += _positive(count)

    def ok(self, count: int = 1) -> None:
        """``count`` frames became a result; RfconstructError when so many were not under way."""
        with self._lock:
            self._close(count)
            self._frames_ok += count

    def lost(self, cause: LossCause, count: int = 1) -> None:
        """``count`` frames were lost; RfconstructError when so many were not under way."""
        with self._lock:
            self._close(count)
            self._lost[cause] += count

    def missing(self, cause: LossCause = LossCause.GAP, count: int = 1) -> None:
        """``count`` frames never arrived as frames: counted in and lost in one step."""
        with self._lock:
            self._frames_in += _positive(count)
            self._lost[cause] += count

    def snapshot(self) -> LedgerSnapshot:
        """Counters that belong together."""
        with self._lock:
            return LedgerSnapshot(self.radar, self._frames_in, self._frames_ok, MappingProxyType(dict(self._lost)))

    @property
    def balanced(self) -> bool:
        """True when no frame is under way."""
        return self.snapshot().balanced

    def check(self) -> None:
        """Raise RfconstructError unless every frame that came in was closed."""
        self.snapshot().check()

    def _close(self, count: int) -> None:
        pending = self._frames_in - self._frames_ok - sum(self._lost.values())
        if _positive(count) > pending:
            raise RfconstructError(
                f"{self.radar}: a frame was accounted for twice",
                value=count,
                allowed=f"at most the {pending} under way",
                action="this is a defect of the software: report it with the recording",
            )


def _positive(count: int) -> int:
    if count < 1:
        raise RfconstructError("frames are counted by positive numbers", value=count, allowed=">= 1")
    return count
