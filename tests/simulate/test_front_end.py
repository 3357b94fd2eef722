# SPDX-License-Identifier: Apache-2.0
"""Every impairment against its own definition, and the defaults against what captures of real cascades show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.calibration_capture import CaptureAverager
from edge.calibration_make import Reflector, make_calibration
from edge.calibration_quality import residual_deg
from edge.calibration_ti import import_ti_calibration
from edge.config import HeatmapSettings
from edge.dsp.imager import Imager
from edge.errors import ConfigError
from edge.reference.point_targets import unpack
from edge.reference.repack import split_loop_sum
from edge.rig import Radar, load_rig
from train.simulate.front_end import FrontEnd, FrontEndSettings
from train.simulate.link_budget import LinkSettings, amplitude_per_rcs
from train.simulate.scatterers import Scatterers
from train.simulate.synthesis import Synthesizer

RIG = load_rig("cascade_pair")
EMPTY = Scatterers.direct(np.zeros((0, 3)), 0.0)
IDEAL = FrontEndSettings.ideal()
SAMPLES = 256


def cascade(which: Any = "horizontal", loops: int = 1) -> Radar:
    board = RIG.radars[which]
    return replace(board, schedule=replace(board.schedule, loops=loops, frame_period_s=0.1))


BOARD = cascade()
BIN_M = BOARD.schedule.profile.range_bin_m


def captured(settings: FrontEndSettings, scatterers: Scatterers = EMPTY, **options: Any) -> Any:
    """Complex samples [loops, slots, receivers, samples] of one frame."""
    radar = cascade(options.get("which", "horizontal"), options.get("loops", 1))
    front_end = FrontEnd(radar, settings, options.get("seed", 1))
    frame = Synthesizer(radar).frame(scatterers, front_end, options.get("number", 0), 0)
    return unpack(frame.adc, frame.layout)


def reflector(bins: float = 84.0, amplitude: float = 4000.0) -> Scatterers:
    """On boresight, a whole number of range bins away."""
    place = np.array(BOARD.mounting.position_m) + np.array([bins * BIN_M, 0.0, 0.0])
    return Scatterers.direct(place, amplitude)


def levels_db(samples: Any, window: Any = None) -> Any:
    """Amplitude of every bin in dB, for tones of 1 at 0 dB."""
    taper = np.hanning(SAMPLES + 1)[:-1] if window is None else window
    return 20 * np.log10(np.abs(np.fft.fft(samples * taper, axis=-1)) / taper.sum() + 1e-9)


def test_noise_has_the_stated_level_and_is_gaussian_and_white() -> None:
    noise = captured(FrontEndSettings.ideal(25.0), loops=8)
    parts = np.stack((noise.real, noise.imag)).ravel()
    assert np.sqrt(np.mean(abs(noise) ** 2)) == pytest.approx(25.0, rel=0.005)
    assert abs(parts.mean()) < 0.06
    assert np.mean((parts / parts.std()) ** 3) == pytest.approx(0.0, abs=0.01)
    assert np.mean((parts / parts.std()) ** 4) == pytest.approx(3.0, abs=0.02)
    assert np.mean(abs(parts) > 3 * parts.std()) == pytest.approx(0.0027, rel=0.1)
    assert np.mean(abs(parts) > 4 * parts.std()) == pytest.approx(6.3e-5, rel=0.5)
    spectrum = np.mean(abs(np.fft.fft(noise, axis=-1)) ** 2, axis=(0, 1, 2))
    assert abs(spectrum / spectrum.mean() - 1).max() < 5 / np.sqrt(8 * 192)


def test_real_samples_are_the_real_parts_of_complex_ones() -> None:
    """Noise of s / sqrt(2); over half the band that is what complex noise of s is over as many bins."""
    board = load_rig("awr2944_pair").radars["horizontal"]
    board = replace(board, schedule=replace(board.schedule, profile=replace(board.schedule.profile, samples=256)))
    frame = Synthesizer(board).frame(EMPTY, FrontEnd(board, FrontEndSettings.ideal(25.0), 1), 0, 0)
    assert frame.adc.shape == (16, 4, 4, 256)
    assert frame.adc.std() == pytest.approx(25.0 / np.sqrt(2.0), rel=0.01)
    spectrum = 2.0 * np.fft.fft(frame.adc.astype(float), axis=-1)[..., :128] / 256
    assert np.mean(abs(spectrum) ** 2) == pytest.approx(25.0**2 / 128, rel=0.02)
    with pytest.raises(ConfigError, match="iq_image_db"):
        FrontEnd(board, FrontEndSettings(iq_image_db=-35.0), 1)


def test_noise_is_independent_between_samples_channels_chirps_frames_and_boards() -> None:
    settings = FrontEndSettings.ideal(200.0)
    loops = captured(settings, loops=8)
    others = [captured(settings, number=1), captured(settings, seed=2), captured(settings, which="vertical")]
    lines = np.concatenate((loops[:4].reshape(-1, SAMPLES), *(other.reshape(-1, SAMPLES) for other in others)))
    real = np.concatenate((lines.real, lines.imag))
    real -= real.mean(axis=1, keepdims=True)
    real /= np.linalg.norm(real, axis=1, keepdims=True)
    for shift in (0, 1, 4, 64):
        correlation = np.abs(real @ np.roll(real, shift, axis=1).T)
        if shift == 0:
            np.fill_diagonal(correlation, 0.0)
        # 2688^2 / 2 pairs of 256 numbers: 5.2 standard deviations are to be expected
        assert correlation.max() * np.sqrt(SAMPLES) < 7.0
        assert np.sqrt(np.mean(correlation**2) * SAMPLES) == pytest.approx(1.0, abs=0.02)


def test_any_frame_can_be_made_again_alone() -> None:
    front_end, synthesizer = FrontEnd(BOARD, FrontEndSettings(), 5), Synthesizer(BOARD)
    frames = [synthesizer.frame(reflector(), front_end, number, 0).adc for number in (0, 1, 2, 7)]
    again = Synthesizer(BOARD).frame(reflector(), FrontEnd(BOARD, FrontEndSettings(), 5), 7, 0).adc
    assert np.array_equal(again, frames[3])
    assert not any(np.array_equal(frames[0], other) for other in frames[1:])


def test_leakage_is_as_strong_and_as_near_as_on_real_boards() -> None:
    """Table of simulator.md: bins 0 to 6, peak in bins 2 to 3, 25 to 95 times the noise, 520 to 970 LSB."""
    for seed in range(4):
        profile = np.median(levels_db(captured(FrontEndSettings(), seed=seed))[0], axis=(0, 1))
        peak = int(np.argmax(profile[: SAMPLES // 2]))
        assert peak in (2, 3)
        assert 520 < 10 ** (profile[peak] / 20) * 2 < 2 * 25.0 * 95
        assert 25 < 10 ** (profile[peak] / 20) / 25.0 < 95
        assert profile[9 : SAMPLES - 4].max() < profile[peak] - 25


def test_mismatch_is_that_of_real_boards() -> None:
    """Gain spread 1.2 to 3.9 dB, receivers more than transmitters; phases separable to 1 to 3.5 degrees; delays."""
    for seed in range(6):
        front_end = FrontEnd(BOARD, FrontEndSettings(), seed)
        level_db = 20 * np.log10(abs(front_end.gain))
        assert 1.2 < level_db.std() < 3.9
        assert level_db.mean(axis=0).std() > level_db.mean(axis=1).std() * 0.8
        assert 1.0 < np.sqrt(np.mean(residual_deg(front_end.gain, front_end.shift_bins, SAMPLES) ** 2)) < 3.5
        assert abs(front_end.shift_bins).max() <= 0.27
        assert np.ptp(front_end.shift_bins, axis=1).max() == 0.0


def test_a_real_board_s_leakage_and_mismatch_look_like_the_default_ones(radar_data: Path) -> None:
    """The corridor's cascade: leakage peaks in bins 2 to 3 and is gone by bin 9; phases separable to 4 degrees."""
    folder, board = radar_data / "cascade_corridor_svenningsson", load_rig("corridor").radars["horizontal"]
    real = import_ti_calibration(folder / "calibration.mat", board.schedule)
    assert np.sqrt(np.mean(residual_deg(real.gain, real.range_shift_bins, SAMPLES) ** 2)) < 4.5
    assert np.ptp(real.range_shift_bins) < 2 * FrontEndSettings().delay_spread_bins
    layout = replace(board.schedule.layout, loops=64)
    sums = np.load(folder / "adc_loop_sum.npz")["adc_loop_sum"]
    measured = unpack(split_loop_sum(sums, 64).reshape(layout.shape), layout).mean(axis=0)
    measured *= np.exp(-2j * np.pi * real.range_shift_bins[..., None] * np.arange(SAMPLES) / SAMPLES)
    simulated = captured(FrontEndSettings(noise_lsb=5.7))[0]
    for samples in (measured, simulated):
        profile_db = np.median(levels_db(samples), axis=(0, 1))[:12]
        profile_db -= profile_db.max()
        assert int(np.argmax(profile_db)) in (2, 3)
        assert profile_db[[1, 4]].min() > -14
        assert profile_db[[0, 6]].max() < -4
        assert profile_db[9:].max() < -25


def test_a_calibration_undoes_the_mismatch_but_for_its_errors() -> None:
    settings = FrontEndSettings(noise_lsb=1.0, leakage=0.0, residual_deg=4.0, coupling_deg=2.0)
    front_end = FrontEnd(BOARD, settings, 3)
    calibration = front_end.calibration()
    ramp = np.exp(-2j * np.pi * calibration.range_shift_bins[..., None] * np.arange(SAMPLES) / SAMPLES)
    beat = Synthesizer(BOARD).beat(reflector())[0]
    found = captured(replace(settings, high_pass=False), reflector(), seed=3)[0]
    left = (found * calibration.gain[..., None] * ramp / beat).mean(axis=-1)
    assert np.degrees(np.std(np.angle(left / left.mean()))) == pytest.approx(4.0, rel=0.2)
    assert np.std(20 * np.log10(abs(left))) == pytest.approx(0.3, rel=0.2)


@pytest.mark.parametrize("range_m", [5.0, np.inf])
def test_the_pipeline_focuses_through_the_calibration(range_m: float) -> None:
    """Without residual errors the sidelobes are a uniform line's again, whatever range the calibration was made at."""
    settings = FrontEndSettings(noise_lsb=0.0, coupling_deg=3.0, residual_deg=0.0, residual_db=0.0, residual_bins=0.0)
    calibration = FrontEnd(BOARD, settings, 4).calibration(range_m)
    radar = replace(BOARD, calibration=calibration)
    frame = Synthesizer(radar).frame(reflector(51.0), FrontEnd(radar, settings, 4), 0, 0)
    heatmap = Imager(radar, HeatmapSettings(angle_window="rectangular"), RIG.settings.antenna).process(frame)
    cut = heatmap.power[:, int(np.argmax(heatmap.power.max(axis=0)))]
    cosine = heatmap.direction_cosine
    lobe = abs(cosine) < 0.021
    assert abs(cosine[np.argmax(cut)]) < 0.004
    assert 10 * np.log10(cut[~lobe & (abs(cosine) < 0.5)].max() / cut.max()) < -12.7


def test_the_real_calibration_procedure_finds_what_the_front_end_states() -> None:
    settings = FrontEndSettings(residual_deg=0.0, residual_db=0.0, residual_bins=0.0, high_pass=False)
    radar = cascade(loops=4)
    front_end, synthesizer = FrontEnd(radar, settings, 8), Synthesizer(radar)
    averager = CaptureAverager(radar.schedule, 84.0, 5.0)
    averager.add(synthesizer.frame(reflector(84.0, 1600.0), front_end, 0, 0))
    made = make_calibration(averager.mean(), radar, Reflector(84.0 * BIN_M), Path("c.npz"), amplitude=True)
    stated = front_end.calibration(84.0 * BIN_M)
    turn = np.exp(1j * np.pi * (stated.range_shift_bins - made.calibration.range_shift_bins))
    ratio = made.calibration.gain / stated.gain * turn
    ratio /= ratio.mean()
    kept = abs(np.angle(ratio)) < np.radians(20)
    assert kept.mean() > 0.98
    assert np.degrees(np.std(np.angle(ratio[kept]))) < 1.0
    assert np.std(20 * np.log10(abs(ratio[kept]))) < 0.2
    shift = made.calibration.range_shift_bins - stated.range_shift_bins
    assert np.std(shift) < 0.01


def test_both_boards_of_a_rig_differ_and_a_seed_gives_the_same_board() -> None:
    first, second, again = (
        FrontEnd(cascade(which), FrontEndSettings(), 2) for which in ("horizontal", "vertical", "horizontal")
    )
    assert not np.allclose(first.gain, second.gain)
    np.testing.assert_array_equal(first.response, again.response)


@pytest.mark.parametrize("bins", [20.0, 84.0])
def test_high_pass_of_the_if(bins: float) -> None:
    """Two first-order sections of 175 and 350 kHz: 31.25 kHz a bin."""
    flat = captured(IDEAL, reflector(bins))
    passed = captured(replace(IDEAL, high_pass=True), reflector(bins))
    f_hz = bins * 31250.0
    expected = 1 / ((1 - 1j * 175e3 / f_hz) * (1 - 1j * 350e3 / f_hz))
    ratio = np.vdot(flat, passed) / np.vdot(flat, flat)
    assert abs(ratio - expected) < 2e-3


def test_start_jitter_turns_chirps_by_the_beat_frequency() -> None:
    """1.1 ns at 2.6 MHz is one degree, by chance, the same for all receivers of a chirp."""
    jittered = captured(replace(IDEAL, start_jitter_s=1.1e-9), reflector(84.0), loops=8)
    plain = captured(IDEAL, reflector(84.0))
    angle_deg = np.degrees(np.angle((jittered * plain.conj()).sum(axis=-1)))
    late = 360.0 * 1.1e-9 * 84 * 31250.0
    assert np.all((abs(angle_deg) < 0.05) | (abs(angle_deg - late) < 0.05))
    assert np.ptp(angle_deg, axis=2).max() < 0.05
    assert 0.3 < np.mean(angle_deg > 0.5 * late) < 0.7


def test_second_harmonic_stands_at_twice_the_range() -> None:
    """-55 dBc at full scale, 6 dB less for every 6 dB of amplitude."""
    for amplitude in (16000.0, 8000.0):
        profile = levels_db(captured(replace(IDEAL, second_harmonic_dbc=-55.0), reflector(50.0, amplitude)))[0, 0, 0]
        expected_db = -55.0 + 20 * np.log10(amplitude / 32767.0)
        assert profile[100] - profile[50] == pytest.approx(expected_db, abs=0.3)


def test_image_stands_at_the_negative_beat() -> None:
    profile = levels_db(captured(replace(IDEAL, iq_image_db=-35.0), reflector(84.0)))[0]
    assert np.allclose(profile[..., SAMPLES - 84] - profile[..., 84], -35.0, atol=0.2)


def test_phase_noise_floor_follows_range_correlation() -> None:
    """-94 dBc/Hz at 1 MHz: -62.6 dBc in 31 kHz next to a reflector at 5 m, 6 dB less at half of that; Hann: +1.8 dB."""
    settings = replace(IDEAL, phase_noise_dbc_hz=-94.0)
    for bins, expected_db in ((84.0, -60.8), (42.0, -66.8)):
        samples = captured(settings, reflector(bins, 20000.0), loops=4)
        power = 10 ** (levels_db(samples) / 10)
        floor = power[..., int(bins) + 8 : int(bins) + 40].mean() / power[..., int(bins)].mean()
        assert 10 * np.log10(floor) == pytest.approx(expected_db, abs=1.0)


def test_dead_and_stuck_channels() -> None:
    settings = FrontEndSettings(dead_transmitters=(12,), dead_receivers=(5,), stuck_receivers=(9,), stuck_code=-100)
    samples = captured(settings, reflector())
    assert not samples[0, :, 5].any()
    assert (samples[0, :, 9] == -100 - 100j).all()
    assert levels_db(samples)[0, 0, 0, 84] < 20
    assert levels_db(samples)[0, 1, 0, 84] > 50


def test_snr_is_the_link_budget_s() -> None:
    """Validation table, row 10: 1 m2 at 5 m stands 14.6 dB over the noise, 38.7 after the range FFT, 58 after all."""
    link, profile = LinkSettings(), BOARD.schedule.profile
    amplitude = amplitude_per_rcs(link, profile.wavelength_m, 100.0) / (84.0 * BIN_M) ** 2
    loss_db = 40 * np.log10(84.0 * BIN_M / 5.0)
    settings = FrontEndSettings.ideal(100.0)
    clean, noisy = captured(IDEAL, reflector(84.0, amplitude)), captured(settings, reflector(84.0, amplitude), loops=8)
    noise = noisy - clean
    per_sample_db = 10 * np.log10(np.mean(abs(clean) ** 2) / np.mean(abs(noise) ** 2))
    assert per_sample_db + loss_db == pytest.approx(14.62, abs=0.1)
    fft_db = 10 * np.log10(np.mean(abs(np.fft.fft(clean)[..., 84]) ** 2) / np.mean(abs(np.fft.fft(noise)) ** 2))
    assert fft_db + loss_db == pytest.approx(38.7, abs=0.1)
    beams = (np.fft.fft(x)[..., 84] * np.exp(-1j * np.angle(np.fft.fft(clean)[..., 84])) for x in (clean, noise))
    signal, rest = (beam[..., BOARD.array.position >= 0][..., :86].sum(axis=-1) for beam in beams)
    assert 10 * np.log10(np.mean(abs(signal) ** 2) / np.mean(abs(rest) ** 2)) + loss_db == pytest.approx(58.0, abs=2.5)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("noise_lsb", -1.0),
        ("leakage", float("nan")),
        ("gain_spread_db", 11.0),
        ("start_jitter_s", 1e-7),
        ("iq_image_db", 0.0),
        ("stuck_code", 40000),
    ],
)
def test_settings_out_of_range_are_refused(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=key):
        FrontEndSettings(**{key: value})


def test_antennas_that_the_board_lacks_are_refused() -> None:
    with pytest.raises(ConfigError, match="dead_transmitters"):
        FrontEnd(BOARD, FrontEndSettings(dead_transmitters=(13,)), 0)
    with pytest.raises(ConfigError, match="seed"):
        FrontEnd(BOARD, FrontEndSettings(), -1)
