# SPDX-License-Identifier: Apache-2.0
"""The emulated capture board against every byte of the hardware notes, from a raw socket; refusals, files, faults."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tda2_host as h
from tda2_host import ACK, NACK, SAFETY_S, VERSION, Host

from edge.frames import Layout, RadarFrame, RadarId
from edge.sources.ti_capture import CaptureFolder
from edge.sources.ti_index import read_index
from train.simulate.cascade_chip import ChipDelays
from train.simulate.faults import Faults
from train.simulate.tda2_board import Tda2Board, Tda2Settings

LOOPS, SAMPLES = 2, 8
LAYOUT = Layout("cascade", 4, LOOPS, 12, SAMPLES, 4)
FRAME_BYTES = LOOPS * 12 * SAMPLES * 4 * 4
DEVICES = (1, 2, 4, 8)
Make = Callable[..., Tda2Board]


def supply(layout: Layout = LAYOUT) -> Callable[[RadarId, int], RadarFrame]:
    """Frames whose samples tell number, device, loop, slot, sample, receiver and part."""

    def frame(radar: RadarId, number: int) -> RadarFrame:
        index = np.arange(layout.int16_count, dtype=np.int64).reshape(layout.shape)
        return RadarFrame(radar, number, number, ((index + 7919 * number) % 30_011).astype(np.int16), layout)

    return frame


def eventually(condition: Callable[[], bool]) -> None:
    """The board's threads get there; the limit is for safety only."""
    end_s = time.monotonic() + SAFETY_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.002)


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    boards: list[Tda2Board] = []

    def make_board(faults: Faults | None = None, layout: Layout = LAYOUT, **settings: Any) -> Tda2Board:
        chosen = Tda2Settings(**{"pace": 0.0, **settings})
        boards.append(Tda2Board("horizontal", supply(layout), tmp_path / "ssd", chosen, faults).start())
        return boards[-1]

    yield make_board
    assert all([board.stop() for board in boards]), "threads that do not end"  # noqa: C419


def hexes(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


def ack_of(order: bytes) -> bytes:
    """The ACK of an order, by the notes' rule."""
    return h.packet(0x81, order[12], order[13], b"", 0x8C5A, struct.unpack_from("<H", order, 6)[0])


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
        parts.append(host.spi_read(1, 4))
        assert parts[0] == hexes("badccdab")
        assert parts[1] == hexes("36a03400000400000100945b"), "MSS powered up"
        assert parts[2] == hexes("00502400") + bytes(32)
        assert parts[3] == hexes("855f3afb")


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


def run_capture(board: Tda2Board, host: Host, frames: int, session: str = "one", loops: int = LOOPS) -> None:
    """Configure all four chips, record ``frames`` frames, stop."""
    h.connect(host)
    for device in DEVICES:
        h.boot(host, device)
        h.configure(host, device, loops, SAMPLES, frames)
    record(host, frames, session, loops)


def record(host: Host, frames: int, session: str, loops: int = LOOPS) -> None:
    h.arm(host, loops, SAMPLES, session, frames)
    for device in (8, 4, 2, 1):
        assert h.trigger(host, device, 1).refusal is None
        host.event(device, 0x100B)
    for device in (8, 4, 2, 1):
        host.event(device, 0x100F)
    assert host.order(0x32) == ACK


def rig_of(layout: Layout = LAYOUT, period_s: float = 16.666665e-3) -> Any:
    schedule = SimpleNamespace(layout=layout, frame_period_s=period_s, packed_12_bit=False)
    return SimpleNamespace(name="emulated", radars={"horizontal": SimpleNamespace(schedule=schedule)})


def frames_in(folder: Path, layout: Layout = LAYOUT) -> list[RadarFrame]:
    return [item for item in CaptureFolder(folder, rig_of(layout), "horizontal") if isinstance(item, RadarFrame)]


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


# --- what a real board refuses


def test_orders_that_come_too_early(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        assert host.order(0x10, 1) == NACK, "before the device map"
        assert host.order(0x21, 1, struct.pack("<I", 4)) == NACK, "not connected"
        assert host.order(0x1A, data=struct.pack("<4BI", 1, 1, 0, 0, 2)) == ACK
        assert host.order(0x10, 2) == NACK, "only device 1"
        assert host.order(0x10, 1) == ACK
        assert host.order(0x20, 4) == NACK, "not in the map"
        assert host.order(0x18) == NACK, "nothing is set"
        assert host.order(0x31) == NACK, "no application"
        assert host.order(0x32) == NACK, "does not record"
        assert host.order(0x77) == NACK, "unknown"
        assert host.order(0x35, data=b"\1\0") == NACK, "length"
        assert host.order(0x38, data=b"/etc/passwd") == NACK
        assert host.order(0x38, data=b"/mnt/ssd/../x") == NACK
        assert host.order(0x38, data=b"/mnt/ssd/x\0") == NACK
        assert host.order(0x37, data=struct.pack("<I", 1)) == NACK, "12 bit"
        assert host.order(0x1A, data=struct.pack("<4BI", 1, 1, 0, 0, 3)) == NACK
    assert len(board.violations) == 14


def test_damaged_packets(make: Make) -> None:
    board = make()
    good = h.packet(0x12, 32, 0x10)
    with Host(board.address) as host:
        for place, bit in ((18, 1), (7, 4), (14, 1)):
            bad = bytearray(good)
            bad[place] ^= bit
            host.send(bytes(bad))
            assert host.answer()[0] == NACK, place
        for byte in good:
            host.send(bytes((byte,)))
        assert host.answer()[0] == ACK, "bytes may come one by one"
        host.send(good + good)
        assert [host.answer()[0], host.answer()[0]] == [ACK, ACK]
        host.send(h.packet(0x12, 32, 0x11) + good)
        assert host.answer()[0] == ACK, "0x11 asks for no answer"
        host.send(b"\xff\xff\0\0" + good)
        with pytest.raises(ConnectionError):
            host.answer()
    with Host(board.address) as host:
        host.send(h.packet(0x12, 32, 0x10, sync=0x1234))
        with pytest.raises(ConnectionError):
            host.answer()


def test_one_connection_at_a_time(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        assert host.order(0x12, ack_type=0x10) == ACK
        with Host(board.address) as other, pytest.raises(ConnectionError):
            other.answer()
        assert host.order(0x12, ack_type=0x10) == ACK
    eventually(lambda: not board.connected and board._server._client is None)
    with Host(board.address) as host:
        assert host.order(0x12, ack_type=0x10) == ACK


def test_wrong_sop_leaves_the_chip_silent(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        h.connect(host)
        assert host.order(0x21, 1, struct.pack("<I", 5)) == ACK
        assert host.order(0x20, 1) == ACK
        host.spi(1, h.rhcp(5, 0x207, 0, [(0x40E0, b"")]))
        assert host.order(0x12, ack_type=0x10) == ACK
        assert host.interrupts == {}
    assert any("SOP 5" in text for text in board.violations)


@pytest.fixture
def booted(make: Make) -> Iterator[tuple[Tda2Board, Host]]:
    board = make()
    with Host(board.address) as host:
        h.connect(host)
        h.boot(host, 1)
        yield board, host


def test_messages_that_are_refused(booted: tuple[Tda2Board, Host]) -> None:
    _, host = booted
    h.configure(host, 1, LOOPS, SAMPLES, 0)
    profile, chirp = h.small_profile(SAMPLES), struct.pack("<4HI4H", 0, 0, 0, 0, 0, 0, 0, 0, 1)

    def changed(data: bytes, place: int, form: str, value: int) -> bytes:
        return data[:place] + struct.pack(form, value) + data[place + struct.calcsize(form) :]

    frame = h.frame(LOOPS, SAMPLES, 1, 0)
    table: list[tuple[int, int, int, bytes, int]] = [
        (1, 0x3F, 0x07E0, b"", 1),
        (5, 0x08, 0x0100, profile, 1),
        (1, 0x08, 0x0080, bytes(8), 3),
        (1, 0x08, 0x0100, profile[:-4], 4),
        (1, 0x04, 0x0080, struct.pack("<4H", 0, 7, 1, 0), 24),
        (1, 0x04, 0x0080, struct.pack("<4H", 15, 8, 1, 0), 25),
        (1, 0x04, 0x0080, struct.pack("<4H", 15, 7, 2, 0), 26),
        (1, 0x04, 0x0082, hexes("0300010000000000"), 5),
        (1, 0x08, 0x0100, changed(profile, 4, "<I", 1_400_000_000), 36),
        (1, 0x08, 0x0100, changed(profile, 8, "<I", 600_000), 37),
        (1, 0x08, 0x0100, changed(profile, 16, "<I", 600_000), 36),
        (1, 0x08, 0x0100, changed(profile, 16, "<I", 650), 41),
        (1, 0x08, 0x0100, changed(changed(profile, 28, "<h", 5600), 16, "<I", 1000), 46),
        (1, 0x08, 0x0100, changed(profile, 32, "<H", 1), 48),
        (1, 0x08, 0x0100, changed(profile, 34, "<H", 1000), 49),
        (1, 0x08, 0x0100, changed(profile, 40, "<H", 49), 52),
        (1, 0x08, 0x0101, changed(chirp, 0, "<H", 512), 59),
        (1, 0x08, 0x0101, changed(chirp, 4, "<H", 3), 62),
        (1, 0x08, 0x0102, changed(frame, 4, "<H", 12), 75),
        (1, 0x08, 0x0102, changed(frame, 6, "<H", 256), 77),
        (1, 0x08, 0x0102, changed(frame, 12, "<I", 1000), 79),
        (1, 0x08, 0x0102, changed(frame, 12, "<I", 200_000), 80),
        (1, 0x08, 0x0102, changed(frame, 16, "<H", 3), 81),
        (1, 0x08, 0x0102, changed(frame, 20, "<I", 20_001), 82),
        (5, 0x206, 0x40C0, struct.pack("<IHH", 12 * LOOPS + 1, 2 * SAMPLES, 0), 5),
        (1, 0x0A, 0x0140, struct.pack("<HH", 0, 0), 21),
        (1, 0x0A, 0x0140, struct.pack("<HH", 9, 0), 5),
    ]
    for direction, message, block, data, code in table:
        got = host.command(1, direction, message, block, data)
        assert got.refusal == (code, block), f"0x{block:04x} {data.hex()}: {got}"
    host.spi(1, h.rhcp(1, 8, host.sequence[1], []))
    host.sequence[1] += 1
    assert host.read_answer(1).refusal == (2, 0)
    chirps = [(0x0101, struct.pack("<4HI4H", k, k, 0, 0, 0, 0, 0, 0, 1)) for k in range(9)]
    host.spi(1, h.rhcp(1, 8, host.sequence[1] % 16, chirps))
    assert host.read_answer(1).refusal is None, "nine chirps in one message"
    host.spi(1, h.rhcp(1, 8, (host.sequence[1] + 1) % 16, [*chirps, chirps[0]]))
    assert host.read_answer(1).kind == 2, "ten are more than 256 bytes"


def test_order_of_the_configuration(booted: tuple[Tda2Board, Host]) -> None:
    board, host = booted
    early = [(1, 4, 0x0080, struct.pack("<4H", 15, 7, 1, 0)), (1, 8, 0x0100, h.PROFILE_A), (1, 6, 0x00C0, b"")]
    for direction, message, block, data in early:
        assert host.command(1, direction, message, block, data).refusal == (6, block), "RF part without power"
    assert host.command(1, 1, 0x0A, 0x0140, struct.pack("<HH", 1, 0)).refusal == (22, 0x0140)
    host.good(1, 5, 0x200, 0x4000)
    host.event(1, 0x5001)
    assert host.command(1, 1, 6, 0x00C0).refusal == (6, 0x00C0), "channels come first"
    assert host.command(1, 1, 8, 0x0100, h.PROFILE_A).refusal == (6, 0x0100), "initialisation comes first"
    assert host.order(0x20, 1) == ACK
    host.event(1, 0x5000)
    host.sequence[1] = 0
    assert host.command(1, 5, 0x200, 0x4000).refusal == (6, 0x4000), "no firmware after a reset"
    assert len(board.violations) == 7


def test_firmware_file(booted: tuple[Tda2Board, Host]) -> None:
    _, host = booted
    first = struct.pack("<II", 0, 7936) + bytes(224)
    assert host.command(1, 5, 0x204, 0x4080, struct.pack("<II", 1, 7936) + bytes(224), 34).refusal == (8, 0x4080)
    assert host.command(1, 5, 0x204, 0x4080, struct.pack("<II", 0, 7940) + bytes(224), 34).refusal == (5, 0x4080)
    assert host.command(1, 5, 0x204, 0x4080, first, 33).refusal == (6, 0x4080)
    host.good(1, 5, 0x204, 0x4080, first, 34)
    assert host.command(1, 5, 0x204, 0x4080, bytes(232), 32).refusal == (6, 0x4080), "a chunk is missing"
    assert host.command(1, 5, 0x200, 0x4000).refusal == (6, 0x4000), "not loaded"
    h.load_firmware(host, 1)
    host.good(1, 5, 0x200, 0x4000)


def test_checksums_and_sequence(booted: tuple[Tda2Board, Host]) -> None:
    board, host = booted

    def next_sequence() -> int:
        host.sequence[1] = (host.sequence[1] + 1) % 16
        return (host.sequence[1] - 1) % 16

    message = bytearray(h.rhcp(5, 0x207, next_sequence(), [(0x40E0, b"")]))
    message[-1] ^= 1
    host.spi(1, bytes(message))
    got = host.read_answer(1)
    assert (got.kind, got.message) == (2, 0x207), "CRC-32 is wrong: NACK of the chip"
    host.spi(1, h.rhcp(5, 0x207, next_sequence(), [(0x40E0, b"")]))
    assert host.read_answer(1).kind == 1, "sent again with the next sequence number"
    host.spi(1, h.rhcp(5, 0x207, (next_sequence() + 3) % 16, [(0x40E0, b"")]))
    assert host.read_answer(1).kind == 2, "a sequence number is left out"
    host.sequence[1] = (host.sequence[1] + 3) % 16
    host.good(1, 5, 0x207, 0x40E0)
    host.spi(1, h.rhcp(5, 0x207, next_sequence(), [(0x40E0, b"")], flags=0x0000))
    assert host.read_answer(1).kind == 2, "CRC of another length"
    silent = bytearray(h.rhcp(5, 0x207, host.sequence[1], [(0x40E0, b"")]))
    silent[14] ^= 1
    host.spi(1, bytes(silent))
    host.good(1, 5, 0x207, 0x40E0)
    assert any("header checksum" in text for text in board.violations), "no answer to a header that is wrong"


def test_spi_reads_are_watched(booted: tuple[Tda2Board, Host]) -> None:
    board, host = booted
    assert host.spi_read(1, 4) == b"\xff" * 4
    assert host.order(0x23, 1, h.READ_REQUEST) == ACK
    assert len(board.violations) == 2
    assert host.order(0x24, 3, struct.pack("<H", 4)) == NACK, "one chip at a time"


def test_start_order_and_running_frames(make: Make, tmp_path: Path) -> None:
    board = make(pace=1.0)
    with Host(board.address) as host:
        h.connect(host)
        for device in DEVICES:
            h.boot(host, device)
            h.configure(host, device, LOOPS, SAMPLES, 0)
        h.arm(host, LOOPS, SAMPLES, "order", 0)
        assert h.trigger(host, 1, 1).refusal is None
        assert any("master started before slaves [1, 2, 3]" in text for text in board.violations)
        assert h.trigger(host, 1, 1).refusal == (20, 0x0140)
        assert host.command(1, 1, 8, 0x0102, h.frame(LOOPS, SAMPLES, 1, 0)).refusal == (83, 0x0102)
        eventually(lambda: board.bursts >= 2)
        assert host.order(0x18) == NACK, "while it records"
        assert h.trigger(host, 1, 0).refusal is None
        host.event(1, 0x100F)
        assert h.trigger(host, 1, 0).refusal == (21, 0x0140)
        assert host.order(0x32) == ACK
    written = board.recorder.written
    assert written[0] >= 2
    assert written[1:] == [0, 0, 0]


def test_cascade_as_a_whole(make: Make) -> None:
    """Chirp table, profiles, loops, period and trigger of the four chips must fit each other and the recorder."""
    board = make()
    with Host(board.address) as host:
        h.connect(host)
        for device in DEVICES:
            h.boot(host, device)
            h.configure(host, device, LOOPS, SAMPLES, 1)
        host.good(8, 1, 8, 0x0101, struct.pack("<4HI4H", 0, 0, 0, 0, 0, 0, 0, 0, 3))
        host.good(4, 1, 8, 0x0100, h.PROFILE_A[:40] + struct.pack("<HH", 40, 0))
        host.good(2, 1, 8, 0x0102, h.frame(LOOPS + 1, SAMPLES, 1, 1))
        host.good(2, 5, 0x206, 0x40C0, struct.pack("<IHH", 12 * (LOOPS + 1), 2 * SAMPLES, 0))
        assert host.order(0x35, data=struct.pack("<I", 17), ack_type=0x10) == ACK
        for device in (8, 4, 2, 1):
            assert h.trigger(host, device, 1).refusal is None
    for words in (
        "chirp 0 fires TX [10, 11]",
        "chip 2 has other profiles",
        "chip 1 has other loops",
        "slaves [1] run by software trigger",
        "told 17 ms",
        "before the recorder",
    ):
        assert any(words in text for text in board.violations), words
    assert len(board.violations) == 6


def test_slow_chips_answer_before_their_events(make: Make) -> None:
    board = make(chip_delays=ChipDelays(2e-3, 2e-3, 2e-3, 1e-3, 0.0), create_s=2e-3, stop_s=2e-3)
    with Host(board.address) as host:
        h.connect(host)
        assert host.order(0x21, 1, struct.pack("<I", 4)) == ACK
        assert host.order(0x20, 1) == ACK
        host.event(1, 0x5000)
        h.load_firmware(host, 1)
        host.good(1, 5, 0x200, 0x4000)
        assert host.events == []
        host.event(1, 0x5001)
        assert host.order(0x20, 1) == ACK
        host.sequence[1] = 0
        host.event(1, 0x5000)
        h.load_firmware(host, 1)
        h.configure(host, 1, LOOPS, SAMPLES, 0)
        for order, event in ((1, 0x100B), (0, 0x100F)):
            assert h.trigger(host, 1, order).refusal is None
            assert host.events == []
            host.event(1, event)


def test_other_size_than_configured_is_not_written(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        run_capture(board, host, 2, loops=4)
    assert board.recorder.refused == 8
    assert any("configured" in text for text in board.violations)


def test_hardware_trigger(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        h.connect(host)
        for device in DEVICES:
            h.boot(host, device)
            h.configure(host, device, LOOPS, SAMPLES, 3)
        host.good(1, 1, 8, 0x0102, h.frame(LOOPS, SAMPLES, 2, 3))
        host.good(1, 5, 0x206, 0x40C0, struct.pack("<IHH", 12 * LOOPS, 2 * SAMPLES, 0))
        h.arm(host, LOOPS, SAMPLES, "pulses", 3)
        for device in (8, 4, 2, 1):
            assert h.trigger(host, device, 1).refusal is None
        assert board.bursts == 0
        board.pulse()
        eventually(lambda: board.bursts == 1)
        board.pulse()
        board.pulse()
        host.event(1, 0x100F)
    assert board.bursts == 3


# --- faults


def test_nacks_and_lost_answers(make: Make) -> None:
    faults = Faults(seed=1)
    board = make(faults)
    faults.set("nack", "horizontal/control", times=2, value=0x12)
    with Host(board.address) as host:
        assert host.order(0x13) == VERSION
        assert [host.order(0x12) for _ in range(3)] == [NACK, NACK, ACK]
        faults.set("drop", "*/control", times=1)
        host.send(h.packet(0x12, 32, 0x10) + h.packet(0x13, 32, 1))
        assert host.answer()[0] == VERSION
        faults.set("duplicate", "*/control", times=1)
        host.send(h.packet(0x12, 32, 0x10))
        assert [host.answer()[0], host.answer()[0]] == [ACK, ACK]
        faults.set("reorder", "*/control", times=1)
        host.send(h.packet(0x12, 32, 0x10) + h.packet(0x13, 32, 1))
        assert [host.answer()[0], host.answer()[0]] == [VERSION, ACK]
        faults.set("delay", "*/control", times=1, value=0.02)
        host.send(h.packet(0x12, 32, 0x10) + h.packet(0x13, 32, 1))
        assert [host.answer()[0], host.answer()[0]] == [VERSION, ACK]
        faults.set("split", "*/control", value=1)
        assert host.order(0x12) == ACK
        faults.clear()
        faults.set("garble", "*/control", times=1)
        host.send(h.packet(0x12, 32, 0x10))
        host.socket.settimeout(0.3)
        with pytest.raises((AssertionError, TimeoutError)):
            host.receive()


def test_hang_up_keeps_the_state(make: Make) -> None:
    faults = Faults()
    board = make(faults)
    with Host(board.address) as host:
        h.connect(host)
        h.boot(host, 1)
        faults.set("hang_up", "*/control", times=1)
        host.send(h.packet(0x12, 32, 0x10))
        with pytest.raises(ConnectionError):
            host.answer()
        sequence = dict(host.sequence)
    with Host(board.address, sequence=sequence) as host:
        assert host.order(0x35, data=bytes(4)) == NACK, "connect again"
        h.connect(host)
        host.good(1, 5, 0x202, 0x404C, bytes.fromhex("010000000000000000000000"))


def test_chip_faults(make: Make) -> None:
    faults = Faults()
    board = make(faults)
    with Host(board.address) as host:
        h.connect(host)
        h.boot(host, 1)
        faults.set("spi_nack", "horizontal/spi", times=2)
        assert [host.command(1, 5, 0x207, 0x40E0).kind for _ in range(3)] == [2, 2, 1]
        faults.set("refuse", "horizontal/spi", times=1, value=7)
        assert host.command(1, 5, 0x207, 0x40E0).refusal == (7, 0x40E0)
        faults.set("drop", "horizontal/irq", times=1)
        host.spi(1, h.rhcp(5, 0x207, host.sequence[1], [(0x40E0, b"")]))
        assert host.order(0x12) == ACK
        assert not any(host.interrupts.values()), "the interrupt was lost, the answer waits"


def test_frame_faults_in_the_files(make: Make, tmp_path: Path) -> None:
    faults = Faults(seed=3)
    faults.set("drop", "horizontal/frames", skip=1, times=1)
    faults.set("dead", "horizontal/frames", value=6)
    faults.set("stuck", "horizontal/frames", value=9)
    faults.set("saturate", "horizontal/frames", value=0.25)
    board = make(faults)
    with Host(board.address) as host:
        run_capture(board, host, 6)
    frames = frames_in(tmp_path / "ssd" / "one")
    assert [f.number for f in frames] == [0, 2, 3, 4, 5], "a period without a frame"
    for f in frames:
        dead, stuck = f.adc[1, :, :, :, 2], f.adc[2, :, :, :, 1]
        rails = np.abs(f.adc.astype(np.int32)) >= 32767
        assert rails.mean() == pytest.approx(0.25, abs=0.05)
        assert not dead[~rails[1, :, :, :, 2]].any()
        assert len(np.unique(stuck[..., 0][~rails[2, :, :, :, 1, 0]])) == 1


def test_late_start_shifts_the_stamps(make: Make, tmp_path: Path) -> None:
    faults = Faults()
    faults.set("late", "horizontal/frames", value=0.004)
    board = make(faults, start_latency_s=0.001)
    before_us = board.clock_us()
    with Host(board.address) as host:
        run_capture(board, host, 2)
    first = frames_in(tmp_path / "ssd" / "one")[0]
    assert first.t_first_chirp_ns // 1000 - before_us >= 5000
    assert faults.struck


def test_unplug_and_plug(make: Make) -> None:
    board = make()
    with Host(board.address) as host:
        h.connect(host)
        h.boot(host, 1)
        board.unplug()
        with pytest.raises(ConnectionError):
            host.answer()
    with Host(board.address) as host, pytest.raises(ConnectionError):
        host.answer()
    board.plug()
    with Host(board.address) as host:
        assert host.order(0x21, 1, struct.pack("<I", 4)) == NACK, "nothing is left of the connection"
        h.connect(host)
        h.boot(host, 1)
        board.unplug(silent=True)
        host.socket.settimeout(0.1)
        host.send(h.packet(0x12, 32, 0x10))
        with pytest.raises(TimeoutError):
            host.answer()


def test_power_cut_in_a_recording(make: Make, tmp_path: Path) -> None:
    """The reader finds whole frames and one that is cut; the index header never got its count."""
    faults = Faults()
    faults.set("unplug", "horizontal/frames", skip=3, times=1)
    board = make(faults)
    with Host(board.address) as host:
        h.connect(host)
        for device in DEVICES:
            h.boot(host, device)
            h.configure(host, device, LOOPS, SAMPLES, 10)
        h.arm(host, LOOPS, SAMPLES, "one", 10)
        for device in (8, 4, 2):
            assert h.trigger(host, device, 1).refusal is None
        host.spi(1, h.rhcp(1, 0x0A, host.sequence[1], [(0x0140, b"\1\0\0\0")]))
        with pytest.raises(ConnectionError):
            list(iter(host.receive, b""))
    folder = tmp_path / "ssd" / "one"
    items = list(CaptureFolder(folder, rig_of(), "horizontal"))
    assert [type(item).__name__ for item in items] == ["RadarFrame", "RadarFrame", "Loss"]
    assert struct.unpack_from("<I", (folder / "master_0000_idx.bin").read_bytes(), 12) == (0,)


def test_any_bytes_leave_the_board_alive(make: Make) -> None:
    """Random bytes, random packets with a right CRC, random messages with right check sums."""
    rng = np.random.default_rng(11)
    board = make()
    for round_ in range(40):
        eventually(lambda: board._server._client is None)
        with Host(board.address) as host:
            if round_ % 2:
                h.connect(host)
            if round_ == 1:
                h.boot(host, 1)
            for _ in range(12):
                data = rng.integers(0, 256, int(rng.integers(0, 60)), dtype=np.uint8).tobytes()
                opcode, device = int(rng.integers(0x10, 0x40)), int(rng.choice([1, 2, 8, 15, 32, 200]))
                if round_ % 4 == 3:
                    blocks = [(int(rng.choice([0x0080, 0x0100, 0x0101, 0x0102, 0x0140, 0x4080, 0x40C0])), data)]
                    data, opcode, device = h.rhcp(1 + 4 * (_ % 2), blocks[0][0] >> 5, _, blocks), 0x23, 1
                raw = h.packet(opcode, device, 1, data)
                with contextlib.suppress(ConnectionError):
                    host.send(raw if round_ % 4 else raw[: int(rng.integers(0, len(raw)))] + data)
            with contextlib.suppress(OSError):
                host.socket.shutdown(socket.SHUT_WR)
                while host.socket.recv(4096):
                    pass
    eventually(lambda: board._server._client is None)
    with Host(board.address) as host:
        h.connect(host)


def test_stopping_while_everything_runs(make: Make) -> None:
    board = make(pace=1.0, chip_delays=ChipDelays(frame_ready_s=0.01), create_s=0.01)
    with Host(board.address) as host:
        h.connect(host)
        for device in DEVICES:
            h.boot(host, device)
            h.configure(host, device, LOOPS, SAMPLES, 0)
        h.arm(host, LOOPS, SAMPLES, "end", 0)
        for device in (8, 4, 2, 1):
            assert h.trigger(host, device, 1).refusal is None
            host.event(device, 0x100B)
        eventually(lambda: board.bursts >= 3)
        assert board.stop()
        with pytest.raises(ConnectionError):
            list(iter(host.receive, b""))
    assert not [t for t in threading.enumerate() if "horizontal" in t.name]
    assert min(board.recorder.written) >= 2
