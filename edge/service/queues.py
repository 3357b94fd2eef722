# SPDX-License-Identifier: Apache-2.0
"""Bounded queues between the threads of the live pipeline: a put never waits, what was full gives its oldest back.

Whoever puts accounts for what comes back, so that nothing is dropped in silence.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from edge.frames import ObjectCloud, RadarId
from edge.service.jobs import Job

T = TypeVar("T")


class DropQueue(Generic[T]):
    """First in, first out.

    Args:
        capacity: items that may wait.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._items: deque[T] = deque()
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: T) -> T | None:
        """Append; returns the oldest item when there was no room for both."""
        with self._changed:
            dropped = self._items.popleft() if len(self._items) >= self.capacity else None
            self._items.append(item)
            self._changed.notify()
            return dropped

    def take(self, timeout_s: float) -> T | None:
        """The oldest item; None when there was none for so long."""
        with self._changed:
            if not self._items:
                self._changed.wait(timeout_s)
            return self._items.popleft() if self._items else None


class PairQueue:
    """Pairs on their way to one imager for each radar; every imager gets every pair once, in order.

    A pair leaves when all imagers have begun with it. When the queue is full the oldest pair that nobody has begun with
    goes, so that both its frames are lost together; if all are begun, one imager hangs and the oldest goes.

    Args:
        radars: of the imagers.
        capacity: pairs that may wait.
    """

    def __init__(self, radars: Iterable[RadarId], capacity: int) -> None:
        self.capacity = capacity
        self._radars = frozenset(radars)
        self._jobs: list[Job] = []
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._jobs)

    def put(self, job: Job) -> Job | None:
        """Append; returns the pair that had to go."""
        with self._changed:
            dropped = None
            if len(self._jobs) >= self.capacity:
                dropped = next((waiting for waiting in self._jobs if not waiting.begun), self._jobs[0])
                self._jobs.remove(dropped)
            self._jobs.append(job)
            self._changed.notify_all()
            return dropped

    def take(self, radar: RadarId, timeout_s: float) -> Job | None:
        """The oldest pair that this radar's imager has not begun with; None when there was none for so long."""
        end_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                for job in self._jobs:
                    if radar not in job.begun:
                        job.begun.add(radar)
                        if job.begun >= self._radars:
                            self._jobs.remove(job)
                        return job
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    return None
                self._changed.wait(left_s)


class ShapeQueue:
    """Objects that wait for their completion: of each object only the newest, and every final one.

    Args:
        capacity: asks that may wait; beyond, the oldest goes that is no final one, else the oldest.
        clock_ns: monotonic.
    """

    def __init__(self, capacity: int, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.capacity = capacity
        self._clock_ns = clock_ns
        self._waiting: dict[tuple[int, int | None], tuple[ObjectCloud, int]] = {}
        """(Identity, end of the window of a final one) -> object and instant of the ask, in the order of the line."""
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, cloud: ObjectCloud) -> ObjectCloud | None:
        """Ask for a shape; returns what will not be completed: an older ask of the object, or one without room.

        The newer ask keeps the older one's place in the line.
        A final one makes a waiting ask needless and goes to the end of the line.
        """
        key = (cloud.identity, cloud.t_end_ns if cloud.final else None)
        with self._changed:
            before = self._waiting.get((cloud.identity, None))
            dropped = None if before is None else before[0]
            if before is not None and cloud.final:
                del self._waiting[cloud.identity, None]
            elif before is None and len(self._waiting) >= self.capacity:
                victim = next((other for other, (waiting, _) in self._waiting.items() if not waiting.final), None)
                dropped = self._waiting.pop(victim or next(iter(self._waiting)))[0]
            self._waiting[key] = (cloud, self._clock_ns())
            self._changed.notify()
            return dropped

    def take(self, timeout_s: float) -> tuple[ObjectCloud, int] | None:
        """The object that is next, and the instant at which it was asked for."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(timeout_s)
            if not self._waiting:
                return None
            return self._waiting.pop(next(iter(self._waiting)))
