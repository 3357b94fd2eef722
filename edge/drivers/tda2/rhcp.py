# SPDX-License-Identifier: Apache-2.0
"""Messages of the radar chips (AWR2243) as they go over SPI: header with checksum, sub-blocks, CRC, refusals, events.

Source: TI Radar Interface Control Document 2.23. All numbers little endian; a message is a sync word, then

    u16 opcode (direction[3:0], type[5:4], message[15:6]), u16 length of header, payload and CRC, u16 flags
    (crcAbsent[9:8], crcLength[11:10], sequence[15:12]), u16 remaining chunks, u16 sub-blocks, u16 checksum,
    sub-blocks {u16 id = 32 message + n, u16 length of all of it, data}, FF up to a multiple of 4, CRC

The host uses CRC-32. A chip uses CRC-16/CCITT-FALSE until the host has chosen (messages of a real chip in TI's forum,
E2E 1267477), so the flags of every message say how it is to be checked.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from edge.drivers.tda2.crc import crc16, ones_complement

HOST_SYNC = bytes.fromhex("34122143")
READ_REQUEST = bytes.fromhex("78566587") + b"\xff" * 12
"""Written before an answer is read; the chip lowers its interrupt line."""
CHIP_SYNC = bytes.fromhex("badccdab")
HEADER_BYTES = 12
LONGEST_MESSAGE = 256
SEQUENCES = 16
_FLAGS_CRC32 = 0x0400
_CRC_BYTES = {0: 2, 1: 4, 2: 8}
_REFUSAL_MESSAGE = 0


class Direction(IntEnum):
    """Which half of a chip is spoken to: the radar (BSS) or the master sub-system (MSS)."""

    TO_RADAR = 1
    FROM_RADAR = 2
    TO_MASTER = 5
    FROM_MASTER = 6


class Kind(IntEnum):
    """Type of a message."""

    COMMAND = 0
    RESPONSE = 1
    NACK = 2
    EVENT = 3


class Event(IntEnum):
    """Sub-blocks of asynchronous events."""

    RADAR_CPU_FAULT = 0x1002
    RADAR_ESM_FAULT = 0x1003
    CALIBRATED = 0x1004
    FRAME_STARTED = 0x100B
    FRAME_ENDED = 0x100F
    POWERED_UP = 0x5000
    RADAR_POWERED_UP = 0x5001
    CPU_FAULT = 0x5002
    ESM_FAULT = 0x5003
    BOOT_STATUS = 0x5005
    RADAR_ERROR = 0x5008
    SUPPLY_FAULT = 0x5009


_CPU_FAULTS = {
    Event.RADAR_CPU_FAULT: "CPU fault of the radar sub-system",
    Event.CPU_FAULT: "CPU fault of the master sub-system",
}
_MONITOR_FAULTS = {
    Event.RADAR_ESM_FAULT: "uncorrectable error of the radar sub-system (ESM group 2)",
    Event.ESM_FAULT: "uncorrectable error of the master sub-system (ESM group 2)",
}
_STATUS_FAULTS = {
    Event.RADAR_ERROR: "failure of the radar sub-system",
    Event.SUPPLY_FAULT: "fault of its analogue supply",
}

REFUSALS = {
    1: "unknown message",
    2: "no sub-block",
    3: "unknown sub-block",
    4: "wrong sub-block length",
    5: "value out of range",
    6: "cannot be processed now",
    7: "CRC of the file",
    8: "type of the file",
    20: "frames run already",
    21: "frames are stopped already",
    22: "no frame is configured",
    24: "receivers",
    25: "transmitters",
    26: "place in the cascade",
    36: "start frequency",
    37: "idle time",
    40: "ramp end",
    41: "ramp end",
    46: "slope",
    48: "number of samples",
    49: "sample rate",
    52: "receiver gain",
    77: "loops",
    79: "frame period",
    80: "bursts are longer than the frame period",
    81: "trigger select",
    82: "trigger delay",
    83: "frames are running",
    160: "dummy chirp at the end of the frame",
}
ALREADY_STOPPED = 21
TRANSIENT = frozenset({6, 7})
"""Refusals that a reset and a new transfer may cure."""
CALIBRATIONS = {
    1: "APLL",
    2: "VCO1",
    3: "VCO2",
    4: "LO distribution",
    5: "ADC DC offset",
    6: "high-pass filter",
    7: "low-pass filter",
    8: "peak detector",
    9: "transmit power",
    10: "receive gain",
    11: "transmit phase",
    12: "IQ mismatch",
}
"""Bits of the initial calibration's status."""


class ChipMessageError(ValueError):
    """Bytes read from a chip that are no message; says which check failed."""


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a message that a chip sends.

    Args:
        direction, kind: see their types.
        message: number of the message that is answered; 0: a refusal.
        length: of header, payload and CRC in bytes.
        crc_bytes: 0, 2, 4 or 8.
        sequence: of the command that is answered.
        blocks: number of sub-blocks.
        raw: the 12 bytes.
    """

    direction: int
    kind: int
    message: int
    length: int
    crc_bytes: int
    sequence: int
    blocks: int
    raw: bytes

    @property
    def payload_bytes(self) -> int:
        """Bytes between header and CRC."""
        return self.length - HEADER_BYTES - self.crc_bytes


@dataclass(frozen=True, slots=True)
class ChipMessage:
    """A message of a chip, checked.

    Args:
        header: its header.
        blocks: sub-block id and data, in order.
    """

    header: Header
    blocks: tuple[tuple[int, bytes], ...]

    @property
    def refusal(self) -> tuple[int, int] | None:
        """Error code and sub-block of a refused command; None: it was not refused."""
        if self.header.kind != Kind.RESPONSE or self.header.message != _REFUSAL_MESSAGE or not self.blocks:
            return None
        data = self.blocks[0][1].ljust(4, b"\0")
        code, block = struct.unpack_from("<2H", data)
        return code, block

    def data(self, block: int) -> bytes:
        """Data of a sub-block, empty when the message has none such."""
        return dict(self.blocks).get(block, b"")


def encode(
    direction: int, message: int, sequence: int, blocks: Sequence[tuple[int, bytes]], remaining: int = 0
) -> bytes:
    """A command with sync word and CRC-32.

    Args:
        direction: see ``Direction``.
        message: number.
        sequence: of this chip, 0..15.
        blocks: sub-block id and data.
        remaining: chunks that follow this one.
    Raises:
        ValueError: longer than 256 bytes.
    """
    payload = b"".join(struct.pack("<2H", block, 4 + len(data)) + data for block, data in blocks)
    payload += b"\xff" * (-len(payload) % 4)
    flags = _FLAGS_CRC32 | sequence << 12
    words = (direction | message << 6, HEADER_BYTES + len(payload) + 4, flags, remaining, len(blocks))
    body = struct.pack("<6H", *words, ones_complement(words)) + payload
    whole = HOST_SYNC + body + struct.pack("<I", zlib.crc32(body))
    if len(whole) > LONGEST_MESSAGE:
        raise ValueError(f"a message of {len(whole)} bytes, at most {LONGEST_MESSAGE}")
    return whole


def parse_header(raw: bytes) -> Header:
    """Header of an answer or event. ChipMessageError: checksum, CRC type or length."""
    opcode, length, flags, _, blocks, check = struct.unpack("<6H", raw)
    expected = ones_complement(struct.unpack_from("<5H", raw))
    if check != expected:
        raise ChipMessageError(f"header checksum 0x{check:04x} instead of 0x{expected:04x} ({raw.hex()})")
    crc_bytes = 0 if flags >> 8 & 3 else _CRC_BYTES.get(flags >> 10 & 3, 0)
    header = Header(opcode & 15, opcode >> 4 & 3, opcode >> 6, length, crc_bytes, flags >> 12, blocks, raw)
    if not HEADER_BYTES + crc_bytes <= length <= LONGEST_MESSAGE:
        raise ChipMessageError(f"header that announces {length} bytes ({raw.hex()})")
    return header


def parse_message(header: Header, payload: bytes, crc: bytes) -> ChipMessage:
    """Message from what was read after its header. ChipMessageError: CRC or sub-blocks that do not fit."""
    checked = header.raw + payload
    if header.crc_bytes in (2, 4):
        expected = crc16(checked) if header.crc_bytes == 2 else zlib.crc32(checked)
        if int.from_bytes(crc, "little") != expected:
            raise ChipMessageError(f"CRC {crc.hex()} instead of {expected.to_bytes(header.crc_bytes, 'little').hex()}")
    blocks, rest = [], payload
    for _ in range(header.blocks):
        if len(rest) < 4 or not 4 <= (size := int.from_bytes(rest[2:4], "little")) <= len(rest):
            raise ChipMessageError(f"sub-blocks that do not fit {len(payload)} bytes ({payload.hex()})")
        blocks.append((int.from_bytes(rest[:2], "little"), rest[4:size]))
        rest = rest[size:]
    return ChipMessage(header, tuple(blocks))


def fault_text(block: int, data: bytes) -> str:
    """What an event says is broken; "" when the chip works on.

    Group 1 of the error signalling module (first word) holds corrected errors, group 2 (second word) the others; in
    status events 0 is no fault (mmwavelink). BOOT_STATUS is no fault by itself: it follows every firmware image.
    """
    words = struct.unpack("<2I", data[:8].ljust(8, b"\0"))
    for faults, broken in ((_CPU_FAULTS, True), (_MONITOR_FAULTS, words[1] != 0), (_STATUS_FAULTS, words[0] != 0)):
        for event, text in faults.items():
            if block == event and broken:
                return text
    return ""


def refusal_text(code: int, block: int) -> str:
    """An error code in words."""
    if code in REFUSALS:
        what = REFUSALS[code]
    else:
        what = "a chirp's field" if 59 <= code <= 71 else "a frame's field" if 72 <= code <= 83 else "not in TI's list"
    return f"error {code} ({what}) on sub-block 0x{block:04x}"
