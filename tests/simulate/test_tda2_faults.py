# SPDX-License-Identifier: Apache-2.0
"""Faults of the emulated capture board on command: lost answers, bad frames, unplugged, any bytes."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tda2_host as h
from tda2_captures import (
    DEVICES,
    LOOPS,
    SAMPLES,
    Make,
    boards_in,
    eventually,
    frames_in,
    rig_of,
    run_capture,
)
from tda2_host import ACK, NACK, VERSION, Host

from edge.sources.ti_capture import CaptureFolder
from train.simulate.cascade_chip import ChipDelays
from train.simulate.faults import Faults


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    yield from boards_in(tmp_path)


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
