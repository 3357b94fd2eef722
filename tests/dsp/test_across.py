# SPDX-License-Identifier: Apache-2.0
"""Motion across a radar's own array: place, level and lobes of points, choice, false alarms, crowded range bins."""

from __future__ import annotations

import numpy as np
import pytest
from dsp_radars import cascade_radar

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.reference.point_targets import make_frame

FLAT = AntennaSettings(along_loss_db=0.0)
BIN = 1.0 / (256 * 0.51264)
ELEVATIONS = np.sin(np.radians([0.0, 20.0, 40.0]))


def point(range_m, across, along):
    """Point by its direction cosines across (y) and along (z) the vertical array."""
    return range_m * np.array([np.sqrt(1.0 - across**2 - along**2), across, along])


def highest_lobe_db(power):
    """Highest lobe beside the main one in the range bin of the peak."""
    row = power[:, power.max(axis=0).argmax()].astype(float)
    row = np.roll(row, -row.argmax())
    right, left = int(np.argmax(np.diff(row) > 0)), int(np.argmax(np.diff(np.roll(row[::-1], 1)) > 0))
    return 10.0 * np.log10(row[right : len(row) - left + 1].max() / row.max())


@pytest.fixture(scope="module", params=[1, 2, 3])
def few_loops(request):
    radar = cascade_radar("vertical", loops=request.param)
    return radar, Imager(radar, HeatmapSettings(), FLAT), Detector(radar, CfarSettings())


@pytest.mark.parametrize("azimuth_deg", [-40.0, 0.0, 20.0, 40.0])
@pytest.mark.parametrize("speed_m_s", [0.5, 1.0, 3.0])
def test_point_stands_where_it_is_and_keeps_its_lobes(few_loops, speed_m_s, azimuth_deg):
    """At 3 m/s and 40 degrees one speed for all had lobes of -3 dB, half a bin and 3 dB lost."""
    radar, imager, detector = few_loops
    velocity = np.array([0.0, speed_m_s, 0.0])
    for along in ELEVATIONS:
        place = point(5.0, np.sin(np.radians(azimuth_deg)), along)
        resting = imager.process(make_frame(radar, [place], 1e3, 0, 0), np.zeros(3))
        lobe_db = highest_lobe_db(resting.power)
        moving = imager.process(make_frame(radar, [place], 1e3, 0, 0, velocity_rig_m_s=velocity), velocity)
        found = detector.process(moving)
        assert "radial speeds tried" in imager.last_report.reason
        assert abs(found.direction_cosine[0] - along) < 0.1 * BIN
        assert found.power_db[0] == pytest.approx(60.0, abs=0.3 if imager.last_report.loops == 1 else 1.2)
        assert highest_lobe_db(moving.power) < max(lobe_db + 3.0, -25.0)
