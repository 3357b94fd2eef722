# SPDX-License-Identifier: Apache-2.0
"""Messages of a recording on disk, indexed by time, so that a player may jump anywhere at once."""

from __future__ import annotations

import os
import tempfile
import threading
from array import array
from bisect import bisect_right

from edge.errors import RecordingError
from edge.stream.decode import decode
from edge.stream.messages import Message
from edge.stream.wire import split

LIMIT_BYTES = 8 << 30
"""Messages beyond are not kept: about an hour of everything at full rate."""


class MessageStore:
    """An unnamed temporary file of messages in the single-frame form, in the order they were added.

    One thread adds while another reads. The file is gone when the store is closed or the process dies.

    Attributes:
        full: the limit was reached; what came later is missing.
        ended: nothing more will come.
        failure: why what should have come did not; "": nothing failed.
        progress: 0..1, share of the recording that has been read.
    """

    def __init__(self, limit_bytes: int = LIMIT_BYTES) -> None:
        self.full = self.ended = False
        self.failure, self.progress = "", 0.0
        self._limit = limit_bytes
        try:
            self._file = tempfile.TemporaryFile(prefix="rfconstruct-view-")  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise RecordingError(
                "no place for the viewer's temporary file", value=error.strerror, action="set TMPDIR to another folder"
            ) from error
        self._lock = threading.Lock()
        self._times, self._ends, self._kinds = array("q"), array("q"), array("B")
        self._kind_of: dict[str, int] = {}

    def add(self, topic: str, t_ns: int, block: bytes) -> None:
        """Append a message.

        Args:
            topic: whatever tells kinds apart: of two of one kind, a jump needs only the newer one of some kinds.
            t_ns: instant on the recording's clock; one earlier than its predecessor's counts as that one's.
            block: single-frame form.
        Raises:
            RecordingError: the disk is full.
        """
        with self._lock:
            start = self._ends[-1] if self._ends else 0
            if self.full or start + len(block) > self._limit:
                self.full = True
                return
            try:
                os.pwrite(self._file.fileno(), block, start)
            except OSError as error:
                raise RecordingError("the viewer's temporary file cannot be written", value=error.strerror) from error
            kind = self._kind_of.setdefault(topic, min(len(self._kind_of), 255))
            self._kinds.append(kind)
            self._ends.append(start + len(block))
            self._times.append(max(t_ns, self._times[-1]) if self._times else t_ns)

    def __len__(self) -> int:
        return len(self._times)

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last instant; (0, 0) while it is empty."""
        with self._lock:
            return (self._times[0], self._times[-1]) if self._times else (0, 0)

    def after(self, t_ns: int) -> int:
        """Number of the first message later than ``t_ns``."""
        with self._lock:
            return bisect_right(self._times, t_ns)

    def t_ns(self, number: int) -> int:
        """Instant of a message."""
        return self._times[number]

    def kind(self, number: int) -> int:
        """Small number of the message's topic."""
        return self._kinds[number]

    def kinds(self) -> dict[str, int]:
        """Topic -> its small number."""
        with self._lock:
            return dict(self._kind_of)

    def message(self, number: int) -> Message | None:
        """Decode a message; None for a type that this version does not know. WireError when it is damaged."""
        start = self._ends[number - 1] if number else 0
        return decode(split(os.pread(self._file.fileno(), self._ends[number] - start, start)))

    def close(self) -> None:
        """Give the disk space back."""
        self._file.close()
