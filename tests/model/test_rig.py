# SPDX-License-Identifier: Apache-2.0
"""rig.toml: what is read, and every way a file can be wrong, named by file, key and value."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from edge.calibration import Calibration, Waveform, save_calibration
from edge.config import PipelineSettings, RigGeometry
from edge.errors import CalibrationError, ConfigError
from edge.rig import InterleaveSettings, find_rig, known_rigs, load_rig
from edge.rig_toml import UNITS, Place, fill, merged, spellings
from edge.waveform import ChirpProfile, Schedule

PROFILE = """
[schedule.profile]
device = "AWR2243"
start_frequency_ghz = 77.0
slope_mhz_per_us = 79.03
idle_us = 5.0
adc_start_us = 6.0
ramp_end_us = 40.0
samples = 256
sample_rate_msps = 8.0
"""
SCHEDULE = "[schedule]\nloops = 8\nframe_period_ms = 16.6667\n" + PROFILE
PAIR = SCHEDULE + "\n[radars.horizontal]\n[radars.vertical]\n"


def rig_from(folder: Path, text: str):
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return load_rig(folder)


def refused(folder: Path, text: str) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        rig_from(folder, text)
    assert "rig.toml" in str(caught.value)
    return caught.value


def test_smallest_pair_takes_every_default(tmp_path):
    rig = rig_from(tmp_path, PAIR)
    assert rig.name == tmp_path.name
    assert list(rig.radars) == ["horizontal", "vertical"]
    assert rig.settings == PipelineSettings()
    assert rig.geometry == RigGeometry()
    assert rig.interleave == InterleaveSettings()
    radar = rig.radars["vertical"]
    assert radar.radar == "vertical"
    assert radar.array.count == 86
    assert radar.calibration.gain.shape == (12, 16)
    assert radar.schedule == Schedule(
        ChirpProfile("AWR2243", 77e9, 79.03e12, 5e-6, 6e-6, 40e-6, 256, 8e6), 8, 16.6667e-3
    )


def test_every_group_is_read(tmp_path):
    rig = rig_from(
        tmp_path,
        'description = "d"\n'
        + PAIR
        + """
[radars.vertical.mounting]
position_m = [0, 0.1, -0.2]
array_sign = -1
power_offset_db = 1.5
range_offset_cm = 3
[geometry]
height_m = 1
offset_m = [1.0, 2.0, 3.0]
[interleave]
drift_ppm = 20
rearm_s = 30.0
[heatmap]
angle_window = "rectangular"
focus = false
[cfar]
kind = "os"
p_fa = 1e-4
[antenna]
along_loss_db = 0.0
[association]
fov_deg = 40.0
[fusion]
max_time_ms = 6000
[objects]
core_points = 5
[completion]
model = "other"
[stream]
endpoints = ["tcp://127.0.0.1:1", "ipc:///tmp/x"]
""",
    )
    mounting, settings = rig.radars["vertical"].mounting, rig.settings
    assert mounting.position_m == (0.0, 0.1, -0.2)
    assert (mounting.array_sign, mounting.power_offset_db, mounting.range_offset_m) == (-1, 1.5, 0.03)
    assert (rig.description, rig.geometry.height_m, rig.geometry.offset_m) == ("d", 1.0, (1.0, 2.0, 3.0))
    assert rig.interleave == InterleaveSettings(20e-6, 30.0)
    assert (settings.heatmap.angle_window, settings.heatmap.focus) == ("rectangular", False)
    assert (settings.cfar.kind, settings.cfar.p_fa, settings.antenna.along_loss_db) == ("os", 1e-4, 0.0)
    assert (settings.association.fov_deg, settings.fusion.max_time_s) == (40.0, 6.0)
    assert (settings.objects.core_points, settings.completion.model) == (5, "other")
    assert settings.stream.endpoints == ("tcp://127.0.0.1:1", "ipc:///tmp/x")


@pytest.mark.parametrize(
    ("extra", "key", "said"),
    [
        ("[cfra]\np_fa = 1e-4", "cfra", "did you mean cfar?"),
        ("[cfar]\npfa = 1e-4", "cfar.pfa", "did you mean p_fa?"),
        ("[radars.horizontal.mounting]\npositon_m = [0, 0, 0]", "radars.horizontal.mounting.positon_m", "position_m"),
        ("[radars.vertikal]", "radars.vertikal", "did you mean vertical?"),
        ("[fusion]\nzzz = 1", "fusion.zzz", "remove it"),
        ('[cfar]\np_fa = "small"', "cfar.p_fa", "a number"),
        ("[cfar]\np_fa = nan", "cfar.p_fa", "finite"),
        ("[cfar]\nguard_angle = 2.5", "cfar.guard_angle", "a whole number"),
        ("[cfar]\nguard_angle = true", "cfar.guard_angle", "a whole number"),
        ("[heatmap]\nfocus = 1", "heatmap.focus", "true or false"),
        ('[heatmap]\nangle_window = "hamming"', "heatmap.angle_window", "rectangular, hann"),
        ("[completion]\nmodel = 3", "completion.model", "text"),
        ("[geometry]\noffset_m = [0, 0]", "geometry.offset_m", "a list of 3 values"),
        ('[geometry]\noffset_m = [0, 0, "x"]', "geometry.offset_m.2", "a number"),
        ('[stream]\nendpoints = "tcp://127.0.0.1:1"', "stream.endpoints", "a list"),
        ("[fusion]\ntravel_s = 3.0", "fusion.travel_s", "travel_m, travel_cm, travel_mm"),
        ("[fusion]\ntravel = 3.0", "fusion.travel", "travel_m, travel_cm, travel_mm"),
        ("[fusion]\ntravel_m = 3.0\ntravel_cm = 300", "fusion.travel_cm", "twice"),
        ("[radars.horizontal.mounting]\narray_sign = 0", "radars.horizontal.mounting.array_sign", "1, -1"),
        ("[radars.horizontal.mounting]\narray_sign = true", "radars.horizontal.mounting.array_sign", "1, -1"),
        ("[cfar]\np_fa = 0.9", "cfar.p_fa", "0 < p_fa < 0.5"),
        ("[interleave]\nrearm_s = -1", "interleave.rearm_s", ">= 0"),
    ],
)
def test_wrong_setting_is_named(tmp_path, extra, key, said):
    error = refused(
        tmp_path, PAIR.replace("[radars.horizontal]\n", "") + extra if "horizontal" in extra else PAIR + extra
    )
    assert key in str(error)
    assert said in str(error)


def test_wrong_value_is_shown(tmp_path):
    assert refused(tmp_path, PAIR + "[cfar]\npfa = 0.125").value == 0.125


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PAIR.replace("slope_mhz_per_us", "slope_mhz"), "slope_hz_per_s, slope_mhz_per_us"),
        (PAIR.replace("idle_us = 5.0\n", ""), "set idle_s"),
        (PAIR.replace("idle_us", "idle_ghz"), "idle_s, idle_ms, idle_us"),
        (PAIR.replace('device = "AWR2243"', 'device = "AWR9999"'), "AWR2243, AWR1843"),
        (PAIR.replace("loops = 8", "loops = 0"), "schedule.loops"),
        (PAIR.replace("loops = 8", "transmitters = [12, 1]\nloops = 8"), "filled row"),
        (SCHEDULE, "radars"),
        (SCHEDULE + "[radars]\nhorizontal = 1", "must be a table"),
        ("schedule = 3\n[radars.horizontal]", "must be a table"),
        ("[schedule]\nprofile = 3\nloops = 8\nframe_period_s = 0.1\n[radars.horizontal]", "must be a table"),
        ("description = 1\n" + PAIR, "text"),
        ('name = "../x"\n' + PAIR, "name"),
        (SCHEDULE + "[radars.horizontal]\ncalibration = 1", "calibration"),
        ("[schedule\n", "not a TOML file"),
    ],
)
def test_wrong_structure_is_named(tmp_path, text, said):
    assert said in str(refused(tmp_path, text))


def test_a_rig_has_the_name_it_says_or_the_folders(tmp_path):
    assert rig_from(tmp_path, PAIR).name == tmp_path.name
    assert rig_from(tmp_path, 'name = "cascade_pair"\n' + PAIR).name == "cascade_pair"


def test_file_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "rig.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a TOML file"):
        load_rig(tmp_path)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ("ramp_end_us = 60.0", "end frequency"),
        ("ramp_end_us = 38.0", "ADC window"),
        ("samples = 2048", "ADC buffer"),
        ("sample_rate_msps = 30.0", "highest ADC rate"),
    ],
)
def test_broken_rule_of_the_hardware_is_named(tmp_path, change, rule):
    key = change.partition(" =")[0]
    lines = [change if line.startswith(key) else line for line in PAIR.splitlines()]
    assert rule in str(refused(tmp_path, "\n".join(lines)))


def own_schedule(change: str) -> str:
    return PAIR + f"[radars.vertical.schedule]\n{change}\n"


def test_radars_with_different_range_bins_are_refused(tmp_path):
    error = refused(tmp_path, own_schedule("profile.slope_mhz_per_us = 77.5"))
    assert "equal range bins" in str(error)


def test_radars_with_almost_equal_range_bins_pass(tmp_path):
    rig = rig_from(tmp_path, own_schedule("profile.slope_mhz_per_us = 78.5"))
    assert rig.radars["vertical"].schedule.profile.slope_hz_per_s == 78.5e12
    assert rig.radars["horizontal"].schedule.profile.slope_hz_per_s == 79.03e12


def test_radars_with_different_periods_are_refused(tmp_path):
    assert "equal periods" in str(refused(tmp_path, own_schedule("frame_period_ms = 17.0")))


@pytest.mark.parametrize(
    ("loops", "rearm_s", "passes"), [(10, 60, True), (14, 60, False), (12, 0, False), (16, 0, False)]
)
def test_bursts_that_would_overlap_are_refused(tmp_path, loops, rearm_s, passes):
    """45 us chirps at 60 frames/s: 10 loops leave room for 60 s of drift; 12 and more exceed the recorder first."""
    text = PAIR.replace("loops = 8", f"loops = {loops}") + f"[interleave]\nrearm_s = {rearm_s}\n"
    if passes:
        rig_from(tmp_path, text)
    else:
        refused(tmp_path, text)


def test_interleave_violation_is_named(tmp_path):
    text = PAIR.replace("loops = 8", "packed_12_bit = true\nloops = 14")
    assert "'interleave'" in str(refused(tmp_path, text))
    assert "burst1 + burst2 + 2 guard <= T" in str(refused(tmp_path, text))
    rig_from(tmp_path, text + "[interleave]\nrearm_s = 0\n")


def test_one_radar_is_a_rig(tmp_path):
    rig = rig_from(tmp_path, SCHEDULE.replace("loops = 8", "loops = 10") + "[radars.vertical]\n")
    assert list(rig.radars) == ["vertical"]
    assert not any(constraint.name == "interleave" for constraint in rig.constraints())


def calibration_for(schedule: Schedule, seed: int) -> Calibration:
    rng = np.random.default_rng(seed)
    gain = np.exp(1j * (rng.uniform(-3, 3, (12, 1)) + rng.uniform(-3, 3, 16)))
    return Calibration(gain, np.zeros((12, 16)), 5.0, made_with=Waveform.of(schedule))


def test_calibration_file_lies_in_the_rigs_folder(tmp_path, monkeypatch):
    schedule = rig_from(tmp_path, PAIR).radars["vertical"].schedule
    save_calibration(tmp_path / "v.npz", calibration_for(schedule, 1))
    monkeypatch.chdir("/")
    rig = rig_from(tmp_path, SCHEDULE + '[radars.horizontal]\n[radars.vertical]\ncalibration = "v.npz"')
    assert rig.radars["vertical"].calibration.reference_range_m == 5.0
    assert (rig.radars["horizontal"].calibration.gain == 1).all()


def test_foreign_calibration_is_refused_with_the_rig(tmp_path):
    schedule = rig_from(tmp_path, PAIR).radars["vertical"].schedule
    save_calibration(tmp_path / "v.npz", calibration_for(schedule, 1))
    other = SCHEDULE.replace("slope_mhz_per_us = 79.03", "slope_mhz_per_us = 60.0")
    with pytest.raises(CalibrationError, match="foreign"):
        rig_from(tmp_path, other + '[radars.vertical]\ncalibration = "v.npz"')


def test_absent_calibration_is_refused(tmp_path):
    with pytest.raises(CalibrationError, match="no such calibration file"):
        rig_from(tmp_path, SCHEDULE + '[radars.vertical]\ncalibration = "v.npz"')


def test_hashes_tell_configurations_and_calibrations_apart(tmp_path):
    rig = rig_from(tmp_path, PAIR)
    assert len(rig.config_hash) == len(rig.calibration_hash) == 8
    assert rig_from(tmp_path, PAIR + "# comment\n").config_hash == rig.config_hash
    assert rig_from(tmp_path, PAIR.replace("idle_us = 5.0", "idle_s = 5e-6")).config_hash == rig.config_hash
    changed = rig_from(tmp_path, PAIR + "[cfar]\np_fa = 1e-5\n")
    assert changed.config_hash != rig.config_hash
    assert changed.calibration_hash == rig.calibration_hash
    save_calibration(tmp_path / "v.npz", calibration_for(rig.radars["vertical"].schedule, 1))
    calibrated = rig.with_calibration("vertical", tmp_path / "v.npz")
    assert calibrated.config_hash == rig.config_hash
    assert calibrated.calibration_hash != rig.calibration_hash
    assert calibrated.with_calibration("horizontal", tmp_path / "v.npz").calibration_hash != calibrated.calibration_hash


def test_every_setting_is_in_the_hash(tmp_path):
    rig = rig_from(tmp_path, PAIR)
    for changes in (
        {"geometry": RigGeometry(height_m=0.9)},
        {"interleave": InterleaveSettings(rearm_s=1.0)},
        {"radars": {"vertical": rig.radars["vertical"]}},
    ):
        assert dataclasses.replace(rig, **changes).config_hash != rig.config_hash


def test_calibration_of_an_absent_radar_is_refused(tmp_path):
    rig = rig_from(tmp_path, SCHEDULE + "[radars.vertical]\n")
    with pytest.raises(ConfigError, match="no such radar"):
        rig.with_calibration("horizontal", tmp_path / "c.npz")


def test_unknown_rig_lists_the_known_ones(tmp_path):
    with pytest.raises(ConfigError, match="cascade_pair") as caught:
        load_rig(tmp_path / "none")
    assert all(name in caught.value.allowed for name in known_rigs())


def test_rig_is_found_by_name_folder_and_file(tmp_path):
    (tmp_path / "rig.toml").write_text(PAIR, encoding="utf-8")
    assert find_rig(tmp_path) == find_rig(tmp_path / "rig.toml") == tmp_path
    assert find_rig("cascade_pair").name == "cascade_pair"


def test_units_are_exact():
    """5 us are the number 5e-6 itself, not a neighbour."""
    place = Place(Path("x.toml"))
    table = {"device": "AWR2243", "start_frequency_mhz": 77_000, "slope_hz_per_s": 79.03e12, "idle_us": 5}
    table |= {"adc_start_ns": 6000, "ramp_end_ms": 0.04, "samples": 256, "sample_rate_ksps": 8000}
    assert fill(ChirpProfile, table, place) == ChirpProfile("AWR2243", 77e9, 79.03e12, 5e-6, 6e-6, 40e-6, 256, 8e6)


def test_spellings_and_merge():
    assert spellings("idle_s") == ["idle_s", "idle_ms", "idle_us", "idle_ns"]
    assert spellings("loops") == ["loops"]
    assert all(other not in UNITS for others in UNITS.values() for other in others)
    base = {"a": {"b": 1, "c": 2}, "d": 3}
    assert merged(base, {"a": {"c": 5}, "e": 6}) == {"a": {"b": 1, "c": 5}, "d": 3, "e": 6}
    assert base == {"a": {"b": 1, "c": 2}, "d": 3}
