# SPDX-License-Identifier: Apache-2.0
"""Detections: local maxima, order, cut, the closed angle axis, sub-bin estimates, near-field corrections."""

from __future__ import annotations

import numpy as np
import pytest
from dsp_radars import calibrated, cascade_radar, place
from test_cfar import RADAR, heatmap

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.reference.point_targets import make_frame

FLAT = AntennaSettings(along_loss_db=0.0)


def bumps(places, levels, shape=(128, 96)):
    """Gaussian power bumps, periodic in angle, on weak exponential noise."""
    power = 1e-3 * np.random.default_rng(0).standard_exponential(shape)
    a, r = np.indices(shape)
    for (a0, r0), level in zip(places, levels, strict=True):
        da = (a - a0 + shape[0] / 2) % shape[0] - shape[0] / 2
        power += level * np.exp(-(da**2) / 1.5 - (r - r0) ** 2 / 1.5)
    return heatmap(power)


@pytest.mark.parametrize("kind", ["ca", "os"])
def test_strongest_first_and_the_rest_is_counted(kind):
    places = [(20 * k + 10.2, 12 * k + 20.3) for k in range(6)]
    levels = [3.0, 6.0, 1.0, 5.0, 2.0, 4.0]
    detector = Detector(RADAR, CfarSettings(kind=kind, max_detections=4))
    found = detector.process(bumps(places, levels))
    assert detector.cut == 2
    order = [1, 3, 5, 0]
    assert np.all(np.diff(found.power_db) <= 0)
    np.testing.assert_allclose(found.range_m, [0.05 * places[k][1] for k in order], atol=0.005)
    np.testing.assert_allclose(found.direction_cosine, [(places[k][0] - 64) / 128 for k in order], atol=0.002)
    assert np.isnan(found.doppler_m_s).all()


def test_columns_are_the_callers_to_keep():
    detector = Detector(RADAR, CfarSettings())
    first = detector.process(bumps([(40, 40)], [9.0]))
    kept = first.range_m.copy()
    detector.process(bumps([(90, 70)], [9.0]))
    assert np.array_equal(first.range_m, kept)


@pytest.mark.parametrize("kind", ["ca", "os"])
@pytest.mark.parametrize("row", [127.6, 0.0, 0.4, 127.9])
def test_peak_where_the_angle_axis_closes_is_one_detection(kind, row):
    found = Detector(RADAR, CfarSettings(kind=kind)).process(bumps([(row, 50.0)], [9.0]))
    assert len(found) == 1
    distance = (found.direction_cosine[0] - (row - 64) / 128 + 0.5) % 1.0 - 0.5
    assert abs(distance) < 0.1 / 128


def test_equal_neighbours_give_one_detection():
    map_ = bumps([], [])
    map_.power[60:62, 40:42] = 5.0
    assert len(Detector(RADAR, CfarSettings()).process(map_)) == 1


@pytest.mark.parametrize("column", [12, 95])
def test_first_and_last_range_cell_can_detect(column):
    map_ = bumps([(60, column)], [9.0])
    found = Detector(RADAR, CfarSettings()).process(map_)
    assert len(found) == 1
    assert abs(found.range_m[0] - 0.05 * column) < 0.03


def test_signal_to_noise_is_the_peak_over_the_ring():
    power = np.full((64, 64), 2.0)
    power[30, 30] = 2000.0
    found = Detector(RADAR, CfarSettings()).process(heatmap(power))
    assert found.snr_db[0] == pytest.approx(30.0, abs=0.01)
    assert found.power_db[0] == pytest.approx(10 * np.log10(2000.0), abs=0.01)


def test_a_strong_target_is_not_its_own_noise():
    """SNR of a cascade's target: a^2 over the noise of a window's weights; a guard inside the lobe stops at 24 dB."""
    radar, amplitude, noise_lsb = cascade_radar(), 10.0, 25.0
    position = radar.array.position
    taper = np.sin(np.pi * (np.arange(86) + 0.5) / 86) ** 2 / np.bincount(position[position >= 0])
    weight = taper[position[position >= 0]]
    noise = noise_lsb**2 * (1.5 / 256) * (weight**2).sum() / weight.sum() ** 2
    imager, detector = Imager(radar, HeatmapSettings(), FLAT), Detector(radar, CfarSettings())
    rng, measured = np.random.default_rng(9), []
    for _ in range(10):
        frame = make_frame(radar, [place(5.0, 10)], amplitude, 0, 0, noise_lsb=noise_lsb, rng=rng)
        measured.append(detector.process(imager.process(frame)).snr_db[0])
    assert np.mean(measured) == pytest.approx(10 * np.log10(amplitude**2 / noise), abs=0.5)


@pytest.mark.parametrize("kind", ["ca", "os"])
def test_silence_gives_no_detection(kind):
    found = Detector(RADAR, CfarSettings(kind=kind)).process(heatmap(np.zeros((64, 64))))
    assert len(found) == 0
    assert found.range_m.dtype == np.float32


@pytest.mark.parametrize("focus", [True, False])
@pytest.mark.parametrize("reference_m", [np.inf, 5.0])
def test_near_field_tilt_is_corrected_whatever_is_focused(focus, reference_m):
    """With a calibration that bakes a wavefront in, or without focusing, positions stay true."""
    radar = cascade_radar()
    tx_m, rx_m = radar.array.element_offsets_m()
    if np.isfinite(reference_m):
        path_m = np.hypot(reference_m, tx_m)[:, None] + np.hypot(reference_m, rx_m) - 2 * reference_m
        phase = -2j * np.pi * path_m / radar.schedule.profile.wavelength_m
        radar = calibrated(radar, gain=np.exp(phase).astype(np.complex64), reference_range_m=reference_m)
    imager, detector = Imager(radar, HeatmapSettings(focus=focus), FLAT), Detector(radar, CfarSettings())
    for range_m, angle_deg in ((4.0, 0), (4.0, 35), (9.0, -40)):
        frame = make_frame(radar, [place(range_m, angle_deg)], 1e3, 0, 0)
        found = detector.process(imager.process(frame))
        assert abs(found.range_m[0] - range_m) < 1e-3
        assert abs(found.direction_cosine[0] - np.sin(np.radians(angle_deg))) < 0.1 / 131


def test_noise_scatters_the_estimates_as_little_as_the_theory_allows():
    """At 30 dB after processing the range scatters by about a hundredth of a bin: below 2 mm rms, without bias."""
    radar = cascade_radar()
    imager, detector = Imager(radar, HeatmapSettings(), FLAT), Detector(radar, CfarSettings())
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(40):
        frame = make_frame(radar, [place(5.0, 10)], 8.0, 0, 0, noise_lsb=25.0, rng=rng)
        found = detector.process(imager.process(frame))
        errors.append((found.range_m[0] - 5.0, found.direction_cosine[0] - np.sin(np.radians(10))))
    spread = np.std(errors, axis=0)
    assert spread[0] < 2e-3
    assert spread[1] < 0.1 / 131
    assert np.all(np.abs(np.mean(errors, axis=0)) < 4 * spread / np.sqrt(40) + (1e-4, 1e-4))
