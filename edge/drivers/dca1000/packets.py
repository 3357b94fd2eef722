# SPDX-License-Identifier: Apache-2.0
"""Bytes of the DCA1000: commands, answers, status bits, and the header of a packet of samples.

Source: TI's DCA1000EVM CLI software (command codes, FPGA configuration) and data packets captured from a real card. All
integers little endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from edge.config import require
from edge.errors import WireError

HEADER, FOOTER = 0xA55A, 0xEEAA
PAYLOAD_BYTES = 1456
"""Samples in a full packet; only the last one of a recording has fewer."""
DATA_HEADER_BYTES = 10
"""u32 sequence number from 1, 48 bit count of the sample bytes before this packet."""
PACKET_SIZE_FIELD = 1470
TICKS_PER_US = 125
DELAY_RANGE_US = (5.0, 500.0)
_START = struct.Struct("<3H")
_END = struct.Struct("<H")
_ANSWER = struct.Struct("<4H")
_LANES = {4: 1, 2: 2}
_TIMER_S = 30


class Code(IntEnum):
    """Command codes."""

    RESET_FPGA = 1
    RESET_RADAR = 2
    CONFIGURE_FPGA = 3
    CONFIGURE_EEPROM = 4
    RECORD_START = 5
    RECORD_STOP = 6
    SYSTEM_ALIVE = 9
    ASYNC_STATUS = 0xA
    PACKET_DELAY = 0xB
    FPGA_VERSION = 0xE


class Status(IntFlag):
    """What the card reports by itself."""

    NO_LVDS_DATA = 1 << 0
    NO_HEADER = 1 << 1
    EEPROM_FAILURE = 1 << 2
    SD_CARD_DETECTED = 1 << 3
    SD_CARD_REMOVED = 1 << 4
    SD_CARD_FULL = 1 << 5
    MODE_CONFIGURATION_FAILURE = 1 << 6
    DDR_FULL = 1 << 7
    RECORD_COMPLETED = 1 << 8
    LVDS_BUFFER_FULL = 1 << 9
    PLAYBACK_COMPLETED = 1 << 10
    PLAYBACK_OUT_OF_SEQUENCE = 1 << 11

    def text(self) -> str:
        """Names of the bits, for people; unknown ones by number."""
        words = [bit.name.lower().replace("_", " ") for bit in Status if bit in self and bit.name]
        unknown = int(self) & ~sum(Status)
        return ", ".join([*words, *([f"unknown bits 0x{unknown:04x}"] if unknown else [])]) or "none"


@dataclass(frozen=True, slots=True)
class Answer:
    """What the card sends to the command port.

    Args:
        code: of the command that is answered; ``Code.ASYNC_STATUS``: nobody asked.
        status: 0 good, 1 failed; version or status bits for the codes that carry them.
    """

    code: int
    status: int

    @property
    def is_status(self) -> bool:
        """Sent by itself; an answer to code 0xA looks the same."""
        return self.code == Code.ASYNC_STATUS


@dataclass(frozen=True, slots=True)
class FpgaVersion:
    """Version of the card's FPGA image.

    Args:
        major, minor: as TI counts them, "2.8".
        playback: image that plays recordings back.
    """

    major: int
    minor: int
    playback: bool

    def text(self) -> str:
        """For people."""
        return f"{self.major}.{self.minor}{' (playback)' if self.playback else ''}"


def command(code: Code, data: bytes = b"") -> bytes:
    """One command: header, code, length of the data, data, footer."""
    return _START.pack(HEADER, code, len(data)) + data + _END.pack(FOOTER)


def fpga_configuration(lanes: int) -> bytes:
    """Data of ``CONFIGURE_FPGA``: raw samples of 16 bits from LVDS to Ethernet.

    Args:
        lanes: 2 (xWR16xx, 18xx, 68xx, 29xx) or 4.
    Raises:
        ConfigError: another number.
    """
    require(lanes in _LANES, "schedule.lvds_lanes", lanes, "2 or 4")
    return bytes((1, _LANES[lanes], 1, 2, 3, _TIMER_S))


def packet_delay(delay_s: float) -> bytes:
    """Data of ``PACKET_DELAY``: size of a packet, pause between packets in steps of 8 ns.

    Args:
        delay_s: 5 to 500 us.
    Raises:
        ConfigError: outside.
    """
    delay_us = round(1e6 * delay_s, 3)
    low, high = DELAY_RANGE_US
    require(low <= delay_us <= high, "schedule.packet_delay_s", delay_s, "5e-6 to 500e-6")
    return struct.pack("<3H", PACKET_SIZE_FIELD, round(delay_us * TICKS_PER_US), 0)


def parse_answer(packet: bytes) -> Answer:
    """One packet from the command port.

    Raises:
        WireError: wrong size, header or footer.
    """
    if len(packet) == _ANSWER.size:
        header, code, status, footer = _ANSWER.unpack(packet)
        if (header, footer) == (HEADER, FOOTER):
            return Answer(code, status)
    raise WireError("no answer of a capture card", value=packet[:16].hex(), allowed="8 bytes: 5aa5 ... aaee")


def parse_version(status: int) -> FpgaVersion:
    """Version from the status of ``FPGA_VERSION``: major in bits 6:0, minor in 13:7, bit 14 playback."""
    return FpgaVersion(status & 0x7F, status >> 7 & 0x7F, bool(status >> 14 & 1))


def data_header(sequence: int, byte_count: int) -> bytes:
    """Header of a packet of samples."""
    return struct.pack("<IIH", sequence & 0xFFFFFFFF, byte_count & 0xFFFFFFFF, byte_count >> 32)


def parse_data_header(packet: bytes) -> tuple[int, int]:
    """Sequence number and byte count of a packet of samples.

    Raises:
        WireError: no room for a header and one sample byte, or more than a packet holds.
    """
    if not DATA_HEADER_BYTES < len(packet) <= DATA_HEADER_BYTES + PAYLOAD_BYTES:
        raise WireError("no packet of samples", value=f"{len(packet)} bytes", allowed="11 to 1466 bytes")
    sequence, low, high = struct.unpack_from("<IIH", packet)
    return sequence, low | high << 32
