# SPDX-License-Identifier: Apache-2.0
"""The hardware's rules for one schedule and for two that take turns, each as an object with its numbers and its words.

Sources: TI Radar Interface Control Document 2.23 and data sheets (chips); TI SWRA662A (staggering in time); rates that
TI's own settings are known to record (cascade) and the DCA1000's table of packet delays (single chips).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from edge.config import require
from edge.errors import ConfigError
from edge.waveform import FRAME_TIME_LSB_S, ChirpProfile, Schedule

Severity = Literal["error", "warning"]

ROUNDING = 1e-9
"""Relative: rounding of a register or of float64 is no violation."""
ADC_SETTLE_S = 0.5e-6
SHORTEST_CHIRP_S = 13e-6
SHORTEST_IDLE_S = 3e-6
EARLIEST_TX_S = -5e-6
SHORTEST_GAP_S = 300e-6
FRAME_PERIOD_RANGE_S = (300e-6, 1.342)
MOST_LOOPS = 255
RECORDER_LIMIT_BYTES_S = 126e6
RECORDER_COMFORT_BYTES_S = 120e6
LARGEST_DUTY = 0.5
LVDS_LANE_BYTES_S = 600e6 / 8
DCA1000_PAYLOAD_BYTES = 1456
DCA1000_SHARE = 0.8
DCA1000_DELAY_S = (5e-6, 10e-6, 25e-6, 50e-6)
DCA1000_RATE_BIT_S = (706e6, 545e6, 325e6, 193e6)
GUARD_S = 0.5e-3
DRIFT_S_PER_S = 40e-6
REARM_S = 60.0
RANGE_BIN_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True)
class Constraint:
    """One rule, applied.

    Args:
        name: short, unique within a check.
        formula: the rule in the symbols of the data sheets, e.g. ``f0 + S ramp <= 81 GHz``.
        limit, measured: both sides of the comparison, in ``unit``.
        unit: of both; "" for counts and ratios.
        passed: whether the rule holds.
        message: empty when it holds; otherwise what is wrong and what to change.
        severity: "error": the hardware will not work; "warning": it may, or it costs something.
    """

    name: str
    formula: str
    limit: float
    measured: float
    unit: str
    passed: bool
    message: str
    severity: Severity = "error"


def _rule(
    name: str,
    formula: str,
    measured: float,
    limit: float,
    unit: str,
    advice: str,
    *,
    least: bool = False,
    warn: bool = False,
) -> Constraint:
    """``measured <= limit``, or ``measured >= limit`` when ``least``."""
    excess = limit - measured if least else measured - limit
    passed = bool(excess <= ROUNDING * max(abs(limit), abs(measured)))
    here, there = (f"{value:.6g} {unit}".rstrip() for value in (measured, limit))
    message = "" if passed else f"{name} {here} is {'below' if least else 'above'} {there}: {advice}"
    return Constraint(name, formula, limit, measured, unit, passed, message, "warning" if warn else "error")


def check_profile(profile: ChirpProfile) -> list[Constraint]:
    """Rules of one chirp.

    Args:
        profile: checked with its register values.
    Returns:
        All rules, in the order of a chirp.
    """
    chip, micro = profile.chip, 1e6
    low_ghz, high_ghz = (edge / 1e9 for edge in chip.band_hz)
    least_msps, most_msps = (rate / 1e6 for rate in chip.sample_rate_range_hz)
    slope, rate = profile.slope_hz_per_s_actual / 1e12, profile.sample_rate_hz / 1e6
    start, end = profile.start_frequency_hz_actual / 1e9, profile.end_frequency_hz / 1e9
    steepest, widest = chip.max_slope_hz_per_s / 1e12, chip.max_bandwidth_hz / 1e9
    adc_end, ramp = (profile.adc_end_s + ADC_SETTLE_S) * micro, profile.ramp_end_s_actual * micro
    buffered = profile.samples * chip.rx * chip.sample_bytes
    tx_start = profile.registers.tx_start / 100
    chirp, idle = profile.chirp_time_s * micro, profile.idle_s_actual * micro
    bandwidth = profile.bandwidth_hz / 1e9
    return [
        _rule("start frequency", f"f0 >= {low_ghz:g} GHz", start, low_ghz, "GHz", "start higher", least=True),
        _rule("end frequency", f"f0 + S ramp <= {high_ghz:g} GHz", end, high_ghz, "GHz", "start lower or ramp shorter"),
        _rule("slope", f"|S| <= {steepest:g} MHz/us", abs(slope), steepest, "MHz/us", "ramp more slowly"),
        _rule("bandwidth", f"S Ns / fs <= {widest:g} GHz", bandwidth, widest, "GHz", "sample less of the ramp"),
        _rule("idle time", "idle >= 3 us", idle, SHORTEST_IDLE_S * micro, "us", "idle longer", least=True, warn=True),
        _rule("chirp time", "idle + ramp >= 13 us", chirp, SHORTEST_CHIRP_S * micro, "us", "idle longer", least=True),
        _rule(
            "transmitter start", "tx start >= -5 us", tx_start, EARLIEST_TX_S * micro, "us", "start later", least=True
        ),
        _rule("ADC window", "adc + Ns / fs + 0.5 us <= ramp", adc_end, ramp, "us", "take fewer samples or ramp longer"),
        _rule("lowest ADC rate", f"fs >= {least_msps:g} Msps", rate, least_msps, "Msps", "sample faster", least=True),
        _rule("highest ADC rate", f"fs <= {most_msps:g} Msps", rate, most_msps, "Msps", "sample more slowly"),
        _rule("ADC buffer", "Ns rx bytes <= buffer", buffered, chip.adc_buffer_bytes, "B", "take fewer samples"),
    ]


def check_schedule(schedule: Schedule, *, force_rate: bool = False) -> list[Constraint]:
    """Rules of one radar's schedule, those of its profile included.

    Args:
        schedule: checked with its register values.
        force_rate: only warn when the cascade's recorder is asked for more than TI's own settings are known to record.
    Returns:
        All rules, passed or not.
    """
    milli = 1e3
    burst, period = schedule.burst_s * milli, schedule.frame_period_s_actual * milli
    gap = schedule.frame_registers().period * FRAME_TIME_LSB_S * milli - burst
    shortest, longest = (limit * milli for limit in FRAME_PERIOD_RANGE_S)
    rules = [
        *check_profile(schedule.profile),
        _rule("loops", "L <= 255", schedule.loops, MOST_LOOPS, "", "repeat the chirps less often"),
        _rule("shortest period", "T >= 0.3 ms", period, shortest, "ms", "lengthen the period", least=True),
        _rule("longest period", "T <= 1342 ms", period, longest, "ms", "shorten the period"),
        _rule("frame gap", "T - slots L Tc >= 0.3 ms", gap, SHORTEST_GAP_S * milli, "ms", "fewer loops", least=True),
    ]
    return rules + (_recorder_rules(schedule, force_rate) if schedule.is_cascade else _single_chip_rules(schedule))


def _recorder_rules(schedule: Schedule, force: bool) -> list[Constraint]:
    """The cascade board records to its own disk: 126 MB/s is what TI's 100 ms, 64 loops ask of it."""
    rate = schedule.data_rate_bytes_s / 1e6
    most, comfort = RECORDER_LIMIT_BYTES_S / 1e6, RECORDER_COMFORT_BYTES_S / 1e6
    advice = "fewer loops, a longer period or 12-bit packing"
    return [
        _rule("recorder rate", "frame bytes / T <= 126 MB/s", rate, most, "MB/s", advice + ", or force it", warn=force),
        _rule("recorder headroom", "frame bytes / T <= 120 MB/s", rate, comfort, "MB/s", advice, warn=True),
    ]


def _single_chip_rules(schedule: Schedule) -> list[Constraint]:
    """Memory, demo firmware, LVDS and DCA1000."""
    profile, chip = schedule.profile, schedule.profile.chip
    duty = schedule.rf_duty
    per_chirp = -(-profile.samples * chip.rx * chip.sample_bytes // 256) * 256
    lvds = profile.chirp_time_s * schedule.lvds_lanes * LVDS_LANE_BYTES_S
    rate = schedule.data_rate_bytes_s * 8 / 1e6
    most = DCA1000_SHARE * dca1000_rate_bit_s(schedule.packet_delay_s) / 1e6
    waiting = schedule.frame_bytes % DCA1000_PAYLOAD_BYTES
    whole = "the frame's last bytes come with the next frame; make frame bytes a multiple of 1456 to avoid it"
    return [
        _rule("RF duty", "slots L ramp / T <= 0.5", duty, LARGEST_DUTY, "", "fewer loops or a longer period"),
        _rule("radar cube", "frame bytes <= L3", schedule.frame_bytes, chip.cube_bytes, "B", "fewer loops or samples"),
        _rule("least loops", "L >= 16", schedule.loops, 16, "", "the demo firmware wants more", least=True, warn=True),
        _rule(
            "loop groups", "L mod 4 = 0", schedule.loops % 4, 0, "", "the demo firmware wants groups of 4", warn=True
        ),
        _rule("LVDS", "chirp bytes <= Tc lanes 75 MB/s", per_chirp, lvds, "B", "idle longer or take fewer samples"),
        _rule(
            "DCA1000 rate", "rate <= 0.8 limit(delay)", rate, most, "Mbit/s", "shorten the packet delay or the frame"
        ),
        _rule("DCA1000 packets", "frame bytes mod 1456 = 0", waiting, 0, "B", whole, warn=True),
    ]


def dca1000_rate_bit_s(packet_delay_s: float) -> float:
    """Highest rate the DCA1000 sends at.

    Args:
        packet_delay_s: its pause between packets of 1456 bytes of samples.
    Returns:
        Payload bit/s. A packet takes the delay and an overhead; the overhead is interpolated in the vendor's table.
    """
    bits = 8 * DCA1000_PAYLOAD_BYTES
    overhead_s = [bits / rate - delay for delay, rate in zip(DCA1000_DELAY_S, DCA1000_RATE_BIT_S, strict=True)]
    return bits / (packet_delay_s + float(np.interp(packet_delay_s, DCA1000_DELAY_S, overhead_s)))


def guard_s(drift_s_per_s: float = DRIFT_S_PER_S, rearm_s: float = REARM_S) -> float:
    """Least silence between two radars' bursts: 0.5 ms and what the clocks drift apart until the next re-arm.

    Args:
        drift_s_per_s: of the two boards' clocks against each other; 40e-6 is two crystals of +-20 ppm.
        rearm_s: time between re-arms; 0: no allowance for drift.
    Raises:
        ConfigError: a negative argument.
    """
    require(drift_s_per_s >= 0.0 and rearm_s >= 0.0, "interleave drift, rearm", (drift_s_per_s, rearm_s), ">= 0")
    return GUARD_S + drift_s_per_s * rearm_s


def start_offset_s(a: Schedule, b: Schedule) -> float:
    """Start of ``b``'s burst after ``a``'s that leaves equal silence on both sides; half a period for equal bursts."""
    return a.burst_s + 0.5 * (a.frame_period_s_actual - a.burst_s - b.burst_s)


def check_interleave(
    a: Schedule, b: Schedule, drift_s_per_s: float = DRIFT_S_PER_S, rearm_s: float = REARM_S
) -> list[Constraint]:
    """Rules of two radars that take turns within one frame period.

    Args:
        a, b: both schedules; ``b`` starts ``start_offset_s`` after ``a``.
        drift_s_per_s: as in ``guard_s``.
        rearm_s: as in ``guard_s``.
    Returns:
        All rules. With equal slopes the ramps stay parallel, and an overlap disturbs only aligned chirps.
    """
    period = 1e3 * min(a.frame_period_s_actual, b.frame_period_s_actual)
    guard = 1e3 * guard_s(drift_s_per_s, rearm_s)
    needed = 1e3 * (a.burst_s + b.burst_s) + 2.0 * guard
    steps = round(abs(a.frame_period_s_actual - b.frame_period_s_actual) / FRAME_TIME_LSB_S)
    bins = a.profile.range_bin_m, b.profile.range_bin_m
    slopes = a.profile.slope_hz_per_s_actual, b.profile.slope_hz_per_s_actual
    formula = f"burst1 + burst2 + 2 guard <= T, guard = 0.5 ms + {drift_s_per_s * 1e6:g} us/s x {rearm_s:g} s"
    unequal = 100 * abs(bins[0] - bins[1]) / min(bins)
    same_chirp = "give both radars the same slope, samples and sample rate"
    crossing = "ramps that cross let one radar into the other's IF band; give both the same slope"
    apart = abs(slopes[0] - slopes[1]) / 1e12
    return [
        _rule("interleave", formula, needed, period, "ms", "fewer loops, a longer period or re-arming more often"),
        _rule("equal periods", "|T1 - T2| < 5 ns", 5.0 * steps, 0.0, "ns", "give both radars the same period"),
        _rule("equal range bins", "|dR1 - dR2| <= 1 %", unequal, 100 * RANGE_BIN_TOLERANCE, "%", same_chirp),
        _rule("equal slopes", "S1 = S2", apart, 0.0, "MHz/us", crossing, warn=True),
    ]


def failed(constraints: Iterable[Constraint], severity: Severity = "error") -> list[Constraint]:
    """Rules of one severity that do not hold."""
    return [constraint for constraint in constraints if not constraint.passed and constraint.severity == severity]


def require_passed(constraints: Iterable[Constraint], what: str = "the schedule") -> None:
    """Refuse what cannot work; warnings pass.

    Args:
        constraints: of one or more checks.
        what: what was checked, for the message.
    Raises:
        ConfigError: names every failed rule of severity "error".
    """
    wrong = failed(constraints)
    if wrong:
        raise ConfigError(
            f"{what} breaks {len(wrong)} of the hardware's rules",
            value=[constraint.name for constraint in wrong],
            allowed="; ".join(constraint.formula for constraint in wrong),
            action="; ".join(constraint.message for constraint in wrong),
        )


def format_table(constraints: Iterable[Constraint]) -> str:
    """Rules as lines of text: state, name, measured, limit, unit, formula."""
    rows = []
    for c in constraints:
        state = "ok" if c.passed else c.severity
        rows.append(f"{state:<8}{c.name:<19}{c.measured:>12.6g}{c.limit:>12.6g}  {c.unit:<7}{c.formula}")
    return "\n".join([f"{'':<8}{'rule':<19}{'measured':>12}{'limit':>12}  {'unit':<7}formula", *rows])
