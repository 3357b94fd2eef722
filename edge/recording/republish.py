# SPDX-License-Identifier: Apache-2.0
"""Publishes recorded results again, to subscribers that need not know: same content, source "replay"."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from edge.config import StreamSettings
from edge.digest import ResultDigest
from edge.errors import WireError
from edge.player import Pace
from edge.recording.playback import PASS_GAP_NS, Part
from edge.recording.reader import RecordingReader
from edge.recording.stored_results import StoredResult, parse, shifted
from edge.stream.messages import STATES, State, Status
from edge.stream.publisher import Publisher
from edge.stream.wire import HASH_BYTES, Draft

STATED = ("status", "hb")


class Republisher(Publisher):
    """A publisher of messages that others made; boot, numbers and publication times are its own.

    Args:
        settings: addresses.
    """

    def __init__(self, settings: StreamSettings) -> None:
        super().__init__(settings, bytes(HASH_BYTES), bytes(HASH_BYTES), "replay")
        self.state: State = "INIT"
        """Of the last recorded status or heartbeat."""

    def forward(self, stored: StoredResult, draft: Draft) -> None:
        """Send it under the hashes of its first publisher; recorded heartbeats only say the state of ours.

        Raises:
            WireError: it does not fit the format.
        """
        with self._lock:
            self._hashes = stored.hashes
        state = draft.fields.get("state")
        if draft.type in STATED and state in STATES:
            self.state = state
        if draft.type != "hb":
            self._send(draft)
        self.heartbeat(self.state)

    def live(self) -> None:
        """Give a sign of life when one is due."""
        self.heartbeat(self.state)

    def invite(self, duration_s: float, stopped: Callable[[], bool]) -> None:
        """Signs of life until waiting subscribers have joined."""
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s and not stopped():
            self.live()
            time.sleep(0.02)

    def end(self, version: str) -> None:
        """Say that nothing more comes."""
        self.status(Status("STOP", versions={"rfconstruct": version}))


class ResultsPlayback:
    """Recorded results in the order and at the pace in which they came.

    Args:
        reader: open recording.
        part: what to play; heartbeats and statuses are messages like others.
        publisher: where they go; None: nowhere, they are only read.
        digest: fed with every message, or None.
    """

    def __init__(
        self, reader: RecordingReader, part: Part, publisher: Republisher | None, digest: ResultDigest | None = None
    ) -> None:
        self._reader, self._part = reader, part
        self._publisher, self._digest = publisher, digest
        self._span_ns = part.span_ns(reader.span_ns)
        self.sent: Counter[str] = Counter()
        """Messages by type."""
        self.unreadable = 0
        """Messages that do not follow the wire format: recorded as they came, but not sent."""
        self.last_fault = ""
        self.passes = 0

    def run(
        self, speed: float, stopped: Callable[[], bool], progress: Callable[[int], Any] = lambda count: None
    ) -> None:
        """Play to the end of the last pass, or until ``stopped``.

        Args:
            speed: recorded seconds per second; 0 plays as fast as it goes.
            stopped: asked before every message.
            progress: told after every message that one more is done.
        """
        pace = Pace(speed, self._publisher.live if self._publisher is not None else None, stopped)
        span_ns, wait_ns = self._span_ns[1] - self._span_ns[0], 0
        shift_ns = shift = 0
        while not self._part.loops or self.passes < self._part.loops:
            times, numbers = _Range(), _Range()
            for log_ns, stored in self._pass():
                pace.wait(log_ns + wait_ns)
                if stopped():
                    return
                times.add(stored.draft.t_ns if stored.draft.type not in STATED else None)
                numbers.add(stored.draft.fields.get("number"))
                self._send(stored, shift_ns, shift)
                progress(1)
            if not self.sent:
                return
            wait_ns += span_ns + PASS_GAP_NS
            shift_ns += max(span_ns, times.width) + PASS_GAP_NS
            shift += numbers.width + 1
            self.passes += 1

    def _pass(self) -> Iterator[tuple[int, StoredResult]]:
        for message in self._reader.results(None if self._part.whole else self._span_ns):
            try:
                yield message.t_ns, parse(message.payload)
            except WireError as error:
                self._refuse(error)

    def _send(self, stored: StoredResult, shift_ns: int, shift: int) -> None:
        try:
            draft = shifted(stored.draft, shift_ns, shift)
            if self._digest is not None:
                self._digest.add(draft)
            if self._publisher is not None:
                self._publisher.forward(stored, draft)
            self.sent[draft.type] += 1
        except WireError as error:
            self._refuse(error)

    def _refuse(self, error: WireError) -> None:
        self.unreadable += 1
        self.last_fault = str(error)


class _Range:
    """Smallest and largest of the integers seen."""

    def __init__(self) -> None:
        self._ends: tuple[int, int] | None = None

    def add(self, value: object) -> None:
        if isinstance(value, int):
            low, high = self._ends or (value, value)
            self._ends = min(low, value), max(high, value)

    @property
    def width(self) -> int:
        return self._ends[1] - self._ends[0] if self._ends else 0
