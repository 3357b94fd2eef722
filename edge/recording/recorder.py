# SPDX-License-Identifier: Apache-2.0
"""Records beside a running pipeline: whoever records never waits for the disk, and what is dropped is counted."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from types import TracebackType

import numpy as np

from edge.errors import RecordingError
from edge.frames import Int16, Pose, RadarFrame
from edge.recording import schema
from edge.recording.writer import RecordingWriter
from edge.sources.base import Loss

QUEUE_BYTES = 128 << 20
"""A second or more of both radars: a disk may stall for so long without loss."""
SMALL_BYTES = 512
"""What a pose counts for in the queue."""
CLOSE_S = 30.0

_Job = tuple[str, int, Callable[[], None], Int16 | None]
"""Topic, bytes, what writes it, and the samples' copy that can be used again after."""


class Recorder:
    """A queue and a thread before a ``RecordingWriter``; any thread may hand things in.

    When the disk fails or is full the recording ends, the file stays readable, ``failure`` says why, and everything
    after it is counted as dropped: the live path goes on.

    Args:
        writer: open; this recorder closes it.
        queue_bytes: most that may wait; what comes while it is full is dropped.
    Attributes:
        written, dropped: topic -> messages.
        bytes_written: of frames and messages, without the file's own records.
        failure: why the recording ended before ``close``; None: it did not.
    """

    def __init__(self, writer: RecordingWriter, queue_bytes: int = QUEUE_BYTES) -> None:
        self.path = writer.path
        self.written: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.bytes_written = 0
        self.failure: RecordingError | None = None
        self._writer, self._limit = writer, queue_bytes
        self._jobs: deque[_Job] = deque()
        self._waiting_bytes, self._closing = 0, False
        self._changed = threading.Condition()
        self._spare: dict[tuple[int, ...], list[Int16]] = {}
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    @property
    def waiting_bytes(self) -> int:
        """What waits for the disk."""
        return self._waiting_bytes

    def put(self, item: RadarFrame | Pose | Loss) -> bool:
        """Hand in what a source gives; a frame's samples are copied, its buffer may be used again at once.

        Returns:
            False when it was dropped: queue full, or the recording has ended. A loss shows in the recording as
            numbers that are missing.
        """
        if isinstance(item, Loss):
            return True
        if isinstance(item, Pose):
            return self._put(schema.POSE_TOPIC, SMALL_BYTES, lambda: self._writer.pose(item), None)
        topic, size = schema.FRAME_TOPICS[item.radar], item.layout.nbytes
        if not self._accepts(topic, size):
            return False
        frame = replace(item, adc=self._copy(item.adc))
        return self._put(topic, size, lambda: self._writer.frame(frame), frame.adc)

    def published(self, frames: Sequence[bytes], t_ns: int | None = None) -> bool:
        """Hand in a message of the stream, as ``Publisher`` returned it or as it came; none for no frames.

        Args:
            frames: topic, header, payloads.
            t_ns: when it was published; None: now.
        Returns:
            False when it was dropped.
        """
        if not frames:
            return True
        at_ns = time.monotonic_ns() if t_ns is None else t_ns
        size = SMALL_BYTES + sum(map(len, frames))
        return self._put(schema.result_topic(frames[0]), size, lambda: self._writer.published(frames, at_ns), None)

    def close(self, longest_s: float = CLOSE_S) -> None:
        """Write what waits, for so long at most, and close the file.

        Raises:
            RecordingError: the recording ended before, or ends now, because of the disk.
        """
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(longest_s)
        if self._thread.is_alive():
            raise RecordingError(f"{self.path}: the disk does not answer", value=f"{self._waiting_bytes} bytes wait")
        self._writer.close()
        if self.failure is not None:
            raise self.failure

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _accepts(self, topic: str, size: int) -> bool:
        with self._changed:
            room = self._waiting_bytes + size <= self._limit or not self._jobs
            if room and self.failure is None and not self._closing:
                return True
            self.dropped[topic] += 1
            return False

    def _put(self, topic: str, size: int, write: Callable[[], None], samples: Int16 | None) -> bool:
        with self._changed:
            if not self._accepts(topic, size):
                return False
            self._jobs.append((topic, size, write, samples))
            self._waiting_bytes += size
            self._changed.notify()
        return True

    def _copy(self, adc: Int16) -> Int16:
        """In memory that an earlier frame has left, when there is some."""
        with self._changed:
            spare = self._spare.get(adc.shape)
            buffer = spare.pop() if spare else np.empty_like(adc)
        np.copyto(buffer, adc)
        return buffer

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closing)
                if not self._jobs:
                    return
                topic, size, write, samples = self._jobs.popleft()
            try:
                if self.failure is None:
                    write()
            except RecordingError as error:
                self.failure = error
            except Exception as error:  # whatever it was: the live path must not notice
                self.failure = RecordingError(f"{self.path}: recording stopped", value=repr(error))
            with self._changed:
                self._waiting_bytes -= size
                if samples is not None:
                    self._spare.setdefault(samples.shape, []).append(samples)
                if self.failure is None:
                    self.written[topic] += 1
                    self.bytes_written += size
                else:
                    self.dropped[topic] += 1


def tee(source: Iterable[RadarFrame | Pose | Loss], recorder: Recorder) -> Iterator[RadarFrame | Pose | Loss]:
    """Everything that passes is recorded, and goes on whether it was or not."""
    for item in source:
        recorder.put(item)
        yield item
