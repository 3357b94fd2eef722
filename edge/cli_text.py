# SPDX-License-Identifier: Apache-2.0
"""Command lines that make TI's single-chip demo firmware stream a schedule's raw samples over LVDS.

Sources: TI mmWave SDK 3.5 user's guide (CLI of the out-of-box demo of xWR18xx and xWR68xx), MCU+ SDK (AWR2944, whose
frameCfg carries the number of samples). The demo insists on all of its processing commands before the first start; they
are set so that its own detector finds nothing and its data port stays silent.
"""

from __future__ import annotations

from edge.config import require
from edge.waveform import Schedule

LARGEST_DEMO_THRESHOLD_DB = 100
SATURATION_SLICE_S = 0.16e-6
MOST_SLICES = 127


def cli_lines(schedule: Schedule) -> list[str]:
    """Lines in the order in which they are sent, from sensorStop to sensorStart.

    Args:
        schedule: of a single-chip board; requested values are sent, the chip rounds them as ``ChirpProfile`` does.
    Raises:
        ConfigError: a cascade, which has no command line.
    """
    chip = schedule.profile.chip
    require(not schedule.is_cascade, "profile.device", chip.name, "a single-chip board", "the cascade is set up by SPI")
    return [
        "sensorStop",
        "flushCfg",
        *_front_end(schedule),
        *_chirps(schedule),
        *_demo_processing(schedule),
        "lvdsStreamCfg -1 0 1 0",
        "calibData 0 0 0",
        "sensorStart",
    ]


def cli_text(schedule: Schedule) -> str:
    """``cli_lines`` as the text of a ``.cfg`` file, one line each."""
    return "\n".join(cli_lines(schedule)) + "\n"


def _front_end(schedule: Schedule) -> list[str]:
    """All receivers, all transmitters of the board, 16 bit, samples swapped to Q first, channels one after another."""
    chip = schedule.profile.chip
    receivers, transmitters = (1 << chip.rx) - 1, sum(_mask(tx) for tx in chip.firing_order)
    kind = 1 if chip.complex_samples else 0
    return [
        "dfeDataOutputMode 1",
        f"channelCfg {receivers} {transmitters} 0",
        f"adcCfg 2 {kind}",
        f"adcbufCfg -1 {1 - kind} 1 1 1",
        "lowPower 0 0",
    ]


def _mask(transmitter: int) -> int:
    return 1 << (transmitter - 1)


def _chirps(schedule: Schedule) -> list[str]:
    """Profile 0, one chirp for each transmitter in firing order, endless frames."""
    profile = schedule.profile
    times_us = [1e6 * t for t in (profile.idle_s, profile.adc_start_s, profile.ramp_end_s)]
    idle, adc_start, ramp_end = (f"{t:.6g}" for t in times_us)
    samples = "" if profile.chip.complex_samples else f" {profile.samples}"
    trigger = 2 if schedule.hardware_trigger else 1
    return [
        f"profileCfg 0 {profile.start_frequency_hz / 1e9:.9g} {idle} {adc_start} {ramp_end} 0 0 "
        f"{profile.slope_hz_per_s / 1e12:.6g} {1e6 * profile.tx_start_s:.6g} {profile.samples} "
        f"{profile.sample_rate_hz / 1e3:.6g} {profile.hpf1} {profile.hpf2} {profile.rx_gain_db}",
        *(f"chirpCfg {slot} {slot} 0 0 0 0 0 {_mask(tx)}" for slot, tx in enumerate(schedule.transmitters)),
        f"frameCfg 0 {schedule.slots - 1} {schedule.loops} 0{samples} {1e3 * schedule.frame_period_s:.7g} {trigger} 0",
    ]


def _demo_processing(schedule: Schedule) -> list[str]:
    """What the demo wants to know before it starts; none of it touches the raw samples."""
    profile, chip = schedule.profile, schedule.profile.chip
    slice_units = max(1, -(-round(profile.adc_window_s / SATURATION_SLICE_S) // 64))
    slices = min(MOST_SLICES, 2 * int(profile.adc_window_s / (slice_units * SATURATION_SLICE_S) + 1e-9) - 1)
    per_slice = 4
    while 2 * (profile.samples // per_slice) - 1 > MOST_SLICES:
        per_slice += 2
    phases = " ".join(["1 0"] * (len(chip.firing_order) * chip.rx))
    return [
        "guiMonitor -1 0 0 0 0 0 0",
        f"cfarCfg -1 0 2 8 4 3 0 {LARGEST_DEMO_THRESHOLD_DB} 0",
        f"cfarCfg -1 1 0 4 2 3 1 {LARGEST_DEMO_THRESHOLD_DB} 0",
        "multiObjBeamForming -1 0 0.5",
        "clutterRemoval -1 0",
        "calibDcRangeSig -1 0 -5 8 256",
        "extendedMaxVelocity -1 0",
        f"compRangeBiasAndRxChanPhase 0.0 {phases}",
        "measureRangeBiasAndRxChanPhase 0 1.5 0.2",
        f"CQRxSatMonitor 0 3 {slice_units} {slices} 0",
        f"CQSigImgMonitor 0 {2 * (profile.samples // per_slice) - 1} {per_slice}",
        "analogMonitor 0 0",
        "aoaFovCfg -1 -90 90 -90 90",
        f"cfarFovCfg -1 0 0 {profile.max_range_m:.2f}",
        f"cfarFovCfg -1 1 {-schedule.max_speed_m_s:.2f} {schedule.max_speed_m_s:.2f}",
    ]
