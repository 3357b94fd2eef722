# SPDX-License-Identifier: Apache-2.0
"""Motion across a radar's own array: place, level and lobes of points, choice, false alarms, crowded range bins."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from dsp_radars import cascade_radar

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.across import LOBE_FLOOR, MARGIN, PROMINENT, TARGETS, WEAKEST
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.dsp.tdm import FOV_COSINE
from edge.reference.across import cells_of_range_bin, lobe_amplitudes
from edge.reference.heatmap import antenna_gain, direction_cosines, range_angle_power
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
        assert highest_lobe_db(moving.power) < max(lobe_db + 3.0, -26.0)


@pytest.mark.parametrize("speed_m_s", [0.5, 1.0, 3.0])
def test_eight_loops_tell_the_speeds_apart(speed_m_s):
    """Lobes rise where a speed stands half a Doppler bin, 0.22 m/s, off."""
    radar = cascade_radar("vertical", loops=8)
    imager, detector = Imager(radar, HeatmapSettings(), FLAT), Detector(radar, CfarSettings())
    velocity = np.array([0.0, speed_m_s, 0.0])
    for across in (0.0, 0.4, 0.7):
        for along in ELEVATIONS:
            frame = make_frame(radar, [point(5.0, across, along)], 1e3, 0, 0, velocity_rig_m_s=velocity)
            heatmap = imager.process(frame, velocity)
            found = detector.process(heatmap)
            assert imager.last_report.choice == "fft"
            assert "sideways" in imager.last_report.reason
            assert abs(found.direction_cosine[0] - along) < 0.12 * BIN
            assert found.doppler_m_s[0] == pytest.approx(-speed_m_s * across, abs=0.03)
            assert highest_lobe_db(heatmap.power) < -19.0


class TestChoice:
    def test_of_the_speeds(self):
        imager = Imager(cascade_radar("vertical"), HeatmapSettings(), FLAT)
        assert imager._across.speeds_m_s(0.1).tolist() == [0.0]
        for across_m_s in (0.5, -1.0, 3.0):
            speeds = imager._across.speeds_m_s(across_m_s)
            assert speeds[-1] >= abs(across_m_s) * FOV_COSINE > speeds[-2]
            assert np.allclose(speeds, -speeds[::-1])

    @pytest.mark.parametrize("which", ["horizontal", "vertical"])
    def test_both_radars_of_a_pair_measure_speeds_sideways(self, which):
        imager = Imager(cascade_radar(which, loops=4), HeatmapSettings(), FLAT)
        assert imager.choice(np.array([0.0, 3.0, 0.0])).name == "fft"
        assert imager.choice(np.array([3.0, 0.0, 0.0])).name == "steer"
        assert imager.choice(np.array([0.0, 0.05, 0.0])).name == "sum"

    def test_reason_names_the_speeds(self):
        vertical, horizontal = (Imager(cascade_radar(w), HeatmapSettings(), FLAT) for w in ("vertical", "horizontal"))
        velocity = np.array([0.0, 0.51, 0.0])
        assert vertical.choice(velocity).reason == (
            "one loop in use; 3 radial speeds tried, the motion across the array"
        )
        assert horizontal.choice(velocity).reason == "one loop in use"


def noise_only(radar, rng):
    frame = make_frame(radar, [[5.0, 0.0, 0.0]], 0.0, 0, 0)
    noise = np.rint(18.0 * rng.standard_normal(frame.adc.shape, dtype=np.float32))
    return dataclasses.replace(frame, adc=noise.astype(np.int16))


@pytest.mark.parametrize(("p_fa", "frames"), [(1e-2, 10), pytest.param(1e-3, 100, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("loops", "speed_m_s"), [(1, 0.5), (1, 3.0), (1, 5.0), (2, 3.0), (3, 1.0), (3, 3.0), (3, 5.0), (8, 1.0)]
)
def test_false_alarms_are_as_designed(loops, speed_m_s, p_fa, frames):
    """The largest of several maps of noise is more than one map's, its ring more even but correlated farther."""
    radar, rng = cascade_radar("vertical", loops=loops), np.random.default_rng(4)
    imager = Imager(radar, HeatmapSettings(), AntennaSettings())
    detectors = [Detector(radar, CfarSettings(kind=kind, p_fa=p_fa)) for kind in ("ca", "go", "so", "os")]
    rates = np.zeros(4)
    for _ in range(frames):
        heatmap = imager.process(noise_only(radar, rng), np.array([0.0, speed_m_s, 0.0]))
        rates += [d.decisions(heatmap)[:, heatmap.range_m >= 0.6].mean() / frames for d in detectors]
    assert heatmap.maps > 1
    np.testing.assert_allclose(rates, p_fa, rtol=0.2)


def test_targets_of_one_range_bin_are_each_taken_from_their_own_map():
    """Left and right at one range their speeds differ by 2.4 m/s: one speed for both moves one of them."""
    radar, velocity = cascade_radar("vertical"), np.array([0.0, 3.0, 0.0])
    places = [point(5.0, 0.4, -0.3), point(5.0, -0.4, 0.1), point(5.0, 0.0, 0.5)]
    frame = make_frame(radar, places, [1e3, 700.0, 800.0], 0, 0, velocity_rig_m_s=velocity)
    heatmap = Imager(radar, HeatmapSettings(), FLAT).process(frame, velocity)
    found = Detector(radar, CfarSettings(kind="os", guard_angle=6, train_angle=14)).process(heatmap)
    order = np.argsort(found.direction_cosine[:3])
    assert found.direction_cosine[:3][order] == pytest.approx([-0.3, 0.1, 0.5], abs=0.5 * BIN)
    assert found.power_db[:3][order] == pytest.approx(20.0 * np.log10([1e3, 700.0, 800.0]), abs=1.0)
    assert (found.power_db[3:] < found.power_db[0] - 15.0).all()


@pytest.mark.parametrize(("which", "sign", "speed_m_s"), [("vertical", 1, 0.5), ("horizontal", -1, 1.0)])
def test_cells_agree_with_the_definition(which, sign, speed_m_s):
    """Maps are those of a single closing speed; lobes, owners and powers follow from sums over channels."""
    rng, axis = np.random.default_rng(3), 1 if which == "vertical" else 2
    radar, settings, antenna = cascade_radar(which, array_sign=sign), HeatmapSettings(), AntennaSettings()
    velocity = np.zeros(3)
    velocity[axis] = speed_m_s
    points = np.c_[rng.uniform(2, 9, 25), rng.uniform(-3, 3, 25), rng.uniform(-3, 3, 25)]
    frame = make_frame(radar, points, rng.uniform(50, 900, 25), 0, 0, velocity, noise_lsb=25.0, rng=rng)
    imager = Imager(radar, settings, antenna)
    power = imager.process(frame, velocity).power
    speeds = imager._across.speeds_m_s(speed_m_s)
    maps = np.array([range_angle_power(radar, frame, settings, antenna, 1, speed) for speed in speeds])
    floor = np.sqrt(MARGIN * LOBE_FLOOR)
    lobes = np.maximum(lobe_amplitudes(radar, settings, imager._across.step_m_s, len(speeds) - 1) * MARGIN**0.5, floor)
    pattern = 1.0 / antenna_gain(antenna, direction_cosines(radar, settings))
    limits = (floor, PROMINENT, WEAKEST, TARGETS)
    expected = np.array([cells_of_range_bin(maps[..., r], pattern, lobes, *limits) for r in range(maps.shape[2])]).T
    close = np.abs(power - expected) <= 1e-3 * expected + 1e-6 * expected.max(axis=0)
    assert (expected < maps.max(axis=0)).mean() > 0.1
    assert close.mean() > 0.998
