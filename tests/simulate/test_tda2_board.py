# SPDX-License-Identifier: Apache-2.0
"""The emulated capture board against every byte of the hardware notes, from a raw socket; files that it writes."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tda2_host as h
from tda2_captures import (
    DEVICES,
    FRAME_BYTES,
    LOOPS,
    SAMPLES,
    Make,
    ack_of,
    boards_in,
    frames_in,
    hexes,
    record,
    run_capture,
    supply,
)
from tda2_host import ACK, VERSION, Host, Received

from edge.frames import Layout
from edge.sources.ti_index import read_index
from train.simulate.faults import Faults
from train.simulate.rhcp import Direction, Kind, Message, SubBlock


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    yield from boards_in(tmp_path)


VECTORS = [
    "10000000 c8a5120000000c00201000000000a695",
    "18000000 c8a51a00000014002010000000000101010104000000 25b9",
    "10000000 c8a5100000000c00010100000000ef4d",
    "14000000 c8a521000000100001010000000004000000fdfd",
    "14000000 c8a521000000100002010000000004000000324c",
    "14000000 c8a5210000001000040100000000040000008d3f",
    "14000000 c8a521000000100008010000000004000000f3d8",
    "18000000 c8a514000000140001010000000000080000c0000000f4f6",
    "18000000 c8a51400000014000101000000000008000060000000821c",
    "18000000 c8a514000000140002010000000000080000c0000000577b",
    "14000000 c8a5350000001000201000000000 64000000 62e9",
    "14000000 c8a5350000001000201000000000 10000000 e661",
    "20000000 c8a5380000001c002010000000002f6d6e742f7373642f746573746469727cc7",
    "14000000 c8a5360000001000201000000000000000000c92",
    "14000000 c8a537000000100020100000000000000000283a",
    "14000000 c8a5390000001000201000000000 00000000 16eb",
    "14000000 c8a5390000001000201000000000 68010000 3700",
]
RESETS = [
    "10000000 c8a5200000000c000101000000001f14",
    "10000000 c8a5200000000c00020100000000ffda",
    "10000000 c8a5200000000c000401000000001e57",
    "10000000 c8a5200000000c00080100000000fd5c",
]


def test_every_packet_of_the_notes_is_answered(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        for text in VECTORS:
            order = hexes(text)
            host.send(order)
            assert host.receive() == ack_of(order), text
        for text in RESETS:
            order = hexes(text)
            host.send(order)
            assert host.answer() == (ACK, 0x20, order[12], b""), text
        host.send(hexes("10000000 c8a5130000000c00200100000000d838"))
        opcode, code, device, text_data = host.answer()
        assert (opcode, code, device) == (VERSION, 0x13, 32)
        assert text_data.decode().isprintable()
    assert all("before the master had its channels" in text for text in board.violations)
    assert len(board.violations) == 3


def test_golden_answers_bit_by_bit(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        host.send(hexes("10000000c8a5120000000c00201000000000a695"))
        assert host.receive() == hexes("10000000 5a8c810012000c00201000000000d447")
        start = hexes("10000000 c8a5310000000c002001000000009250")
        host.send(start)
        expected = h.packet(0x82, 32, 1, b"", 0x8C5A, 0x31)
        assert expected[-2:] == hexes("8264"), "the notes' CRC of this NACK"
        assert host.receive() == expected, "nothing is configured: NACK"
        h.connect(host)
        h.arm(host, LOOPS, SAMPLES, "golden", 1)
        assert host.order(0x32) == ACK
        assert host.order(0x18) == ACK
        host.send(start)
        assert host.receive() == hexes("10000000 5a8c810031000c002001000000001d61")
        assert host.order(0x21, 1, struct.pack("<I", 4)) == ACK
        host.send(hexes(RESETS[0]))
        assert host.receive() == ack_of(hexes(RESETS[0]))
        assert host.receive() == hexes("10000000 5a8c880000000c00010100000000b6cb"), "HOST_IRQ"
        host.send(hexes("20000000 c8a5230000001c0001010000000078566587ffffffffffffffffffffffff0959"))
        assert host.answer()[:2] == (ACK, 0x23)
        parts = []
        for text in ("0400 82c3", "0c00 2b4a", "2400 64c5"):
            host.send(hexes("12000000 c8a5240000000e00010100000000") + hexes(text))
            parts.append(host.answer()[3])
        parts.append(host.spi_read(1, 2))
        assert parts[0] == hexes("badccdab")
        assert parts[1] == hexes("36a032000c00000001008a5f"), "MSS powered up; the logged event's header"
        assert parts[2] == hexes("00502400") + bytes(32)
        assert int.from_bytes(parts[3], "little") == h.crc16(parts[1] + parts[2])


def test_event_of_a_chip_whose_crc_type_was_not_set() -> None:
    """CPU fault as a user logged it (TI E2E 1267477), and the notes' power-up event with CRC-32."""
    data = hexes("05000000800000fe") + bytes(16) + b"\xff" * 6 + bytes(2)
    fault = Message(Direction.FROM_MSS, Kind.EVENT, 0x280, blocks=(SubBlock(0x5002, data),))
    assert fault.to_bytes(False) == hexes("36a032000c00000001008a5f 02502400") + data + hexes("f4b5")
    powered = Message(Direction.FROM_MSS, Kind.EVENT, 0x280, blocks=(SubBlock(0x5000, bytes(32)),))
    assert powered.to_bytes() == hexes("36a03400000400000100945b 00502400") + bytes(32) + hexes("855f3afb")


def flags(message: Received) -> int:
    """Of a message's header, without the sequence number."""
    return int.from_bytes(message.raw[4:6], "little") & 0x0FFF


def test_crc_16_until_the_crc_type_is_set(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        h.connect(host)
        h.boot(host, 1)
        assert flags(host.good(1, 5, 0x207, 0x40E0)) == 0
        host.good(1, 5, 0x202, 0x404C, hexes("010000000000000000000000"))
        assert flags(host.good(1, 5, 0x207, 0x40E0)) == 0x0400
        host.good(1, 5, 0x200, 0x4000)
        host.event(1, 0x5001)
        assert board.violations == []
        host.order(0x20, 1)
        assert host.read(1).raw[4:6] == hexes("0c00"), "a reset chip has forgotten it"


def test_other_bytes_before_the_sync_word(make: Make) -> None:
    faults = Faults(seed=3)
    faults.set("babble", "horizontal/spi", value=4096, times=3)
    board = make(faults=faults)
    with Host(board.address) as host:
        h.connect(host)
        assert host.order(0x21, 1, struct.pack("<I", 4)) == ACK
        assert host.order(0x20, 1) == ACK
        host.event(1, 0x5000)
        assert len(host.before_sync) == 100, "at most"
        h.load_firmware(host, 1)
        assert host.before_sync == b""
        assert board.violations == []


def test_golden_profile_answer_and_start(make: Make) -> None:
    board = make(layout=Layout("cascade", 4, 8, 12, 256, 4))
    with Host(board.address) as host:
        h.connect(host)
        for device in DEVICES:
            h.boot(host, device)
            h.configure(host, device, 8, 256, 0, h.PROFILE_A)
        host.sequence[1] = 6
        board.chips[0]._sequence = 6
        message = h.rhcp(1, 8, 6, [(0x0100, h.PROFILE_A)])
        assert message == hexes("3412214301024000006400000100bd9900013000") + h.PROFILE_A + hexes("4c4f5eb4")
        host.spi(1, message)
        assert host.read(1).raw == hexes("12021000006400000000dd99 61758826")
        board.chips[0]._sequence = 3
        for trigger, crc in ((1, "5cb47681"), (2, "bfb3f90f")):
            frame = hexes(f"000000000b00080000000002d5dc3200 0{trigger}00 0000 00000000")
            sent = h.rhcp(1, 8, 3, [(0x0102, frame)])
            assert sent[-4:] == hexes(crc)
            board.chips[0]._sequence = 3
            host.spi(1, sent)
            assert host.read(1).refusal is None
        hardware = hexes("000000000b00080000000002954032000200000000000000")
        board.chips[0]._sequence = 3
        sent = h.rhcp(1, 8, 3, [(0x0102, hardware)])
        assert sent[-4:] == hexes("dc6797ec")
        host.spi(1, sent)
        assert host.read(1).refusal is None
        assert board.chips[0].frame is not None
        assert board.chips[0].frame.period * 5e-9 == pytest.approx(16.466665e-3, abs=1e-12)
        host.sequence[1] = 4
        host.good(1, 5, 0x206, 0x40C0, hexes("6000000000020000"))


@pytest.mark.parametrize(("device", "crc"), [(1, "a684"), (2, "e830"), (4, "5548"), (8, "2fb9")])
def test_start_message_bytes(device: int, crc: str) -> None:
    start = h.rhcp(1, 0x0A, 5, [(0x0140, hexes("01000000"))])
    head = f"2c000000 c8a5230000002800 0{device}1000000000"
    message = "341221438102180000540000010065a94001080001000000ee0e8977"
    assert h.packet(0x23, device, 0x10, start) == hexes(head + message + crc)


def test_segments_are_written_as_the_recorder_does(make: Make, tmp_path: Path) -> None:
    board = make(roll_over_bytes=2 * FRAME_BYTES, clock_us=7_000_000)
    with Host(board.address) as host:
        run_capture(board, host, 5)
        record(host, 5, "two")
        record(host, 5, "two")
    assert board.violations == []
    folder = tmp_path / "ssd" / "one"
    names = ("master", "slave1", "slave2", "slave3")
    expected = {f"{n}_{k:04d}_{x}.bin" for n in names for k in range(3) for x in ("data", "idx")}
    assert {path.name for path in folder.iterdir()} == expected
    first = frames_in(folder)
    second = frames_in(tmp_path / "ssd" / "two")
    wanted = supply()
    assert [f.number for f in first] == [0, 1, 2, 3, 4]
    assert all(np.array_equal(f.adc, wanted("horizontal", k).adc) for k, f in enumerate(first))
    assert all(np.array_equal(f.adc, wanted("horizontal", 5 + k).adc) for k, f in enumerate(second)), "it goes on"
    assert len(second) == 10, "the old directory's numbers count on"
    index = read_index(folder / "slave2_0000_idx.bin")
    assert (index.device, len(index), index.data_bytes) == (2, 2, 2 * FRAME_BYTES)
    steps_us = np.diff([f.t_first_chirp_ns for f in first]) // 1000
    assert steps_us.tolist() == [16_667, 16_666, 16_667, 16_667], "3,333,333 steps of 5 ns, rounded to us"
    assert first[0].t_first_chirp_ns >= 7_000_000_000


def test_index_header_as_real_files(make: Make, tmp_path: Path, radar_data: Path) -> None:
    """Tag, version, flags and fields of a real entry; only sizes, times and buffer addresses differ."""
    board = make()
    with Host(board.address) as host:
        run_capture(board, host, 2)
    for name in ("master", "slave3"):
        real = (radar_data / "cascade_corridor_svenningsson" / f"{name}_0000_idx.bin").read_bytes()
        ours = (tmp_path / "ssd" / "one" / f"{name}_0000_idx.bin").read_bytes()
        assert ours[:12] == real[:12]
        assert ours[24:32] == real[24:32]
        width, height, pitch = struct.unpack_from("<2HI", ours, 32)
        real_width, _, real_pitch = struct.unpack_from("<2HI", real, 32)
        assert (width, height) == (8 * SAMPLES, 12 * LOOPS)
        assert pitch / width == real_pitch / real_width


def test_decoded_configuration(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        run_capture(board, host, 1)
        temperature = host.good(1, 1, 0x17, 0x02EA).blocks[0]
    assert len(temperature[1]) == 24
    profile = board.chips[2].profiles[0]
    assert (profile.slope, profile.idle, profile.adc_start, profile.ramp_end) == (1637, 500, 600, 4000)
    assert (profile.samples, profile.sample_rate_khz, profile.rx_gain) == (SAMPLES, 8000, 48)
    assert [board.chips[n].chirps[i].tx_enable for n, i in ((3, 0), (2, 5), (0, 11), (0, 0))] == [4, 1, 1, 0]
    frame = board.chips[0].frame
    assert frame is not None
    assert (frame.loops, frame.frames, frame.trigger, board.chips[1].frame.trigger) == (LOOPS, 1, 1, 2)  # type: ignore[union-attr]
    assert board.chips[0].settings[0x0087] == hexes("0100000000000000")
