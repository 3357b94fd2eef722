# SPDX-License-Identifier: Apache-2.0
"""The hardware's rules: schedules known to work pass, each rule trips alone, two bursts that pass never overlap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.constraints import (
    check_interleave,
    check_profile,
    check_schedule,
    dca1000_rate_bit_s,
    failed,
    format_table,
    guard_s,
    require_passed,
    start_offset_s,
)
from edge.errors import ConfigError
from edge.waveform import ChirpProfile, Schedule

US = 1e-6
PERIOD_S = 1 / 60
A = ChirpProfile("AWR2243", 77e9, 79.03e12, 5 * US, 6 * US, 40 * US, 256, 8e6)
D = ChirpProfile("AWR1843", 77e9, 70e12, 7 * US, 6 * US, 50 * US, 256, 6.25e6)
GOOD = [
    (A, 8),
    (A, 10),
    (replace(A, start_frequency_hz=76.4e9, ramp_end_s=56 * US, samples=384), 6),
    (ChirpProfile("AWR2243", 76.3e9, 99.987e12, 5 * US, 6 * US, 46 * US, 384, 10e6), 6),
    (ChirpProfile("AWR2243", 77e9, 60.012e12, 5 * US, 5 * US, 33 * US, 256, 10.24e6), 8),
    (D, 16),
    (ChirpProfile("AWR1843", 76.2e9, 80e12, 7 * US, 6 * US, 56 * US, 256, 5.5e6), 16),
]


def cascade(loops, period_s=PERIOD_S, **changes):
    return Schedule(A, loops, period_s, **changes)


def names(constraints, severity="error"):
    return [constraint.name for constraint in failed(constraints, severity)]


def interleaves(a, b, **drift):
    return "interleave" not in names(check_interleave(a, b, **drift))


@pytest.mark.parametrize(("profile", "loops"), GOOD, ids=lambda value: getattr(value, "device", str(value)))
def test_recommended_schedules_pass(profile, loops):
    schedule = Schedule(profile, loops, PERIOD_S)
    require_passed(check_schedule(schedule) + check_interleave(schedule, schedule))


@pytest.mark.parametrize(
    ("loops", "with_drift", "without_drift"),
    [(8, True, True), (10, True, True), (11, False, True), (14, False, True), (15, False, False), (16, False, False)],
)
def test_how_many_loops_interleave_at_60_frames_per_second(loops, with_drift, without_drift):
    schedule = cascade(loops)
    assert interleaves(schedule, schedule) is with_drift
    assert interleaves(schedule, schedule, rearm_s=0.0) is without_drift


def test_guard_is_half_a_millisecond_and_the_drift():
    assert guard_s() == pytest.approx(0.5e-3 + 2.4e-3)
    assert guard_s(rearm_s=0.0) == 0.5e-3
    rule = check_interleave(cascade(10), cascade(10))[0]
    assert (rule.measured, rule.limit) == pytest.approx((2 * 5.4 + 2 * 2.9, 16.666665))
    with pytest.raises(ConfigError, match="rearm"):
        guard_s(rearm_s=-1.0)


@pytest.mark.parametrize(("loops_a", "loops_b"), [(8, 8), (10, 10), (8, 12), (3, 16)])
@pytest.mark.parametrize("drift", [40e-6, -40e-6])
def test_bursts_that_pass_never_overlap_until_the_next_re_arm(loops_a, loops_b, drift):
    """Two simulated time lines, 60 s at +-40 ppm: 0.5 ms of silence is left on both sides, always."""
    a, b = cascade(loops_a), cascade(loops_b)
    assert interleaves(a, b)
    frames = np.arange(round(60.0 / PERIOD_S) - 1)
    start_a = frames * a.frame_period_s_actual
    start_b = (start_offset_s(a, b) + frames * b.frame_period_s_actual) * (1.0 + drift)
    after_a = start_b - (start_a + a.burst_s)
    after_b = start_a[1:] - (start_b + b.burst_s)[:-1]
    assert min(after_a.min(), after_b.min()) >= 0.5e-3


def test_offset_of_equal_bursts_is_half_a_period():
    assert start_offset_s(cascade(8), cascade(8)) == pytest.approx(PERIOD_S / 2, abs=3e-9)


def test_radars_that_do_not_match():
    other = replace(A, slope_hz_per_s=A.slope_hz_per_s * 1.02)
    mixed = check_interleave(cascade(8), Schedule(other, 8, PERIOD_S))
    assert names(mixed) == ["equal range bins"]
    assert names(mixed, "warning") == ["equal slopes"]
    near = Schedule(replace(A, slope_hz_per_s=A.slope_hz_per_s * 1.005), 8, PERIOD_S)
    assert names(check_interleave(cascade(8), near)) == []
    assert names(check_interleave(cascade(8), cascade(8, PERIOD_S + 5e-9))) == ["equal periods"]


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"start_frequency_hz": 75.9e9}, "start frequency"),
        ({"start_frequency_hz": 77.9e9}, "end frequency"),
        ({"slope_hz_per_s": 267e12, "ramp_end_s": 14 * US, "samples": 56}, "slope"),
        ({"idle_s": 2 * US, "ramp_end_s": 10.9 * US, "samples": 32}, "chirp time"),
        ({"tx_start_s": -5.1 * US}, "transmitter start"),
        ({"samples": 270}, "ADC window"),
        ({"sample_rate_hz": 1.9e6, "samples": 60}, "lowest ADC rate"),
        ({"sample_rate_hz": 22.6e6}, "highest ADC rate"),
        ({"samples": 1025, "sample_rate_hz": 20e6, "slope_hz_per_s": 50e12, "ramp_end_s": 60 * US}, "ADC buffer"),
    ],
)
def test_each_chirp_rule_trips_alone(changes, rule):
    broken = check_profile(replace(A, **changes))
    assert names(broken) == [rule]
    assert rule in failed(broken)[0].message
    assert names(check_profile(A)) == []


def test_limits_themselves_pass():
    edge = replace(A, samples=1024, sample_rate_hz=20e6, slope_hz_per_s=50e12, ramp_end_s=60 * US)
    assert names(check_profile(edge)) == []
    assert names(check_profile(replace(A, start_frequency_hz=76e9))) == []
    fastest = replace(A, sample_rate_hz=22.5e6, idle_s=3 * US)
    assert names(check_profile(fastest)) + names(check_profile(fastest), "warning") == []


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"slope_hz_per_s": 101e12, "samples": 180, "ramp_end_s": 38 * US}, "slope"),
        ({"sample_rate_hz": 12.6e6}, "highest ADC rate"),
        ({"slope_hz_per_s": 99e12, "start_frequency_hz": 76e9, "samples": 256, "ramp_end_s": 50 * US}, "bandwidth"),
    ],
)
def test_single_chip_limits_are_tighter(changes, rule):
    assert names(check_profile(replace(D, **changes))) == [rule]


def test_iwr6843_works_in_its_own_band():
    sixty = replace(D, device="IWR6843", start_frequency_hz=60e9)
    assert names(check_profile(sixty)) == []
    assert names(check_profile(replace(D, device="IWR6843"))) == ["end frequency"]


@pytest.mark.parametrize(
    ("schedule", "rule"),
    [
        (cascade(8, 4.6e-3), "frame gap"),
        (Schedule(A, 256, 0.2, packed_12_bit=True), "loops"),
        (cascade(8, 1.4), "longest period"),
    ],
)
def test_each_schedule_rule_trips(schedule, rule):
    assert rule in names(check_schedule(schedule))


def test_recorder_rate():
    assert names(check_schedule(cascade(64, 0.1))) == []
    assert names(check_schedule(cascade(64, 0.1)), "warning") == ["recorder headroom"]
    assert names(check_schedule(cascade(12))) == ["recorder rate"]
    assert names(check_schedule(cascade(12), force_rate=True)) == []
    assert names(check_schedule(cascade(12), force_rate=True), "warning") == ["recorder rate", "recorder headroom"]
    assert names(check_schedule(cascade(12, packed_12_bit=True))) == []


@pytest.mark.parametrize(("delay_us", "mbit_s"), [(5, 706), (10, 545), (25, 325), (50, 193)])
def test_dca1000_rates(delay_us, mbit_s):
    assert dca1000_rate_bit_s(delay_us * US) / 1e6 == pytest.approx(mbit_s)


def test_dca1000_rate_falls_with_the_delay():
    rates = [dca1000_rate_bit_s(delay * US) for delay in range(5, 501)]
    assert np.all(np.diff(rates) < 0.0)
    assert rates[-1] < 1456 * 8 / 500e-6


def test_single_chip_schedule_rules():
    def broken(severity="error", **changes):
        return names(check_schedule(replace(Schedule(D, 16, PERIOD_S), **changes)), severity)

    assert broken() == []
    assert broken("warning") == ["DCA1000 packets"]
    assert broken("warning", profile=replace(D, samples=182)) == []
    assert broken(packet_delay_s=100 * US) == ["DCA1000 rate"]
    assert broken(loops=88, frame_period_s=0.1) == ["radar cube"]
    assert broken(frame_period_s=4.6e-3, packet_delay_s=5 * US) == ["RF duty"]
    assert broken("warning", loops=6, profile=replace(D, samples=182)) == ["least loops", "loop groups"]
    fast = replace(D, samples=512, sample_rate_hz=12.5e6, ramp_end_s=47.5 * US, idle_s=6 * US)
    assert broken(profile=fast, lvds_lanes=2) == ["LVDS"]


def test_refusal_names_every_broken_rule_and_no_warning():
    with pytest.raises(ConfigError) as refused:
        require_passed(check_schedule(cascade(16)) + check_interleave(cascade(16), cascade(16)), "rig test")
    text = str(refused.value)
    assert "rig test breaks 2" in text
    assert "recorder rate" in text
    assert "interleave" in text
    assert "headroom" not in text
    assert "17.28" not in text
    assert "23.08 ms" in text


def test_table_has_a_line_for_every_rule():
    rules = check_schedule(cascade(12))
    lines = format_table(rules).splitlines()
    assert len(lines) == len(rules) + 1
    assert sum(line.startswith("error") for line in lines) == 1
    assert sum(line.startswith("warning") for line in lines) == 1
    assert len({rule.name for rule in rules}) == len(rules)
