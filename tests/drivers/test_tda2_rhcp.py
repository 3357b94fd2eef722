# SPDX-License-Identifier: Apache-2.0
"""Messages of the radar chips: published vectors, bytes of real chips, and everything that fails a check."""

from __future__ import annotations

import struct
import zlib

import pytest

from edge.drivers.tda2 import steps as s
from edge.drivers.tda2.chips import ChipAnswerError, ChipFaultError
from edge.drivers.tda2.crc import crc16, ones_complement
from edge.drivers.tda2.packets import CHIPS, Opcode
from edge.drivers.tda2.plan import command_packet, read_packets
from edge.drivers.tda2.reports import boot_note, check_calibration, temperatures, version_text
from edge.drivers.tda2.rhcp import (
    READ_REQUEST,
    ChipMessage,
    ChipMessageError,
    Direction,
    Event,
    Kind,
    encode,
    fault_text,
    parse_header,
    parse_message,
    refusal_text,
)
from edge.drivers.tda2.steps import Command

PROFILE_A = bytes.fromhex("00000200e4388e55f401000058020000a00f00000000000000000000650600000001401f0000000030000000")
FRAME_8_LOOPS = "000000000b00080000000002d5dc3200{:02x}00000000000000"


def message(raw: bytes) -> ChipMessage:
    """A message without its sync word, as it would be read."""
    header = parse_header(raw[:12])
    end = 12 + header.payload_bytes
    return parse_message(header, raw[12:end], raw[end:])


def answer(opcode: int, payload: bytes = b"", blocks: int = 0, flags: int = 0x6400) -> bytes:
    """An answer with CRC-32 and right check sums."""
    words = (opcode, 16 + len(payload), flags, 0, blocks)
    body = struct.pack("<6H", *words, ones_complement(words)) + payload
    return body + struct.pack("<I", zlib.crc32(body))


def test_profile_message() -> None:
    got = encode(Direction.TO_RADAR, 0x08, 6, [(0x0100, PROFILE_A)])
    expected = bytes.fromhex("3412214301024000006400000100bd9900013000") + PROFILE_A + bytes.fromhex("4c4f5eb4")
    assert got == expected


@pytest.mark.parametrize(
    ("data", "crc"),
    [
        (FRAME_8_LOOPS.format(1), "5cb47681"),
        (FRAME_8_LOOPS.format(2), "bfb3f90f"),
        ("000000000b00080000000002954032000200000000000000", "dc6797ec"),
    ],
)
def test_frame_messages(data: str, crc: str) -> None:
    assert encode(Direction.TO_RADAR, 0x08, 3, [(0x0102, bytes.fromhex(data))])[-4:].hex() == crc


@pytest.mark.parametrize(("device", "crc"), [(1, "a684"), (2, "e830"), (4, "5548"), (8, "2fb9")])
def test_start_packets(device: int, crc: str) -> None:
    start = s.trigger_step("start", device, s.START).action
    assert isinstance(start, Command)
    packet = command_packet(device, start, 5).to_bytes()
    middle = "341221438102180000540000010065a94001080001000000ee0e8977"
    assert packet.hex() == f"2c000000c8a5230000002800{device:02x}1000000000{middle}{crc}"


def test_firmware_heads() -> None:
    image = b"MSTR".ljust(7936, b"\0")
    chunk = struct.pack("<2I", 0, 7936) + image[:224]
    got = encode(Direction.TO_MASTER, 0x204, 0, [(0x4080, chunk)], 34)
    assert got.hex().startswith("341221430581fc00000422000100db798040ec0000000000001f00004d535452")
    assert len(got) == 256
    with pytest.raises(ValueError, match="at most 256"):
        encode(Direction.TO_MASTER, 0x204, 0, [(0x4080, chunk + b"\0")], 34)


def test_payload_is_padded() -> None:
    got = encode(Direction.TO_RADAR, 0x08, 0, [(0x0100, b"\1\2\3")])
    assert got[16:24] == bytes.fromhex("00010700010203ff")
    assert message(got[4:]).blocks == ((0x0100, b"\1\2\3"),)


def test_read_request() -> None:
    packets = [packet.to_bytes().hex() for _, packet in read_packets(1, 36)]
    assert packets[0] == "20000000c8a5230000001c0001010000000078566587ffffffffffffffffffffffff0959"
    assert len(READ_REQUEST) == 16
    assert [packet[-8:-4] for packet in packets[1:]] == ["0400", "0c00", "2400", "0400"]


def test_answer_of_the_notes() -> None:
    got = message(bytes.fromhex("12021000006400000000dd99" + "61758826"))
    assert (got.header.direction, got.header.kind, got.header.message) == (Direction.FROM_RADAR, Kind.RESPONSE, 8)
    assert (got.header.sequence, got.blocks, got.refusal) == (6, (), None)


def test_event_with_crc_32() -> None:
    head = bytes.fromhex("36a03400000400000100945b")
    header = parse_header(head)
    assert (header.kind, header.message, header.payload_bytes, header.crc_bytes) == (Kind.EVENT, 0x280, 36, 4)


def test_event_of_a_real_chip_with_crc_16() -> None:
    """CPU fault of an AWR2243 before its CRC type was set, as a user logged it (TI E2E 1267477)."""
    payload = bytes.fromhex("0250240005000000800000fe") + bytes(16) + b"\xff" * 6 + bytes(2)
    got = message(bytes.fromhex("36a032000c00000001008a5f") + payload + bytes.fromhex("f4b5"))
    assert (got.header.crc_bytes, got.header.payload_bytes) == (2, 36)
    assert [(block, len(data)) for block, data in got.blocks] == [(Event.CPU_FAULT, 32)]
    assert int.from_bytes(bytes.fromhex("f4b5"), "little") == crc16(got.header.raw + payload)


def test_refusal() -> None:
    payload = struct.pack("<4H", 0, 8, 37, 0x0100)
    got = message(answer(0x0012, payload, 1))
    assert got.refusal == (37, 0x0100)
    assert refusal_text(37, 0x0100) == "error 37 (idle time) on sub-block 0x0100"
    assert "a chirp's field" in refusal_text(65, 0x0101)
    assert "a frame's field" in refusal_text(75, 0x0102)
    assert "not in TI's list" in refusal_text(999, 1)


GOOD = answer(0x0212, struct.pack("<2HI", 0x0220, 8, 1), 1)


@pytest.mark.parametrize(
    ("raw", "what"),
    [
        (GOOD[:2] + b"\x19" + GOOD[3:], "header checksum"),
        (GOOD[:-1] + bytes([GOOD[-1] ^ 1]), "CRC"),
        (GOOD[:15] + bytes([GOOD[15] ^ 1]) + GOOD[16:], "CRC"),
        (answer(0x0212, struct.pack("<2HI", 0x0220, 12, 1), 1), "sub-blocks that do not fit"),
        (answer(0x0212, struct.pack("<2HI", 0x0220, 3, 1), 1), "sub-blocks that do not fit"),
        (answer(0x0212, struct.pack("<2HI", 0x0220, 8, 1), 2), "sub-blocks that do not fit"),
        (answer(0x0212, bytes(244)), "announces 260 bytes"),
    ],
)
def test_damaged_messages(raw: bytes, what: str) -> None:
    with pytest.raises(ChipMessageError, match=what):
        message(raw)


def test_header_shorter_than_itself() -> None:
    words = (0x0212, 12, 0x0400, 0, 0)
    with pytest.raises(ChipMessageError, match="announces 12 bytes"):
        parse_header(struct.pack("<6H", *words, ones_complement(words)))


def test_message_without_crc() -> None:
    words = (0x0212, 12, 0x6500, 0, 0)
    got = message(struct.pack("<6H", *words, ones_complement(words)))
    assert (got.header.crc_bytes, got.header.sequence) == (0, 6)


def test_calibration_result() -> None:
    check_calibration("master", struct.pack("<2I2H2I", 0x1FFE, 0x1FFE, 45, 0, 0, 0))
    with pytest.raises(ChipFaultError, match="failed: VCO2, transmit power"):
        check_calibration("master", struct.pack("<2I2H2I", 0x1FFE & ~(1 << 3 | 1 << 9), 0, 45, 0, 0, 0))
    check_calibration("master", struct.pack("<2I2H2I", 0x1FFE | 1, 0, 45, 0, 0, 0))
    with pytest.raises(ChipAnswerError, match="4 bytes"):
        check_calibration("master", bytes(4))


def test_temperatures_and_versions() -> None:
    got = temperatures("master", struct.pack("<I10hI", 7, *range(-2, 8), 0))
    assert (got["RX0"], got["TX0"], got["DIG1"]) == (-2, 2, 7)
    with pytest.raises(ChipAnswerError, match="20 bytes"):
        temperatures("master", bytes(20))
    data = bytes((1, 1, 1, 2, 2, 1, 7, 20, 3, 17, 2, 2, 21, 8, 5, 0x1D))
    assert version_text(data) == "2.2.1.7 patch 2.2.1.13"
    assert version_text(data[:15]) == "unknown"


def test_what_events_break() -> None:
    """TI's host takes boot status and corrected errors for good news; so must this one."""
    clean, group_2 = bytes(32), struct.pack("<2I", 0, 1 << 12)
    assert fault_text(Event.BOOT_STATUS, b"\xff" * 32) == ""
    assert fault_text(Event.FRAME_ENDED, b"\xff" * 32) == ""
    assert "CPU fault of the radar" in fault_text(Event.RADAR_CPU_FAULT, clean)
    assert fault_text(Event.RADAR_ESM_FAULT, struct.pack("<2I", 0xFFFF, 0)) == ""
    assert "ESM group 2" in fault_text(Event.ESM_FAULT, group_2)
    assert fault_text(Event.RADAR_ERROR, clean) == ""
    assert "radar sub-system" in fault_text(Event.RADAR_ERROR, struct.pack("<2I", 3, 0))
    assert "supply" in fault_text(Event.SUPPLY_FAULT, struct.pack("<2I", 1, 1))
    assert boot_note("master", struct.pack("<IQQ", 999, 0, 0)) == ""
    assert boot_note("master", struct.pack("<IQQ", 999, 1 << 30, 0)) == "master: boot status 0x40000000, 0 is good"


def test_message_numbers_follow_from_sub_blocks() -> None:
    for block, expected in ((0x4080, (5, 0x204)), (0x02CC, (1, 0x16)), (0x0223, (1, 0x11)), (0x40C0, (5, 0x206))):
        command = Command("", block)
        assert (command.direction, command.message) == expected
    assert Opcode.SPI_WRITE == 0x23
    assert CHIPS == (1, 2, 4, 8)
