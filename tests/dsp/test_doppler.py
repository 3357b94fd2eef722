# SPDX-License-Identifier: Apache-2.0
"""Doppler kept: signs, speeds up to v_max and beyond by doubled elements, directions of moving targets, definitions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from dsp_radars import cascade_radar, place, single_chip_radar

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.doppler import DopplerFft
from edge.dsp.imager import Imager
from edge.dsp.kernels_doppler import doppler_fft
from edge.reference.doppler import doppler_spectrum
from edge.reference.point_targets import make_frame

FLAT = AntennaSettings(along_loss_db=0.0)
FFT = HeatmapSettings(doppler="fft")
BIN = 1.0 / (256 * 0.51264)
CHIRP_S = 45e-6


@pytest.fixture(scope="module")
def radar():
    return cascade_radar(loops=8)


@pytest.fixture(scope="module")
def road(radar):
    return Imager(radar, FFT, FLAT), Detector(radar, CfarSettings())


def moving_target(radar, range_m, angle_deg, radial_m_s, amplitude=1e3, **options):
    """A point that moves along its line of sight; radial speed positive away."""
    point = np.array(place(range_m, angle_deg))
    towards = -radial_m_s * point / np.linalg.norm(point)
    return make_frame(radar, [point], amplitude, 0, 0, velocity_rig_m_s=towards, **options)


def interval_m_s(radar):
    return radar.schedule.profile.wavelength_m / (2 * 12 * CHIRP_S)


@pytest.mark.parametrize("radial_m_s", [-1.5, -0.44, 0.0, 0.6, 1.7])
def test_speed_is_measured_positive_away(road, radar, radial_m_s):
    imager, detector = road
    found = detector.process(imager.process(moving_target(radar, 6.0, 15.0, radial_m_s)))
    assert imager.last_report.choice == "fft"
    assert found.doppler_m_s[0] == pytest.approx(radial_m_s, abs=0.02)


def test_an_approaching_target_has_negative_speed(road, radar):
    """Rig and target close in: the rig drives forward at 1 m/s towards a static point."""
    imager, detector = road
    frame = make_frame(radar, [place(6.0, 0.0)], 1e3, 0, 0, velocity_rig_m_s=[1.0, 0.0, 0.0])
    assert detector.process(imager.process(frame)).doppler_m_s[0] == pytest.approx(-1.0, abs=0.02)


@pytest.mark.parametrize("radial_m_s", [-12.0, -7.3, -3.0, 1.9, 4.4, 9.0, 15.0])
def test_doubled_elements_unfold_speeds_beyond_the_loops_limit(road, radar, radial_m_s):
    """The loops alone know 1.76 m/s to either side; neighbouring slots 21 m/s."""
    imager, detector = road
    assert abs(radial_m_s) > interval_m_s(radar) / 2
    found = detector.process(imager.process(moving_target(radar, 5.0, -20.0, radial_m_s)))
    assert found.doppler_m_s[0] == pytest.approx(radial_m_s, abs=0.05)
    assert abs(found.direction_cosine[0] - np.sin(np.radians(-20.0))) < 0.25 * BIN
    assert abs(found.range_m[0] - 5.0) < 8e-3


@pytest.mark.parametrize("range_m", [3.0, 8.0])
@pytest.mark.parametrize("angle_deg", [-40.0, 5.0])
def test_speed_and_direction_in_noise(road, radar, range_m, angle_deg):
    imager, detector = road
    rng = np.random.default_rng(3)
    for radial_m_s in (-2.6, 5.3):
        frame = moving_target(radar, range_m, angle_deg, radial_m_s, 40.0, noise_lsb=25.0, rng=rng)
        found = detector.process(imager.process(frame))
        assert found.doppler_m_s[0] == pytest.approx(radial_m_s, abs=0.15)
        assert abs(found.direction_cosine[0] - np.sin(np.radians(angle_deg))) < 0.5 * BIN


def test_two_speeds_in_one_range_bin_are_told_apart(road, radar):
    imager, detector = road
    standing = make_frame(radar, [place(6.0, 20.0)], 600.0, 0, 0)
    moving = moving_target(radar, 6.0, -15.0, 1.3, 600.0)
    both = dataclasses.replace(standing, adc=standing.adc + moving.adc)
    found = detector.process(imager.process(both))
    order = np.argsort(found.direction_cosine[:2])
    assert found.doppler_m_s[:2][order] == pytest.approx([1.3, 0.0], abs=0.05)
    assert found.direction_cosine[:2][order] == pytest.approx(np.sin(np.radians([-15.0, 20.0])), abs=0.5 * BIN)


def test_a_mover_is_lost_in_the_sum_and_kept_by_the_fft(radar):
    """At 0.44 m/s the eight loops turn once: their sum cancels."""
    null_m_s = interval_m_s(radar) / 8
    frame = moving_target(radar, 6.0, 0.0, null_m_s, 300.0)
    summed = Imager(radar, HeatmapSettings(doppler="sum"), FLAT).process(frame, np.zeros(3)).power.max()
    kept = Imager(radar, FFT, FLAT).process(frame).power.max()
    assert 10 * np.log10(kept / 300.0**2) == pytest.approx(0.0, abs=0.3)
    assert summed < 1e-2 * kept


def test_without_doubled_elements_the_speed_is_folded():
    radar = single_chip_radar(loops=16)
    settings = HeatmapSettings(angle_bins=64, doppler="fft")
    imager, detector = Imager(radar, settings, FLAT), Detector(radar, CfarSettings(guard_angle=14, train_angle=24))
    wavelength_m, loop_s = radar.schedule.profile.wavelength_m, 3 * CHIRP_S
    interval = wavelength_m / (2 * loop_s)
    for radial_m_s, expected in ((2.0, 2.0), (0.6 * interval, -0.4 * interval)):
        point = np.array(place(4.0, 0.0))
        frame = make_frame(radar, [point], 500.0, 0, 0, velocity_rig_m_s=[-radial_m_s, 0.0, 0.0])
        found = detector.process(imager.process(frame))
        assert found.doppler_m_s[0] == pytest.approx(expected, abs=0.03 * interval)


@pytest.mark.parametrize("loops", [1, 2, 8, 16])
def test_fft_over_loops_agrees_with_the_definition(loops):
    rng = np.random.default_rng(loops)
    values = rng.standard_normal((3, loops, 2, 64)).astype(np.float32)
    expected = doppler_spectrum((values[:, :, 0] + 1j * values[:, :, 1]).transpose(1, 0, 2), loops) * loops
    turns = np.exp(-2j * np.pi * np.arange(loops // 2) / loops)
    doppler_fft(values, np.ascontiguousarray(np.stack((turns.real, turns.imag)), dtype=np.float32))
    digits = loops.bit_length() - 1
    for i, k in enumerate(range(-(loops // 2), loops - loops // 2)):
        place_ = int(format(k % loops, f"0{digits}b")[::-1], 2) if digits else 0
        found = values[:, place_, 0] + 1j * values[:, place_, 1]
        assert np.abs(found - expected[i]).max() < 1e-5 * np.abs(expected).max()


def test_maps_of_loops_that_are_no_power_of_two_are_padded():
    radar = cascade_radar(loops=6)
    imager = Imager(radar, FFT, FLAT)
    heatmap = imager.process(moving_target(radar, 6.0, 10.0, 0.0))
    assert heatmap.doppler.power.shape == (8, 256, 256)
    assert heatmap.doppler.speed_m_s == pytest.approx(np.arange(-4, 4) * interval_m_s(radar) / 8)
    assert 10 * np.log10(heatmap.doppler.power[4].max()) == pytest.approx(60.0, abs=0.3)
    assert np.array_equal(heatmap.power, heatmap.doppler.power.max(axis=0))


def test_largest_fold_covers_neighbouring_slots(road, radar):
    maps = road[0]._doppler.maps
    assert isinstance(road[0]._doppler, DopplerFft)
    assert maps.most_folds == 6
    assert maps.interval_m_s == pytest.approx(3.526, abs=0.01)
    assert maps.most_folds * maps.interval_m_s == pytest.approx(radar.schedule.profile.wavelength_m / (4 * CHIRP_S))
