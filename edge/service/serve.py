# SPDX-License-Identifier: Apache-2.0
"""Runs a source through the live pipeline: reads it on a thread of its own, watches from the caller's."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator

from edge.errors import CaptureError, RfconstructError
from edge.frames import Pose, RadarFrame
from edge.player import Pace
from edge.service.live import LivePipeline
from edge.service.observer import Observer
from edge.service.stage import name_thread
from edge.sources.base import Loss

Item = RadarFrame | Pose | Loss
TICK_S = 0.1
LEAVE_S = 10.0
"""A source that does not give its next item for so long after it was told to stop is left behind."""


class Ingest(threading.Thread):
    """Feeds a source to the pipeline until it ends, fails, or is told to stop.

    Args:
        source: frames, poses and losses in time order.
        pipeline: where they go.
        taken: told of every item; a progress bar, for example.
    Attributes:
        error: what the source, or the pipeline that refused an item, raised.
    """

    def __init__(
        self, source: Iterable[Item], pipeline: LivePipeline, taken: Callable[[Item], None] | None = None
    ) -> None:
        super().__init__(name="ingest", daemon=True)
        self._source, self._pipeline, self._taken = source, pipeline, taken
        self.stopping = threading.Event()
        self.error: Exception | None = None

    def run(self) -> None:
        """The thread."""
        name_thread(self.name)
        try:
            for item in self._source:
                if self.stopping.is_set():
                    return
                self._pipeline.feed(item)
                if self._taken is not None:
                    self._taken(item)
        except Exception as error:
            if not self.stopping.is_set():
                self.error = error


def serve(
    source: Iterable[Item],
    pipeline: LivePipeline,
    observer: Observer,
    stopped: Callable[[], bool] = lambda: False,
    taken: Callable[[Item], None] | None = None,
    close: Callable[[], None] | None = None,
) -> None:
    """Play a source to its end, or until ``stopped``; then finish the pipeline, whatever happened.

    Args:
        source: iterated on a thread of its own; it waits for its frames itself (``paced`` makes a recording do so).
        pipeline: not finished.
        observer: of the pipeline.
        stopped: asked ten times a second.
        taken: told of every item, on the source's thread.
        close: called when the source was told to stop, to wake it: ``source.close``.
    Raises:
        What the source raised, after the pipeline was finished.
    """
    ingest = Ingest(source, pipeline, taken)
    pipeline.start()
    observer.live()
    try:
        ingest.start()
        while ingest.is_alive() and not stopped():
            ingest.join(TICK_S)
            observer.tick()
        if ingest.is_alive():
            ingest.stopping.set()
            if close is not None:
                close()
            ingest.join(LEAVE_S)
    finally:
        ingest.stopping.set()
        observer.ending("" if ingest.error is None else f"{type(ingest.error).__name__}: {ingest.error}")
        observer.tick()
        pipeline.finish()
        observer.tick()
    if ingest.error is not None:
        if isinstance(ingest.error, RfconstructError | OSError):
            raise ingest.error
        raise CaptureError(f"the source failed ({type(ingest.error).__name__}: {ingest.error})") from ingest.error


def paced(
    source: Iterable[Item],
    speed: float,
    stopped: Callable[[], bool] | None = None,
) -> Iterator[Item]:
    """The items of a recording, each when it is due.

    Args:
        source: items in time order.
        speed: recorded seconds per second; 0 gives them as fast as they are read.
        stopped: True ends a wait.
    """
    pace = Pace(speed, None, stopped)
    for item in source:
        if not isinstance(item, Loss):
            pace.wait(item.t_ns if isinstance(item, Pose) else item.t_first_chirp_ns)
        yield item
