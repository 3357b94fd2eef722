# SPDX-License-Identifier: Apache-2.0
"""The driver against emulated boards: whole captures; every fault is named within its time or cured by trying again."""

from __future__ import annotations

import socket
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.board_settings import CascadeBoard
from edge.drivers.board import Board
from edge.drivers.tda2.cascade import CascadeDriver
from edge.drivers.tda2.chips import ChipFaultError, CommandRefusedError
from edge.drivers.tda2.link import AnswerTimeoutError, LinkLostError
from edge.drivers.tda2.packets import Opcode, Packet
from edge.drivers.tda2.rhcp import READ_REQUEST
from edge.drivers.tda2.timeouts import TimeOuts
from edge.errors import DeviceError, FirmwareError, LinkError, RefusalError
from edge.frames import RADARS, Layout, RadarFrame, RadarId
from edge.rig import Rig, load_rig
from edge.sources.ti_capture import CaptureFolder
from edge.waveform import Schedule
from train.simulate.cascade_chip import ChipDelays
from train.simulate.faults import Faults
from train.simulate.rig import VirtualRig, VirtualRigSettings
from train.simulate.tda2_board import Tda2Board, Tda2Settings

SAMPLES, LOOPS = 8, 2
SAFETY_S = 30.0
IMAGE = b"MSTR".ljust(7936, b"\xa5")
"""Stands for TI's, which cannot be shipped; the emulated chips look at its length only."""
_NO_PAUSE = {
    "after_sop_s": 0.0,
    "after_map_s": 0.0,
    "after_request_s": 0.0,
    "after_record_s": 0.0,
    "before_reconnect_s": 0.0,
    "before_close_s": 0.0,
}
PATIENT = TimeOuts(
    **_NO_PAUSE,
    connect_s=SAFETY_S,
    spi_s=SAFETY_S,
    answer_s=SAFETY_S,
    power_up_s=SAFETY_S,
    radar_power_up_s=SAFETY_S,
    calibration_s=SAFETY_S,
    frame_started_s=SAFETY_S,
    frame_ended_s=SAFETY_S,
)
"""A busy machine changes nothing."""
SHORT = replace(PATIENT, connect_s=0.6, spi_s=0.6, answer_s=0.6, power_up_s=0.6, frame_ended_s=0.6, stop_record_s=0.6)
"""For faults that only a time-out shows."""


def silent_progress(_what: str, _done: int, _total: int) -> None:
    pass


def small_rig() -> Rig:
    rig = load_rig("cascade_pair")
    radars = {}
    for radar, own in rig.radars.items():
        profile = replace(own.schedule.profile, samples=SAMPLES)
        radars[radar] = replace(own, schedule=replace(own.schedule, profile=profile, loops=LOOPS))
    return replace(rig, radars=radars)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return small_rig()


@pytest.fixture(scope="module")
def schedule(rig: Rig) -> Schedule:
    return rig.radars["horizontal"].schedule


def frame_of(layout: Layout) -> Callable[[RadarId, int], RadarFrame]:
    def frame(radar: RadarId, number: int) -> RadarFrame:
        samples = np.full(layout.shape, 100 * (radar == "vertical") + number % 50 + 1, dtype=np.int16)
        return RadarFrame(radar, number, number, samples, layout)

    return frame


@pytest.fixture
def image(tmp_path: Path) -> str:
    path = tmp_path / "image.bin"
    path.write_bytes(IMAGE + zlib.crc32(IMAGE).to_bytes(4, "little"))
    return str(path)


Make = Callable[..., tuple[Tda2Board, CascadeDriver]]


@pytest.fixture
def make(tmp_path: Path, image: str, schedule: Schedule) -> Iterator[Make]:
    """Makes an emulated board and its driver; in the end both let go of everything."""
    made: list[tuple[Tda2Board, CascadeDriver]] = []

    def build(
        faults: Faults | None = None, timeouts: TimeOuts = PATIENT, firmware: str = image, **settings: Any
    ) -> tuple[Tda2Board, CascadeDriver]:
        chosen = Tda2Settings(**{"pace": 0.0, **settings})
        board = Tda2Board("horizontal", frame_of(schedule.layout), tmp_path / "ssd", chosen, faults).start()
        made.append((board, driver_for(board, schedule, tmp_path, firmware, timeouts)))
        return made[-1]

    yield build
    for board, driver in made:
        driver.close()
        assert board.stop(), "threads that do not end"


def driver_for(
    board: Tda2Board, schedule: Schedule, folder: Path, firmware: str, timeouts: TimeOuts = PATIENT
) -> CascadeDriver:
    host, port = board.address
    settings = CascadeBoard(host, port, firmware=firmware, segment_frames=3)
    return CascadeDriver(board.radar, schedule, settings, folder, timeouts)


def configured(board: Tda2Board, driver: CascadeDriver) -> list[str]:
    driver.connect()
    notes = driver.configure(silent_progress)
    assert all(chip.applied and len(chip.chirps) == 12 for chip in board.chips)
    return notes


def capture(driver: CascadeDriver, frames: int) -> None:
    driver.arm(frames)
    times = driver.start()
    assert times.sent_ns <= times.answered_ns
    assert times.frame_ready_ns is not None
    assert times.answered_ns <= times.frame_ready_ns
    assert driver.wait_ended(SAFETY_S)
    driver.stop()


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


def test_recording_that_a_vanished_host_left(make: Make, schedule: Schedule, tmp_path: Path, image: str) -> None:
    board, first = make()
    configured(board, first)
    first.arm(0)
    first._link.close()
    second = driver_for(board, schedule, tmp_path, image)
    configured(board, second)
    capture(second, 2)
    second.close()
    assert board.recorder.written == [2, 2, 2, 2]


# --- what goes wrong: named


def test_refusal_is_named_and_final(make: Make) -> None:
    faults = Faults(seed=1)
    faults.set("refuse", "horizontal/spi", times=1, skip=10, value=46)
    _, driver = make(faults)
    driver.connect()
    with pytest.raises(CommandRefusedError, match=r"master refused firmware 11/35: error 46 \(slope\) on .* 0x4080"):
        driver.configure(silent_progress)


def test_nack_for_ever(make: Make) -> None:
    faults = Faults(seed=1)
    faults.set("nack", "horizontal/control", value=Opcode.SET_SOP)
    board, driver = make(faults)
    driver.connect()
    with pytest.raises(RefusalError, match=r"NACK to functional mode \(SET_SOP, master\) \(3 tries\)"):
        driver.configure(silent_progress)
    assert [opcode for opcode, _ in board.log].count(Opcode.SET_SOP) == 3


def test_nack_of_the_connection(make: Make) -> None:
    faults = Faults(seed=1)
    faults.set("nack", "horizontal/control", value=Opcode.DEVICE_MAP)
    _, driver = make(faults)
    with pytest.raises(RefusalError, match="NACK to device map"):
        driver.connect()


def test_chip_that_never_answers(make: Make) -> None:
    faults = Faults(seed=1)
    faults.set("drop", "horizontal/irq")
    _, driver = make(faults, SHORT)
    driver.connect()
    with pytest.raises(AnswerTimeoutError, match=r"master did not report POWERED_UP \(0x5000\) within 0.6 s \(3 tries"):
        driver.configure(silent_progress)


def test_board_that_answers_nothing(make: Make) -> None:
    faults = Faults(seed=1)
    faults.set("drop", "horizontal/control")
    _, driver = make(faults, SHORT)
    with pytest.raises(AnswerTimeoutError, match=r"did not answer ping \(PING, board\) within 0.6 s"):
        driver.connect()


def test_garbage_for_ever(make: Make) -> None:
    faults = Faults(seed=1)
    faults.set("babble", "horizontal/control", value=100)
    _, driver = make(faults)
    with pytest.raises(LinkLostError, match="garbage instead of a packet"):
        driver.connect()


def test_calibration_that_fails_once(make: Make) -> None:
    board, driver = make()
    driver.connect()
    board.chips[0].init_status = 0x1FFE & ~(1 << 9)
    seen: list[str] = []

    def progress(what: str, _done: int, _total: int) -> None:
        if "RF initialisation" in what:
            seen.append(what)
        elif len(seen) == 1:
            board.chips[0].init_status = None

    driver.configure(progress)
    assert len(seen) == 2


def test_power_cut_while_configuring(make: Make) -> None:
    """The board reboots: named while it is away; once it is back, it is configured like a new one."""
    board, driver = make()
    driver.connect()

    def progress(what: str, _done: int, _total: int) -> None:
        if "firmware 9/35 (slave1" in what:
            board.unplug()

    with pytest.raises(LinkError, match=r"ended the connection|connection broke"):
        driver.configure(progress)
    board.plug()
    board.violations.clear()
    configured(board, driver)
    capture(driver, 2)
    assert board.violations == []


def test_cable_pulled_while_frames_run(make: Make) -> None:
    board, driver = make(timeouts=SHORT, pace=10.0)
    configured(board, driver)
    driver.arm(0)
    driver.start()
    board.unplug(silent=True)
    with pytest.raises(AnswerTimeoutError, match=r"slave3.*within"):
        driver.stop()
    driver.close()


def test_close_while_frames_run(make: Make) -> None:
    board, driver = make(pace=10.0)
    configured(board, driver)
    driver.arm(0)
    driver.start()
    driver.close()
    assert not board.recorder.recording
    assert not any(chip.running for chip in board.chips)
    driver.close()


def test_wrong_firmware_before_anything_is_sent(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "wrong.bin"
    path.write_bytes(IMAGE + b"\0\0\0\0")
    board, driver = make(firmware=str(path))
    driver.connect()
    with pytest.raises(FirmwareError, match="damaged"):
        driver.configure(silent_progress)
    assert Opcode.SET_SOP not in [opcode for opcode, _ in board.log]


def test_second_host(make: Make) -> None:
    board, driver = make()
    with socket.create_connection(board.address):
        while board._server._client is None:
            time.sleep(0.002)
        with pytest.raises(LinkLostError, match="one host at a time"):
            driver.connect()


def test_wrong_sop_mode(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chip that boots in another mode says nothing."""
    monkeypatch.setattr("edge.drivers.tda2.steps.SOP_FUNCTIONAL", 5)
    _, driver = make(timeouts=SHORT)
    driver.connect()
    with pytest.raises((AnswerTimeoutError, ChipFaultError), match="POWERED_UP"):
        driver.configure(silent_progress)
