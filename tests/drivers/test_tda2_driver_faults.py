# SPDX-License-Identifier: Apache-2.0
"""The driver against emulated boards that fail: every fault is named within its time, and nothing hangs."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest
from emulated_cascade import (
    IMAGE,
    SHORT,
    Make,
    capture,
    configured,
    driver_for,
    silent_progress,
)

from edge.drivers.tda2.chips import ChipFaultError, CommandRefusedError
from edge.drivers.tda2.link import AnswerTimeoutError, LinkLostError
from edge.drivers.tda2.packets import Opcode
from edge.errors import FirmwareError, LinkError, RefusalError
from edge.waveform import Schedule
from train.simulate.faults import Faults


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
