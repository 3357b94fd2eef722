# SPDX-License-Identifier: Apache-2.0
"""Finds every chunk of a damaged recording whose CRC holds, wherever it lies, and writes their messages to a good one.

The records of an MCAP file are a chain: one wrong length and a reader that follows it is lost. Here chunks are found by
the look of their heads and believed only when the CRC-32 of their content agrees, so nothing between two of them
matters, not even the file's beginning: what a message is can be told from its content.
"""

from __future__ import annotations

import json
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode

from edge.errors import RecordingError, WireError
from edge.frames import RADARS, RadarId
from edge.recording import schema
from edge.recording.head import LIBRARY, write_head
from edge.recording.mcap_reading import CHUNK, LARGEST_CHUNK, MESSAGE, RECORD, McapFile
from edge.recording.mcap_writing import AppendFile, McapWriter
from edge.stream.wire import split

HEAD_BYTES = RECORD.size + CHUNK.size + 8
"""Of a chunk without compression: opcode, length, times, sizes, CRC, no name, size."""
_HEAD = re.compile(rb"\x06....\x00{4}.{28}\x00{4}", re.DOTALL)
"""Opcode of a chunk; a length below 4 GiB; times, size, CRC; no compression."""
WINDOW_BYTES = 1 << 20
WORK = 8
"""CRCs are computed over at most so many times the file's size: garbage that looks like heads must end."""


@dataclass(slots=True)
class SalvageReport:
    """What was saved and what was not.

    Args:
        kept: topic -> messages written.
        unknown: messages whose kind cannot be told.
        chunks: chunks whose CRC holds.
        bytes_lost: bytes that are neither in such a chunk nor records that the good file has its own of.
        missing: radar -> frame numbers between the first and the last kept that are not there.
        has_rig: the rig's folder was saved too; without it ``replay`` needs ``--rig``.
        was_whole: the file had its end and nothing was lost.
    """

    kept: Counter[str] = field(default_factory=Counter)
    unknown: int = 0
    chunks: int = 0
    bytes_lost: int = 0
    missing: dict[RadarId, int] = field(default_factory=dict)
    has_rig: bool = False
    was_whole: bool = False


def recover(source: Path, out: Path) -> SalvageReport:
    """Write everything that a CRC vouches for to a new recording, in the order it was recorded.

    Args:
        source: cut or damaged; not changed.
        out: must not exist.
    Raises:
        RecordingError: unreadable, nothing to save, or ``out`` cannot be written; nothing is left of it then.
    """
    report = SalvageReport()
    with _Bytes(source) as data:
        head = _Head.read(source)
        report.has_rig = any(name.startswith(schema.RIG_PREFIX) for name in head.attachments)
        try:
            file = AppendFile(out)
        except OSError as error:
            raise RecordingError(
                f"{out}: cannot be created", value=error.strerror, action="choose another name"
            ) from error
        try:
            _rewrite(data, head, file, report)
        except BaseException as error:
            file.close()
            out.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise RecordingError(f"{out}: cannot be written", value=error.strerror) from error
            raise
        file.close()
    report.was_whole = head.whole and not report.bytes_lost
    return report


@dataclass(frozen=True, slots=True)
class _Head:
    """What could be read of the beginning."""

    metadata: dict[str, str]
    attachments: dict[str, bytes]
    topics: dict[int, str]
    whole: bool

    @classmethod
    def read(cls, source: Path) -> _Head:
        try:
            mcap = McapFile(source)
        except RecordingError:
            return cls({}, {}, {}, False)
        try:
            metadata = dict(mcap.metadata.get(schema.METADATA, {}))
            return cls(metadata, dict(mcap.attachments), mcap.channels, mcap.statistics is not None)
        finally:
            mcap.close()


def _rewrite(data: _Bytes, head: _Head, file: AppendFile, report: SalvageReport) -> None:
    writer = McapWriter(file, schema.PROFILE, LIBRARY)
    channels = write_head(writer, _metadata(head), head.attachments, RADARS)
    numbers: dict[RadarId, list[int]] = {}
    for payload, channel, t_ns, sequence in _messages(data, report):
        topic = topic_of(payload, head.topics.get(channel, ""))
        if topic is None or not 0 <= t_ns < 2**63:
            report.unknown += 1
            continue
        radar = next((radar for radar, name in schema.FRAME_TOPICS.items() if name == topic), None)
        if radar is None:
            writer.add_message(channels[topic], t_ns, payload)
        else:
            writer.write_message(channels[topic], t_ns, (payload,), sequence)
            first, _, count = numbers.get(radar, [sequence, 0, 0])
            numbers[radar] = [min(first, sequence), max(sequence, numbers.get(radar, [0, 0])[1]), count + 1]
        report.kept[topic] += 1
    if not report.kept:
        raise RecordingError(f"{data.path}: nothing can be saved", value=f"{data.size} bytes, no whole chunk")
    report.missing = {radar: max(0, last - first + 1 - count) for radar, (first, last, count) in numbers.items()}
    writer.finish()
    file.sync()


def _metadata(head: _Head) -> dict[str, str]:
    metadata = {"format_version": str(schema.FORMAT_VERSION), "rig": "", "config_hash": "", **head.metadata}
    try:
        notes = json.loads(metadata.get("notes", "[]"))
    except (ValueError, RecursionError):
        notes = []
    notes = [note for note in notes if isinstance(note, str)] if isinstance(notes, list) else []
    return {**metadata, "notes": json.dumps([*notes, "recovered from a cut or damaged recording"])}


def topic_of(payload: memoryview, stated: str = "") -> str | None:
    """What a message is, by its content, or by its channel when that states a result; None: nothing of ours."""
    start = bytes(payload[: schema.FRAME_HEADER.size])
    if start.startswith(schema.FRAME_MAGIC) and len(start) == schema.FRAME_HEADER.size:
        radar = start[6]
        return schema.FRAME_TOPICS[RADARS[radar]] if radar < len(RADARS) else None
    if start.startswith(b'{"timestamp"'):
        return schema.POSE_TOPIC
    try:
        return schema.result_topic(split(bytes(payload))[0])
    except WireError:
        return stated if stated in schema.RESULT_TOPICS else None


def _messages(data: _Bytes, report: SalvageReport) -> Iterator[tuple[memoryview, int, int, int]]:
    """Payload, channel, log time and sequence of every message of every chunk whose CRC holds."""
    reached, position, work = 0, 0, WORK * data.size + LARGEST_CHUNK
    while work > 0 and (found := data.find(_HEAD, position)) is not None:
        body, cost = _chunk(data, found)
        work -= cost
        if body is None:
            position = found + 1
            continue
        report.chunks += 1
        report.bytes_lost += _foreign(data, reached, found)
        yield from _inner(body)
        position = reached = found + HEAD_BYTES + len(body)
    report.bytes_lost += _foreign(data, reached, data.size)


def _chunk(data: _Bytes, offset: int) -> tuple[memoryview | None, int]:
    """Records of the chunk at ``offset`` when its lengths agree and its CRC holds; how many bytes were looked at."""
    head = data.read(offset, HEAD_BYTES)
    if len(head) < HEAD_BYTES:
        return None, 0
    _, length = RECORD.unpack_from(head)
    _, _, plain, crc, _ = CHUNK.unpack_from(head, RECORD.size)
    (size,) = struct.unpack_from("<Q", head, HEAD_BYTES - 8)
    fits = length == CHUNK.size + 8 + size and plain == size and 0 < size <= LARGEST_CHUNK
    if not fits or offset + HEAD_BYTES + size > data.size:
        return None, 0
    body = memoryview(data.read(offset + HEAD_BYTES, size))
    return (body if len(body) == size and zlib.crc32(body) == crc else None), size


def _inner(body: memoryview) -> Iterator[tuple[memoryview, int, int, int]]:
    offset = 0
    while offset + RECORD.size <= len(body):
        opcode, length = RECORD.unpack_from(body, offset)
        start = offset + RECORD.size
        offset = start + length
        if offset <= len(body) and opcode == Opcode.MESSAGE and length >= MESSAGE.size:
            channel, sequence, t_ns, _ = MESSAGE.unpack_from(body, start)
            yield body[start + MESSAGE.size : offset], channel, t_ns, sequence


def _foreign(data: _Bytes, start: int, end: int) -> int:
    """Bytes between two chunks that are not a chain of whole records other than chunks."""
    offset = start + 8 if start == 0 and data.read(0, 6) == b"\x89MCAP0" else start
    while offset + RECORD.size <= end:
        opcode, length = RECORD.unpack(data.read(offset, RECORD.size))
        if not (0 < opcode <= max(Opcode)) or opcode == Opcode.CHUNK or offset + RECORD.size + length > end:
            break
        offset += RECORD.size + length
        if opcode == Opcode.FOOTER and end - offset == 8:
            return 0
    return end - offset


class _Bytes:
    """A file that is read piece by piece: it may shrink or vanish under our hands without harm."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._window: tuple[int, bytes] = (0, b"")
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            self.size = os.fstat(self._fd).st_size
        except OSError as error:
            raise RecordingError(f"{path}: cannot be opened", value=error.strerror, action="check the path") from error

    def read(self, offset: int, count: int) -> bytes:
        """Up to ``count`` bytes; fewer at the end."""
        parts, wanted = [], max(0, min(count, self.size - offset))
        while wanted:
            try:
                part = os.pread(self._fd, wanted, offset)
            except OSError as error:
                raise RecordingError(f"{self.path}: cannot be read", value=error.strerror) from error
            if not part:
                break
            parts.append(part)
            offset, wanted = offset + len(part), wanted - len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def find(self, pattern: re.Pattern[bytes], position: int) -> int | None:
        """Where the pattern, of at most ``HEAD_BYTES``, begins, at ``position`` or behind."""
        while position < self.size:
            start, window = self._window
            if not start <= position <= start + len(window) - HEAD_BYTES:
                start, window = self._window = position, self.read(position, WINDOW_BYTES)
            match = pattern.search(window, position - start)
            if match is not None:
                return start + match.start()
            if start + len(window) >= self.size or len(window) < WINDOW_BYTES:
                return None
            position = start + len(window) - HEAD_BYTES + 1
        return None

    def __enter__(self) -> _Bytes:
        return self

    def __exit__(self, *exception: object) -> None:
        os.close(self._fd)
