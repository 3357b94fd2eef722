# SPDX-License-Identifier: Apache-2.0
"""Collects the poses of a live source on a thread of its own, while frames are recorded, copied or processed."""

from __future__ import annotations

import contextlib
import threading
from collections import deque

from edge.errors import RfconstructError
from edge.frames import Pose
from edge.odometry.source import PoseEvent, PoseHealth, PoseSource

POLL_S = 0.05
KEPT = 65_536
"""Poses that may wait; the oldest go first. A quarter of an hour at 60 a second."""
JOIN_S = 5.0


class PoseFeed:
    """Polls a source of poses.

    Args:
        source: not started; closed by ``close``.
    Attributes:
        first: set when the first pose is there.
    Raises:
        RfconstructError: what the source's ``start`` raises.
    """

    def __init__(self, source: PoseSource) -> None:
        self.first = threading.Event()
        self._source, self._lock = source, threading.Lock()
        self._waiting: deque[Pose | PoseEvent] = deque(maxlen=KEPT)
        self._error: RfconstructError | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="poses")
        try:
            source.start()
        except BaseException:
            source.close()
            raise
        self._thread.start()

    @property
    def name(self) -> str:
        """Of the source."""
        return self._source.name

    @property
    def health(self) -> PoseHealth:
        """Of the source."""
        return self._source.health

    def take(self) -> list[Pose | PoseEvent]:
        """What came since the last call, in order.

        Raises:
            RfconstructError: the source ended with it.
        """
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
            error, self._error = (None, self._error) if taken else (self._error, None)
        if error is not None:
            raise error
        return taken

    def close(self) -> None:
        """End the thread and the source; never raises."""
        self._closing.set()
        self._thread.join(JOIN_S)
        with contextlib.suppress(Exception):
            self._source.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                items = self._source.poll(POLL_S)
            except RfconstructError as error:
                with self._lock:
                    self._error = error
                return
            if not items:
                self._closing.wait(5e-3)  # a source that has ended returns at once
                continue
            with self._lock:
                self._waiting.extend(items)
            if any(isinstance(item, Pose) for item in items):
                self.first.set()
