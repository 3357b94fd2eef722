# SPDX-License-Identifier: Apache-2.0
"""The driver against emulated boards: whole captures, and faults that trying again cures."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from emulated_cascade import (
    PATIENT,
    SAFETY_S,
    SAMPLES,
    SHORT,
    Make,
    capture,
    configured,
    driver_for,
    frame_of,
)

from edge.drivers.board import Board
from edge.drivers.tda2.packets import Opcode, Packet
from edge.drivers.tda2.rhcp import READ_REQUEST
from edge.errors import DeviceError
from edge.frames import RADARS, RadarFrame
from edge.rig import Rig
from edge.sources.ti_capture import CaptureFolder
from edge.waveform import Schedule
from train.simulate.cascade_chip import ChipDelays
from train.simulate.faults import Faults
from train.simulate.rig import VirtualRig, VirtualRigSettings


def test_two_boards_from_start_to_end(rig: Rig, tmp_path: Path, image: str) -> None:
    """Configured one after the other, armed, started, stopped twice; the files hold every frame; nothing was amiss."""
    layout = rig.radars["horizontal"].schedule.layout
    settings = VirtualRigSettings(pace=0.0)
    with VirtualRig(rig, frame_of(layout), tmp_path, settings=settings) as virtual:
        drivers = {
            radar: driver_for(virtual.boards[radar], rig.radars[radar].schedule, tmp_path, image) for radar in RADARS
        }
        steps: list[tuple[str, int, int]] = []
        for driver in drivers.values():
            assert isinstance(driver, Board)
            driver.connect()
            notes = driver.configure(lambda *step: steps.append(step))
            assert len(notes) == 5
            assert "Virtual TDA2" in notes[0]
            assert "slave3: master sub-system 2.2.2.0 patch 2.2.0.0" in notes[4]
            assert "calibrated (0x1ffe), 45 °C" in notes[4]
            assert driver.temperatures()["slave2"]["TX1"] == 45
        assert steps[0] == ("master: functional mode (master)", 0, steps[0][2])
        assert steps[-1][1] == steps[-1][2] == len(steps) // 2 - 3
        folders = []
        for frames in (3, 5):
            for driver in drivers.values():
                driver.arm(frames)
            for driver in drivers.values():
                driver.start()
            for driver in drivers.values():
                assert driver.wait_ended(SAFETY_S)
                driver.stop()
                folders.append((driver.radar, driver.directory, frames))
        for driver in drivers.values():
            driver.close()
        assert not any(virtual.violations().values())
        assert len({directory for _, directory, _ in folders}) == 4
        for radar, directory, frames in folders:
            folder = tmp_path / radar / directory.removeprefix("/mnt/ssd/")
            items = list(CaptureFolder(folder, rig, radar))
            assert len(items) == frames
            assert all(isinstance(item, RadarFrame) for item in items)
        expected = rig.radars["vertical"].schedule.profile.registers
        for chip in virtual.boards["vertical"].chips:
            profile = chip.profiles[0]
            assert (profile.slope, profile.samples, profile.rx_gain) == (expected.slope, SAMPLES, 48)
            assert chip.frame is not None
            assert (chip.frame.frames, chip.frame.trigger) == (5, 1 if chip.master else 2)


def test_the_dry_run_is_what_is_sent(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    board, driver = make()
    planned = [line.split() for line in driver.plan() if line[:5].strip().isdigit()]
    sent: list[Packet] = []
    send = driver._link.send

    def record(packet: Packet) -> int:
        sent.append(packet)
        return send(packet)

    monkeypatch.setattr(driver._link, "send", record)
    configured(board, driver)
    capture(driver, 3)
    driver.close()
    reads = [p for p in sent if p.opcode == Opcode.SPI_READ or p.data == READ_REQUEST]
    got = [p for p in sent if p not in reads]
    expected = [parts for parts in planned if parts[1] != "early"]
    assert len(got) == len(expected)
    for packet, parts in zip(got, expected, strict=True):
        if packet.opcode not in (Opcode.TRACE_START, Opcode.SESSION_DIRECTORY):
            assert packet.to_bytes().hex() == parts[-1], parts
    assert board.violations == []


def test_endless_frames_and_early_stop(make: Make) -> None:
    """Frames until stopped, and stopped before a large number of them is over."""
    board, driver = make(pace=10.0)
    configured(board, driver)
    for frames in (0, 60_000):
        before = board.bursts
        driver.arm(frames)
        driver.start()
        while board.bursts < before + 3:
            time.sleep(0.002)
        assert not driver.wait_ended(0.0)
        driver.stop()
        assert min(board.recorder.written) >= 2
    assert board.violations == []


def test_external_trigger_without_a_report(
    make: Make, schedule: Schedule, tmp_path: Path, image: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The master waits for pulses, so its report may come late: no error. Every pulse is a frame."""
    board, _ = make()
    timeouts = replace(PATIENT, frame_started_s=0.5)
    driver = driver_for(board, replace(schedule, hardware_trigger=True), tmp_path, image, timeouts)
    configured(board, driver)
    driver.arm(2)
    monkeypatch.setattr(board.chips[0], "_delays", ChipDelays(frame_ready_s=SAFETY_S))
    assert driver.start().frame_ready_ns is None
    while not driver.wait_ended(0.02):
        board.pulse()
    driver.stop()
    driver.close()
    assert board.recorder.written == [2, 2, 2, 2]
    assert board.violations == []


def test_start_before_arm(make: Make) -> None:
    _, driver = make()
    with pytest.raises(DeviceError, match="before it was armed"):
        driver.start()


# --- what goes wrong: cured


def test_clumsy_wire(make: Make) -> None:
    """Pieces, delays, doubled interrupts, NACKs of chips and bytes before their sync words need no second try."""
    faults = Faults(seed=1)
    faults.set("split", "horizontal/control", value=5)
    faults.set("delay", "horizontal/control", share=0.01, value=0.01)
    faults.set("delay", "horizontal/irq", share=0.02, value=0.01)
    faults.set("duplicate", "horizontal/irq", share=0.1)
    faults.set("spi_nack", "horizontal/spi", times=2, skip=50)
    faults.set("babble", "horizontal/spi", share=0.2, value=100)
    board, driver = make(faults)
    notes = configured(board, driver)
    assert len(faults.struck) == 6
    assert min(faults.struck.values()) >= 1
    assert "horizontal radar: 2 commands repeated after NACK" in notes
    assert [opcode for opcode, _ in board.log].count(Opcode.DEVICE_RESET) == 4
    faults.clear()
    capture(driver, 2)
    assert board.recorder.written == [2, 2, 2, 2]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (("garble", "irq", {"skip": 5}), ("hang_up", "control", {"skip": 200})),
        (("nack", "control", {"skip": 8}), ("truncate", "control", {"skip": 100})),
    ],
)
def test_two_faults_and_a_third_try(make: Make, first: tuple[Any, ...], second: tuple[Any, ...]) -> None:
    faults = Faults(seed=1)
    for fault, where, options in (first, second):
        faults.set(fault, f"horizontal/{where}", times=1, **options)
    board, driver = make(faults, SHORT)
    configured(board, driver)
    assert sum(faults.struck.values()) == 2
    capture(driver, 2)
    assert board.recorder.written == [2, 2, 2, 2]


@pytest.mark.parametrize(("where", "skip"), [("control", 100), ("irq", 0)])
def test_one_lost_packet_is_cured_by_a_reset(make: Make, where: str, skip: int) -> None:
    faults = Faults(seed=1)
    faults.set("drop", f"horizontal/{where}", times=1, skip=skip)
    board, driver = make(faults, SHORT)
    configured(board, driver)
    resets = [device for opcode, device in board.log if opcode == Opcode.DEVICE_RESET]
    assert resets == [1, 1, 2, 4, 8]


def test_slaves_alone_begin_again(make: Make) -> None:
    """The master is up: it is not reset when a slave's interrupt is lost."""
    faults = Faults(seed=1)
    board, driver = make(faults, SHORT)
    driver.connect()

    def progress(what: str, _done: int, _total: int) -> None:
        if "firmware 5/35 (slave1" in what and not faults.struck:
            faults.set("drop", "horizontal/irq", times=1)

    driver.configure(progress)
    resets = [device for opcode, device in board.log if opcode == Opcode.DEVICE_RESET]
    assert resets == [1, 2, 4, 8, 2, 4, 8]
