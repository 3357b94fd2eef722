# SPDX-License-Identifier: Apache-2.0
"""The shipped rigs: their figures against the published table, their command lines, and their README."""

from __future__ import annotations

import json

import numpy as np
import pytest

from edge.cli_text import cli_lines, cli_text
from edge.constraints import failed
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import ConfigError
from edge.rig import known_rigs, load_rig
from edge.rig_table import rig_table

CASCADES = ["cascade_demo", "cascade_pair", "cascade_pair_fine", "corridor"]
SINGLE_CHIPS = ["awr1843_pair", "awr2944_pair", "iwr6843_pair"]


def test_rigs_are_these():
    assert known_rigs() == sorted(CASCADES + SINGLE_CHIPS)


# Profiles A, B2, D of the interleaving table (T = 16.667 ms), D with 182 samples at 4.5 Msps, computed independently of
# this code.
@pytest.mark.parametrize(
    ("name", "burst_ms", "range_bin_cm", "max_range_m", "max_speed_m_s", "speed_bin_m_s", "rate_mb_s", "end_ghz"),
    [
        ("cascade_pair", 4.320, 5.93, 15.2, 1.76, 0.44, 94.4, 80.16),
        ("cascade_pair_fine", 3.672, 3.90, 15.0, 1.55, 0.52, 106.0, 80.90),
        ("awr1843_pair", 2.736, 5.29, 9.64, 5.56, 0.70, 8.39, 80.50),
        ("corridor", 34.56, 5.93, 15.2, 1.76, 0.055, 125.8, 80.16),
    ],
)
def test_figures(name, burst_ms, range_bin_cm, max_range_m, max_speed_m_s, speed_bin_m_s, rate_mb_s, end_ghz):
    for radar in load_rig(name).radars.values():
        schedule, profile = radar.schedule, radar.schedule.profile
        assert 1e3 * schedule.burst_s == pytest.approx(burst_ms, abs=1e-3)
        assert 100 * profile.range_bin_m == pytest.approx(range_bin_cm, abs=0.006)
        assert profile.max_range_m == pytest.approx(max_range_m, abs=0.06)
        assert schedule.max_speed_m_s == pytest.approx(max_speed_m_s, abs=0.006)
        assert schedule.speed_bin_m_s == pytest.approx(speed_bin_m_s, abs=0.006)
        assert schedule.data_rate_bytes_s / 1e6 == pytest.approx(rate_mb_s, abs=0.2)
        assert profile.end_frequency_hz / 1e9 == pytest.approx(end_ghz, abs=0.006)


@pytest.mark.parametrize("name", CASCADES + SINGLE_CHIPS)
def test_rig_breaks_no_rule_and_says_what_it_is(name):
    rig = load_rig(name)
    assert not failed(rig.constraints())
    assert rig.description
    assert len(rig.radars) == (1 if name == "corridor" else 2)


@pytest.mark.parametrize("name", [n for n in CASCADES + SINGLE_CHIPS if n != "corridor"])
def test_origin_is_the_common_one(name):
    """Vertical board's y and horizontal board's z are 0: then each range correction is known to its own radar."""
    radars = load_rig(name).radars
    assert radars["vertical"].mounting.position_m[1] == 0
    assert radars["horizontal"].mounting.position_m[2] == 0
    apart = np.subtract(radars["vertical"].mounting.position_m, radars["horizontal"].mounting.position_m)
    assert np.linalg.norm(apart) == pytest.approx(0.2 if name in CASCADES else 0.1, abs=0.01)


@pytest.mark.parametrize("name", CASCADES + SINGLE_CHIPS)
def test_settings_fit_the_array(name):
    """Imager and detector accept them, and the CFAR guard covers the main lobe but for its foot."""
    rig = load_rig(name)
    for radar in rig.radars.values():
        Imager(radar, rig.settings.heatmap, rig.settings.antenna)
        Detector(radar, rig.settings.cfar)
        lobe_bins = 2 * rig.settings.heatmap.angle_bins / radar.array.count
        assert 0.8 * lobe_bins <= rig.settings.cfar.guard_angle <= 1.2 * lobe_bins


def test_corridor_is_the_captures_own_configuration(radar_data):
    folder = radar_data / "cascade_corridor_svenningsson"
    config = json.loads((folder / "config.json").read_text())
    schedule = load_rig("corridor").radars["horizontal"].schedule
    assert schedule.profile.slope_hz_per_s == config["chirpSlope"]
    assert schedule.profile.sample_rate_hz == config["Sampling_Rate_sps"]
    assert schedule.profile.samples == config["numSamplePerChirp"]
    assert schedule.loops == config["nchirp_loops"]
    assert list(schedule.transmitters) == config["TxToEnable"]
    line = next(x for x in (folder / "Cascade_Capture.txt").read_text().splitlines() if "ProfileConfig" in x)
    code, idle, adc_start, ramp_end, slope, samples, rate, gain = (
        int(line.split(",")[k]) for k in (2, 3, 4, 5, 8, 10, 11, 14)
    )
    registers = schedule.profile.registers
    assert (registers.start_frequency, registers.idle, registers.adc_start, registers.ramp_end) == (
        *(code, idle, adc_start, ramp_end),
    )
    assert (registers.slope, registers.samples, registers.sample_rate_khz) == (slope, samples, rate)
    assert schedule.profile.rx_gain_db == gain


@pytest.mark.parametrize("name", SINGLE_CHIPS)
def test_command_lines_are_those_of_the_schedule(name):
    rig = load_rig(name)
    for radar in rig.radars.values():
        assert (rig.directory / f"{radar.radar}.cfg").read_text(encoding="ascii") == cli_text(radar.schedule)


def test_command_lines_of_two_1843_are_the_published_ones():
    lines = cli_lines(load_rig("awr1843_pair").radars["horizontal"].schedule)
    expected = [
        "sensorStop",
        "flushCfg",
        "dfeDataOutputMode 1",
        "channelCfg 15 7 0",
        "adcCfg 2 1",
        "adcbufCfg -1 0 1 1 1",
        "lowPower 0 0",
        "profileCfg 0 77 7 6 50 0 0 70 1 182 4500 0 0 30",
        "chirpCfg 0 0 0 0 0 0 0 1",
        "chirpCfg 1 1 0 0 0 0 0 4",
        "chirpCfg 2 2 0 0 0 0 0 2",
        "frameCfg 0 2 16 0 16.667 1 0",
        "guiMonitor -1 0 0 0 0 0 0",
    ]
    assert lines[: len(expected)] == expected
    assert lines[-1] == "sensorStart"
    assert "lvdsStreamCfg -1 0 1 0" in lines
    bias = next(line for line in lines if line.startswith("compRangeBias"))
    assert len(bias.split()) == 2 + 2 * 12


def test_frames_of_two_1843_fill_whole_packets():
    """139,776 = 96 x 1456: nothing of a frame waits for the next one, at 5.3 cm or better."""
    for radar in load_rig("awr1843_pair").radars.values():
        assert radar.schedule.frame_bytes == 96 * 1456
        assert radar.schedule.profile.range_bin_m < 0.053


def test_command_lines_of_2944_carry_real_samples():
    """Real ADC format, four transmitters and the number of samples inside frameCfg."""
    lines = cli_lines(load_rig("awr2944_pair").radars["vertical"].schedule)
    for line in ("channelCfg 15 15 0", "adcCfg 2 0", "adcbufCfg -1 1 1 1 1", "frameCfg 0 3 16 0 512 16.667 1 0"):
        assert line in lines
    assert [line.split()[-1] for line in lines if line.startswith("chirpCfg")] == ["1", "4", "8", "2"]
    assert len(next(line for line in lines if line.startswith("compRangeBias")).split()) == 2 + 2 * 16


def test_cascade_has_no_command_line():
    with pytest.raises(ConfigError, match="single-chip"):
        cli_text(load_rig("cascade_pair").radars["horizontal"].schedule)


def test_readme_holds_the_table():
    readme = (load_rig("cascade_pair").directory.parent / "README.md").read_text(encoding="utf-8")
    assert rig_table() in readme
    assert "python -m edge.rig_table" in readme
