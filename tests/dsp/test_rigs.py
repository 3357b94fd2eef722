# SPDX-License-Identifier: Apache-2.0
"""Shipped rigs with their own boards and settings: point targets and sidelobes where they must be."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_imager import FLAT, sidelobe_db

from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.reference.heatmap import range_angle_power
from edge.reference.point_targets import make_frame
from edge.rig import load_rig

AMPLITUDE_LSB = 1e3
RANGES_M = (3.0, 5.0, 12.0)
ALONG = {"horizontal": 1, "vertical": 2}


def target(radar, range_m, cosine):
    """Point at a range and direction cosine from the board's phase centre, in the plane of its array."""
    direction = np.zeros(3)
    direction[0], direction[ALONG[radar.radar]] = np.sqrt(1.0 - cosine**2), cosine
    return np.array(radar.mounting.position_m) + range_m * direction


class Eye:
    """Imager and detector of one radar as the rig sets them."""

    def __init__(self, name, which):
        rig = load_rig(name)
        self.radar, self.antenna = rig.radars[which], rig.settings.antenna
        self.imager = Imager(self.radar, rig.settings.heatmap, self.antenna)
        self.detector = Detector(self.radar, rig.settings.cfar)

    def check(self, range_m, cosine):
        """Range within 1 mm, direction within a tenth of a bin, ahead within 0.02 degrees; level within 0.2 dB."""
        angle_deg = np.degrees(np.arcsin(cosine))
        loss_db = 2.0 * self.antenna.along_loss_db * (angle_deg / self.antenna.along_edge_deg) ** 2
        amplitude_lsb = AMPLITUDE_LSB * 10 ** (-loss_db / 20)
        frame = make_frame(self.radar, [target(self.radar, range_m, cosine)], amplitude_lsb, 0, 0)
        heatmap = self.imager.process(frame)
        found = self.detector.process(heatmap)
        bin_cosine = float(np.diff(heatmap.direction_cosine[:2])[0])
        assert abs(found.range_m[0] - range_m) < 1e-3
        assert abs(found.direction_cosine[0] - cosine) < 0.1 * bin_cosine
        if cosine == 0.0:
            assert abs(np.degrees(np.arcsin(found.direction_cosine[0]))) < 0.02
        assert found.power_db[0] == pytest.approx(60.0, abs=0.2)


@pytest.mark.parametrize("which", ["horizontal", "vertical"])
@pytest.mark.parametrize("name", ["cascade_pair", "cascade_pair_fine", "cascade_demo"])
def test_cascade_sees_points_where_they_are(name, which):
    eye = Eye(name, which)
    for range_m in RANGES_M:
        for angle_deg in (0, 20, 40, 45, -20, -40, -45):
            eye.check(range_m, np.sin(np.radians(angle_deg)))


def test_corridor_rig_sees_points_where_they_are():
    """Its array is turned round, and 64 loops are summed."""
    eye = Eye("corridor", "horizontal")
    for range_m, angle_deg in ((3.0, -45), (5.0, 0), (12.0, 20)):
        eye.check(range_m, np.sin(np.radians(angle_deg)))


@pytest.mark.parametrize("which", ["horizontal", "vertical"])
@pytest.mark.parametrize("name", ["awr1843_pair", "awr2944_pair", "iwr6843_pair"])
def test_single_chip_sees_points_where_they_are(name, which):
    """The compensation of the antenna pattern moves the maximum of an eight-element lobe by up to a bin outwards."""
    eye = Eye(name, which)
    usable_m = eye.radar.schedule.profile.usable_range_m
    for range_m in RANGES_M:
        for cosine in (0.0, 0.3, -0.3, 0.6, -0.6, 0.7, -0.7):
            eye.check(min(range_m, 0.95 * usable_m), cosine)


@pytest.fixture(scope="module", params=["cascade_demo", "cascade_pair_fine"])
def fine(request):
    """Board and settings with rectangular windows and the angle axis interpolated 2048 / 86 = 24 times."""
    rig = load_rig(request.param)
    settings = dataclasses.replace(
        rig.settings.heatmap, range_window="rectangular", angle_window="rectangular", angle_bins=2048
    )
    return rig.radars["horizontal"], settings, Imager(rig.radars["horizontal"], settings, FLAT)


@pytest.mark.parametrize("range_m", RANGES_M)
def test_focused_sidelobe_ahead_is_that_of_a_uniform_array(fine, range_m):
    radar, _, imager = fine
    frame = make_frame(radar, [target(radar, range_m, 0.0)], AMPLITUDE_LSB, 0, 0)
    assert sidelobe_db(imager.process(frame).power) == pytest.approx(-13.26, abs=0.1)


@pytest.mark.parametrize("range_m", RANGES_M)
@pytest.mark.parametrize("angle_deg", [20, 40])
def test_focused_sidelobe_elsewhere_is_that_of_the_definition(fine, range_m, angle_deg):
    radar, settings, imager = fine
    frame = make_frame(radar, [target(radar, range_m, np.sin(np.radians(angle_deg)))], AMPLITUDE_LSB, 0, 0)
    expected_db = sidelobe_db(range_angle_power(radar, frame, settings, FLAT))
    assert sidelobe_db(imager.process(frame).power) == pytest.approx(expected_db, abs=0.1)
