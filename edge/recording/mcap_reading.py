# SPDX-License-Identifier: Apache-2.0
"""Walks the records of an uncompressed MCAP file that may be cut or damaged anywhere.

The ``mcap`` package's readers stop with various errors at the first cut record, copy messages twice and allocate what
a damaged length asks for. This one gives every message of every chunk whose CRC holds, nothing that no CRC vouches for,
and never allocates more than the file is long. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Statistics

from edge.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
CHUNK = struct.Struct("<QQQII")
MESSAGE = struct.Struct("<HIQQ")
FOOTER = struct.Struct("<QQI")
FOOTER_BYTES = RECORD.size + FOOTER.size + len(MAGIC)
DATA_END_BYTES = 4
LARGEST_CHUNK = 256 << 20
LARGEST_SUMMARY = 256 << 20
LARGEST_ATTACHMENT = 64 << 20
_READ_ERRORS = (struct.error, EndOfFile, ValueError, KeyError, OverflowError)


@dataclass(slots=True)
class ReadReport:
    """What a pass over a file found.

    Args:
        messages: messages given.
        damaged_chunks: chunks left out: their CRC or their structure is wrong.
        bytes_lost: bytes of damaged chunks and of the cut end.
        missing: messages that the summary counts and the file does not give; 0 in a file without its end.
    """

    messages: int = 0
    damaged_chunks: int = 0
    bytes_lost: int = 0
    missing: int = 0


@dataclass(frozen=True, slots=True)
class Message:
    """One message; ``payload`` is valid until the next one is asked for."""

    topic: str
    log_time_ns: int
    payload: memoryview
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class _Record:
    opcode: int
    offset: int
    length: int
    available: int

    @property
    def whole(self) -> bool:
        return self.available == self.length


class McapFile:
    """An MCAP file opened for reading.

    Args:
        path: of the file.
    Attributes:
        profile: of the header; None when the file is cut inside it.
        metadata: name -> key -> value, those before the first chunk.
        attachments: name -> bytes, those before the first chunk whose CRC holds.
        statistics: of the summary; None when the file has no readable end.
    Raises:
        RecordingError: unreadable, or no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be opened", value=error.strerror, action="check the path") from error
        self.profile: str | None = None
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.statistics: Statistics | None = None
        self._channels: dict[int, str] = {}
        self._buffer = bytearray()
        try:
            self.size = os.fstat(self._fd).st_size
            magic = self._read(0, min(self.size, len(MAGIC)))
            if magic != MAGIC:
                raise RecordingError(f"{path}: no MCAP file", value=bytes(magic), allowed=f"begins with {MAGIC!r}")
            self._read_head()
            self._read_summary()
        except OSError as error:
            self.close()
            raise RecordingError(f"{path}: cannot be read", value=error.strerror) from error
        except RecordingError:
            self.close()
            raise

    def messages(self, report: ReadReport, span_ns: tuple[int, int] | None = None) -> Iterator[Message]:
        """Every readable message in the order of the file; ``report`` is filled on the way.

        Args:
            report: of this pass.
            span_ns: chunks that end before the first or begin after the second instant are passed over unread.
        Raises:
            RecordingError: a compressed chunk, or the disk fails.
        """
        channels = dict(self._channels)
        for record in self._records():
            if record.opcode == Opcode.DATA_END and record.length == DATA_END_BYTES:
                break
            if record.opcode == Opcode.CHUNK:
                if span_ns is None or self._within(record, *span_ns):
                    yield from self._chunk_messages(record, channels, report)
            elif not record.whole:
                report.bytes_lost += record.available
            elif record.opcode in (Opcode.CHANNEL, Opcode.MESSAGE) and record.length <= LARGEST_CHUNK:
                head = RECORD.pack(record.opcode, record.length)
                yield from self._inner(memoryview(head + self._read(record.offset, record.length)), channels, report)
        if self.statistics is not None and self._fd >= 0 and span_ns is None:
            report.missing = max(0, self.statistics.message_count - report.messages)

    def close(self) -> None:
        """Close the file; any iteration ends."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _records(self) -> Iterator[_Record]:
        """Top-level records; the last one may be cut, which also stands for an impossible record."""
        offset = len(MAGIC)
        while offset < self.size and self._fd >= 0:
            head = self._read(offset, RECORD.size)
            body = offset + RECORD.size
            if len(head) < RECORD.size:
                yield _Record(0, offset, RECORD.size, len(head))
                return
            opcode, length = RECORD.unpack(head)
            known = 0 < opcode <= max(Opcode) or opcode >= 0x80
            if not known:
                yield _Record(0, offset, self.size, self.size - offset)
                return
            yield _Record(opcode, body, length, min(length, self.size - body))
            if opcode == Opcode.FOOTER:
                return
            offset = body + length

    def _within(self, record: _Record, first_ns: int, last_ns: int) -> bool:
        """Whether a chunk's own times say that it touches the span."""
        head = self._read(record.offset, CHUNK.size)
        if len(head) < CHUNK.size:
            return True
        start_ns, end_ns, *_ = CHUNK.unpack(head)
        return not (end_ns < first_ns or start_ns > last_ns)

    def _chunk_messages(self, record: _Record, channels: dict[int, str], report: ReadReport) -> Iterator[Message]:
        data = self._chunk_data(record) if record.whole else None
        if data is None:
            report.damaged_chunks += record.whole
            report.bytes_lost += record.available
        else:
            yield from self._inner(data, channels, report)

    def _chunk_data(self, record: _Record) -> memoryview | None:
        """Records of a chunk; None when its structure or its CRC is wrong."""
        if not CHUNK.size + 8 <= record.length <= LARGEST_CHUNK:
            return None
        head = self._read(record.offset, min(record.length, CHUNK.size + 40))
        _, _, _, crc, name_length = CHUNK.unpack_from(head)
        start = CHUNK.size + name_length + 8
        if len(head) < start:
            return None
        (length,) = struct.unpack_from("<Q", head, start - 8)
        if length != record.length - start:
            return None
        if name_length:
            raise RecordingError(
                f"{self.path}: compressed chunk",
                value=bytes(head[CHUNK.size : start - 8]),
                allowed="uncompressed recordings",
                action="decompress it: mcap compress --compression none",
            )
        data = self._read_reused(record.offset + start, length)
        return data if len(data) == length and (crc == 0 or zlib.crc32(data) == crc) else None

    def _inner(self, data: memoryview, channels: dict[int, str], report: ReadReport) -> Iterator[Message]:
        """Messages of consecutive records; ends at the first that is not whole."""
        offset = 0
        while offset + RECORD.size <= len(data):
            opcode, length = RECORD.unpack_from(data, offset)
            body = offset + RECORD.size
            if body + length > len(data):
                break
            if opcode == Opcode.CHANNEL:
                channel = _parse(Channel, data[body : body + length])
                if channel is not None:
                    channels.setdefault(channel.id, channel.topic)  # what the summary says has a CRC
            elif opcode == Opcode.MESSAGE and length >= MESSAGE.size:
                channel_id, sequence, log_time_ns, _ = MESSAGE.unpack_from(data, body)
                if channel_id in channels:
                    report.messages += 1
                    payload = data[body + MESSAGE.size : body + length]
                    yield Message(channels[channel_id], log_time_ns, payload, sequence)
            offset = body + length
        report.bytes_lost += len(data) - offset

    def _read_head(self) -> None:
        """Header, metadata, attachments and channels before the first chunk."""
        for record in self._records():
            if record.opcode in (Opcode.CHUNK, Opcode.DATA_END) or not record.whole:
                return
            if record.length > LARGEST_ATTACHMENT + 4096:
                continue
            if record.opcode == Opcode.HEADER:
                header = _parse(Header, self._read(record.offset, record.length))
                self.profile = "" if header is None else header.profile
            elif record.opcode == Opcode.CHANNEL:
                channel = _parse(Channel, self._read(record.offset, record.length))
                if channel is not None:
                    self._channels.setdefault(channel.id, channel.topic)
            elif record.opcode == Opcode.METADATA:
                metadata = _parse(Metadata, self._read(record.offset, record.length))
                if metadata is not None:
                    self.metadata[metadata.name] = metadata.metadata
            elif record.opcode == Opcode.ATTACHMENT:
                body = self._read(record.offset, record.length)
                crc_holds = zlib.crc32(body[:-4]).to_bytes(4, "little") == body[-4:]
                attachment = _parse(Attachment, body) if crc_holds else None
                if attachment is not None:
                    self.attachments[attachment.name] = attachment.data

    def _read_summary(self) -> None:
        """Channels and statistics from the end of the file, when it has one whose CRC holds."""
        tail = self._read(max(0, self.size - FOOTER_BYTES), FOOTER_BYTES)
        if len(tail) < FOOTER_BYTES or tail[-len(MAGIC) :] != MAGIC:
            return
        opcode, length = RECORD.unpack_from(tail)
        start, _, crc = FOOTER.unpack_from(tail, RECORD.size)
        end = self.size - FOOTER_BYTES
        if opcode != Opcode.FOOTER or length != FOOTER.size or not len(MAGIC) <= start < end:
            return
        if end - start > LARGEST_SUMMARY:
            return
        summary = self._read(start, end - start)
        if crc and zlib.crc32(tail[: RECORD.size + 16], zlib.crc32(summary)) != crc:
            return
        offset = 0
        while offset + RECORD.size <= len(summary):
            opcode, length = RECORD.unpack_from(summary, offset)
            body = summary[offset + RECORD.size : offset + RECORD.size + length]
            if opcode == Opcode.CHANNEL:
                channel = _parse(Channel, body)
                if channel is not None:
                    self._channels[channel.id] = channel.topic
            elif opcode == Opcode.STATISTICS:
                self.statistics = _parse(Statistics, body)
            offset += RECORD.size + length

    @property
    def channels(self) -> dict[int, str]:
        """Channel id -> topic, as the summary says, or else the beginning."""
        return dict(self._channels)

    def _read(self, offset: int, length: int) -> bytes:
        """At most ``length`` bytes from ``offset``; fewer at the end of the file."""
        return os.pread(self._fd, min(length, max(0, self.size - offset)), offset) if self._fd >= 0 else b""

    def _read_reused(self, offset: int, length: int) -> memoryview:
        """As ``_read``, into a buffer that the next call overwrites."""
        if len(self._buffer) < length:
            self._buffer = bytearray(length)
        view, filled = memoryview(self._buffer)[:length], 0
        while filled < length and self._fd >= 0:
            count = os.preadv(self._fd, [view[filled:]], offset + filled)
            if not count:
                break
            filled += count
        return view[:filled]


def _parse(kind: Any, body: bytes | memoryview) -> Any:
    """A record of the ``mcap`` package, or None when its bytes are no such record."""
    try:
        return kind.read(ReadDataStream(BytesIO(body)))
    except _READ_ERRORS:
        return None
