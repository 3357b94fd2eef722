# SPDX-License-Identifier: Apache-2.0
"""A small cascade rig, its emulated boards and what the tests of their driver have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from edge.board_settings import CascadeBoard
from edge.drivers.tda2.cascade import CascadeDriver
from edge.drivers.tda2.timeouts import TimeOuts
from edge.frames import Layout, RadarFrame, RadarId
from edge.rig import Rig, load_rig
from edge.waveform import Schedule
from train.simulate.tda2_board import Tda2Board

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


def frame_of(layout: Layout) -> Callable[[RadarId, int], RadarFrame]:
    def frame(radar: RadarId, number: int) -> RadarFrame:
        samples = np.full(layout.shape, 100 * (radar == "vertical") + number % 50 + 1, dtype=np.int16)
        return RadarFrame(radar, number, number, samples, layout)

    return frame


Make = Callable[..., tuple[Tda2Board, CascadeDriver]]


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
