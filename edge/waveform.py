# SPDX-License-Identifier: Apache-2.0
"""Chirp profiles and schedules: every derived quantity from the values the chip's registers really hold.

A request is rounded to the registers' least significant bits; ``*_actual`` and everything derived from them describe
the chirp that is transmitted. Nothing is refused here except numbers that fit no register: the rules of the hardware
are in ``edge/constraints.py``. Source: TI Radar Interface Control Document 2.23, messages 0x0100 (profile) and 0x0102
(frame).
"""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from edge.config import require
from edge.devices import DEVICES, Device, DeviceName
from edge.frames import Float64, Layout

SPEED_OF_LIGHT_M_S = 299_792_458.0
TIME_LSB_S = 10e-9
FRAME_TIME_LSB_S = 5e-9
TRIGGER_MARGIN_S = 200e-6
"""External pulses must come after the programmed period is over: it is programmed shorter by this."""
USABLE_IF_SHARE = 0.9
"""The IF filter passes 0.9 of the sampling rate (complex1x, ICD), of half the rate with real samples."""


@dataclass(frozen=True, slots=True)
class ProfileRegisters:
    """Integers of the profile message, in its order; lsb of frequency and slope as the device has them, times 10 ns."""

    profile: int
    vco: int
    calibration_table: int
    start_frequency: int
    idle: int
    adc_start: int
    ramp_end: int
    tx_backoff: int
    tx_phase: int
    slope: int
    tx_start: int
    samples: int
    sample_rate_khz: int
    hpf1: int
    hpf2: int
    tx_calibration: int
    rx_gain: int
    reserved: int = 0

    def to_bytes(self) -> bytes:
        """Payload of sub-block 0x0100, 44 bytes, little endian (ICD)."""
        return struct.pack("<HBB6I2h2H2B3H", *astuple(self))


@dataclass(frozen=True, slots=True)
class FrameRegisters:
    """Integers of the frame message, in its order; times in 5 ns."""

    reserved: int
    first_chirp: int
    last_chirp: int
    loops: int
    frames: int
    half_words: int
    period: int
    trigger: int
    reserved_too: int
    delay: int

    def to_bytes(self) -> bytes:
        """Payload of sub-block 0x0102, 24 bytes, little endian (ICD)."""
        return struct.pack("<6HI2HI", *astuple(self))


@dataclass(frozen=True)
class ChirpProfile:
    """One chirp as it is asked for, and as the chip transmits it.

    TI's demo firmware truncates what it reads from its command line, where this rounds: 70 MHz/us would become 1449
    steps instead of 1450. Text for it must be written from ``registers``.

    Args:
        device: chip, a key of ``DEVICES``.
        start_frequency_hz: at the start of the ramp.
        slope_hz_per_s: of the ramp.
        idle_s: before the ramp.
        adc_start_s: first sample, from the start of the ramp.
        ramp_end_s: end of the ramp, from its start.
        samples: of one chirp.
        sample_rate_hz: whole kHz, as the register holds it.
        tx_start_s: transmitter on, from the start of the ramp; may be negative.
        rx_gain_db: even, 30 to 52; the RF part is the chip's default (30 dB).
        hpf1, hpf2: codes of the high-pass corners (0: 175 and 350 kHz).
    Raises:
        ConfigError: unknown device, or a value that its register cannot hold.
    """

    device: DeviceName
    start_frequency_hz: float
    slope_hz_per_s: float
    idle_s: float
    adc_start_s: float
    ramp_end_s: float
    samples: int
    sample_rate_hz: float
    tx_start_s: float = 0.0
    rx_gain_db: int = 48
    hpf1: int = 0
    hpf2: int = 0

    def __post_init__(self) -> None:
        require(self.device in DEVICES, "profile.device", self.device, ", ".join(DEVICES))
        limits = {
            "start_frequency_hz": (1.0, self.chip.frequency_lsb_hz * (2**32 - 1)),
            "slope_hz_per_s": (self.chip.slope_lsb_hz_per_s, self.chip.slope_lsb_hz_per_s * (2**15 - 1)),
            "idle_s": (0.0, 5.24e-3),
            "adc_start_s": (0.0, 40.95e-6),
            "ramp_end_s": (TIME_LSB_S, 5e-3),
            "samples": (2, 2**16 - 1),
            "sample_rate_hz": (1e3, 1e3 * (2**16 - 1)),
            "tx_start_s": (-40.95e-6, 40.95e-6),
            "rx_gain_db": (30, 52),
            "hpf1": (0, 3),
            "hpf2": (0, 3),
        }
        for key, (low, high) in limits.items():
            value = getattr(self, key)
            inside = low - 1e-9 * abs(low) <= value <= high + 1e-9 * abs(high)
            require(inside, f"profile.{key}", value, f"{low:g} to {high:g}")
        whole = abs(self.sample_rate_hz / 1e3 - round(self.sample_rate_hz / 1e3)) < 1e-6
        require(whole, "profile.sample_rate_hz", self.sample_rate_hz, "a whole number of kHz, as the register holds it")
        require(self.rx_gain_db % 2 == 0, "profile.rx_gain_db", self.rx_gain_db, "an even number")

    @property
    def chip(self) -> Device:
        """What the board can do."""
        return DEVICES[self.device]

    @cached_property
    def registers(self) -> ProfileRegisters:
        """The register values nearest to the request."""
        return ProfileRegisters(
            profile=0,
            vco=self.chip.vco,
            calibration_table=0,
            start_frequency=round(self.start_frequency_hz / self.chip.frequency_lsb_hz),
            idle=round(self.idle_s / TIME_LSB_S),
            adc_start=round(self.adc_start_s / TIME_LSB_S),
            ramp_end=round(self.ramp_end_s / TIME_LSB_S),
            tx_backoff=0,
            tx_phase=0,
            slope=round(self.slope_hz_per_s / self.chip.slope_lsb_hz_per_s),
            tx_start=round(self.tx_start_s / TIME_LSB_S),
            samples=self.samples,
            sample_rate_khz=round(self.sample_rate_hz / 1e3),
            hpf1=self.hpf1,
            hpf2=self.hpf2,
            tx_calibration=0,
            rx_gain=self.rx_gain_db,
        )

    @property
    def start_frequency_hz_actual(self) -> float:
        """Start of the ramp."""
        return self.registers.start_frequency * self.chip.frequency_lsb_hz

    @property
    def slope_hz_per_s_actual(self) -> float:
        """Slope of the ramp."""
        return self.registers.slope * self.chip.slope_lsb_hz_per_s

    @property
    def idle_s_actual(self) -> float:
        """Idle time."""
        return self.registers.idle * TIME_LSB_S

    @property
    def adc_start_s_actual(self) -> float:
        """First sample, from the start of the ramp."""
        return self.registers.adc_start * TIME_LSB_S

    @property
    def ramp_end_s_actual(self) -> float:
        """End of the ramp, from its start."""
        return self.registers.ramp_end * TIME_LSB_S

    @property
    def adc_window_s(self) -> float:
        """Duration of the samples: samples / sample_rate."""
        return self.samples / self.sample_rate_hz

    @property
    def adc_end_s(self) -> float:
        """End of the samples, from the start of the ramp."""
        return self.adc_start_s_actual + self.adc_window_s

    @property
    def chirp_time_s(self) -> float:
        """Chirp to chirp: idle + ramp."""
        return (self.registers.idle + self.registers.ramp_end) * TIME_LSB_S

    @property
    def center_frequency_hz(self) -> float:
        """Frequency in the middle of the ADC window, where t_n = 0."""
        middle_s = self.adc_start_s_actual + 0.5 * self.adc_window_s
        return self.start_frequency_hz_actual + self.slope_hz_per_s_actual * middle_s

    @property
    def end_frequency_hz(self) -> float:
        """Frequency at the end of the ramp."""
        return self.start_frequency_hz_actual + self.slope_hz_per_s_actual * self.ramp_end_s_actual

    @property
    def wavelength_m(self) -> float:
        """At the middle of the ADC window."""
        return SPEED_OF_LIGHT_M_S / self.center_frequency_hz

    @property
    def bandwidth_hz(self) -> float:
        """Sampled bandwidth: slope times ADC window."""
        return self.slope_hz_per_s_actual * self.adc_window_s

    @property
    def range_bin_m(self) -> float:
        """Range resolution c / 2B = bin of an FFT over ``samples``."""
        return SPEED_OF_LIGHT_M_S / (2.0 * self.bandwidth_hz)

    @property
    def highest_beat_hz(self) -> float:
        """Beat frequencies from 0 to here are told apart: the sampling rate, of real samples half of it."""
        return self.sample_rate_hz if self.chip.complex_samples else 0.5 * self.sample_rate_hz

    @property
    def max_range_m(self) -> float:
        """Range at the highest beat frequency."""
        return SPEED_OF_LIGHT_M_S * self.highest_beat_hz / (2.0 * self.slope_hz_per_s_actual)

    @property
    def usable_range_m(self) -> float:
        """Range that the IF filter passes: 0.9 of ``max_range_m``."""
        return USABLE_IF_SHARE * self.max_range_m


@dataclass(frozen=True)
class Schedule:
    """One radar's burst: every transmitter in turn, ``loops`` times, once a frame period.

    Args:
        profile: the chirp.
        loops: repetitions of the chirp table.
        frame_period_s: burst to burst.
        transmitters: transmitter of slot 0, 1, ..., numbered from 1; empty: the device's order (cascade: TX 12 - s).
        hardware_trigger: frames start with an external pulse; False: by command.
        packed_12_bit: the cascade's recorder keeps 12 of 16 bits (data rate 3/4).
        iq_order: of the capture; None: I first from the cascade, Q first from single chips (sampleSwap 1).
        packet_delay_s: DCA1000's pause between packets.
        lvds_lanes: lanes to the DCA1000.
    Raises:
        ConfigError: a value that its register cannot hold, or transmitters the device lacks.
    """

    profile: ChirpProfile
    loops: int
    frame_period_s: float
    transmitters: tuple[int, ...] = ()
    hardware_trigger: bool = False
    packed_12_bit: bool = False
    iq_order: Literal["IQ", "QI"] | None = None
    packet_delay_s: float = 25e-6
    lvds_lanes: int = 2

    def __post_init__(self) -> None:
        chip = self.profile.chip
        if not self.transmitters:
            object.__setattr__(self, "transmitters", chip.firing_order)
        known = len(set(self.transmitters)) == len(self.transmitters) and set(self.transmitters) <= set(
            chip.firing_order
        )
        allowed = f"each at most once of {sorted(chip.firing_order)}"
        require(known, "schedule.transmitters", self.transmitters, allowed)
        require(1 <= self.loops <= 2**16 - 1, "schedule.loops", self.loops, "1 to 65535")
        longest_s = FRAME_TIME_LSB_S * (2**32 - 1)
        period_s = self.frame_period_s
        require(
            TRIGGER_MARGIN_S < period_s <= longest_s, "schedule.frame_period_s", period_s, f"200e-6 to {longest_s:g}"
        )
        require(self.iq_order in (None, "IQ", "QI"), "schedule.iq_order", self.iq_order, "IQ or QI")
        require(
            5e-6 <= round(self.packet_delay_s, 9) <= 500e-6,
            "schedule.packet_delay_s",
            self.packet_delay_s,
            "5 to 500 us",
        )
        require(self.lvds_lanes in (2, 4), "schedule.lvds_lanes", self.lvds_lanes, "2 or 4")
        cascade_only = self.is_cascade or not self.packed_12_bit
        require(cascade_only, "schedule.packed_12_bit", self.packed_12_bit, "true for the cascade's recorder only")

    @property
    def is_cascade(self) -> bool:
        """Recorded by the cascade's own recorder; otherwise streamed by a DCA1000."""
        return self.profile.chip.chips > 1

    @property
    def slots(self) -> int:
        """Chirps of one loop."""
        return len(self.transmitters)

    def frame_registers(self, *, slave: bool = False, frames: int = 0) -> FrameRegisters:
        """Values of the frame message.

        Args:
            slave: of a slave chip, which waits for the master's pulse.
            frames: frames to send, 0: until stopped.
        Returns:
            With a hardware trigger the programmed period is 0.2 ms shorter than the frame period, which the pulses set.
        """
        margin_s = TRIGGER_MARGIN_S if self.hardware_trigger else 0.0
        return FrameRegisters(
            reserved=0,
            first_chirp=0,
            last_chirp=self.slots - 1,
            loops=self.loops,
            frames=frames,
            half_words=2 * self.profile.samples,
            period=round((self.frame_period_s - margin_s) / FRAME_TIME_LSB_S),
            trigger=2 if slave or self.hardware_trigger else 1,
            reserved_too=0,
            delay=0,
        )

    @property
    def frame_period_s_actual(self) -> float:
        """Burst to burst in whole steps of 5 ns."""
        return round(self.frame_period_s / FRAME_TIME_LSB_S) * FRAME_TIME_LSB_S

    @property
    def burst_s(self) -> float:
        """First chirp's idle time to last chirp's end."""
        return self.slots * self.loops * self.profile.chirp_time_s

    @property
    def rf_duty(self) -> float:
        """Share of the frame period with a ramp on the air."""
        return self.slots * self.loops * self.profile.ramp_end_s_actual / self.frame_period_s_actual

    @property
    def max_speed_m_s(self) -> float:
        """Largest unambiguous radial speed, lambda / (4 slots Tc)."""
        return self.profile.wavelength_m / (4.0 * self.slots * self.profile.chirp_time_s)

    @property
    def speed_bin_m_s(self) -> float:
        """Radial speed of one Doppler bin, lambda / (2 burst)."""
        return self.profile.wavelength_m / (2.0 * self.burst_s)

    @property
    def transmit_time_s(self) -> Float64:
        """float64 [slots], start of each slot after the first chirp, in the first loop."""
        return np.arange(self.slots, dtype=np.float64) * self.profile.chirp_time_s

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame in memory (all chips)."""
        chip = self.profile.chip
        return self.loops * self.slots * chip.chips * chip.rx * self.profile.samples * chip.sample_bytes

    @property
    def data_rate_bytes_s(self) -> float:
        """Mean rate at which the radar's samples are recorded or sent."""
        return self.frame_bytes * (0.75 if self.packed_12_bit else 1.0) / self.frame_period_s_actual

    @cached_property
    def layout(self) -> Layout:
        """Axis order of the capture.

        Raises:
            ConfigError: an odd number of samples from a DCA1000, which sends them in pairs.
        """
        chip = self.profile.chip
        in_pairs = self.is_cascade or self.profile.samples % 2 == 0
        require(in_pairs, "profile.samples", self.profile.samples, "an even number")
        kind: Literal["cascade", "dca1000", "dca1000_real"] = "cascade" if self.is_cascade else "dca1000"
        if not chip.complex_samples:
            return Layout("dca1000_real", chip.chips, self.loops, self.slots, self.profile.samples, chip.rx)
        order = self.iq_order or ("IQ" if self.is_cascade else "QI")
        return Layout(kind, chip.chips, self.loops, self.slots, self.profile.samples, chip.rx, order)
