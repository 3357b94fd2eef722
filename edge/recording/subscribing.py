# SPDX-License-Identifier: Apache-2.0
"""A client whose messages are recorded as they come, byte for byte."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from edge.recording.recorder import Recorder
from edge.stream.client import Client
from edge.stream.messages import Message
from edge.stream.wire import MAJOR


class RecordingClient(Client):
    """Records what ``recv`` takes, also messages of types that this version does not know.

    Malformed messages, and ones that were sent again for another subscriber, are counted and not recorded.

    Args:
        endpoint, topics, keys: of ``connect``.
    """

    def __init__(self, endpoint: str, topics: Sequence[str] = (), keys: str | Path | None = None) -> None:
        super().__init__(endpoint, topics, None, keys=keys)
        self.recorded = 0
        """Messages handed to the recorder."""
        self._recorder: Recorder | None = None
        self._wanted = tuple(f"{MAJOR}/{topic.strip('/')}/".encode() for topic in topics)

    def record_to(self, recorder: Recorder) -> None:
        """From now on."""
        self._recorder = recorder

    def _accept(self, frames: list[bytes]) -> Message | None:
        refused = self.malformed + self.repeated
        message = super()._accept(frames)
        wanted = not self._wanted or frames[0].startswith(self._wanted)
        if self._recorder is not None and wanted and refused == self.malformed + self.repeated:
            self._recorder.published(frames, time.monotonic_ns())
            self.recorded += 1
        return message
