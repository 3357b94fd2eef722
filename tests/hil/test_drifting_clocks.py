# SPDX-License-Identifier: Apache-2.0
"""Clocks that drift ten times faster than crystals do: live frames are re-armed in time, no burst meets another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.commands.hardware import configure, make_boards
from edge.drivers.single_chip import SingleChipDriver
from edge.frames import RADARS, RadarFrame
from edge.rig import load_rig
from edge.sources.base import Loss
from edge.sources.live_cards import CardSource
from edge.sources.pairing import FramePairer
from train.simulate.boards_file import data_targets, write_boards
from train.simulate.rig import VirtualRig, VirtualRigSettings
from train.simulate.supplies import targets

DRIFT_PPM = 400.0
FRAMES = 1500


@pytest.mark.slow
def test_rearmed_before_the_guard_closes(tmp_path: Path) -> None:
    plain = load_rig("awr1843_pair")
    settings = VirtualRigSettings(data_targets=data_targets(plain))
    with VirtualRig(plain, targets(plain, 4), tmp_path, settings=settings) as virtual:
        slow = virtual.radars["vertical"]
        slow.settings = replace(slow.settings, clock_ppm=-DRIFT_PPM)
        write_boards(tmp_path / "boards.toml", virtual)
        rig = load_rig("awr1843_pair", tmp_path / "boards.toml")
        drivers = {r: d for r, d in make_boards(rig).items() if isinstance(d, SingleChipDriver)}
        pairer, drifts = FramePairer(RADARS), list[float]()
        try:
            configure(drivers, lambda text: None, lambda: False)
            source = CardSource(rig, drivers, frames=FRAMES)
            assert source.watch is not None
            for item in source:
                if isinstance(item, RadarFrame | Loss):
                    pairs, _ = pairer.add(item)
                    for _ in pairs:
                        for radar in RADARS:
                            pairer.ledgers[radar].ok()
                if source.watch.last is not None and source.watch.last.drift_error < 20e-6:
                    drifts.append(source.watch.last.drift)
        finally:
            for driver in drivers.values():
                driver.close()
    pairer.flush()
    assert 1 <= source.rearms <= 6
    assert source.watch.overlaps == 0
    assert np.median(drifts) == pytest.approx(DRIFT_PPM * 1e-6, rel=0.25)
    for radar in RADARS:
        account = pairer.ledgers[radar].snapshot()
        assert account.frames_in == FRAMES
        assert account.frames_ok >= FRAMES - 5
