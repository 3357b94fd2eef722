# SPDX-License-Identifier: Apache-2.0
"""What one radar chip of the cascade accepts: messages, lengths, order, and the range of every field.

Source: TI Radar Interface Control Document 2.23 as the hardware notes give it. Error codes 59-71 (chirp) and 72-83
(frame) are given there as ranges with a few named members; the others are numbered here in the order of the fields.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from edge.devices import DEVICES
from train.simulate.rhcp import CommandRefusedError, Direction, Refusal

CHIP = DEVICES["AWR2243"]
PROFILES, CHIRP_SLOTS, LARGEST_LOOPS = 4, 512, 255
MASTER, SLAVE = 1, 2
"""Values of the cascading field and of the trigger select (software, hardware)."""
IMAGE_BYTES, CHUNKS = 7936, 35
FIRST_CHUNK, CHUNK = 232, 232

POWER_UP, RF_POWER_UP, RF_INIT, FRAME_READY, FRAME_END = 0x5000, 0x5001, 0x1004, 0x100B, 0x100F
BOOT_STATUS = 0x5005
"""Sub-blocks of asynchronous events."""

FILE, RF_POWER, VERSION_MSS, VERSION_RF, DIE_ID = 0x4080, 0x4000, 0x40E0, 0x0220, 0x0223
CHANNELS, ADC_OUT, LOW_POWER, HSI_CLOCK, RF_DEVICE = 0x0080, 0x0082, 0x0083, 0x0085, 0x0086
MISC, CALIBRATIONS, BANDWIDTH, INIT = 0x0087, 0x0089, 0x008D, 0x00C0
PROFILE, CHIRP, FRAME, TRIGGER, LDO, TEMPERATURE = 0x0100, 0x0101, 0x0102, 0x0140, 0x02CC, 0x02EA
CRC_TYPE, DATA_FORMAT, DATA_PATH, LANE_CLOCK, CSI_LANES, APPLY = 0x404C, 0x4041, 0x4042, 0x4044, 0x4047, 0x40C0

LENGTHS: dict[int, int] = {
    **dict.fromkeys((RF_POWER, VERSION_MSS, VERSION_RF, DIE_ID, INIT, TEMPERATURE), 0),
    **dict.fromkeys((LOW_POWER, HSI_CLOCK, LDO, LANE_CLOCK, TRIGGER), 4),
    **dict.fromkeys((CHANNELS, ADC_OUT, MISC, DATA_PATH, CSI_LANES, APPLY), 8),
    **dict.fromkeys((RF_DEVICE, CALIBRATIONS, CRC_TYPE, DATA_FORMAT), 12),
    BANDWIDTH: 16,
    PROFILE: 44,
    CHIRP: 20,
    FRAME: 24,
}
"""Sub-block -> bytes of its data; the firmware file's vary."""

NEEDS: dict[int, tuple[int, ...]] = {
    CRC_TYPE: (FILE,),
    RF_POWER: (FILE,),
    INIT: (CHANNELS, ADC_OUT),
    PROFILE: (INIT,),
    CHIRP: (PROFILE,),
    FRAME: (CHIRP,),
    APPLY: (FRAME, DATA_FORMAT, DATA_PATH, LANE_CLOCK, CSI_LANES),
}
"""What must have been done before; messages to the BSS also need the RF part powered."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Registers of sub-block 0x0100 in their order."""

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
    reserved: int

    @property
    def chirp_time_10ns(self) -> int:
        """Idle time and ramp."""
        return self.idle + self.ramp_end


@dataclass(frozen=True, slots=True)
class Chirp:
    """Registers of sub-block 0x0101 in their order."""

    first: int
    last: int
    profile: int
    reserved: int
    start_frequency: int
    slope: int
    idle: int
    adc_start: int
    tx_enable: int


@dataclass(frozen=True, slots=True)
class Frame:
    """Registers of sub-block 0x0102 in their order; period and delay in 5 ns."""

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


def message_of(block: int) -> tuple[Direction, int]:
    """Direction and message number that a sub-block belongs to."""
    identity = block >> 5
    return (Direction.TO_MSS if identity >= 0x200 else Direction.TO_BSS), identity


KNOWN_MESSAGES = {message_of(block) for block in (*LENGTHS, FILE)}


def check_channels(data: bytes, master: bool) -> None:
    """Receivers, transmitters and place in the cascade. CommandRefusedError otherwise."""
    rx, tx, cascading, _ = struct.unpack("<4H", data)
    _field(1 <= rx <= 15, Refusal.RX, CHANNELS, "rx mask", rx)
    _field(tx <= 7, Refusal.TX, CHANNELS, "tx mask", tx)
    expected = MASTER if master else SLAVE
    _field(cascading == expected, Refusal.CASCADE, CHANNELS, f"cascading {expected} expected", cascading)


def check_adc_out(data: bytes) -> None:
    """16 bit (2) and complex1x (1), as the recorder needs them."""
    bits, kind = struct.unpack_from("<2H", data)
    _field(bits == 2, Refusal.DATA, ADC_OUT, "ADC bits", bits)
    _field(kind == 1, Refusal.DATA, ADC_OUT, "ADC format", kind)


def check_crc_type(data: bytes) -> None:
    """CRC-32 (1): the framing here knows no other."""
    _field(data[0] == 1, Refusal.DATA, CRC_TYPE, "CRC type", data[0])


def profile_of(data: bytes) -> Profile:
    """A profile within the chip's limits. CommandRefusedError otherwise."""
    p = Profile(*struct.unpack("<HBB6I2h2H2B3H", data))
    _field(p.profile < PROFILES, Refusal.DATA, PROFILE, "profile", p.profile)
    step_hz, slope_step = CHIP.frequency_lsb_hz, CHIP.slope_lsb_hz_per_s
    start_hz = p.start_frequency * step_hz
    end_hz = start_hz + p.slope * slope_step * p.ramp_end * 1e-8
    inside = 76e9 - step_hz <= start_hz <= 81e9 and 76e9 - step_hz <= end_hz <= 81e9
    _field(inside, Refusal.START_FREQUENCY, PROFILE, "ramp leaves 76..81 GHz", f"{start_hz:.6g}..{end_hz:.6g} Hz")
    _field(p.idle <= 524_287, Refusal.IDLE, PROFILE, "idle", p.idle)
    _field(p.adc_start <= 4095, Refusal.DATA, PROFILE, "ADC start", p.adc_start)
    _field(1 <= p.ramp_end <= 500_000, Refusal.RAMP_END, PROFILE, "ramp end", p.ramp_end)
    _field(abs(p.slope * slope_step) <= 266e12, Refusal.SLOPE, PROFILE, "slope", p.slope)
    _field(2 <= p.samples <= 1024, Refusal.SAMPLES, PROFILE, "samples", p.samples)
    _field(2000 <= p.sample_rate_khz <= 22_500, Refusal.SAMPLE_RATE, PROFILE, "kHz", p.sample_rate_khz)
    adc_end = p.adc_start + 1e5 * p.samples / p.sample_rate_khz
    _field(adc_end <= p.ramp_end, Refusal.RAMP_BEFORE_SAMPLES, PROFILE, "ramp ends before the samples", p.ramp_end)
    gain = p.rx_gain & 0x3F
    _field(30 <= gain <= 52 and gain % 2 == 0 and p.rx_gain >> 6 < 3, Refusal.GAIN, PROFILE, "gain", p.rx_gain)
    _field(p.hpf1 <= 3 and p.hpf2 <= 3, Refusal.DATA, PROFILE, "high-pass corner", (p.hpf1, p.hpf2))
    _field(p.chirp_time_10ns >= 1300, Refusal.IDLE, PROFILE, "chirp shorter than 13 us", p.chirp_time_10ns)
    return p


def chirp_of(data: bytes, profiles: dict[int, Profile]) -> Chirp:
    """A chirp whose profile is known. CommandRefusedError otherwise."""
    chirp = Chirp(*struct.unpack("<4HI4H", data))
    checks = (
        (chirp.first < CHIRP_SLOTS, "first chirp", chirp.first),
        (chirp.last < CHIRP_SLOTS, "last chirp", chirp.last),
        (chirp.first <= chirp.last, "last before first", chirp.last),
        (chirp.profile in profiles, "profile that is not configured", chirp.profile),
        (chirp.start_frequency <= 8_388_607, "start frequency", chirp.start_frequency),
        (chirp.slope <= 63, "slope", chirp.slope),
        (chirp.idle <= 4095, "idle", chirp.idle),
        (chirp.adc_start <= 4095, "ADC start", chirp.adc_start),
        (chirp.tx_enable <= 7, "transmitters", chirp.tx_enable),
    )
    for number, (good, what, value) in enumerate(checks):
        _field(good, Refusal.CHIRP + number, CHIRP, what, value)
    return chirp


def frame_of(data: bytes, profiles: dict[int, Profile], chirps: dict[int, Chirp]) -> Frame:
    """A frame of configured chirps that fits its period. CommandRefusedError otherwise."""
    frame = Frame(*struct.unpack("<6HI2HI", data))
    _field(frame.first_chirp < CHIRP_SLOTS, Refusal.FRAME, FRAME, "first chirp", frame.first_chirp)
    _field(frame.last_chirp < CHIRP_SLOTS, Refusal.FRAME + 1, FRAME, "last chirp", frame.last_chirp)
    _field(frame.first_chirp <= frame.last_chirp, Refusal.FRAME + 2, FRAME, "last before first", frame.last_chirp)
    used = range(frame.first_chirp, frame.last_chirp + 1)
    missing = [index for index in used if index not in chirps]
    _field(not missing, Refusal.FRAME + 3, FRAME, "chirps that are not configured", missing)
    _field(1 <= frame.loops <= LARGEST_LOOPS, Refusal.LOOPS, FRAME, "loops", frame.loops)
    _field(60_000 <= frame.period <= 268_400_000, Refusal.PERIOD, FRAME, "period, 5 ns", frame.period)
    _field(frame.trigger in (MASTER, SLAVE), Refusal.TRIGGER, FRAME, "trigger select", frame.trigger)
    _field(frame.delay <= 20_000, Refusal.TRIGGER_DELAY, FRAME, "trigger delay, 5 ns", frame.delay)
    on_5ns = sum(2 * (profiles[chirps[i].profile].chirp_time_10ns + chirps[i].idle) for i in used) * frame.loops
    _field(on_5ns + 60_000 <= frame.period, Refusal.ON_TIME, FRAME, "no 300 us between frames", on_5ns)
    half_words = 2 * profiles[chirps[frame.first_chirp].profile].samples
    _field(frame.half_words == half_words, Refusal.FRAME + 6, FRAME, f"{half_words} half words", frame.half_words)
    return frame


def check_apply(data: bytes, frame: Frame) -> None:
    """Chirps of a frame and half words of a chirp, as the frame command has them."""
    chirps, half_words, _ = struct.unpack("<I2H", data)
    expected = (frame.last_chirp - frame.first_chirp + 1) * frame.loops
    _field(chirps == expected, Refusal.DATA, APPLY, f"{expected} chirps", chirps)
    _field(half_words == frame.half_words, Refusal.DATA, APPLY, f"{frame.half_words} half words", half_words)


def _field(good: bool, code: int, block: int, what: str, value: object) -> None:
    if not good:
        raise CommandRefusedError(code, block, f"{what}: {value}")
