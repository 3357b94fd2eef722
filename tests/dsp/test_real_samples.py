# SPDX-License-Identifier: Apache-2.0
"""Real samples (AWR2944): layout on the wire, half a spectrum, and what a target and noise give in it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from dsp_radars import calibrated, place

from edge.array import array_for
from edge.calibration import Calibration
from edge.config import AntennaSettings, CfarSettings, HeatmapSettings, Mounting
from edge.dsp.checks import FrameRejected
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import ConfigError
from edge.frames import Layout, LossCause, RadarFrame
from edge.reference.heatmap import range_angle_power
from edge.reference.point_targets import make_frame, pack, unpack
from edge.rig import Radar
from edge.waveform import SPEED_OF_LIGHT_M_S, ChirpProfile, Schedule

FLAT = AntennaSettings(along_loss_db=0.0)
SETTINGS = HeatmapSettings(angle_bins=64)


def real_radar(samples: int = 256, loops: int = 1) -> Radar:
    profile = ChirpProfile("AWR2944", 77e9, 60e12, 5e-6, 6e-6, 50e-6, samples, 1e3 * round(6e3 * samples / 256))
    schedule = Schedule(profile, loops, 0.1)
    calibration = Calibration.identity(schedule.layout)
    return Radar("horizontal", schedule, array_for("AWR2944"), Mounting(), calibration)


def test_layout_is_loop_slot_receiver_sample() -> None:
    layout = Layout("dca1000_real", 1, 2, 4, 6, 4)
    assert layout.shape == (2, 4, 4, 6)
    assert layout.nbytes == 2 * layout.int16_count == 2 * 2 * 4 * 4 * 6
    assert (layout.parts, layout.channels) == (1, 16)
    samples = np.arange(layout.int16_count).reshape(2, 4, 4, 6) + 5j
    wire = pack(samples, layout).tobytes()
    assert wire == np.arange(layout.int16_count, dtype="<i2").tobytes(), "real parts, one after another"
    assert np.array_equal(unpack(pack(samples, layout), layout), samples.real)
    assert np.array_equal(unpack(pack(samples, layout), layout)[1, 2, 3], samples[1, 2, 3].real)


def test_odd_chirps_are_refused() -> None:
    with pytest.raises(ConfigError, match="samples"):
        _ = real_radar(255).schedule.layout


def test_axis_is_half_of_the_spectrum() -> None:
    """Bins of c / 2B as with complex samples, up to the beat frequency fs / 2."""
    radar = real_radar()
    profile, imager = radar.schedule.profile, Imager(radar, SETTINGS, FLAT)
    half_m = SPEED_OF_LIGHT_M_S * 0.5 * profile.sample_rate_hz / (2.0 * profile.slope_hz_per_s_actual)
    assert profile.max_range_m == pytest.approx(half_m)
    assert len(imager.range_m) == 128
    assert imager.range_m[-1] == pytest.approx(half_m - profile.range_bin_m, rel=1e-6)


@pytest.mark.parametrize("samples", [256, 400])
def test_heatmap_is_that_of_the_definition(samples: int) -> None:
    """Float64 Fourier sums over real samples, zero-padded or not, with gains and delays of channels undone."""
    radar, rng = real_radar(samples), np.random.default_rng(samples)
    shape = (4, 4)
    gain = (rng.uniform(0.7, 1.3, shape) * np.exp(2j * np.pi * rng.random(shape))).astype(np.complex64)
    radar = calibrated(radar, gain=gain, range_shift_bins=rng.uniform(-0.4, 0.4, shape))
    farthest_m = radar.schedule.profile.usable_range_m
    points = [place(3.0, 10), place(5.02, -35), place(0.98 * farthest_m, 50)]
    frame = make_frame(radar, points, [900.0, 500.0, 300.0], 0, 0, noise_lsb=20.0, rng=rng)
    for window in ("hann", "rectangular"):
        settings = dataclasses.replace(SETTINGS, range_window=window, angle_window=window)
        power = Imager(radar, settings, FLAT).process(frame).power.astype(float)
        expected = range_angle_power(radar, frame, settings, FLAT)
        assert power.shape == expected.shape
        assert np.abs(power - expected).max() < 2e-5 * expected.max()


@pytest.mark.parametrize("angle_deg", [0, 25, -45])
@pytest.mark.parametrize("range_m", [2.0, 3.013, 4.5, 6.5])
def test_point_target_stands_where_it_is(range_m: float, angle_deg: float) -> None:
    """Range within 1 mm from 40 bins on, level 60 dB for a = 1000 LSB of a cosine, and nothing else 45 dB below."""
    radar = real_radar(512)
    frame = make_frame(radar, [place(range_m, angle_deg)], 1e3, 0, 0)
    heatmap = Imager(radar, SETTINGS, FLAT).process(frame)
    found = Detector(radar, CfarSettings(guard_angle=14, train_angle=24)).process(heatmap)
    assert abs(found.range_m[0] - range_m) < 1e-3
    assert abs(found.direction_cosine[0] - math.sin(math.radians(angle_deg))) < 0.1 / (64 * 0.51)
    assert found.power_db[0] == pytest.approx(60.0, abs=0.2)
    away = np.abs(heatmap.range_m - range_m) > 12 * radar.schedule.profile.range_bin_m
    assert heatmap.power[:, away].max() < 10 ** (-4.5) * heatmap.power.max(), "no mirror image"


def test_noise_floor() -> None:
    """Power of white noise of s LSB per real sample: (2 s)^2 sum w^2 / (sum w)^2 for each channel, averaged over them.

    The same as of complex noise of sqrt(2) s over Ns / 2 samples. Away from zero and the highest frequency, where both
    halves of the spectrum overlap.
    """
    radar, rng, deviation = real_radar(512, loops=4), np.random.default_rng(7), 30.0
    settings = dataclasses.replace(SETTINGS, angle_window="rectangular")
    imager, layout, total, frames = Imager(radar, settings, FLAT), radar.schedule.layout, 0.0, 24
    for number in range(frames):
        codes = np.rint(deviation * rng.standard_normal(layout.shape)).astype(np.int16)
        power = imager.process(RadarFrame("horizontal", number, 0, codes, layout)).power
        total = total + power[:, 8:-8].mean(dtype=float) / frames
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(512) / 512)
    per_channel = 4.0 * (deviation**2 + 1 / 12) * (window**2).sum() / window.sum() ** 2 / layout.loops
    row = np.asarray(radar.array.position)[np.asarray(radar.array.position) >= 0]
    multiplicity = np.bincount(row)
    expected = per_channel * (1.0 / multiplicity).sum() / len(multiplicity) ** 2
    assert total == pytest.approx(expected, rel=0.02)


def test_false_alarms_of_noise_are_as_rare_as_set() -> None:
    """Share of cells above their threshold where detections are taken, averaged over 60 frames."""
    radar, rng = real_radar(256), np.random.default_rng(3)
    settings = CfarSettings(p_fa=1e-3, guard_angle=14, train_angle=24)
    imager, detector, layout = Imager(radar, SETTINGS, FLAT), Detector(radar, settings), radar.schedule.layout
    taken = (imager.range_m > 1.0) & (imager.range_m < radar.schedule.profile.usable_range_m)
    share = []
    for number in range(60):
        codes = np.rint(30.0 * rng.standard_normal(layout.shape)).astype(np.int16)
        heatmap = imager.process(RadarFrame("horizontal", number, 0, codes, layout))
        share.append(detector.decisions(heatmap)[:, taken].mean())
    assert np.mean(share) == pytest.approx(1e-3, rel=0.35)


def test_checks_of_a_frame() -> None:
    """All zero, rails and dead channels are seen in real samples too."""
    radar = real_radar(256, loops=2)
    imager, layout = Imager(radar, SETTINGS, FLAT), radar.schedule.layout
    zero = RadarFrame("horizontal", 0, 0, np.zeros(layout.shape, np.int16), layout)
    with pytest.raises(FrameRejected) as rejected:
        imager.process(zero)
    assert rejected.value.cause == LossCause.ALL_ZERO
    codes = np.random.default_rng(1).integers(-100, 100, layout.shape).astype(np.int16)
    codes[:, 1, 2] = 7
    codes[:, 2, 0] = np.tile([5, -5], 128)  # changes at every sample: alive
    codes[0, 0, 0, :8] = 32767
    codes[0, 0, 1, :2] = -32768
    imager.process(RadarFrame("horizontal", 0, 0, codes, layout))
    assert imager.last_report.dead == ("TX3 RX3",)
    assert imager.last_report.saturated_share == pytest.approx(10 / layout.int16_count)
    codes[:] = 32767
    with pytest.raises(FrameRejected) as rejected:
        imager.process(RadarFrame("horizontal", 0, 0, codes, layout))
    assert rejected.value.cause == LossCause.SATURATED
