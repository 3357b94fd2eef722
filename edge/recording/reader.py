# SPDX-License-Identifier: Apache-2.0
"""Reads recordings, also cut or damaged ones, up to their last whole record, and says what was lost."""

from __future__ import annotations

import json
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from edge.errors import RecordingError
from edge.frames import Layout, Pose, RadarFrame, RadarId
from edge.recording import schema
from edge.recording.mcap_reading import McapFile, Message, ReadReport
from edge.rig import FILE_NAME, Rig, load_rig
from edge.sources.base import Loss

_RADAR_OF_TOPIC: dict[str, RadarId] = {topic: radar for radar, topic in schema.FRAME_TOPICS.items()}
_CALIBRATION_KEY = re.compile(r"^\s*calibration\s*=.*$", re.MULTILINE)


class RecordingReader:
    """A recording as a source of frames and poses, in the order they were recorded.

    Args:
        path: MCAP file of ``RecordingWriter``.
    Attributes:
        truncated: the file lacks its end: it was cut, its writer died, or its end is damaged.
        rig_name: of the rig that recorded; empty when the file was cut before it.
        config_hash: of that rig.
        notes: what whoever recorded or imported wanted a reader to know.
        report: what the newest pass over the file found so far.
    Raises:
        RecordingError: unreadable, no MCAP file, or not one of ours.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._mcap = McapFile(self.path)
        if self._mcap.profile not in (schema.PROFILE, None):
            self._mcap.close()
            raise RecordingError(
                f"{self.path}: not a recording of rfconstruct", value=self._mcap.profile, allowed=schema.PROFILE
            )
        self.truncated: bool = self._mcap.statistics is None
        self._metadata = self._mcap.metadata.get(schema.METADATA, {})
        self.rig_name = self._metadata.get("rig", "")
        hexadecimal = self._metadata.get("config_hash", "")
        self.config_hash = bytes.fromhex(hexadecimal) if re.fullmatch("([0-9a-f]{2})*", hexadecimal) else b""
        self.notes = _texts(self._metadata.get("notes", "[]"))
        self.report = ReadReport()
        self._counts: dict[str, int] | None = None
        self._span_ns: tuple[int, int] | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    @property
    def total_frames(self) -> int:
        """Raw frames of both radars; reads a truncated file once to know."""
        counts, _ = self._contents()
        return sum(counts.get(topic, 0) for topic in _RADAR_OF_TOPIC)

    @property
    def recovered(self) -> int:
        """Messages that can be read; reads a truncated file once to know."""
        return sum(self._contents()[0].values())

    def __iter__(self) -> Iterator[RadarFrame | Pose | Loss]:
        """Frames and poses in the order they were recorded; frames of damaged chunks show as gaps in the numbers.

        Raises:
            RecordingError: a message that is whole but not what its topic says, or the disk fails.
        """
        yield from self.items()

    def items(self, span_ns: tuple[int, int] | None = None) -> Iterator[RadarFrame | Pose]:
        """Frames and poses, or those whose log time lies in a span, its ends included; the rest is not even read.

        Raises:
            RecordingError: as iteration.
        """
        layouts: dict[RadarId, Layout] = {}
        for message in self._messages(span_ns):
            if message.topic in _RADAR_OF_TOPIC:
                frame = schema.decode_frame(message.payload)
                if frame.radar != _RADAR_OF_TOPIC[message.topic]:
                    raise RecordingError(f"{self.path}: {frame.radar} frame under topic {message.topic}")
                if layouts.setdefault(frame.radar, frame.layout) != frame.layout:
                    raise RecordingError(
                        f"{self.path}: {frame.radar} frame {frame.number} has another layout than those before",
                        value=frame.layout,
                        allowed=str(layouts[frame.radar]),
                    )
                yield frame
            elif message.topic == schema.POSE_TOPIC:
                yield schema.decode_pose(message.payload)

    def results(self, span_ns: tuple[int, int] | None = None) -> Iterator[schema.RecordedMessage]:
        """Published results, in the order they were recorded; ``span_ns`` as for ``items``."""
        for message in self._messages(span_ns):
            if message.topic in schema.RESULT_TOPICS:
                yield schema.RecordedMessage(message.topic, message.log_time_ns, bytes(message.payload))

    def verify(self) -> ReadReport:
        """Read everything and check every CRC; frames are not decoded."""
        self._survey()
        return self.report

    def info(self) -> dict[str, object]:
        """What is in the file, as plain values for JSON."""
        counts, span_ns = self._contents()
        return {
            "path": str(self.path),
            "rig": self.rig_name,
            "config_hash": self.config_hash.hex(),
            "host": self._metadata.get("host", ""),
            "notes": self.notes,
            "bytes": self._mcap.size,
            "truncated": self.truncated,
            "bytes_lost": self.report.bytes_lost,
            "damaged_chunks": self.report.damaged_chunks,
            "missing": self.report.missing,
            "t_start_ns": span_ns[0],
            "t_end_ns": span_ns[1],
            "duration_s": (span_ns[1] - span_ns[0]) / 1e9,
            "topics": counts,
        }

    def read_rig(self) -> Rig:
        """The rig that recorded, with the calibrations it used; its folder lasts as long as this reader.

        Raises:
            RecordingError: the file was cut before the rig.
            ConfigError, CalibrationError: this version of the software refuses the rig.
        """
        texts = {n: data for n, data in self._mcap.attachments.items() if n.startswith(schema.RIG_PREFIX)}
        if schema.RIG_PREFIX + FILE_NAME not in texts or not _is_file_name(self.rig_name):
            raise RecordingError(
                f"{self.path}: holds no rig", action="give one: rfconstruct replay --rig NAME", value=sorted(texts)
            )
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="rfconstruct-rig-")
        folder = Path(self._folder.name) / self.rig_name
        folder.mkdir(exist_ok=True)
        for stored, data in texts.items():
            if _is_file_name(stored.removeprefix(schema.RIG_PREFIX)):
                (folder / stored.removeprefix(schema.RIG_PREFIX)).write_bytes(data)
        toml = folder / FILE_NAME
        toml.write_text(_CALIBRATION_KEY.sub("", toml.read_text(encoding="utf-8", errors="replace")), encoding="utf-8")
        rig = load_rig(folder)
        for radar in rig.radars:
            stored = f"{schema.CALIBRATION_PREFIX}{radar}.npz"
            if stored in self._mcap.attachments:
                path = folder / f"calibration_{radar}.npz"
                path.write_bytes(self._mcap.attachments[stored])
                rig = rig.with_calibration(radar, path)
        return rig

    def close(self) -> None:
        """Close the file; any iteration ends."""
        self._mcap.close()
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def __enter__(self) -> RecordingReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time; reads a truncated file once to know."""
        return self._contents()[1]

    def frames_of(self, radar: RadarId) -> int:
        """Raw frames of one radar; reads a truncated file once to know."""
        return self._contents()[0].get(schema.FRAME_TOPICS[radar], 0)

    @property
    def has_frames(self) -> bool:
        """Whether there is any raw frame; results alone cannot go through the pipeline."""
        return self.total_frames > 0

    @property
    def has_results(self) -> bool:
        """Whether there is any published result."""
        counts, _ = self._contents()
        return any(counts.get(topic, 0) for topic in schema.RESULT_TOPICS)

    def messages(self, span_ns: tuple[int, int] | None = None) -> Iterator[Message]:
        """Everything readable, undecoded; a message's payload is valid until the next one is asked for."""
        return self._messages(span_ns)

    def _messages(self, span_ns: tuple[int, int] | None = None) -> Iterator[Message]:
        self.report = ReadReport()
        try:
            for message in self._mcap.messages(self.report, span_ns):
                if span_ns is None or span_ns[0] <= message.log_time_ns <= span_ns[1]:
                    yield message
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be read", value=error.strerror) from error

    def _contents(self) -> tuple[dict[str, int], tuple[int, int]]:
        """Messages of every topic, and the first and last log time."""
        statistics = self._mcap.statistics
        if statistics is None:
            if self._counts is None or self._span_ns is None:
                return self._survey()
            return self._counts, self._span_ns
        topics, counts = self._mcap.channels, statistics.channel_message_counts
        by_topic = {topics.get(channel, f"channel {channel}"): count for channel, count in sorted(counts.items())}
        return by_topic, (statistics.message_start_time, statistics.message_end_time)

    def _survey(self) -> tuple[dict[str, int], tuple[int, int]]:
        counts: Counter[str] = Counter()
        first, last = None, 0
        for message in self._messages():
            counts[message.topic] += 1
            first = message.log_time_ns if first is None else min(first, message.log_time_ns)
            last = max(last, message.log_time_ns)
        self._counts, self._span_ns = dict(counts), (first or 0, last)
        return self._counts, self._span_ns


def _texts(stored: str) -> list[str]:
    """A list of sentences from JSON; whatever else it is gives none."""
    try:
        values = json.loads(stored)
    except (ValueError, RecursionError):
        return []
    return [value for value in values if isinstance(value, str)] if isinstance(values, list) else []


def _is_file_name(name: str) -> bool:
    """True for one that stays in its folder."""
    return bool(re.fullmatch(r"[\w .+-]{1,60}", name)) and name not in (".", "..")
