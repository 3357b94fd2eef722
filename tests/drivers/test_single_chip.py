# SPDX-License-Identifier: Apache-2.0
"""The driver of a single-chip radar against the emulated card and demo: order, frames, faults; its plan on paper."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from card_rig import CardRig, slow_pair

from edge.board_settings import CaptureCardBoard
from edge.drivers.board import Board
from edge.drivers.dca1000.assembler import Assembled
from edge.drivers.dca1000.packets import Status
from edge.drivers.single_chip import SingleChipDriver, Timing
from edge.errors import LinkError, RefusalError
from edge.rig import load_rig
from train.simulate.faults import Faults

SAFETY_S = 30.0


def take(driver: SingleChipDriver, count: int) -> list[Assembled]:
    assert driver.receiver is not None
    found: list[Assembled] = []
    while len(found) < count:
        item = driver.receiver.get(SAFETY_S)
        assert item is not None, "no frame"
        found.append(item)
    return found


def one(tmp_path: Path, faults: Faults | None = None, **settings: object) -> CardRig:
    return CardRig(slow_pair(0.03, ("vertical",)), tmp_path, faults, **settings)


def test_plan_is_every_byte_and_line() -> None:
    """The published order and vectors; command lines are those of the rig's file."""
    rig = load_rig("awr1843_pair")
    plan = SingleChipDriver("vertical", rig.radars["vertical"].schedule, CaptureCardBoard(serial_number="R1")).plan()
    assert all(line.startswith("vertical: ") for line in plan)
    sent = [line.removeprefix("vertical: ") for line in plan]
    udp = [line.split()[1] for line in sent if line.startswith("UDP")]
    assert udp == [
        "5aa506000000aaee",
        "5aa502000000aaee",
        "5aa509000000aaee",
        "5aa50e000000aaee",
        "5aa50b000600be05350c0000aaee",
        "5aa50300060001020102031eaaee",
        "5aa509000000aaee",
        "5aa505000000aaee",
        "5aa506000000aaee",
    ]
    cli = [line.removeprefix("CLI ") for line in sent if line.startswith("CLI")]
    file = (rig.directory / "vertical.cfg").read_text().splitlines()
    assert cli == [*file, "sensorStop", "sensorStart 0", "sensorStop"]
    start = next(k for k, line in enumerate(sent) if "RECORD_START" in line)
    assert sent[start + 1] == "CLI sensorStart 0", "the record start comes before the frames"
    assert "a frame fills 96 packets, nothing waits" in "\n".join(sent)
    assert "USB serial number R1" in "\n".join(sent)


@pytest.mark.parametrize(("name", "size", "waiting"), [("iwr6843_pair", 196_608, 48), ("awr2944_pair", 262_144, 64)])
def test_what_waits_for_the_next_frame_is_said(name: str, size: int, waiting: int) -> None:
    schedule = load_rig(name).radars["horizontal"].schedule
    timing = Timing.of(schedule)
    assert timing.waiting_bytes == timing.frame_bytes % 1456
    text = next(line for line in SingleChipDriver("horizontal", schedule, CaptureCardBoard()).plan() if "wait" in line)
    assert f"({timing.waiting_bytes} of the first frame's) wait 16.7 ms" in text
    assert (timing.frame_bytes, timing.waiting_bytes) == (size, waiting)
    assert timing.frame_bytes == schedule.layout.nbytes


def test_it_is_a_board() -> None:
    schedule = load_rig("awr1843_pair").radars["vertical"].schedule
    assert isinstance(SingleChipDriver("vertical", schedule, CaptureCardBoard()), Board)


def test_frames_of_two_recordings(tmp_path: Path) -> None:
    """Configured once, armed twice: both times the supply's frames from the recording's first byte on."""
    with one(tmp_path) as cards:
        driver = cards.drivers["vertical"]
        steps: list[tuple[str, int, int]] = []
        driver.connect()
        notes = driver.configure(lambda *step: steps.append(step))
        assert notes[0] == "vertical card: FPGA version 2.8"
        assert any("Init Calibration Status = 0x1ffe" in note for note in notes)
        assert [done for _, done, _ in steps] == list(range(len(steps)))
        assert steps[-1][1] == steps[-1][2]
        for recording in (1, 2):
            driver.arm(0)
            times = driver.start()
            assert times.sent_ns <= times.answered_ns
            assert times.frame_ready_ns is not None
            items = take(driver, 3)
            driver.stop()
            assert [(item.recording, item.index, item.missing_bytes) for item in items] == [
                (recording, k, 0) for k in range(3)
            ]
            assert items[0].arrival_ns == times.frame_ready_ns
            frames = [item.data.tobytes() for item in items if item.data is not None]
            truth = [cards.supply("vertical", k).adc.tobytes() for k in range(3)]
            start = truth.index(frames[0])
            assert frames == [truth[(start + k) % 3] for k in range(3)]
        assert driver.receiver is not None
        counters = driver.receiver.counters()
        counters.account.check()
        assert (counters.account.missing_bytes, counters.kernel_drops) == (0, 0)
        assert cards.violations() == []
        assert driver.check() == []


def test_samples_are_decoded_from_the_right_place(tmp_path: Path) -> None:
    """48 bytes of every frame wait for the next one; the last ones come with the record stop."""
    rig = slow_pair(0.03, ("horizontal",), samples=180)
    with CardRig(rig, tmp_path) as cards:
        driver = cards.ready().drivers["horizontal"]
        driver.arm(0)
        driver.start()
        items = take(driver, 2)
        driver.stop()
        assert driver.timing.waiting_bytes == 138_240 % 1456
        assert driver.receiver is not None
        while (item := driver.receiver.get()) is not None:
            items.append(item)
        assert all(item.missing_bytes == 0 for item in items)
        truth = [cards.supply("horizontal", k).adc.tobytes() for k in range(3)]
        frames = [item.data.tobytes() for item in items if item.data is not None]
        start = truth.index(frames[0])
        assert frames == [truth[(start + k) % 3] for k in range(len(frames))]
        driver.receiver.counters().account.check()


def test_stuck_command_line_is_reset_by_the_card(tmp_path: Path) -> None:
    """A half answer during the configuration: one reset, everything again."""
    faults = Faults()
    with one(tmp_path, faults) as cards:
        driver = cards.drivers["vertical"]
        driver.connect()
        faults.set("babble", "vertical/cli", times=1, skip=4, value=100)
        assert driver.cli is not None
        driver.cli._answer_s = 0.3
        driver.configure(lambda *step: None)
        assert cards.virtual.cards["vertical"].log.count(2) == 2
        driver.arm(0)
        driver.start()
        take(driver, 1)
        driver.stop()
        assert cards.violations() == []


def test_refused_line_is_not_tried_again(tmp_path: Path) -> None:
    faults = Faults()
    with one(tmp_path, faults) as cards:
        driver = cards.drivers["vertical"]
        driver.connect()
        faults.set("nack", "vertical/cli", times=1, skip=3)
        with pytest.raises(RefusalError, match="vertical radar refuses") as caught:
            driver.configure(lambda *step: None)
        assert caught.value.value == "Error -1"
        assert cards.virtual.cards["vertical"].log.count(2) == 1


def test_no_frames_is_a_named_error(tmp_path: Path) -> None:
    """The radar starts but nothing reaches the host."""
    faults = Faults()
    faults.set("drop", "vertical/data")
    with one(tmp_path, faults) as cards:
        driver = cards.ready().drivers["vertical"]
        driver.arm(0)
        with pytest.raises(LinkError, match="no samples of the vertical radar"):
            driver.start()


def test_card_reports_no_lvds_data(tmp_path: Path) -> None:
    with one(tmp_path, card={"no_data_s": 0.01}) as cards:
        driver = cards.ready().drivers["vertical"]
        driver.arm(0)
        assert driver.card.wait_status(Status.NO_LVDS_DATA, SAFETY_S)
        with pytest.raises(LinkError, match="NO_LVDS_DATA"):
            driver.check()


def test_radar_that_falls_silent_ends_the_recording(tmp_path: Path) -> None:
    with one(tmp_path, card={"flush_s": 0.05}) as cards:
        driver = cards.ready().drivers["vertical"]
        driver.arm(0)
        driver.start()
        take(driver, 1)
        cards.virtual.radars["vertical"].reset()
        assert driver.card.wait_status(Status.RECORD_COMPLETED, SAFETY_S)
        with pytest.raises(LinkError, match="ended the recording"):
            driver.check()


def test_unplugged(tmp_path: Path) -> None:
    """Each method names what is gone; close gives everything back whatever happened."""
    before = set(threading.enumerate())
    with one(tmp_path) as cards:
        driver = cards.ready().drivers["vertical"]
        inner = set(threading.enumerate())
        cards.virtual.unplug("vertical")
        with pytest.raises(LinkError, match="serial port of the vertical radar is gone"):
            driver.start()
        with pytest.raises(LinkError, match=r"vertical card does not answer RECORD_ST(ART|OP)"):
            driver.arm(0)
        driver.close()
        driver.close()
        assert {t.name for t in inner - set(threading.enumerate())} >= {"vertical samples"}
        with pytest.raises(LinkError, match="not connected"):
            driver.start()
        with pytest.raises(LinkError, match="not connected"):
            driver.arm(0)
        with pytest.raises(LinkError, match="vertical card does not answer"):
            driver.connect()
    assert set(threading.enumerate()) <= before


def test_port_that_is_taken(tmp_path: Path) -> None:
    with one(tmp_path) as cards:
        driver = cards.drivers["vertical"]
        driver.connect()
        other = SingleChipDriver("horizontal", driver.schedule, driver.board)
        with pytest.raises(LinkError, match="another program has this port"):
            other.connect()
        missing = SingleChipDriver("horizontal", driver.schedule, CaptureCardBoard(host_address="192.0.2.7"))
        with pytest.raises(LinkError, match=r"ip address add 192\.0\.2\.7/24"):
            missing.connect()
