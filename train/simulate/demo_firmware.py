# SPDX-License-Identifier: Apache-2.0
"""TI's out-of-box demo on a single-chip radar, as its command line shows it: what it accepts, refuses and remembers.

Source: hardware notes 4.1 and 6.5 (commands, fields, order, limits). What the notes leave open is listed
in docs/simulation.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

from edge.devices import Device


class SensorState(IntEnum):
    """As queryDemoStatus reports it."""

    INIT = 0
    OPENED = 1
    STARTED = 2
    STOPPED = 3


class CommandError(Exception):
    """The command line answers Error."""


@dataclass(frozen=True, slots=True)
class DemoProfile:
    """profileCfg, in its units: GHz, microseconds, MHz/us, ksps, dB."""

    identity: int
    start_ghz: float
    idle_us: float
    adc_start_us: float
    ramp_end_us: float
    tx_backoff: float
    tx_phase: float
    slope_mhz_us: float
    tx_start_us: float
    samples: int
    rate_ksps: float
    hpf1: int
    hpf2: int
    rx_gain_db: float

    @property
    def chirp_us(self) -> float:
        """Idle time and ramp."""
        return self.idle_us + self.ramp_end_us


@dataclass(frozen=True, slots=True)
class DemoFrame:
    """frameCfg: trigger 1 software, 2 hardware."""

    first: int
    last: int
    loops: int
    frames: int
    period_ms: float
    trigger: int
    delay_ms: float


@dataclass(slots=True)
class DemoConfiguration:
    """What the command line was told.

    Args:
        values: command -> its numbers, as last accepted.
        profiles: by number.
        chirps: chirp -> (profile, transmitter mask).
        frame: None: not yet.
    """

    values: dict[str, tuple[float, ...]] = field(default_factory=dict)
    profiles: dict[int, DemoProfile] = field(default_factory=dict)
    chirps: dict[int, tuple[int, int]] = field(default_factory=dict)
    frame: DemoFrame | None = None

    @property
    def receivers(self) -> int:
        """Receivers in use."""
        return int(self.values.get("channelCfg", (0,))[0]).bit_count()

    @property
    def sample_bytes(self) -> int:
        """Bytes of one 16-bit sample: complex1x has two parts."""
        return 2 if self.values.get("adcCfg", (0.0, 1.0))[1] == REAL else 4

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame of 16-bit samples."""
        if self.frame is None:
            return 0
        profile = self.profiles[self.chirps[self.frame.first][0]]
        chirps = (self.frame.last - self.frame.first + 1) * self.frame.loops
        return self.sample_bytes * chirps * self.receivers * profile.samples


REAL = 0.0
"""adcCfg's second number: real samples; 1: complex1x."""
ARGUMENTS: dict[str, int] = {
    "dfeDataOutputMode": 1,
    "channelCfg": 3,
    "adcCfg": 2,
    "adcbufCfg": 5,
    "profileCfg": 14,
    "chirpCfg": 8,
    "frameCfg": 7,
    "lowPower": 2,
    "guiMonitor": 7,
    "cfarCfg": 9,
    "multiObjBeamForming": 3,
    "clutterRemoval": 2,
    "calibDcRangeSig": 5,
    "extendedMaxVelocity": 2,
    "compRangeBiasAndRxChanPhase": 25,
    "measureRangeBiasAndRxChanPhase": 3,
    "CQRxSatMonitor": 5,
    "CQSigImgMonitor": 3,
    "analogMonitor": 2,
    "aoaFovCfg": 5,
    "cfarFovCfg": 4,
    "lvdsStreamCfg": 4,
    "calibData": 3,
}
"""Configuration commands and how many numbers each takes."""
OF_2944 = {"frameCfg": 8, "compRangeBiasAndRxChanPhase": 33}
"""Those of the AWR2944's demo that differ: samples after the frames; gain and phase of 16 channels."""
DIRECTIONS = ("cfarCfg", "cfarFovCfg")
"""Given twice, for range (0) and Doppler (1)."""
FIXED = ("channelCfg", "adcCfg", "lowPower")
"""Cannot change after the first start without a reboot."""
FRONT_END = (*FIXED, "dfeDataOutputMode", "adcbufCfg", "profileCfg", "chirpCfg", "frameCfg", "lvdsStreamCfg")
"""Cannot be given while the sensor runs."""
LANES, LANE_MBIT_S = 2, 600


class DemoFirmware:
    """State behind the command line.

    Args:
        device: chip, with its limits; AWR1843, IWR6843 or AWR2944 (real samples only).
        begin: called when frames start, with the configuration.
        end: called when they stop.
    Attributes:
        configuration: decoded.
        state: of the sensor.
        starts: how often the sensor was started since the reset.
        violations: lines that were answered with an error, and why.
    """

    def __init__(
        self, device: Device, begin: Callable[[DemoConfiguration], None], end: Callable[[], None]
    ) -> None:
        self.violations: list[str] = []
        self._device = device
        self._begin, self._end = begin, end
        self._real = not device.complex_samples
        self._arguments = ARGUMENTS | OF_2944 if self._real else ARGUMENTS
        self.reset()

    def reset(self) -> None:
        """Reboot: nothing is configured. The caller stops the frames."""
        self.configuration, self.state, self.starts = DemoConfiguration(), SensorState.INIT, 0
        self._fixed: dict[str, tuple[float, ...]] = {}

    def execute(self, line: str) -> list[str]:
        """Answer to one line, without echo and prompt; empty lines and comments have none."""
        words = line.split()
        if not words or words[0].startswith("%"):
            return []
        name, arguments = words[0], words[1:]
        actions = {"sensorStart": self._start, "sensorStop": self._stop, "flushCfg": self._flush}
        try:
            if name == "queryDemoStatus":
                return [f"Sensor State: {self.state:d}", f"Data port baud rate: {self._data_baud}", "Done"]
            if name == "version":
                platform = f"xWR{self._device.name[3:5]}xx"
                return [f"{'Platform':24s}: {platform}", f"{'mmWave SDK Version':24s}: 03.05.00.04", "Done"]
            if name in actions:
                return [*actions[name](_numbers(arguments)), "Done"]
            if name not in self._arguments:
                self.violations.append(f"{line}: not a command")
                return [f"'{name}' is not recognized as a CLI command"]
            self._configure(name, _numbers(arguments))
        except CommandError as error:
            self.violations.append(f"{line}: {error}")
            return [f"Error: {error}", "Error -1"]
        return ["Done"]

    def _configure(self, name: str, numbers: tuple[float, ...]) -> None:
        if len(numbers) != self._arguments[name]:
            raise CommandError("Invalid usage of the CLI command")
        if self.state == SensorState.STARTED and name in FRONT_END:
            raise CommandError("stop the sensor first")
        if self._fixed.get(name, numbers) != numbers:
            raise CommandError("cannot be changed after the first start without a reboot")
        self._check(name, numbers)
        configuration = self.configuration
        if name == "profileCfg":
            _check_profile(numbers, self._device)
            values: list[Any] = list(numbers)
            for index in (0, 9, 11, 12):
                values[index] = int(values[index])
            configuration.profiles[values[0]] = DemoProfile(*values)
        elif name == "chirpCfg":
            chirps = range(int(numbers[0]), int(numbers[1]) + 1)
            configuration.chirps.update(dict.fromkeys(chirps, (int(numbers[2]), int(numbers[7]))))
        elif name == "frameCfg":
            first, last, loops, frames = (int(number) for number in numbers[:4])
            period_ms, trigger, delay_ms = numbers[-3:]
            configuration.frame = DemoFrame(first, last, loops, frames, period_ms, int(trigger), delay_ms)
        key = f"{name} {int(numbers[1])}" if name in DIRECTIONS else name
        configuration.values[key] = numbers

    @property
    def _data_baud(self) -> int:
        return 3_125_000 if self._real else 921_600

    def _check(self, name: str, numbers: tuple[float, ...]) -> None:
        """One command's numbers by themselves."""
        transmitters = len(self._device.firing_order)
        if name == "channelCfg":
            inside = numbers[0] in range(1, 16) and numbers[1] in range(1, 1 << transmitters) and numbers[2] == 0
            _need(inside, "rx, tx or cascading")
        elif name == "adcCfg":
            form = "real (2 0)" if self._real else "complex1x (2 1)"
            _need(numbers == (2.0, REAL if self._real else 1.0), f"only 16 bit {form} is emulated")
        elif name == "adcbufCfg":
            _need(numbers[:2] == (-1.0, 1.0 if self._real else 0.0), "ADC buffer: subframe or format")
            _need(numbers[2] in (0, 1) and numbers[3:] == (1.0, 1.0), "ADC buffer")
        elif name == "chirpCfg":
            _chirp(numbers, transmitters)
        elif name == "frameCfg":
            _frame((*numbers[:4], *numbers[-3:]))
        else:
            _CHECKS.get(name, _anything)(numbers)

    def _flush(self, _numbers: tuple[float, ...]) -> list[str]:
        if self.state == SensorState.STARTED:
            raise CommandError("stop the sensor first")
        self.configuration.profiles.clear()
        self.configuration.chirps.clear()
        self.configuration.frame = None
        for name in ("profileCfg", "chirpCfg", "frameCfg"):
            self.configuration.values.pop(name, None)
        return []

    def _stop(self, _numbers: tuple[float, ...]) -> list[str]:
        if self.state != SensorState.STARTED:
            return ["Ignored: Sensor is already stopped"]
        self.state = SensorState.STOPPED
        self._end()
        return []

    def _start(self, numbers: tuple[float, ...]) -> list[str]:
        if self.state == SensorState.STARTED:
            return ["Ignored: Sensor is already started"]
        if numbers not in ((), (0.0,)):
            raise CommandError("Invalid usage of the CLI command")
        if numbers and self.starts == 0:
            raise CommandError("nothing to start again: the sensor was never started")
        self._check_start()
        notes = [] if numbers else ["Debug: Init Calibration Status = 0x1ffe"]
        self._fixed = {name: self.configuration.values[name] for name in FIXED}
        self.state, self.starts = SensorState.STARTED, self.starts + 1
        self._begin(self.configuration)
        return notes

    def _check_start(self) -> None:
        """The whole list, and every limit."""
        c = self.configuration
        keys = [f"{n} {d}" for n in DIRECTIONS for d in (0, 1)] + [n for n in self._arguments if n not in DIRECTIONS]
        missing = [key for key in keys if key not in c.values]
        if missing or c.frame is None:
            raise CommandError(f"configuration is not complete: {', '.join(missing)}")
        frame, tx_mask = c.frame, int(c.values["channelCfg"][1])
        used = range(frame.first, frame.last + 1)
        for index in used:
            profile, tx = c.chirps.get(index, (-1, 0))
            if profile not in c.profiles or not tx or tx & ~tx_mask:
                raise CommandError(f"chirp {index} has no profile or no transmitter that is switched on")
        profiles = [c.profiles[c.chirps[index][0]] for index in used]
        if len({profile.samples for profile in profiles}) > 1:
            raise CommandError("chirps of one frame with different samples")
        ramp_us = frame.loops * sum(profile.ramp_end_us for profile in profiles)
        burst_us = frame.loops * sum(profile.chirp_us for profile in profiles)
        samples = profiles[0].samples
        if self._real and int(c.values["frameCfg"][4]) != samples:
            raise CommandError("samples of frameCfg and profileCfg differ")
        chirp_bytes = c.sample_bytes * samples * c.receivers
        lanes_bytes = min(profile.chirp_us for profile in profiles) * LANES * LANE_MBIT_S / 8
        limits = (
            (burst_us + 300.0 <= 1000.0 * frame.period_ms, "frame does not fit its period"),
            (ramp_us < 500.0 * frame.period_ms, "RF duty of 50 % or more"),
            (chirp_bytes <= self._device.adc_buffer_bytes, "ADC buffer"),
            (c.frame_bytes <= self._device.cube_bytes, "radar cube"),
            (lanes_bytes >= -(-chirp_bytes // 256) * 256, "LVDS lanes too slow for this chirp"),
        )
        for good, what in limits:
            if not good:
                raise CommandError(what)


def _numbers(words: list[str]) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
    except ValueError as error:
        raise CommandError("Invalid usage of the CLI command") from error


def _need(good: bool, what: str) -> None:
    if not good:
        raise CommandError(what)


def _anything(_numbers: tuple[float, ...]) -> None:
    """No limit is known."""


def _check_profile(numbers: tuple[float, ...], device: Device) -> None:
    _, start, idle, adc_start, ramp_end, _, _, slope, _, samples, rate, hpf1, hpf2, gain = numbers
    low, high = (1e-9 * edge for edge in device.band_hz)
    steepest, (slowest, fastest) = 1e-12 * device.max_slope_hz_per_s, device.sample_rate_range_hz
    _need(numbers[0] in range(4), "profile 0..3")
    _need(start >= low and start + 1e-3 * slope * ramp_end <= high + 1e-9, f"ramp leaves {low:g}..{high:g} GHz")
    _need(0 < slope <= steepest, f"slope above {steepest:g} MHz/us")
    _need(idle >= 2 and 0 <= adc_start <= 40.95 and 0 < ramp_end <= 5000, "times")
    _need(samples % 1 == 0 and 2 <= samples <= 1024, "samples")
    _need(1e-3 * slowest <= rate <= 1e-3 * fastest, f"sampling rate {slowest:g}..{fastest:g} Hz")
    _need(adc_start + 1e3 * samples / rate <= ramp_end, "ramp ends before the samples")
    _need(hpf1 in range(4) and hpf2 in range(4), "high-pass corner")
    _need(24 <= gain <= 52 and gain % 2 == 0, "receiver gain")


def _chirp(numbers: tuple[float, ...], transmitters: int) -> None:
    first, last, profile, *_, tx = numbers
    _need(0 <= first <= last < 512, "chirps 0..511")
    _need(profile in range(4) and tx in range(1, 1 << transmitters), "profile or transmitters")


def _frame(numbers: tuple[float, ...]) -> None:
    first, last, loops, frames, period_ms, trigger, delay_ms = numbers
    _need(0 <= first <= last < 512, "chirps 0..511")
    _need(16 <= loops <= 255 and loops % 4 == 0, "loops: 16 or more, a multiple of 4")
    _need(0 <= frames <= 65_535 and 0.3 <= period_ms <= 1342 and delay_ms >= 0, "frames, period or delay")
    _need(trigger in (1, 2), "trigger 1 or 2")


_CHECKS: dict[str, Callable[[tuple[float, ...]], None]] = {
    "dfeDataOutputMode": lambda n: _need(n[0] == 1, "only frames (1) are emulated"),
    "cfarCfg": lambda n: _need(n[1] in (0, 1), "range (0) or Doppler (1)"),
    "cfarFovCfg": lambda n: _need(n[1] in (0, 1), "range (0) or Doppler (1)"),
    "lvdsStreamCfg": lambda n: _need(n[0] == -1 and n[1] in (0, 1) and n[2] in (0, 1, 4) and n[3] in (0, 1), "LVDS"),
}
