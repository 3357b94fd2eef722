# SPDX-License-Identifier: Apache-2.0
"""What waits for the thread that hands results out: windows and shapes before frames, both bounded and counted."""

from __future__ import annotations

import threading
from collections import deque
from typing import Protocol, runtime_checkable

from edge.frames import Shape
from edge.pipeline import FrameResult, WindowResult

Result = FrameResult | WindowResult | Shape


@runtime_checkable
class ShapeSink(Protocol):
    """A sink that takes shapes as they come; those of the live pipeline come after their window, one by one."""

    def shape(self, shape: Shape) -> None:
        """One shape is done."""


class Outbox:
    """A put never waits; the oldest of its kind is dropped when there is no room.

    Args:
        frames, results: frames, and windows and shapes, that may wait.
    Attributes:
        dropped: results that nobody got.
    """

    def __init__(self, frames: int = 32, results: int = 64) -> None:
        self.capacity = frames + results
        self.dropped = 0
        self._frames: deque[Result] = deque()
        self._results: deque[Result] = deque()
        self._limits = {id(self._frames): frames, id(self._results): results}
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._frames) + len(self._results)

    def put(self, result: Result) -> None:
        """Append."""
        with self._changed:
            line = self._frames if isinstance(result, FrameResult) else self._results
            if len(line) >= self._limits[id(line)]:
                line.popleft()
                self.dropped += 1
            line.append(result)
            self._changed.notify()

    def take(self, timeout_s: float) -> Result | None:
        """The oldest window or shape, or else the oldest frame; None when there was nothing for so long."""
        with self._changed:
            if not len(self):
                self._changed.wait(timeout_s)
            for line in (self._results, self._frames):
                if line:
                    return line.popleft()
            return None
