# SPDX-License-Identifier: Apache-2.0
"""Shared stages: an exchanged calibration images like a fresh imager; tables are made once for boards alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.calibration import Calibration
from edge.dsp.imager import Imager
from edge.errors import ConfigError
from edge.reference.point_targets import make_frame
from edge.rig import Radar, Rig, load_rig
from train.simulate.stages import KEPT, SharedStages

RNG = np.random.default_rng(3)


def mismatched(board: Radar) -> Radar:
    shape = board.calibration.gain.shape
    gain = np.exp(RNG.normal(0, 0.3, shape) + 2j * np.pi * RNG.random(shape))
    return replace(board, calibration=Calibration(gain, RNG.uniform(-0.3, 0.3, shape)))


def with_boards(rig: Rig) -> Rig:
    return replace(rig, radars={radar: mismatched(board) for radar, board in rig.radars.items()})


@pytest.mark.parametrize("name", ["cascade_demo", "awr1843_pair"])
def test_an_exchanged_calibration_gives_the_heatmap_of_a_fresh_imager(name: str) -> None:
    rig = load_rig(name)
    first, second = mismatched(rig.radars["horizontal"]), mismatched(rig.radars["horizontal"])
    imager = Imager(first, rig.settings.heatmap, rig.settings.antenna)
    calibration = second.calibration
    ramp = calibration.range_shift_bins
    frame = make_frame(second, [[3.0, 0.5, 0.0]], 500.0, 0, 0, None, 5.0, None, 1.0 / calibration.gain, ramp)
    for board in (first, second):
        imager.recalibrate(board.calibration)
        expected = Imager(board, rig.settings.heatmap, rig.settings.antenna).process(frame).power
        power = imager.process(frame).power
        np.testing.assert_allclose(power, expected, rtol=2e-3, atol=1e-6 * float(expected.max()))


def test_another_reference_range_is_refused() -> None:
    rig = load_rig("cascade_demo")
    board = rig.radars["vertical"]
    imager = Imager(board, rig.settings.heatmap, rig.settings.antenna)
    with pytest.raises(ConfigError, match="reference_range_m"):
        imager.recalibrate(replace(board.calibration, reference_range_m=5.0))


def test_boards_alike_share_and_what_is_old_goes() -> None:
    rig, stages = load_rig("awr1843_pair"), SharedStages()
    one, other = stages.imaging(with_boards(rig)), stages.imaging(with_boards(replace(rig, name="other")))
    assert all(one[radar][0] is other[radar][0] and one[radar][1] is other[radar][1] for radar in rig.radars)
    cfar = replace(rig, settings=replace(rig.settings, cfar=replace(rig.settings.cfar, p_fa=1e-3)))
    third = stages.imaging(cfar)
    assert all(third[radar][0] is one[radar][0] and third[radar][1] is not one[radar][1] for radar in rig.radars)
    made = stages.synthesizers(rig)
    assert stages.synthesizers(with_boards(rig)) == made
    for p_fa in np.geomspace(1e-6, 1e-2, KEPT):
        settings = replace(rig.settings, cfar=replace(rig.settings.cfar, p_fa=float(p_fa)))
        stages.imaging(replace(rig, settings=settings))
    assert len(stages) == KEPT
    assert stages.synthesizers(rig)["horizontal"] is not made["horizontal"]
