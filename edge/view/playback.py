# SPDX-License-Identifier: Apache-2.0
"""The player behind the scrubber: pause, speed and jumps over a store of messages."""

from __future__ import annotations

import threading
from collections.abc import Iterator

from edge.errors import WireError
from edge.stream.messages import Message
from edge.view.store import MessageStore

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
LOOK_BACK_NS = 30_000_000_000
"""A jump shows objects, windows and path of so long before."""
NEWEST_ONLY = ("heat", "det", "hb", "status")
"""Names in topics of which a jump, or a step over many messages, needs only the newest of each topic."""
LONGEST_STEP_S = 0.5
"""Wall time that one step may cover: after a stall the player goes on where it was."""
PATH_POSES = 1000


class Player:
    """Gives the messages that are due; any thread may pause, change the speed or jump.

    Args:
        store: being filled, or full.
    Attributes:
        damaged: messages that could not be decoded.
    """

    def __init__(self, store: MessageStore) -> None:
        self.damaged = 0
        self._store = store
        self._lock = threading.Lock()
        self._t_ns: int | None = None
        self._next = 0
        self._playing, self._speed = True, 1.0
        self._jump_ns: int | None = None
        self._last_wall_s: float | None = None

    @property
    def playing(self) -> bool:
        """Whether the clock runs; at the end of a recording it does not."""
        return self._playing

    @property
    def position_s(self) -> float:
        """Seconds from the beginning of the recording."""
        start_ns = self._store.span_ns[0]
        return 0.0 if self._t_ns is None else (self._t_ns - start_ns) / 1e9

    @property
    def length_s(self) -> float:
        """Of what is there so far."""
        first_ns, last_ns = self._store.span_ns
        return (last_ns - first_ns) / 1e9

    @property
    def clock_s(self) -> float:
        """The recording's clock at the position: ``wall_s`` of the scene."""
        return (self._t_ns or 0) / 1e9

    def play(self, playing: bool) -> None:
        """Go on or pause; going on at the end begins again."""
        with self._lock:
            if playing and self._store.ended and self.position_s >= self.length_s:
                self._jump_ns = self._store.span_ns[0]
            self._playing = playing

    def set_speed(self, speed: float) -> None:
        """Recorded seconds per second."""
        with self._lock:
            self._speed = min(max(speed, SPEEDS[0]), SPEEDS[-1])

    def seek(self, position_s: float) -> None:
        """Jump to a position; beyond the end: the end."""
        first_ns, last_ns = self._store.span_ns
        with self._lock:
            self._jump_ns = min(max(first_ns + round(1e9 * position_s), first_ns), last_ns)

    def step(self, wall_s: float) -> tuple[bool, Iterator[Message]]:
        """Advance the clock.

        Args:
            wall_s: monotonic.
        Returns:
            Whether the scene must be emptied first, and the messages that are due, in order.
        """
        with self._lock:
            passed_s = 0.0 if self._last_wall_s is None else min(wall_s - self._last_wall_s, LONGEST_STEP_S)
            self._last_wall_s = wall_s
            if not len(self._store):
                return False, iter(())
            first_ns, last_ns = self._store.span_ns
            if self._t_ns is None:
                self._t_ns = first_ns
            jump_ns, self._jump_ns = self._jump_ns, None
            if jump_ns is not None:
                self._t_ns = jump_ns
                self._next = self._store.after(jump_ns)
                return True, self._messages(self._history(jump_ns))
            if self._playing:
                self._t_ns = min(self._t_ns + round(1e9 * passed_s * self._speed), last_ns)
                if self._t_ns == last_ns and self._store.ended:
                    self._playing = False
            begin, self._next = self._next, self._store.after(self._t_ns)
            return False, self._messages(self._newest(range(begin, self._next)))

    def _history(self, t_ns: int) -> list[int]:
        """Messages that rebuild the scene at an instant: poses thinned, of heatmaps and the like the newest."""
        end = self._store.after(t_ns)
        numbers = self._newest(range(self._store.after(t_ns - LOOK_BACK_NS), end))
        pose_kinds = self._named(("pose",))
        poses = [number for number in numbers if self._store.kind(number) in pose_kinds]
        thinned = set(poses) - set(poses[:: -(-len(poses) // PATH_POSES) or 1]) - set(poses[-1:])
        return [number for number in numbers if number not in thinned]

    def _newest(self, numbers: range) -> list[int]:
        """All messages but those whose kind is ``NEWEST_ONLY`` and that have a newer one among them."""
        newest_only = self._named(NEWEST_ONLY)
        seen: set[int] = set()
        kept: list[int] = []
        for number in reversed(numbers):
            kind = self._store.kind(number)
            if kind in newest_only:
                if kind in seen:
                    continue
                seen.add(kind)
            kept.append(number)
        return kept[::-1]

    def _named(self, names: tuple[str, ...]) -> set[int]:
        """Kinds whose topic's first name, after the version, is one of these."""
        kinds = self._store.kinds()
        return {kind for topic, kind in kinds.items() if topic.partition("/")[2].partition("/")[0] in names}

    def _messages(self, numbers: list[int]) -> Iterator[Message]:
        for number in numbers:
            try:
                message = self._store.message(number)
            except WireError:
                self.damaged += 1
                continue
            if message is not None:
                yield message
