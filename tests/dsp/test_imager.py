# SPDX-License-Identifier: Apache-2.0
"""Heatmaps of known scenes: positions, levels, sidelobes, motion, calibration, and the float64 definition."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from dsp_radars import calibrated, cascade_radar, place, relaid, single_chip_radar

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.dsp.tdm import divide, doppler_phasors
from edge.errors import ConfigError
from edge.reference.heatmap import range_angle_power
from edge.reference.point_targets import make_frame

FLAT = AntennaSettings(along_loss_db=0.0)
BIN = 1.0 / (256 * 0.51264)
"""Direction cosine of one angle bin of the cascade at 78.74 GHz."""


def strongest(radar, frame, settings=None, **motion):
    heatmap = Imager(radar, settings or HeatmapSettings(), FLAT).process(frame, **motion)
    found = Detector(radar, CfarSettings()).process(heatmap)
    return float(found.range_m[0]), float(found.direction_cosine[0]), float(found.power_db[0])


@pytest.mark.parametrize("which", ["horizontal", "vertical"])
@pytest.mark.parametrize("window", ["hann", "rectangular"])
@pytest.mark.parametrize("angle_deg", [0, 20, 40, -45])
@pytest.mark.parametrize("range_m", [3.0, 5.0, 12.0])
def test_point_target_stands_where_it_is(range_m, angle_deg, window, which):
    radar = cascade_radar(which)
    settings = HeatmapSettings(range_window=window, angle_window=window)
    frame = make_frame(radar, [place(range_m, angle_deg, which)], 1e3, 0, 0)
    measured_m, cosine, power_db = strongest(radar, frame, settings)
    assert abs(measured_m - range_m) < 1e-3
    assert abs(cosine - np.sin(np.radians(angle_deg))) < 0.1 * BIN
    assert power_db == pytest.approx(60.0, abs=0.5 if window == "rectangular" else 0.2)
    if angle_deg == 0:
        assert abs(np.degrees(np.arcsin(cosine))) < 0.02


def test_range_is_exact_between_bins_too():
    radar = cascade_radar()
    for range_m in np.linspace(5.0, 5.06, 7):
        assert abs(strongest(radar, make_frame(radar, [place(range_m, 30)], 1e3, 0, 0))[0] - range_m) < 1e-3


def test_board_turned_round_and_displaced_still_measures_in_the_rig():
    radar = cascade_radar("vertical", array_sign=-1, position_m=(0.0, 0.1, -0.05), range_offset_m=0.13)
    point = np.array([5.0, 0.1, 1.2])
    from_board = point - np.array([0.0, 0.1, -0.05])
    measured_m, cosine, _ = strongest(radar, make_frame(radar, [point], 1e3, 0, 0))
    assert abs(measured_m - np.linalg.norm(from_board)) < 2e-3
    assert abs(cosine - from_board[2] / np.linalg.norm(from_board)) < 0.1 * BIN


def sidelobe_db(power):
    """Highest lobe beside the main one, in the range row of the peak."""
    row = power[:, power.max(axis=0).argmax()].astype(float)
    row = np.roll(row, len(row) // 2 - row.argmax())
    right = row[len(row) // 2 :]
    null = int(np.argmax(np.diff(right) > 0))
    left = row[: len(row) // 2 + 1][::-1]
    null_left = int(np.argmax(np.diff(left) > 0))
    return 10 * np.log10(max(right[null : len(right) - 1].max(), left[null_left : len(left) - 1].max()) / row.max())


@pytest.fixture(scope="module")
def fine():
    return HeatmapSettings(range_window="rectangular", angle_window="rectangular", angle_bins=2048)


@pytest.mark.parametrize("range_m", [3.0, 5.0, 12.0])
def test_focused_array_has_the_sidelobe_of_a_uniform_one(range_m, fine):
    radar = cascade_radar()
    heatmap = Imager(radar, fine, FLAT).process(make_frame(radar, [place(range_m, 0)], 1e3, 0, 0))
    assert sidelobe_db(heatmap.power) == pytest.approx(-13.26, abs=0.1)


@pytest.mark.parametrize(("range_m", "angle_deg"), [(3.0, 20), (3.0, 40), (5.0, 40), (12.0, 20)])
def test_sidelobes_elsewhere_agree_with_the_definition(range_m, angle_deg, fine):
    radar = cascade_radar()
    frame = make_frame(radar, [place(range_m, angle_deg)], 1e3, 0, 0)
    heatmap = Imager(radar, fine, FLAT).process(frame)
    assert sidelobe_db(heatmap.power) == pytest.approx(
        sidelobe_db(range_angle_power(radar, frame, fine, FLAT)), abs=0.1
    )


def test_without_focusing_the_sidelobe_at_three_metres_rises(fine):
    radar = cascade_radar()
    frame = make_frame(radar, [place(3.0, 0)], 1e3, 0, 0)
    blurred = Imager(radar, dataclasses.replace(fine, focus=False), FLAT).process(frame)
    offsets_m = radar.array.element_offsets_m()
    position = radar.array.position
    path_m = sum(np.sqrt(9.0 + offset**2)[s] for offset, s in zip(offsets_m, np.indices(position.shape), strict=True))
    phasor = np.exp(2j * np.pi * path_m / radar.schedule.profile.wavelength_m)
    row = [phasor[position == e].mean() for e in range(86)]
    expected_db = sidelobe_db(np.square(np.abs(np.fft.fft(row, 2048)))[:, None])
    assert sidelobe_db(blurred.power) == pytest.approx(expected_db, abs=0.1)
    assert -12.0 < expected_db < -7.5


def noisy_scene(radar, seed):
    rng = np.random.default_rng(seed)
    points = np.c_[rng.uniform(1, 12, 25), rng.uniform(-4, 4, 25), rng.uniform(-4, 4, 25)]
    return make_frame(radar, points, rng.uniform(20, 500, 25), 0, 0, noise_lsb=25.0, rng=rng)


@pytest.mark.parametrize("focus", [True, False])
@pytest.mark.parametrize("window", ["hann", "rectangular"])
def test_kernel_agrees_with_the_definition(window, focus):
    rng = np.random.default_rng(7)
    radar = cascade_radar("vertical", loops=3, array_sign=-1, range_offset_m=0.1)
    gain = (rng.uniform(0.5, 2, (12, 16)) * np.exp(2j * np.pi * rng.random((12, 16)))).astype(np.complex64)
    shift_bins = rng.uniform(-1, 1, (12, 16))
    radar = calibrated(radar, gain=gain, range_shift_bins=shift_bins, reference_range_m=5.0)
    settings = HeatmapSettings(range_window=window, angle_window=window, focus=focus)
    frame = noisy_scene(radar, 1)
    imager = Imager(radar, settings, AntennaSettings())
    heatmap = imager.process(frame, np.array([0.1, 0.0, 0.0]))
    closing_m_s = 0.5 * (1.0 + np.sqrt(0.5)) * 0.1
    expected = range_angle_power(radar, frame, settings, AntennaSettings(), imager.last_report.loops, closing_m_s)
    assert imager.last_report.loops == 3
    assert heatmap.motion is None
    assert np.abs(heatmap.power - expected).max() < 1e-5 * expected.max()


def check_samples(make, samples, settings):
    radar = make(samples=samples)
    frame = noisy_scene(radar, samples)
    heatmap = Imager(radar, settings, FLAT).process(frame)
    expected = range_angle_power(radar, frame, settings, FLAT)
    assert heatmap.power.shape == (settings.angle_bins, max(64, 1 << (samples - 1).bit_length()))
    assert np.abs(heatmap.power - expected).max() < 1e-5 * expected.max()


@pytest.mark.parametrize("samples", [182, 256])
def test_cascade_with_fewer_samples_is_padded(samples):
    check_samples(cascade_radar, samples, HeatmapSettings())


@pytest.mark.parametrize("samples", [182, 384, 512])
def test_single_chip_with_any_number_of_samples(samples):
    check_samples(single_chip_radar, samples, HeatmapSettings(angle_bins=64))


@pytest.mark.slow
@pytest.mark.parametrize("samples", [64, 100, 384, 1000])
@pytest.mark.parametrize("make", [single_chip_radar, cascade_radar])
def test_every_transform_length(make, samples):
    check_samples(make, samples, HeatmapSettings())


@pytest.mark.slow
@pytest.mark.parametrize("bins", [128, 512, 1024, 4096])
def test_any_number_of_angle_bins(bins):
    radar = single_chip_radar()
    settings = HeatmapSettings(angle_bins=bins)
    frame = noisy_scene(radar, bins)
    expected = range_angle_power(radar, frame, settings, FLAT)
    assert np.abs(Imager(radar, settings, FLAT).process(frame).power - expected).max() < 1e-5 * expected.max()


def test_single_chip_finds_its_target():
    radar = single_chip_radar(samples=384)
    frame = make_frame(radar, [place(4.0, 25)], 500.0, 0, 0)
    heatmap = Imager(radar, HeatmapSettings(angle_bins=64), FLAT).process(frame)
    found = Detector(radar, CfarSettings(guard_angle=14, train_angle=24, guard_range=3)).process(heatmap)
    assert abs(found.range_m[0] - 4.0) < 2e-3
    assert abs(np.degrees(np.arcsin(found.direction_cosine[0])) - 25) < 0.1
    assert found.power_db[0] == pytest.approx(54.0, abs=0.2)


def test_axes_are_what_the_contract_says():
    radar = cascade_radar(range_offset_m=0.25)
    heatmap = Imager(radar, HeatmapSettings(), FLAT).process(noisy_scene(radar, 0))
    pitch = radar.array.pitch_wavelengths(radar.schedule.profile.center_frequency_hz)
    assert heatmap.direction_cosine[0] == pytest.approx(-0.5 / pitch, rel=1e-6)
    assert heatmap.direction_cosine[128] == 0.0
    assert np.allclose(np.diff(heatmap.direction_cosine), 1 / (256 * pitch), rtol=1e-3)
    assert heatmap.range_m[0] == pytest.approx(0.25)
    assert np.diff(heatmap.range_m).mean() == pytest.approx(radar.schedule.profile.range_bin_m, rel=1e-5)


def test_antenna_gain_along_the_array_is_given_back():
    radar, antenna = cascade_radar(), AntennaSettings(along_edge_deg=40.0, along_loss_db=5.0)
    frame = make_frame(radar, [place(5.0, 40)], 1e3 * 10 ** (-2 * 5.0 / 20), 0, 0)
    heatmap = Imager(radar, HeatmapSettings(), antenna).process(frame)
    found = Detector(radar, CfarSettings()).process(heatmap)
    assert found.power_db[0] == pytest.approx(60.0, abs=0.3)
    assert abs(found.direction_cosine[0] - np.sin(np.radians(40))) < 0.1 * BIN


def test_antenna_compensation_is_capped():
    radar = cascade_radar()
    frame = noisy_scene(radar, 0)
    flat = Imager(radar, HeatmapSettings(), FLAT).process(frame).power.copy()
    capped = AntennaSettings(along_edge_deg=20.0, along_loss_db=20.0, max_loss_db=15.0)
    ratio = Imager(radar, HeatmapSettings(), capped).process(frame).power / flat
    assert ratio.max() == pytest.approx(1e3, rel=1e-4)


def test_more_bins_than_twice_the_row_are_needed():
    with pytest.raises(ConfigError, match="angle_bins"):
        Imager(cascade_radar(), HeatmapSettings(angle_bins=128), FLAT)


def far_lobe_db(power):
    """Highest power beyond 7 rows of the peak, outside Hann's main lobe of 6, in the peak's range cell."""
    row = power[:, power.max(axis=0).argmax()]
    away = np.abs((np.arange(256) - row.argmax() + 128) % 256 - 128)
    return 10 * np.log10(row[away > 7].max() / row.max())


class TestMotion:
    @pytest.mark.parametrize("speed_m_s", [0.5, 2.0])
    def test_forward_motion_is_undone_between_slots(self, speed_m_s):
        radar = cascade_radar()
        velocity = np.array([speed_m_s, 0.0, 0.0])
        frame = make_frame(radar, [place(6.0, 20)], 1e3, 0, 0, velocity_rig_m_s=velocity)
        truth = np.sin(np.radians(20))
        compensated = strongest(radar, frame, velocity_rig_m_s=velocity)
        ignored = strongest(radar, frame)
        assert abs(compensated[1] - truth) < 0.1 * BIN
        assert abs(ignored[1] - truth) > 4 * abs(compensated[1] - truth)

    def test_doppler_bin_undoes_a_moving_target(self):
        radar = cascade_radar(loops=8)
        velocity = np.array([0.5, 0.0, 0.0])
        frame = make_frame(radar, [place(6.0, 20)], 1e3, 0, 0, velocity_rig_m_s=velocity)
        profile = radar.schedule.profile
        radial = -0.5 * np.cos(np.radians(20))
        doppler_bin = radial * 2 * 12 * 8 * profile.chirp_time_s / profile.wavelength_m
        phasors = doppler_phasors(doppler_bin, 8, 12)
        _, cosine, power_db = strongest(radar, frame, HeatmapSettings(loops=1), slot_phasors=phasors)
        assert abs(np.degrees(np.arcsin(cosine)) - 20) < 0.02
        assert power_db == pytest.approx(60, abs=0.2)

    @pytest.mark.parametrize(("which", "axis", "sign"), [("horizontal", 1, 1), ("vertical", 2, 1), ("vertical", 2, -1)])
    @pytest.mark.parametrize("speed_m_s", [0.4, -1.5, 3.0])
    @pytest.mark.parametrize("angle_deg", [-20.7, 12.0, 35.0])
    def test_travel_along_the_array_is_undone_in_every_direction(self, which, axis, sign, speed_m_s, angle_deg):
        """-20.7 degrees at -1.5 m/s lies near the border of two sectors."""
        radar = cascade_radar(which, array_sign=sign)
        velocity = np.zeros(3)
        velocity[axis] = speed_m_s
        truth = np.sin(np.radians(angle_deg))
        frame = make_frame(radar, [place(6.0, angle_deg, which)], 1e3, 0, 0, velocity_rig_m_s=velocity)
        imager = Imager(radar, HeatmapSettings(), FLAT)
        heatmap = imager.process(frame, velocity)
        assert far_lobe_db(heatmap.power) < -18.0
        found = Detector(radar, CfarSettings()).process(heatmap)
        assert abs(found.range_m[0] - 6.0) < 1e-3
        assert abs(found.direction_cosine[0] - truth) < 0.1 * BIN
        assert found.power_db[0] == pytest.approx(60.0, abs=0.2)
        if abs(speed_m_s) > 1 and angle_deg == 35.0:
            assert far_lobe_db(imager.process(frame).power) > -16.0

    def test_sectors_cover_every_row_once(self):
        cosine = (np.arange(256) - 128) / (256 * 0.5126)
        for count in range(1, 10):
            sectors = divide(cosine, count)
            assert [s.first for s in sectors] == [0] + [s.last for s in sectors[:-1]]
            assert sectors[-1].last == 256
            assert np.allclose([s.centre for s in sectors], -np.array([s.centre for s in sectors])[::-1])

    def test_loops_follow_the_ego_speed(self):
        radar = cascade_radar(loops=8)
        imager = Imager(radar, HeatmapSettings(doppler="sum"), FLAT)
        assert imager.choice(None).loops == 8
        wavelength_m = radar.schedule.profile.wavelength_m
        for loops in (1, 2, 5, 8):
            limit = 0.4 * wavelength_m / (2 * 12 * loops * 45e-6)
            assert imager.choice(np.array([0, 0.999 * limit * np.sqrt(2), 0])).loops == loops
            assert imager.choice(np.array([0.999 * limit, 0, 0])).loops == loops
        assert imager.choice(np.array([0, 30.0, 0])).loops == 1
        assert Imager(radar, HeatmapSettings(loops=3), FLAT).choice(None).loops == 3

    def test_summed_loops_keep_the_level_and_lower_the_noise(self):
        radar = cascade_radar(loops=16)
        frame = make_frame(radar, [place(5.0, 0)], 300.0, 0, 0, noise_lsb=25.0, rng=np.random.default_rng(4))
        one, all_ = (Imager(radar, HeatmapSettings(loops=n), FLAT).process(frame).power for n in (1, 0))
        assert 10 * np.log10(all_.max() / one.max()) == pytest.approx(0.0, abs=0.2)
        assert 10 * np.log10(np.median(one) / np.median(all_)) == pytest.approx(10 * np.log10(16), abs=0.3)


def test_calibration_undoes_random_gains_and_delays():
    rng = np.random.default_rng(11)
    radar = cascade_radar()
    gain = 10 ** (rng.normal(0, 2, (12, 16)) / 20) * np.exp(2j * np.pi * rng.random((12, 16)))
    shift = rng.uniform(-0.5, 0.5, (12, 16))
    points = [place(4.0, 10), place(7.0, -30)]
    clean = Imager(radar, HeatmapSettings(), FLAT).process(make_frame(radar, points, 1e3, 0, 0)).power.copy()
    frame = make_frame(radar, points, 1e3, 0, 0, channel_gain=gain, shift_bins=shift)
    spoiled = Imager(radar, HeatmapSettings(), FLAT).process(frame).power.copy()
    radar = calibrated(radar, gain=(1 / gain).astype(np.complex64), range_shift_bins=shift)
    restored = Imager(radar, HeatmapSettings(), FLAT).process(frame).power
    assert np.abs(restored - clean).max() < 2e-3 * clean.max()
    assert spoiled.max() < 0.1 * clean.max()


@pytest.mark.parametrize("make", [single_chip_radar, pytest.param(cascade_radar, marks=pytest.mark.slow)])
def test_swapped_i_and_q_put_the_target_on_the_image_side(make):
    radar, settings = make(), HeatmapSettings() if make is cascade_radar else HeatmapSettings(angle_bins=64)
    layout = radar.schedule.layout
    swapped = dataclasses.replace(layout, iq_order="IQ" if layout.iq_order == "QI" else "QI")
    frame = make_frame(radar, [place(4.0, 0)], 500.0, 0, 0)
    right = Imager(radar, settings, FLAT).process(frame).power.max(axis=0).argmax()
    wrong = Imager(relaid(radar, swapped), settings, FLAT).process(dataclasses.replace(frame, layout=swapped))
    assert (right + wrong.power.max(axis=0).argmax()) % len(wrong.range_m) == pytest.approx(0, abs=1)
