# SPDX-License-Identifier: Apache-2.0
"""Calibration files: round trip, refusals, repair, near field, and TI's real and synthetic files."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
from scipy.io import savemat

from edge.calibration import Calibration, Waveform, load_calibration, save_calibration
from edge.calibration_fit import additive_fit, phasor_fit
from edge.calibration_ti import import_ti_calibration
from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import CalibrationError, DependencyError
from edge.frames import RadarFrame
from edge.reference.point_targets import make_frame, unpack
from edge.reference.repack import split_loop_sum
from edge.rig import load_rig

FLAT = AntennaSettings(along_loss_db=0.0)
CORRIDOR_OUTLIERS = {"TX2/RX13", "TX7/RX13", "TX8/RX16", "TX10/RX16"}


@pytest.fixture(scope="module")
def radar():
    """Cascade of one loop, not calibrated."""
    return load_rig("cascade_demo").radars["horizontal"]


def separable(rng, shape=(12, 16)):
    """Mismatch gain and shift of transmitters times receivers; the separable phase is the one at mid-chirp."""
    level_db, angle, shift = (rng.uniform(-a, a, shape[0])[:, None] + rng.uniform(-a, a, shape[1]) for a in (1, 3, 0.4))
    return 10 ** (level_db / 20) * np.exp(1j * (angle - np.pi * shift * 255 / 256)), shift


def measured(radar, rng, **changes):
    gain, shift = separable(rng)
    gain = 1 / gain
    values = {"reference_range_m": 5.0, "board": "B7", "temperature_c": 41.5, "date": "2026-03-04", **changes}
    return Calibration(gain, shift, made_with=Waveform.of(radar.schedule), **values)


def test_saved_calibration_comes_back(radar, tmp_path):
    saved = measured(radar, np.random.default_rng(1), repaired=("TX3/RX4",))
    save_calibration(tmp_path / "c.npz", saved)
    loaded = load_calibration(tmp_path / "c.npz", radar.schedule)
    assert np.array_equal(loaded.gain, saved.gain)
    assert np.array_equal(loaded.range_shift_bins, saved.range_shift_bins)
    for name in ("reference_range_m", "board", "temperature_c", "date", "made_with", "repaired"):
        assert getattr(loaded, name) == getattr(saved, name)


def test_far_field_calibration_keeps_its_infinite_range(radar, tmp_path):
    save_calibration(tmp_path / "c.npz", measured(radar, np.random.default_rng(2), reference_range_m=np.inf))
    assert load_calibration(tmp_path / "c.npz", radar.schedule).reference_range_m == np.inf


def test_identity_changes_nothing_and_has_no_file(radar, tmp_path):
    identity = Calibration.identity(radar.schedule.layout)
    assert (identity.gain == 1).all()
    assert not identity.range_shift_bins.any()
    with pytest.raises(CalibrationError, match="made with"):
        save_calibration(tmp_path / "c.npz", identity)


def test_arrays_are_read_only(radar):
    with pytest.raises(ValueError, match="read-only"):
        Calibration.identity(radar.schedule.layout).gain[0, 0] = 2


@pytest.mark.parametrize(
    ("gain", "shift", "reference_m", "message"),
    [
        (np.ones((12, 16)), np.zeros((12, 4)), 5.0, "common shape"),
        (np.ones(192), np.zeros(192), 5.0, "common shape"),
        (np.full((12, 16), np.nan), np.zeros((12, 16)), 5.0, "slot 0, receiver 0"),
        (np.zeros((12, 16)), np.zeros((12, 16)), 5.0, "no gain"),
        (np.ones((12, 16)), np.full((12, 16), np.inf), 5.0, "no number"),
        (np.ones((12, 16)), np.zeros((12, 16)), 0.0, "reflector range"),
        (np.ones((12, 16)), np.zeros((12, 16)), np.nan, "reflector range"),
    ],
)
def test_impossible_calibration_is_refused(gain, shift, reference_m, message):
    with pytest.raises(CalibrationError, match=message):
        Calibration(gain, shift, reference_m)


@pytest.mark.parametrize(
    ("change", "value"),
    [("slope_hz_per_s", 70e12), ("sample_rate_hz", 8.2e6), ("samples", 240), ("start_frequency_hz", 76.5e9)],
)
def test_foreign_calibration_names_both_values(radar, tmp_path, change, value):
    save_calibration(tmp_path / "c.npz", measured(radar, np.random.default_rng(3)))
    profile = dataclasses.replace(radar.schedule.profile, **{change: value})
    with pytest.raises(CalibrationError, match="foreign") as caught:
        load_calibration(tmp_path / "c.npz", dataclasses.replace(radar.schedule, profile=profile))
    assert change in str(caught.value.value)
    assert change in caught.value.allowed
    assert caught.value.value != caught.value.allowed


def test_calibration_of_another_board_is_foreign(radar, tmp_path):
    save_calibration(tmp_path / "c.npz", measured(radar, np.random.default_rng(3)))
    with pytest.raises(CalibrationError, match=r"receivers = 16.*receivers = 4"):
        load_calibration(tmp_path / "c.npz", load_rig("awr1843_pair").radars["vertical"].schedule)


def test_more_loops_keep_the_calibration(radar, tmp_path):
    save_calibration(tmp_path / "c.npz", measured(radar, np.random.default_rng(3)))
    load_calibration(tmp_path / "c.npz", dataclasses.replace(radar.schedule, loops=8))


def rewritten(path, **changes):
    with np.load(path) as stored:
        content = {**stored, **changes}
    np.savez(path, **content)
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gain": np.full((12, 16), -1e6)}, "dummy"),
        ({"gain": np.ones((12, 16), complex)}, "dummy"),
        ({"gain": np.arange(1.0, 65.0).reshape(4, 16)}, "contradict the header"),
        ({"gain": np.array([["a", "b"]])}, "not numbers"),
        ({"gain": np.array([{}])}, "not a calibration file"),
        ({"header": np.array("{")}, "not a calibration file"),
        ({"header": np.array("[1]")}, "unknown calibration format"),
        ({"header": np.array('{"format": "rfconstruct-calibration-1"}')}, "which waveform"),
    ],
)
def test_damaged_file_is_refused_by_name(radar, tmp_path, changes, message):
    save_calibration(tmp_path / "c.npz", measured(radar, np.random.default_rng(4)))
    with pytest.raises(CalibrationError, match=message) as caught:
        load_calibration(rewritten(tmp_path / "c.npz", **changes), radar.schedule)
    assert "c.npz" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04cut", b"plain text"])
def test_other_files_are_refused(radar, tmp_path, content):
    (tmp_path / "c.npz").write_bytes(content)
    with pytest.raises(CalibrationError, match="not a calibration file"):
        load_calibration(tmp_path / "c.npz", radar.schedule)


def test_absent_file_is_refused(radar, tmp_path):
    for name, read in (("c.npz", load_calibration), ("c.mat", import_ti_calibration)):
        with pytest.raises(CalibrationError, match="no such calibration file"):
            read(tmp_path / name, radar.schedule)


def test_outliers_are_repaired_and_named(radar, tmp_path):
    calibration = measured(radar, np.random.default_rng(5))
    gain, shift = calibration.gain.copy(), calibration.range_shift_bins.copy()
    shift[3, 7] += 8.8
    gain[0, 0] *= 10
    gain[11, 2] *= np.exp(2j)
    spoiled = dataclasses.replace(calibration, gain=gain, range_shift_bins=shift)
    save_calibration(tmp_path / "c.npz", spoiled)
    loaded = load_calibration(tmp_path / "c.npz", radar.schedule)
    assert loaded.repaired == ("TX12/RX1", "TX9/RX8", "TX1/RX3")
    assert np.abs(loaded.gain / calibration.gain - 1).max() < 1e-5
    assert np.abs(loaded.range_shift_bins - calibration.range_shift_bins).max() < 1e-9


def test_random_values_are_no_calibration(radar, tmp_path):
    rng = np.random.default_rng(6)
    noise = np.exp(2j * np.pi * rng.random((12, 16)))
    save_calibration(tmp_path / "c.npz", dataclasses.replace(measured(radar, rng), gain=noise))
    with pytest.raises(CalibrationError, match="channels contradict"):
        load_calibration(tmp_path / "c.npz", radar.schedule)


def test_fits_reproduce_separable_tables():
    rng = np.random.default_rng(7)
    values = rng.normal(size=12)[:, None] + rng.normal(size=16)
    assert np.abs(additive_fit(values) - values).max() < 1e-12
    assert np.abs(phasor_fit(np.exp(1j * values)) - np.exp(1j * values)).max() < 1e-12


def ti_file(path, bins, peak, slope=79.034, rate=8e6, samples=256):
    """A file with TI's structure; matrices in firing order are turned to TX1, TX2, ..."""
    spectrum = np.zeros((5 * samples, 1, 1), complex)
    result = {
        "RangeMat": bins[::-1],
        "PeakValMat": peak[::-1],
        "Rx_fft": np.broadcast_to(spectrum, (5 * samples, 2, 2)),
    }
    savemat(path, {"calibResult": result, "params": {"Slope_MHzperus": slope, "Sampling_Rate_sps": rate}})
    return path


def ti_measurement(frame, radar):
    """TI's script on a frame: peak of the 5x zero-padded FFT of the mean over loops, bins from 1, between 1 and 5 m."""
    samples = unpack(frame.adc, radar.schedule.layout).mean(axis=0)
    spectrum = np.fft.fft(samples * np.hanning(258)[1:-1], 5 * 256)
    bins = np.abs(spectrum[..., 85:421]).argmax(axis=-1) + 85
    return bins + 1, np.take_along_axis(spectrum, bins[..., None], axis=-1)[..., 0]


@pytest.fixture(scope="module")
def mismatched(radar):
    """Mismatch of every channel, and what TI's script measures on a reflector 2 m ahead."""
    gain, shift = separable(np.random.default_rng(9))
    frame = make_frame(radar, ahead(radar, 2.0), 3000.0, 0, 0, channel_gain=gain, shift_bins=shift)
    return gain, shift, *ti_measurement(frame, radar)


def ahead(radar, range_m):
    return [np.add(radar.mounting.position_m, (range_m, 0.0, 0.0))]


def test_near_field_reflector_calibrates_a_farther_target(radar, mismatched, tmp_path):
    """Reflector at 2 m, target at 9 m: perfect only when the curvature is taken out, but for the grid of TI's FFT."""
    gain, shift, bins, peak = mismatched
    calibration = import_ti_calibration(ti_file(tmp_path / "c.mat", bins.astype(np.uint16), peak), radar.schedule)
    assert calibration.reference_range_m == pytest.approx(2.0, abs=0.05)
    assert calibration.repaired == ()
    frame = make_frame(radar, ahead(radar, 9.0), 1000.0, 0, 0, channel_gain=gain, shift_bins=shift)

    def peak_of(correction):
        corrected = dataclasses.replace(radar, calibration=correction)
        heatmap = Imager(corrected, HeatmapSettings(), FLAT).process(frame)
        row = np.unravel_index(heatmap.power.argmax(), heatmap.power.shape)[0]
        return 10 * np.log10(heatmap.power.max()), heatmap.direction_cosine[row]

    perfect_db, _ = peak_of(Calibration(np.exp(-1j * np.angle(gain)), shift - shift[0, 0]))
    aware_db, cosine = peak_of(calibration)
    assert aware_db == pytest.approx(perfect_db, abs=0.3)
    assert abs(cosine) < 0.004
    assert perfect_db - peak_of(dataclasses.replace(calibration, reference_range_m=np.inf))[0] > 1.0


@pytest.mark.parametrize("kind", [np.uint16, np.int32, np.float64])
def test_integer_types_do_not_wrap(radar, mismatched, tmp_path, kind):
    bins, peak = mismatched[2:]
    calibration = import_ti_calibration(ti_file(tmp_path / "c.mat", bins.astype(kind), peak), radar.schedule)
    assert np.array_equal(calibration.range_shift_bins, (bins - bins[0, 0]) / 5)
    assert calibration.range_shift_bins.min() < 0


def test_amplitudes_are_left_alone(radar, mismatched, tmp_path):
    calibration = import_ti_calibration(ti_file(tmp_path / "c.mat", *mismatched[2:]), radar.schedule)
    assert np.abs(np.abs(calibration.gain) - 1).max() < 1e-6


@pytest.mark.parametrize("dummy", ["bins", "peak"])
def test_ti_dummy_is_refused(radar, mismatched, tmp_path, dummy):
    bins, peak = mismatched[2:]
    placeholder = np.full((12, 16), -1_000_000)
    path = ti_file(tmp_path / "c.mat", *((placeholder, peak) if dummy == "bins" else (bins, placeholder)))
    with pytest.raises(CalibrationError, match="dummy"):
        import_ti_calibration(path, radar.schedule)


@pytest.mark.parametrize("change", [{"slope": 15.0148}, {"rate": 15e6}, {"samples": 512}])
def test_ti_foreign_is_refused(radar, mismatched, tmp_path, change):
    path = ti_file(tmp_path / "c.mat", *mismatched[2:], **change)
    with pytest.raises(CalibrationError, match="foreign"):
        import_ti_calibration(path, radar.schedule)


def test_ti_file_of_a_smaller_board_is_foreign(radar, mismatched, tmp_path):
    bins, peak = (matrix[:3, :4] for matrix in mismatched[2:])
    with pytest.raises(CalibrationError, match="foreign"):
        import_ti_calibration(ti_file(tmp_path / "c.mat", bins, peak), radar.schedule)


def test_other_mat_files_are_refused(radar, tmp_path):
    (tmp_path / "a.mat").write_bytes(b"no matlab")
    savemat(tmp_path / "b.mat", {"x": 1.0})
    savemat(tmp_path / "c.mat", {"calibResult": {"RangeMat": np.ones((12, 16))}})
    for name, message in (("a", "not a MATLAB"), ("b", "cascade calibration"), ("c", "PeakValMat")):
        with pytest.raises(CalibrationError, match=message):
            import_ti_calibration(tmp_path / f"{name}.mat", radar.schedule)


def test_missing_scipy_names_the_extra(radar, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.io", None)
    with pytest.raises(DependencyError, match=r"rfconstruct\[import\]"):
        import_ti_calibration(tmp_path / "c.mat", radar.schedule)


def test_real_calibration_puts_the_reflector_straight_ahead(radar_data):
    folder = radar_data / "cascade_corridor_svenningsson"
    rig = load_rig("corridor").with_calibration("horizontal", folder / "calibration.mat")
    radar = rig.radars["horizontal"]
    assert set(radar.calibration.repaired) == CORRIDOR_OUTLIERS
    assert radar.calibration.date == "2020-11-20"
    assert radar.calibration.reference_range_m == pytest.approx(5.02, abs=0.03)
    with np.load(folder / "adc_loop_sum.npz") as stored:
        adc = split_loop_sum(stored["adc_loop_sum"], radar.schedule.loops)
    frame = RadarFrame("horizontal", 0, 0, adc, radar.schedule.layout)
    heatmap = Imager(radar, rig.settings.heatmap, rig.settings.antenna).process(frame)
    found = Detector(radar, CfarSettings(guard_angle=6, train_angle=14)).process(heatmap)
    strongest = np.flatnonzero(np.abs(found.range_m - 5.02) < 0.3)[0]
    assert found.range_m[strongest] == pytest.approx(5.02, abs=0.03)
    assert np.degrees(np.arcsin(found.direction_cosine[strongest])) == pytest.approx(0.0, abs=0.3)


def test_real_calibration_survives_our_own_format(radar_data, tmp_path):
    rig = load_rig("corridor").with_calibration(
        "horizontal", radar_data / "cascade_corridor_svenningsson" / "calibration.mat"
    )
    imported = rig.radars["horizontal"].calibration
    save_calibration(tmp_path / "c.npz", imported)
    loaded = load_calibration(tmp_path / "c.npz", rig.radars["horizontal"].schedule)
    assert np.array_equal(loaded.gain, imported.gain)
    assert set(loaded.repaired) == CORRIDOR_OUTLIERS
