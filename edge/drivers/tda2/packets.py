# SPDX-License-Identifier: Apache-2.0
"""Packets between host and capture board: framing, CRC-16, opcodes, and a reader for bytes that come in any pieces.

Source: TI's capture host and replayed traces of it. All numbers little endian; a packet is

    u32 length of what follows, u16 sync, u16 opcode, u16 ackCode, u16 dataLength, u8 devSelection, u8 ackType,
    4 reserved bytes, data (at most 498 bytes), u16 CRC over opcode to data

where dataLength counts opcode to data, and ackCode is the opcode that is answered.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from edge.drivers.tda2.crc import crc16

HOST_SYNC, BOARD_SYNC = 0xA5C8, 0x8C5A
LARGEST_DATA = 498
_LENGTH = struct.Struct("<I")
_HEAD = struct.Struct("<4H2B4x")
_CRC = struct.Struct("<H")
_SHORTEST, _LONGEST = _HEAD.size + _CRC.size, _HEAD.size + LARGEST_DATA + _CRC.size

MASTER, SLAVE1, SLAVE2, SLAVE3 = 1, 2, 4, 8
SLAVES = (SLAVE1, SLAVE2, SLAVE3)
CHIPS = (MASTER, *SLAVES)
BOARD = 32
DEVICE_NAMES = {MASTER: "master", SLAVE1: "slave1", SLAVE2: "slave2", SLAVE3: "slave3", BOARD: "board"}
"""Bits of devSelection."""


class Opcode(IntEnum):
    """Orders of the host, and what the board sends."""

    CONNECT = 0x10
    DISCONNECT = 0x11
    PING = 0x12
    VERSION_GET = 0x13
    CONFIG_SET = 0x14
    TRACE_START = 0x16
    TRACE_STOP = 0x17
    CREATE_APP = 0x18
    DEVICE_MAP = 0x1A
    DEVICE_RESET = 0x20
    SET_SOP = 0x21
    SPI_WRITE = 0x23
    SPI_READ = 0x24
    START_RECORD = 0x31
    STOP_RECORD = 0x32
    FRAME_PERIOD = 0x35
    NUM_FILES = 0x36
    PACKING = 0x37
    SESSION_DIRECTORY = 0x38
    NUM_FRAMES = 0x39
    ACK = 0x81
    NACK = 0x82
    VERSION = 0x83
    TRACE = 0x85
    HOST_IRQ = 0x88
    SPI_DATA = 0x89


class AckType(IntEnum):
    """When an order is answered."""

    PROCESSED = 0x01
    RECEIVED = 0x10


class PacketError(ValueError):
    """Bytes of the board that are no packet: after them, none can be found in the stream."""


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet of either direction.

    Args:
        opcode: see ``Opcode``; of the board any number.
        device: devSelection.
        ack_type: see ``AckType``.
        data: at most 498 bytes.
        ack_code: in answers, the opcode that is answered.
    """

    opcode: int
    device: int
    ack_type: int = AckType.PROCESSED
    data: bytes = b""
    ack_code: int = 0

    def to_bytes(self, sync: int = HOST_SYNC) -> bytes:
        """The whole packet with its length; ValueError when the data are too long."""
        if len(self.data) > LARGEST_DATA:
            raise ValueError(f"{len(self.data)} bytes of data, at most {LARGEST_DATA} fit a packet")
        counted = _HEAD.size - 2 + len(self.data)
        body = _HEAD.pack(sync, self.opcode, self.ack_code, counted, self.device, self.ack_type) + self.data
        return _LENGTH.pack(len(body) + _CRC.size) + body + _CRC.pack(crc16(body[2:]))


class PacketReader:
    """Cuts a byte stream into packets, however the bytes arrive.

    Args:
        sync: of whom the stream comes from.
    """

    def __init__(self, sync: int = BOARD_SYNC) -> None:
        self._sync, self._bytes = sync, bytearray()

    @property
    def pending(self) -> int:
        """Bytes of a packet that is not complete yet."""
        return len(self._bytes)

    def feed(self, data: bytes) -> list[Packet]:
        """Packets that are complete now.

        Raises:
            PacketError: impossible length, other sync word, wrong CRC or wrong dataLength; says which.
        """
        self._bytes += data
        packets: list[Packet] = []
        while len(self._bytes) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._bytes)
            if not _SHORTEST <= length <= _LONGEST:
                raise PacketError(f"a packet of {length} bytes is announced, {_SHORTEST} to {_LONGEST} are possible")
            end = _LENGTH.size + length
            if len(self._bytes) < end:
                break
            packets.append(_parse(bytes(self._bytes[_LENGTH.size : end]), self._sync))
            del self._bytes[:end]
        return packets


def _parse(body: bytes, expected_sync: int) -> Packet:
    sync, opcode, ack_code, counted, device, ack_type = _HEAD.unpack_from(body)
    if sync != expected_sync:
        raise PacketError(f"sync word 0x{sync:04x} instead of 0x{expected_sync:04x}")
    (crc,) = _CRC.unpack_from(body, len(body) - _CRC.size)
    expected = crc16(body[2 : -_CRC.size])
    if crc != expected:
        raise PacketError(f"CRC-16 0x{crc:04x} instead of 0x{expected:04x}")
    if counted != len(body) - 2 - _CRC.size:
        raise PacketError(f"dataLength {counted} in a packet of {len(body)} bytes")
    return Packet(opcode, device, ack_type, body[_HEAD.size : -_CRC.size], ack_code)


def device_name(device: int) -> str:
    """Name of a devSelection; several bits are joined with "+"."""
    names = [name for bit, name in DEVICE_NAMES.items() if device & bit]
    return "+".join(names) or f"device {device}"


def order_name(opcode: int) -> str:
    """Name of an opcode for messages."""
    return Opcode(opcode).name if opcode in list(Opcode) else f"opcode 0x{opcode:02x}"
