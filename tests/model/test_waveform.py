# SPDX-License-Identifier: Apache-2.0
"""Chirps and schedules against register words, a real capture's settings and the tables of the hardware notes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from edge.devices import DEVICES
from edge.errors import ConfigError
from edge.waveform import ChirpProfile, Schedule

US = 1e-6
PERIOD_S = 1 / 60


def profile(device, start_ghz, slope, idle, adc, ramp, samples, msps):
    return ChirpProfile(device, start_ghz * 1e9, slope * 1e12, idle * US, adc * US, ramp * US, samples, msps * 1e6)


A = profile("AWR2243", 77, 79.03, 5, 6, 40, 256, 8)
B = profile("AWR2243", 76.4, 79.034, 5, 6, 56, 384, 8)
B2 = profile("AWR2243", 76.3, 99.987, 5, 6, 46, 384, 10)
C = profile("AWR2243", 77, 60.012, 5, 5, 33, 256, 10.24)
D = profile("AWR1843", 77, 70.0, 7, 6, 50, 256, 6.25)
D2 = profile("AWR1843", 76.2, 80.0, 7, 6, 56, 256, 5.5)

BURSTS = [
    # profile, loops, burst ms, guard ms, range bin cm, max range m, max speed, speed bin, MB/s, end GHz
    (A, 8, 4.320, 4.01, 5.93, 15.2, 1.76, 0.44, 94.4, 80.16),
    (A, 4, 2.160, 6.17, 5.93, 15.2, 1.76, 0.88, 47.2, 80.16),
    (A, 10, 5.400, 2.93, 5.93, 15.2, 1.76, 0.35, 118, 80.16),
    (A, 12, 6.480, 1.85, 5.93, 15.2, 1.76, 0.29, 141.6, 80.16),
    (A, 14, 7.560, 0.77, 5.93, 15.2, 1.76, 0.25, 165, 80.16),
    (B, 6, 4.392, 3.94, 3.95, 15.2, 1.30, 0.43, 106, 80.83),
    (B2, 6, 3.672, 4.66, 3.90, 15.0, 1.55, 0.52, 106, 80.90),
    (C, 8, 3.648, 4.69, 9.99, 25.6, 2.11, 0.53, 94.4, 78.98),
    (D, 16, 2.736, 5.60, 5.23, 13.4, 5.56, 0.70, 11.8, 80.50),
    (D2, 16, 3.024, 5.31, 4.03, 10.3, 5.05, 0.63, 11.8, 80.68),
]


@pytest.mark.parametrize("row", BURSTS, ids=lambda row: f"{row[0].device} {row[2]} ms")
def test_table_of_schedules(row):
    chirp, loops, burst, guard, bin_cm, range_m, speed, speed_bin, rate, end = row
    schedule = Schedule(chirp, loops, PERIOD_S)
    assert schedule.burst_s * 1e3 == pytest.approx(burst, abs=5e-4)
    assert (PERIOD_S / 2 - schedule.burst_s) * 1e3 == pytest.approx(guard, abs=6e-3)
    assert chirp.range_bin_m * 100 == pytest.approx(bin_cm, abs=6e-3)
    assert chirp.max_range_m == pytest.approx(range_m, abs=0.06)
    assert chirp.usable_range_m == pytest.approx(0.9 * chirp.max_range_m)
    assert schedule.max_speed_m_s == pytest.approx(speed, abs=6e-3)
    assert schedule.speed_bin_m_s == pytest.approx(speed_bin, abs=6e-3)
    assert schedule.data_rate_bytes_s / 1e6 == pytest.approx(rate, abs=0.6 if rate >= 100 else 0.06)
    assert chirp.end_frequency_hz / 1e9 == pytest.approx(end, abs=6e-3)


def test_profile_words_are_the_boards():
    azinke = replace(A, slope_hz_per_s=15.0148e12, rx_gain_db=48)
    assert azinke.registers.to_bytes().hex() == (
        "00000200e4388e55f401000058020000a00f00000000000000000000370100000001401f0000000030000000"
    )
    assert A.registers.slope == 1637
    assert A.registers.to_bytes().hex() == (
        "00000200e4388e55f401000058020000a00f00000000000000000000650600000001401f0000000030000000"
    )


@pytest.mark.parametrize(
    ("loops", "period_s", "hardware", "slave", "words"),
    [
        (16, 0.1, False, False, "000000000b00100000000002002d31010100000000000000"),
        (8, PERIOD_S, False, False, "000000000b00080000000002d5dc32000100000000000000"),
        (8, PERIOD_S, False, True, "000000000b00080000000002d5dc32000200000000000000"),
        (8, PERIOD_S, True, False, "000000000b00080000000002954032000200000000000000"),
    ],
)
def test_frame_words_are_the_boards(loops, period_s, hardware, slave, words):
    schedule = Schedule(A, loops, period_s, hardware_trigger=hardware)
    assert schedule.frame_registers(slave=slave).to_bytes().hex() == words
    assert schedule.frame_period_s_actual == pytest.approx(period_s, abs=2.6e-9)


@pytest.mark.parametrize(
    ("device", "frequency_hz", "slope_khz_us"),
    [
        ("AWR2243", 53.644, 48.279),
        ("AWR1843", 53.644, 48.279),
        ("IWR6843", 40.233, 36.209),
        ("AWR2944", 53.644, 48.279),
    ],
)
def test_register_steps(device, frequency_hz, slope_khz_us):
    chip = DEVICES[device]
    assert chip.frequency_lsb_hz == pytest.approx(frequency_hz, abs=1e-3)
    assert chip.slope_lsb_hz_per_s / 1e9 == pytest.approx(slope_khz_us, abs=1e-3)
    slopes = [replace(A, device=device, slope_hz_per_s=s * 1e12).slope_hz_per_s_actual for s in np.linspace(50, 51, 64)]
    steps = np.diff(np.unique(slopes)) / chip.slope_lsb_hz_per_s
    assert steps == pytest.approx(np.ones(len(steps)))


def test_real_iwr6843_capture_holds_the_same_register_values(radar_data):
    stored = json.loads((radar_data / "iwr6843_frame" / "iwr6843.mmwave.json").read_text())
    device = stored["mmWaveDevices"][0]["rfConfig"]
    asked = device["rlProfiles"][0]["rlProfileCfg_t"]
    made = ChirpProfile(
        "IWR6843",
        60e9,
        29.837e12,
        asked["idleTimeConst_usec"] * US,
        asked["adcStartTimeConst_usec"] * US,
        asked["rampEndTime_usec"] * US,
        asked["numAdcSamples"],
        asked["digOutSampleRate"] * 1e3,
    )
    assert made.start_frequency_hz_actual / 1e9 == pytest.approx(asked["startFreqConst_GHz"], abs=1e-13)
    assert made.slope_hz_per_s_actual / 1e12 == pytest.approx(asked["freqSlopeConst_MHz_usec"], abs=2e-4)


def test_center_is_the_middle_of_the_adc_window():
    middle_s = 6e-6 + 128 / 8e6
    assert A.center_frequency_hz == pytest.approx(77e9 + 1637 * A.chip.slope_lsb_hz_per_s * middle_s, abs=30)
    assert A.wavelength_m * 1e3 == pytest.approx(3.807, abs=5e-4)
    first, last = (
        A.start_frequency_hz_actual + A.slope_hz_per_s_actual * t for t in (A.adc_start_s_actual, A.adc_end_s)
    )
    assert A.center_frequency_hz == pytest.approx(0.5 * (first + last))
    assert A.bandwidth_hz == pytest.approx(last - first)


def test_everything_derived_comes_from_registers():
    off = replace(A, slope_hz_per_s=A.slope_hz_per_s + 20e9, idle_s=A.idle_s + 4e-9, ramp_end_s=A.ramp_end_s - 4e-9)
    for name in ("slope_hz_per_s_actual", "chirp_time_s", "range_bin_m", "center_frequency_hz", "max_range_m"):
        assert getattr(off, name) == getattr(A, name)


def test_frame_of_the_default_schedule():
    schedule = Schedule(A, 8, PERIOD_S)
    assert schedule.frame_bytes == schedule.layout.nbytes == 1_572_864
    assert schedule.layout.shape == (4, 8, 12, 256, 4, 2)
    assert schedule.layout.iq_order == "IQ"
    assert schedule.transmitters == (12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1)
    assert schedule.transmit_time_s == pytest.approx(np.arange(12) * 45e-6)
    assert schedule.rf_duty == pytest.approx(0.23, abs=2e-3)
    packed = replace(Schedule(A, 12, PERIOD_S), packed_12_bit=True)
    assert packed.data_rate_bytes_s / 1e6 == pytest.approx(106, abs=0.5)
    assert packed.frame_bytes == Schedule(A, 12, PERIOD_S).frame_bytes


def test_frame_of_a_single_chip():
    schedule = Schedule(D, 16, PERIOD_S)
    assert schedule.frame_bytes == schedule.layout.nbytes == 196_608
    assert (schedule.layout.kind, schedule.layout.iq_order, schedule.slots) == ("dca1000", "QI", 3)
    assert schedule.transmitters == (1, 3, 2)
    studio = replace(schedule, transmitters=(1, 2, 3), iq_order="IQ")
    assert studio.layout.iq_order == "IQ"
    azimuth = replace(schedule, transmitters=(1, 3))
    assert azimuth.max_speed_m_s == pytest.approx(1.5 * schedule.max_speed_m_s)


def test_real_samples_have_half_the_range_and_half_the_bytes():
    real = replace(D, device="AWR2944")
    schedule = Schedule(real, 16, PERIOD_S)
    assert real.max_range_m == pytest.approx(0.5 * D.max_range_m)
    assert real.range_bin_m == D.range_bin_m
    assert schedule.frame_bytes == 4 * 16 * 4 * 256 * 2
    assert schedule.layout.kind == "dca1000_real"
    assert schedule.layout.nbytes == schedule.frame_bytes
    assert schedule.layout.shape == (16, 4, 4, 256)
    highest_hz = 0.45 * D.sample_rate_hz
    assert real.usable_range_m == pytest.approx(highest_hz * 299_792_458.0 / (2 * real.slope_hz_per_s_actual))
    with pytest.raises(ConfigError, match="even"):
        _ = Schedule(replace(real, samples=255), 16, PERIOD_S).layout


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("device", "AWR9999"),
        ("slope_hz_per_s", 0.0),
        ("slope_hz_per_s", -79e12),
        ("slope_hz_per_s", 2000e12),
        ("start_frequency_hz", float("nan")),
        ("idle_s", -1e-6),
        ("adc_start_s", 50e-6),
        ("samples", 1),
        ("sample_rate_hz", 8_000_400.0),
        ("rx_gain_db", 47),
    ],
)
def test_values_no_register_holds_are_refused(key, value):
    with pytest.raises(ConfigError, match=key):
        replace(A, **{key: value})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("loops", 0),
        ("frame_period_s", 0.0),
        ("frame_period_s", float("nan")),
        ("transmitters", (13,)),
        ("transmitters", (12, 12)),
        ("iq_order", "II"),
        ("packet_delay_s", 1e-6),
        ("lvds_lanes", 3),
    ],
)
def test_impossible_schedules_are_refused(key, value):
    with pytest.raises(ConfigError, match=key):
        replace(Schedule(A, 8, PERIOD_S), **{key: value})


def test_packing_is_the_cascades():
    with pytest.raises(ConfigError, match="packed_12_bit"):
        Schedule(D, 16, PERIOD_S, packed_12_bit=True)
