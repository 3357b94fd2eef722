# SPDX-License-Identifier: Apache-2.0
"""Emulated cascade boards with their driver; a module's own fixtures of these names come first."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from emulated_cascade import IMAGE, PATIENT, Make, driver_for, frame_of, small_rig

from edge.drivers.tda2.cascade import CascadeDriver
from edge.drivers.tda2.timeouts import TimeOuts
from edge.rig import Rig
from edge.waveform import Schedule
from train.simulate.faults import Faults
from train.simulate.tda2_board import Tda2Board, Tda2Settings


@pytest.fixture(scope="module")
def rig() -> Rig:
    return small_rig()


@pytest.fixture(scope="module")
def schedule(rig: Rig) -> Schedule:
    return rig.radars["horizontal"].schedule


@pytest.fixture
def image(tmp_path: Path) -> str:
    path = tmp_path / "image.bin"
    path.write_bytes(IMAGE + zlib.crc32(IMAGE).to_bytes(4, "little"))
    return str(path)


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
