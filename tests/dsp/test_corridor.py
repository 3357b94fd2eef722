# SPDX-License-Identifier: Apache-2.0
"""A real cascade capture: corner reflector and two straight walls of a corridor, with and without TI's calibration.

Everything comes from the rig ``corridor``. Its array sign is -1: only then x = r u shows the walls on the sides, and
the uncalibrated reflector on the side, that the description of the recording names. Left and right themselves cannot be
decided from the data.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.frames import RadarFrame
from edge.reference.repack import split_loop_sum
from edge.rig import load_rig

REFLECTOR_M = 5.02


@pytest.fixture(scope="module")
def folder(radar_data):
    return radar_data / "cascade_corridor_svenningsson"


@pytest.fixture(scope="module")
def rig(folder):
    return load_rig("corridor").with_calibration("horizontal", folder / "calibration.mat")


@pytest.fixture(scope="module")
def frame(folder, rig):
    with np.load(folder / "adc_loop_sum.npz") as stored:
        loop_sum = stored["adc_loop_sum"]
    layout = rig.radars["horizontal"].schedule.layout
    adc = split_loop_sum(loop_sum, layout.loops)
    assert np.array_equal(adc.sum(axis=1, dtype=np.int64)[1, 4, :, 2], loop_sum[7, 6])
    return RadarFrame("horizontal", 0, 0, adc, layout)


def heatmap_of(rig, frame):
    return Imager(rig.radars["horizontal"], rig.settings.heatmap, rig.settings.antenna).process(frame)


@pytest.fixture(scope="module")
def calibrated(rig, frame):
    return heatmap_of(rig, frame)


@pytest.fixture(scope="module")
def uncalibrated(frame):
    return heatmap_of(load_rig("corridor"), frame)


def detected(rig, heatmap):
    """The strongest detection within 0.3 m of the reflector's range: metres, degrees, dB."""
    found = Detector(rig.radars["horizontal"], rig.settings.cfar).process(heatmap)
    near = np.flatnonzero(np.abs(found.range_m - REFLECTOR_M) < 0.3)[0]
    return found.range_m[near], np.degrees(np.arcsin(found.direction_cosine[near])), found.power_db[near]


def test_reflector_stands_at_its_range_straight_ahead(rig, calibrated):
    range_m, angle_deg, _ = detected(rig, calibrated)
    assert range_m == pytest.approx(5.02, abs=0.03)
    assert angle_deg == pytest.approx(0.0, abs=0.3)


def test_without_calibration_the_reflector_wanders_and_fades(rig, calibrated, uncalibrated):
    _, angle_deg, power_db = detected(rig, uncalibrated)
    assert angle_deg == pytest.approx(-2.9, abs=0.3)
    assert detected(rig, calibrated)[2] - power_db > 5.0


def wall(heatmap, side, nearest_m, farthest_m, longest_m):
    """Strongest cell of every range with ``nearest_m`` < |x| < ``farthest_m`` on one side, and Theil and Sen's line.

    Returns the line's x at the middle range, its slope over range, and the residuals of all cells.
    """
    x_m, r_m = [], []
    for k in np.flatnonzero((heatmap.range_m > 1.6) & (heatmap.range_m < longest_m)):
        x = heatmap.range_m[k] * heatmap.direction_cosine
        inside = np.flatnonzero((side * x > nearest_m) & (side * x < farthest_m))
        x_m.append(x[inside[heatmap.power[inside, k].argmax()]])
        r_m.append(heatmap.range_m[k])
    x, r = np.array(x_m), np.array(r_m)
    i, j = np.triu_indices(len(r), 1)
    slope = np.median((x[j] - x[i]) / (r[j] - r[i]))
    offset = np.median(x - slope * r)
    return offset + slope * 0.5 * (1.6 + longest_m), slope, x - offset - slope * r


@pytest.mark.parametrize(("side", "expected_m", "longest_m"), [(1, 1.13, 4.0), (-1, -1.28, 2.9)])
def test_walls_stand_where_they_were_measured(calibrated, side, expected_m, longest_m):
    """The right wall's echo is covered by stronger ones beyond 2.9 m."""
    x_m, _, residual = wall(calibrated, side, 0.6, 2.0, longest_m)
    close = np.abs(residual) < 0.1
    assert x_m == pytest.approx(expected_m, abs=0.05)
    assert close.mean() > 0.9
    assert residual[close].std() < 0.035


@pytest.mark.parametrize("side", [1, -1])
def test_walls_are_straight_and_parallel(calibrated, side):
    assert abs(wall(calibrated, side, 1.0, 1.5, 4.0)[1]) <= 0.03


def test_without_calibration_the_left_wall_smears(uncalibrated):
    residual = wall(uncalibrated, 1, 0.6, 2.0, 4.0)[2]
    assert (np.abs(residual) < 0.1).mean() < 0.7


def test_capture_is_not_swapped(uncalibrated):
    """Power at positive over negative beat frequencies, leakage left out: about +10 dB for I first."""
    profile = uncalibrated.power.sum(axis=0)
    assert 10 * np.log10(profile[10:128].sum() / profile[128:-10].sum()) > 6.0
