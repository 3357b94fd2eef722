# SPDX-License-Identifier: Apache-2.0
"""Reads a whole recording once and tells what is in it, what is missing and where it has gaps."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from edge.errors import WireError
from edge.recording import schema
from edge.recording.reader import RecordingReader
from edge.recording.stored_results import parse

GAP_FACTOR = 2.5
"""A pause of so many usual intervals is a gap."""
U32 = 2**32


@dataclass(slots=True)
class _Lane:
    """One topic on the way."""

    times_ns: array[int] = field(default_factory=lambda: array("q"))
    nbytes: int = 0
    first: int = 0
    last: int = 0
    missing: int = 0
    disordered: int = 0

    def number(self, number: int) -> None:
        """The next frame's number, modulo 2^32."""
        if not self.times_ns:
            self.first = self.last = number
            return
        ahead = (number - self.last) % U32
        if 0 < ahead < U32 // 2:
            self.missing += ahead - 1
            self.last = number
        else:
            self.disordered += 1

    def facts(self, start_ns: int) -> dict[str, Any]:
        times = np.frombuffer(self.times_ns, np.int64)
        seconds = (times - start_ns) / 1e9
        facts: dict[str, Any] = {
            "messages": len(times),
            "megabytes": round(self.nbytes / 1e6, 3),
            "from_s": round(float(seconds.min()), 6),
            "to_s": round(float(seconds.max()), 6),
        }
        steps = np.diff(seconds)
        if len(steps) and (usual := float(np.median(steps))) > 0:
            facts["rate_hz"] = round(1.0 / usual, 3)
            wide = steps > GAP_FACTOR * usual
            facts["gaps"] = int(wide.sum())
            if wide.any():
                at = int(np.argmax(steps))
                facts["longest_gap"] = f"{steps[at]:.3f} s at {seconds[at]:.3f} s"
        return facts


@dataclass(slots=True)
class _Publisher:
    """The publishers whose messages were recorded: sequence numbers that are missing tell what was lost on the way."""

    boots: set[bytes] = field(default_factory=set)
    sequence: dict[tuple[bytes, str], int] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    unreadable: int = 0

    def add(self, payload: bytes) -> None:
        try:
            stored = parse(payload)
        except WireError:
            self.unreadable += 1
            return
        boot, topic, number = stored.header["boot"], stored.draft.topic, stored.header["seq"]
        self.boots.add(boot)
        last = self.sequence.get((boot, topic))
        if last is not None and number > last + 1:
            self.lost[topic] = self.lost.get(topic, 0) + number - last - 1
        self.sequence[boot, topic] = max(number, last if last is not None else 0)


def survey(reader: RecordingReader, progress: Callable[[int], Any] = lambda nbytes: None) -> dict[str, Any]:
    """What ``info`` prints, as plain values for JSON.

    Args:
        reader: open recording.
        progress: told how many more bytes were read.
    Raises:
        RecordingError: the disk fails, or a chunk is compressed.
    """
    lanes: dict[str, _Lane] = {}
    publisher = _Publisher()
    radar_topics = set(schema.FRAME_TOPICS.values())
    for message in reader.messages():
        lane = lanes.setdefault(message.topic, _Lane())
        if message.topic in radar_topics:
            lane.number(message.sequence)
        elif message.topic in schema.RESULT_TOPICS:
            publisher.add(bytes(message.payload))
        lane.times_ns.append(min(message.log_time_ns, 2**63 - 1))
        lane.nbytes += len(message.payload)
        progress(len(message.payload))
    report = reader.report
    start_ns = min((min(lane.times_ns) for lane in lanes.values()), default=0)
    streams = {topic: lane.facts(start_ns) for topic, lane in lanes.items()}
    for topic in radar_topics & lanes.keys():
        lane = lanes[topic]
        numbers = {"first_number": lane.first, "last_number": lane.last, "missing_numbers": lane.missing}
        streams[topic] |= numbers | ({"out_of_order": lane.disordered} if lane.disordered else {})
    content: dict[str, Any] = {**reader.info()}
    content["bytes_lost"], content["damaged_chunks"] = report.bytes_lost, report.damaged_chunks
    content["missing"] = report.missing
    damaged = report.bytes_lost or report.damaged_chunks or report.missing
    content["whole"] = not (reader.truncated or damaged)
    content["streams"] = streams
    if publisher.boots or publisher.unreadable:
        content["publishers"] = len(publisher.boots)
        content["lost_before_recording"] = publisher.lost
        content["unreadable_messages"] = publisher.unreadable
    return content
