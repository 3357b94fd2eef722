# SPDX-License-Identifier: Apache-2.0
"""Appends uncompressed MCAP chunks to a file; frames go from the caller's memory to the file without a copy.

The ``mcap`` package's writer copies a message five times and keeps an object for every chunk; here its record types
write everything small, and chunks are gathered by ``writev``. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

RECORD_HEAD_BYTES = 9
MAGIC = b"\x89MCAP0\r\n"
CHUNK_HEAD = struct.Struct("<BQQQQIIQ")
"""Opcode, length, first and last log time, uncompressed size, CRC, length of the compression's name (0), size."""
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time."""
CHUNK_BYTES = 256 * 1024
"""A chunk of small messages is closed beyond this."""

Buffer = bytes | bytearray | memoryview


class AppendFile:
    """A new file that only grows; a failed append is taken back whole.

    Args:
        path: must not exist.
    Raises:
        OSError: also from every method.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self.position = 0

    def append(self, parts: Sequence[Buffer]) -> None:
        """Write all parts one after the other."""
        total, written = sum(map(len, parts)), 0
        try:
            written = os.writev(self._fd, parts)
            while written < total:
                written += os.writev(self._fd, _behind(parts, written))
        except OSError:
            os.ftruncate(self._fd, self.position)
            os.lseek(self._fd, self.position, os.SEEK_SET)
            raise
        self.position += total

    def sync(self) -> None:
        """Wait until the data are on the disk."""
        os.fdatasync(self._fd)

    def close(self) -> None:
        """Close; nothing can be appended after."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    @property
    def closed(self) -> bool:
        """True after ``close``."""
        return self._fd < 0


class McapWriter:
    """Header, attachments and channels first, then messages in chunks, then ``finish`` with the summary.

    Not for several threads at once. OSError of the file passes through; nothing may be called after it.

    Args:
        file: empty file.
        profile, library: of the header.
    """

    def __init__(self, file: AppendFile, profile: str, library: str) -> None:
        self._file = file
        self._small = bytearray()
        self._times_ns: list[int] = []
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._summary: dict[Opcode, bytearray] = {
            opcode: bytearray()
            for opcode in (
                Opcode.SCHEMA,
                Opcode.CHANNEL,
                Opcode.STATISTICS,
                Opcode.CHUNK_INDEX,
                Opcode.ATTACHMENT_INDEX,
                Opcode.METADATA_INDEX,
            )
        }
        self._statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._file.append([MAGIC, _bytes_of(Header(profile, library))])

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Store names and values."""
        data, offset = _bytes_of(Metadata(name=name, metadata=values)), self._file.position
        self._file.append([data])
        self._summary[Opcode.METADATA_INDEX] += _bytes_of(MetadataIndex(offset=offset, length=len(data), name=name))
        self._statistics.metadata_count += 1

    def add_attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Store a file with its own CRC."""
        data, offset = _bytes_of(Attachment(0, 0, name, media_type, content)), self._file.position
        self._file.append([data])
        index = AttachmentIndex(offset, len(data), 0, 0, len(content), name, media_type)
        self._summary[Opcode.ATTACHMENT_INDEX] += _bytes_of(index)
        self._statistics.attachment_count += 1

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Store a schema outside the chunks; returns its id."""
        self._statistics.schema_count += 1
        record = _bytes_of(Schema(self._statistics.schema_count, data, encoding, name))
        self._file.append([record])
        self._summary[Opcode.SCHEMA] += record
        return self._statistics.schema_count

    def add_channel(self, topic: str, encoding: str, schema_id: int) -> int:
        """Store a channel outside the chunks, so that no damaged chunk takes it away; returns its id."""
        self._statistics.channel_count += 1
        record = _bytes_of(Channel(self._statistics.channel_count, topic, encoding, {}, schema_id))
        self._file.append([record])
        self._summary[Opcode.CHANNEL] += record
        return self._statistics.channel_count

    def add_message(self, channel: int, t_ns: int, payload: Buffer) -> None:
        """Copy a small message into the chunk in progress."""
        self._begin_message(channel, t_ns, len(payload), 0)
        self._small += payload
        if len(self._small) > CHUNK_BYTES:
            self._write_chunk(())

    def write_message(self, channel: int, t_ns: int, parts: Sequence[Buffer], sequence: int) -> None:
        """Write a message whose payload is ``parts`` joined, and what waited before it, as one chunk, at once."""
        self._begin_message(channel, t_ns, sum(map(len, parts)), sequence)
        self._write_chunk(parts)

    def flush(self) -> None:
        """Write the chunk in progress, if any."""
        if self._times_ns:
            self._write_chunk(())

    def finish(self) -> None:
        """Write the chunk in progress and the summary; the file is complete after it."""
        self.flush()
        self._file.append([_bytes_of(DataEnd(0))])
        start = self._file.position
        self._summary[Opcode.STATISTICS] += _bytes_of(self._statistics)
        groups, offsets, offset = [], bytearray(), start
        for opcode, group in self._summary.items():
            if group:
                groups.append(group)
                offsets += _bytes_of(SummaryOffset(opcode, offset, len(group)))
                offset += len(group)
        parts: list[Buffer] = [*groups, offsets]
        crc = 0
        for part in (*parts, struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset)):
            crc = zlib.crc32(part, crc)
        self._file.append([*parts, _bytes_of(Footer(start, offset, crc)), MAGIC])

    def _begin_message(self, channel: int, t_ns: int, size: int, sequence: int) -> None:
        self._index.setdefault(channel, []).append((t_ns, len(self._small)))
        self._times_ns.append(t_ns)
        self._small += MESSAGE_HEAD.pack(
            Opcode.MESSAGE, MESSAGE_HEAD.size - RECORD_HEAD_BYTES + size, channel, sequence, t_ns, t_ns
        )

    def _write_chunk(self, large: Sequence[Buffer]) -> None:
        """One chunk of the small messages and the payload of a large one, and its index."""
        crc, size = zlib.crc32(self._small), len(self._small)
        for part in large:
            crc, size = zlib.crc32(part, crc), size + len(part)
        first, last = min(self._times_ns), max(self._times_ns)
        head = CHUNK_HEAD.pack(
            Opcode.CHUNK, CHUNK_HEAD.size - RECORD_HEAD_BYTES + size, first, last, size, crc, 0, size
        )
        offset, length = self._file.position, len(head) + size
        index, offsets = bytearray(), {}
        for channel, entries in self._index.items():
            offsets[channel] = offset + length + len(index)
            index += _bytes_of(MessageIndex(channel, entries))
        self._file.append([head, self._small, *large, index])
        self._summary[Opcode.CHUNK_INDEX] += _bytes_of(
            ChunkIndex(length, offset, "", size, last, len(index), offsets, first, size)
        )
        self._count(first, last)
        self._small.clear()
        self._times_ns.clear()
        self._index.clear()

    def _count(self, first: int, last: int) -> None:
        statistics = self._statistics
        statistics.message_start_time = min(first, statistics.message_start_time) if statistics.chunk_count else first
        statistics.message_end_time = max(last, statistics.message_end_time)
        statistics.chunk_count += 1
        statistics.message_count += len(self._times_ns)
        for channel, entries in self._index.items():
            counts = statistics.channel_message_counts
            counts[channel] = counts.get(channel, 0) + len(entries)


def _behind(parts: Sequence[Buffer], written: int) -> list[Buffer]:
    """What is left of ``parts`` after ``written`` bytes."""
    rest: list[Buffer] = []
    for part in parts:
        if written < len(part):
            rest.append(memoryview(part)[written:])
        written = max(0, written - len(part))
    return rest


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
