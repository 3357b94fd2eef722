# SPDX-License-Identifier: Apache-2.0
"""The radar chips' own protocol inside the SPI packets: headers, sub-blocks, checksum and CRC, as the chip sees it.

Source: TI Radar Interface Control Document 2.23. Little endian; header of six u16 (opcode, length, flags, remaining
chunks, number of sub-blocks, checksum), sub-blocks ``{u16 id, u16 length, data}``, CRC over header and payload: CRC-32
from the host; CRC-16/CCITT-FALSE from a chip whose CRC type was not set (event logged by a user, TI E2E 1267477).
"""

from __future__ import annotations

import binascii
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

HOST_SYNC = bytes.fromhex("34122143")
READ_SYNC = bytes.fromhex("78566587") + b"\xff" * 12
"""What the host writes before it reads: the chip answers by lowering its interrupt line."""
CHIP_SYNC = bytes.fromhex("badccdab")
HEADER = struct.Struct("<6H")
CRC_BYTES = 4
LONGEST_MESSAGE = 256
"""With the sync word."""
FLAGS_CRC32 = 0x0400
_FLAGS_LOGGED = 0x000C
"""Of the logged event with CRC-16: no acknowledgement wanted."""
_RETRY_BITS = 0x0003


class Direction(IntEnum):
    """Who speaks to whom: BSS is the radar sub-system, MSS the master sub-system of a chip."""

    TO_BSS = 1
    FROM_BSS = 2
    TO_MSS = 5
    FROM_MSS = 6


class Kind(IntEnum):
    """Type of a message."""

    COMMAND = 0
    RESPONSE = 1
    NACK = 2
    EVENT = 3


class Refusal(IntEnum):
    """Error codes of a refused command that the hardware notes name."""

    MESSAGE = 1
    NO_SUB_BLOCK = 2
    SUB_BLOCK = 3
    LENGTH = 4
    DATA = 5
    PROCESSING = 6
    FILE_CRC = 7
    FILE_TYPE = 8
    ALREADY_STARTED = 20
    ALREADY_STOPPED = 21
    NO_FRAME = 22
    RX = 24
    TX = 25
    CASCADE = 26
    START_FREQUENCY = 36
    IDLE = 37
    RAMP_END = 40
    RAMP_BEFORE_SAMPLES = 41
    SLOPE = 46
    SAMPLES = 48
    SAMPLE_RATE = 49
    GAIN = 52
    CHIRP = 59
    FRAME = 72
    LOOPS = 77
    PERIOD = 79
    ON_TIME = 80
    TRIGGER = 81
    TRIGGER_DELAY = 82
    FRAME_RUNNING = 83


class CommandRefusedError(Exception):
    """The chip answers with an error code.

    Args:
        code: the error.
        block: sub-block it is about.
        reason: for the list of violations.
    """

    def __init__(self, code: int, block: int, reason: str) -> None:
        self.code, self.block, self.reason = int(code), block, reason
        super().__init__(f"error {self.code} on sub-block 0x{block:04x}: {reason}")


class BadMessageError(Exception):
    """Bytes that the chip cannot take for a message.

    Args:
        reason: what is wrong.
        header: when the header itself is whole, the message it announces: then the chip answers NACK; None: silence.
    """

    def __init__(self, reason: str, header: Message | None = None) -> None:
        self.header = header
        super().__init__(reason)


@dataclass(frozen=True, slots=True)
class SubBlock:
    """One sub-block: id = message * 32 + n, and its data."""

    identity: int
    data: bytes = b""


@dataclass(frozen=True, slots=True)
class Message:
    """One message of either direction.

    Args:
        direction, kind: see their types.
        identity: message number.
        sequence: 0..15.
        blocks: sub-blocks.
        remaining: chunks that follow.
        count: sub-blocks that a received header announces.
    """

    direction: int
    kind: int
    identity: int
    sequence: int = 0
    blocks: tuple[SubBlock, ...] = ()
    remaining: int = 0
    count: int = 0

    def to_bytes(self, crc_32: bool = True) -> bytes:
        """Header, payload padded to 4 bytes with FF, CRC-32 or CRC-16; without the sync word."""
        payload = b"".join(struct.pack("<2H", b.identity, 4 + len(b.data)) + b.data for b in self.blocks)
        payload += b"\xff" * (-len(payload) % 4)
        opcode = self.direction | self.kind << 4 | self.identity << 6
        flags = FLAGS_CRC32 if crc_32 else _FLAGS_LOGGED if self.kind == Kind.EVENT else 0
        length = HEADER.size + len(payload) + (CRC_BYTES if crc_32 else 2)
        words = (opcode, length, flags | self.sequence << 12, self.remaining, len(self.blocks))
        body = struct.pack("<6H", *words, checksum(words)) + payload
        return body + (struct.pack("<I", zlib.crc32(body)) if crc_32 else struct.pack("<H", crc16(body)))


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021 from 0xFFFF."""
    return binascii.crc_hqx(data, 0xFFFF)


def checksum(words: Sequence[int]) -> int:
    """One's complement of the one's complement sum of 16-bit words (ICD: 0281 0800 040C 0000 0001 -> F171)."""
    total = sum(words)
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def parse_header(data: bytes) -> Message:
    """The message that the host wrote, without its sub-blocks: everything the chip checks before it looks at them.

    Args:
        data: what was written to SPI, sync word first.
    Raises:
        BadMessageError: sync, length, checksum, flags or CRC-32 are wrong.
    """
    if data[:4] != HOST_SYNC:
        raise BadMessageError(f"sync {data[:4].hex()} instead of {HOST_SYNC.hex()}")
    body = data[4:]
    if len(body) < HEADER.size + CRC_BYTES:
        raise BadMessageError(f"{len(body)} bytes are no message")
    opcode, length, flags, remaining, count, check = HEADER.unpack_from(body)
    if checksum(HEADER.unpack_from(body)[:5]) != check:
        raise BadMessageError(f"header checksum {check:04x}")
    header = Message(opcode & 15, opcode >> 4 & 3, opcode >> 6, flags >> 12, (), remaining, count)
    if length != len(body) or len(data) > LONGEST_MESSAGE or length % 4:
        raise BadMessageError(f"length {length}, {len(body)} bytes after the sync word were written", header)
    if flags & 0x0FFF & ~_RETRY_BITS != FLAGS_CRC32:
        raise BadMessageError(f"flags {flags:04x}: CRC-32 and version 0 expected", header)
    if zlib.crc32(body[:-CRC_BYTES]) != int.from_bytes(body[-CRC_BYTES:], "little"):
        raise BadMessageError("CRC-32", header)
    return header


def sub_blocks(data: bytes, header: Message) -> tuple[SubBlock, ...]:
    """Sub-blocks of a message whose header is right.

    Raises:
        CommandRefusedError: no sub-block, or lengths of sub-blocks that do not fit the payload.
    """
    payload, count = data[4 + HEADER.size : -CRC_BYTES], header.count
    if count == 0:
        raise CommandRefusedError(Refusal.NO_SUB_BLOCK, 0, "message without sub-block")
    found: list[SubBlock] = []
    for _ in range(count):
        if len(payload) < 4:
            raise CommandRefusedError(Refusal.NO_SUB_BLOCK, 0, f"{len(found)} of {count} sub-blocks")
        identity, length = struct.unpack_from("<2H", payload)
        if not 4 <= length <= len(payload):
            raise CommandRefusedError(Refusal.LENGTH, identity, f"length {length} of {len(payload)} bytes left")
        found.append(SubBlock(identity, payload[4:length]))
        payload = payload[length:]
    if payload.strip(b"\xff") or len(payload) > 3:
        raise CommandRefusedError(Refusal.LENGTH, found[-1].identity, f"{len(payload)} bytes after the last sub-block")
    return tuple(found)
