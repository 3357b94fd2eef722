# SPDX-License-Identifier: Apache-2.0
"""The control protocol of the cascade's capture board (TCP): packets, CRC-16, opcodes, as the board sees them."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

HOST_SYNC, BOARD_SYNC = 0xA5C8, 0x8C5A
LENGTH = struct.Struct("<I")
HEAD = struct.Struct("<HHHHBB4x")
"""Sync, opcode, ackCode, dataLength, devSelection, ackType, four reserved bytes."""
CRC = struct.Struct("<H")
LARGEST_DATA = 498
_COUNTED = HEAD.size - 2
"""dataLength counts opcode to data: neither sync nor CRC."""
BOARD = 32
"""Bit of the capture board itself in devSelection; the radar chips have 1, 2, 4, 8."""


class Opcode(IntEnum):
    """Orders of the host and what the board sends."""

    CONNECT = 0x10
    DISCONNECT = 0x11
    PING = 0x12
    VERSION_GET = 0x13
    CONFIG_SET = 0x14
    CONFIG_GET = 0x15
    TRACE_START = 0x16
    TRACE_FETCH = 0x17
    CREATE_APP = 0x18
    STATS_START = 0x19
    DEVICE_MAP = 0x1A
    DEV_RESET = 0x20
    SET_SOP = 0x21
    GET_SOP = 0x22
    SPI_WRITE = 0x23
    SPI_READ = 0x24
    GPIO_CONFIGURE = 0x25
    GPIO_SET = 0x26
    GPIO_GET = 0x27
    START_RECORD = 0x31
    STOP_RECORD = 0x32
    FRAME_PERIOD = 0x35
    NUM_FILES = 0x36
    PACKING = 0x37
    SESSION_DIR = 0x38
    NUM_FRAMES = 0x39
    ACK = 0x81
    NACK = 0x82
    VERSION = 0x83
    CONFIG = 0x84
    TRACE = 0x85
    GPIO = 0x86
    HOST_IRQ = 0x88
    SPI_DATA = 0x89
    SOP = 0x8A


class AckType(IntEnum):
    """When an order is answered."""

    PROCESSED = 0x01
    RECEIVED = 0x10
    NONE = 0x11


class FramingError(Exception):
    """The byte stream can no longer be cut into packets."""


class NackError(Exception):
    """An order that the board does not carry out; the reason goes to the list of violations."""


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet of either direction.

    Args:
        opcode: see ``Opcode``; any number.
        device: devSelection.
        ack_type: see ``AckType``; any number.
        data: at most 498 bytes.
        ack_code: in answers the opcode that is answered.
        fault: what is wrong with a received packet that was cut out well; "": nothing.
    """

    opcode: int
    device: int
    ack_type: int = AckType.PROCESSED
    data: bytes = b""
    ack_code: int = 0
    fault: str = ""

    def to_bytes(self, sync: int = BOARD_SYNC) -> bytes:
        """The packet with its length and CRC, as the board sends it."""
        head = HEAD.pack(sync, self.opcode, self.ack_code, _COUNTED + len(self.data), self.device, self.ack_type)
        body = head + self.data
        return LENGTH.pack(len(body) + CRC.size) + body + CRC.pack(crc16(body[2:]))

    def answer(self, opcode: int, data: bytes = b"") -> Packet:
        """An answer to this packet: same device and ackType."""
        return Packet(opcode, self.device, self.ack_type, data, self.opcode)


def _crc_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        crc = value << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
        table.append(crc)
    return tuple(table)


_CRC_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF, not reflected ("123456789" -> 0x29B1)."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc << 8) & 0xFFFF ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


class PacketReader:
    """Cuts the host's byte stream into packets, however the bytes arrive."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> list[Packet]:
        """Packets that are complete now.

        Raises:
            FramingError: a length or sync word after which no packet can be found.
        """
        self._bytes += data
        packets: list[Packet] = []
        while len(self._bytes) >= LENGTH.size:
            (length,) = LENGTH.unpack_from(self._bytes)
            if not HEAD.size + CRC.size <= length <= HEAD.size + LARGEST_DATA + CRC.size:
                raise FramingError(f"packet length {length}")
            if len(self._bytes) < LENGTH.size + length:
                break
            packets.append(_packet(bytes(self._bytes[LENGTH.size : LENGTH.size + length])))
            del self._bytes[: LENGTH.size + length]
        return packets


def _packet(body: bytes) -> Packet:
    sync, opcode, ack_code, counted, device, ack_type = HEAD.unpack_from(body)
    if sync != HOST_SYNC:
        raise FramingError(f"sync 0x{sync:04x}")
    data = body[HEAD.size : -CRC.size]
    (crc,) = CRC.unpack(body[-CRC.size :])
    fault = ""
    if crc != crc16(body[2 : -CRC.size]):
        fault = f"CRC 0x{crc:04x}"
    elif counted != _COUNTED + len(data):
        fault = f"dataLength {counted} of {_COUNTED + len(data)} bytes"
    elif ack_code or any(body[HEAD.size - 4 : HEAD.size]):
        fault = f"ackCode {ack_code} or reserved bytes are not 0"
    elif ack_type not in list(AckType):
        fault = f"ackType 0x{ack_type:02x}"
    return Packet(opcode, device, ack_type, data, ack_code, fault)
