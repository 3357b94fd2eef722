# SPDX-License-Identifier: Apache-2.0
"""What a real capture board and its chips refuse, the emulated ones refuse too."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import tda2_host as h
from tda2_captures import (
    DEVICES,
    LOOPS,
    SAMPLES,
    Make,
    boards_in,
    eventually,
    hexes,
    run_capture,
)
from tda2_host import ACK, NACK, Host

from train.simulate.cascade_chip import SOP_FUNCTIONAL, CascadeChip, ChipDelays
from train.simulate.tda2_board import Tda2Board


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    yield from boards_in(tmp_path)


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


def test_firmware_is_reported_once_however_late_its_answers_are() -> None:
    """What the second-last chunk sets in motion may come after the last chunk was taken."""
    waiting: list[Callable[[], None]] = []
    chip = CascadeChip(
        0, "", ChipDelays(answer_s=1e-3), None, lambda _, action: waiting.append(action), lambda: None, lambda _: None,
        lambda _: None,
    )  # fmt: skip
    chip.sop = SOP_FUNCTIONAL
    chip.reset()
    image = struct.pack("<II", 0, 7936) + b"MSTR" + bytes(7932)
    for index in range(35):
        block = (0x4080, image[232 * index : 232 * (index + 1)])
        chip.receive(h.rhcp(5, 0x204, index % 16, [block], 34 - index))
    while waiting:
        waiting.pop(0)()
    reports = [message for message in chip.outbox if struct.pack("<H", 0x5005) in message]
    assert len(chip.outbox) == 1 + 35 + 1  # power-up, answers, boot status
    assert len(reports) == 1
