# SPDX-License-Identifier: Apache-2.0
"""The receivers' faults: noise, leakage, channel mismatch, IF filter, jitter, distortion, and what a calibration knows.

Defaults are what captures of real cascades show (docs/simulation.md); those that no capture confirmed are off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.calibration import Calibration, Waveform
from edge.config import require
from edge.dsp.tables import curvature_m
from edge.frames import RADARS, Complex64, Float32, Float64, Int16
from train.simulate.kernels_front_end import digitise

if TYPE_CHECKING:
    from edge.rig import Radar

Complex128 = NDArray[np.complex128]

HPF1_HZ = (175e3, 235e3, 350e3, 700e3)
HPF2_HZ = (350e3, 700e3, 1.4e6, 2.8e6)
"""Corners of the IF's two high-pass filters by code (ICD 2.23, message 0x0100), taken as first order each."""
LEAKAGE_M, LEAKAGE_SHARE = (0.08, 0.15, 0.28), (0.5, 1.0, 0.3)
"""Half paths of the leakage and their amplitudes over the strongest one's, which falls into range bins 2 to 3."""
LEAKAGE_SPREAD_DB = 2.0
RX_SHARE, TX_SHARE, COUPLING_SHARE = 0.87, 0.42, 0.25
"""Parts of the gain spread: receivers, transmitters and what is neither's; their squares sum to 1."""
FULL_SCALE_LSB = 32767.0
_DRAWN, _JITTER, _FREQUENCY = 1, 2, 3
"""Streams of random numbers."""
_LOW = 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class FrontEndSettings:
    """One board's faults. Amplitudes are of complex samples, in LSB; a board with real samples gives their real parts.

    Real noise of noise_lsb / sqrt(2) over half the sampling rate is, per range bin, what complex noise of noise_lsb is
    over as many bins.

    Args:
        noise_lsb: standard deviation of a complex sample's noise behind a receiver of mean gain; 0 to 1000.
        leakage: amplitude of the strongest leakage over ``noise_lsb``; 0 to 1000.
        gain_spread_db: standard deviation of the channels' gains; 0 to 10.
        phase_spread_deg: every transmitter's and receiver's phase lies within +- this; 0 to 180.
        coupling_deg: standard deviation of the phase that is neither a transmitter's nor a receiver's; 0 to 45.
        delay_spread_bins: every transmitter's delay lies within +- this, in range bins; 0 to 2.
        residual_deg, residual_db, residual_bins: standard deviations of the calibration's errors per channel; 0 to
            45 degrees, 6 dB, 0.5 bins.
        high_pass: the IF's high-pass filters of the chirp profile act on the echoes.
        start_jitter_s: every chirp starts on time or this late, by chance; 0 to 10 ns. 1.1 ns on cascades (TI SPRACV2).
            Every loop is then synthesised by itself, which takes as many times longer.
        second_harmonic_dbc: of an echo at full scale, falls with its amplitude; -100 to -20. At most -55 (AWR2243
            errata, ANA#12A). None: none.
        phase_noise_dbc_hz: at 1 MHz off the carrier, falling by 20 dB per decade; -130 to -60. About -94. None: none.
            Every loop is then synthesised by itself, with two FFTs.
        iq_image_db: every receiver's image at the negative beat frequency; -80 to -10. About -35. None: none.
        dead_transmitters: numbers as on the board, of those that radiate nothing.
        dead_receivers: in capture order from 0, of those that give zeros only.
        stuck_receivers: of those that give ``stuck_code`` only.
        stuck_code: -32768 to 32767.
    Raises:
        ConfigError: a value out of its range.
    """

    noise_lsb: float = 25.0
    leakage: float = 50.0
    gain_spread_db: float = 2.4
    phase_spread_deg: float = 180.0
    coupling_deg: float = 2.0
    delay_spread_bins: float = 0.27
    residual_deg: float = 4.0
    residual_db: float = 0.3
    residual_bins: float = 0.01
    high_pass: bool = True
    start_jitter_s: float = 0.0
    second_harmonic_dbc: float | None = None
    phase_noise_dbc_hz: float | None = None
    iq_image_db: float | None = None
    dead_transmitters: tuple[int, ...] = ()
    dead_receivers: tuple[int, ...] = ()
    stuck_receivers: tuple[int, ...] = ()
    stuck_code: int = 2047

    def __post_init__(self) -> None:
        for key, low, high in (
            ("noise_lsb", 0.0, 1000.0),
            ("leakage", 0.0, 1000.0),
            ("gain_spread_db", 0.0, 10.0),
            ("phase_spread_deg", 0.0, 180.0),
            ("coupling_deg", 0.0, 45.0),
            ("delay_spread_bins", 0.0, 2.0),
            ("residual_deg", 0.0, 45.0),
            ("residual_db", 0.0, 6.0),
            ("residual_bins", 0.0, 0.5),
            ("start_jitter_s", 0.0, 10e-9),
            ("second_harmonic_dbc", -100.0, -20.0),
            ("phase_noise_dbc_hz", -130.0, -60.0),
            ("iq_image_db", -80.0, -10.0),
            ("stuck_code", -32768, 32767),
        ):
            value = getattr(self, key)
            require(value is None or low <= value <= high, f"front_end.{key}", value, f"{low:g} to {high:g}")

    @classmethod
    def ideal(cls, noise_lsb: float = 0.0) -> FrontEndSettings:
        """A board without faults except, if wanted, noise."""
        return cls(
            noise_lsb=noise_lsb,
            leakage=0.0,
            gain_spread_db=0.0,
            phase_spread_deg=0.0,
            coupling_deg=0.0,
            delay_spread_bins=0.0,
            residual_deg=0.0,
            residual_db=0.0,
            residual_bins=0.0,
            high_pass=False,
        )


class FrontEnd:
    """The faults of one board, drawn once from a seed.

    Arrays go by chip, slot, sample, receiver of the chip: the order in which a cascade's samples are captured.

    Args:
        radar: board and schedule.
        settings: what to draw.
        seed: of this rig; the two radars draw differently.
    Attributes:
        gain: complex128 [slots, receivers].
        shift_bins: float64 [slots, receivers], beat-frequency offset in bins of an Ns-point FFT.
        response, leakage: complex64 [chips, slots, samples * rx]: factor and addition of every sample.
        per_chirp: whether the chirps of a burst differ from each other in more than their noise.
    Raises:
        ConfigError: a dead or stuck antenna that the board does not have, an image of real samples, or a negative
            seed.
    """

    def __init__(self, radar: Radar, settings: FrontEndSettings, seed: int) -> None:
        self.radar, self.settings, self.seed = radar, settings, seed
        require(0 <= seed < 2**63, "front_end seed", seed, "0 to 2^63 - 1")
        layout = radar.schedule.layout
        self._index = RADARS.index(radar.radar)
        self._slots, self._receivers, self._samples = layout.slots, layout.devices * layout.rx, layout.samples
        self._rx, self._chips = layout.rx, layout.devices
        quadrature = layout.kind != "dca1000_real" or settings.iq_image_db is None
        require(quadrature, "front_end.iq_image_db", settings.iq_image_db, "None: real samples have no image")
        for name, known in (
            ("dead_transmitters", set(radar.schedule.transmitters)),
            ("dead_receivers", set(range(self._receivers))),
            ("stuck_receivers", set(range(self._receivers))),
        ):
            require(set(getattr(settings, name)) <= known, f"front_end.{name}", getattr(settings, name), str(known))
        rng = np.random.default_rng((seed, self._index, _DRAWN))
        self.gain, receive_level = self._draw_gain(rng)
        self.shift_bins = np.repeat(self._within(rng, settings.delay_spread_bins, self._slots), self._receivers, axis=1)
        n = np.arange(self._samples) / self._samples
        samples = self.gain[:, :, None] * np.exp(2j * np.pi * self.shift_bins[:, :, None] * n)
        leakage = self._draw_leakage(rng)
        deviation = settings.noise_lsb / math.sqrt(2.0) * receive_level
        self._image = self._draw_image(rng)
        self._draw_calibration(rng)
        dead = np.isin(radar.schedule.transmitters, settings.dead_transmitters)
        samples[dead] = leakage[dead] = 0.0
        for receivers, code in ((settings.dead_receivers, 0), (settings.stuck_receivers, settings.stuck_code)):
            index = list(receivers)
            samples[:, index], leakage[:, index], deviation[index] = 0.0, code * (1.0 + 1.0j), 0.0
        self.response, self.leakage = self._captured(samples), self._captured(leakage)
        lanes = np.repeat(deviation.reshape(self._chips, 1, self._rx), 2, axis=2)
        self._deviation: Float32 = np.tile(lanes, (1, self._samples, 1)).reshape(self._chips, -1).astype(np.float32)
        self.per_chirp = settings.start_jitter_s > 0.0 or settings.phase_noise_dbc_hz is not None

    def _within(self, rng: np.random.Generator, limit: float, count: int) -> Float64:
        """Uniform within +-limit, [count, 1]."""
        return rng.uniform(-1.0, 1.0, (count, 1)) * limit

    def _draw_gain(self, rng: np.random.Generator) -> tuple[Complex128, Float64]:
        """Gain [slots, receivers] of mean level 0 dB, and the receivers' levels [receivers]: these lift noise too."""
        spread_db, shape = self.settings.gain_spread_db, (self._slots, self._receivers)
        receive_db = spread_db * RX_SHARE * rng.standard_normal(self._receivers)
        receive_db -= receive_db.mean()
        transmit_db = spread_db * TX_SHARE * rng.standard_normal((self._slots, 1))
        level_db = transmit_db - transmit_db.mean() + receive_db
        level_db = level_db + spread_db * COUPLING_SHARE * rng.standard_normal(shape)
        limit_rad = math.radians(self.settings.phase_spread_deg)
        angle = self._within(rng, limit_rad, self._slots) + self._within(rng, limit_rad, self._receivers).T
        angle = angle + math.radians(self.settings.coupling_deg) * rng.standard_normal(shape)
        return 10.0 ** (level_db / 20.0) * np.exp(1j * angle), 10.0 ** (receive_db / 20.0)

    def _draw_leakage(self, rng: np.random.Generator) -> Complex128:
        """Samples [slots, receivers, samples] of what couples from transmitters into receivers."""
        profile, shape = self.radar.schedule.profile, (self._slots, self._receivers, 1)
        n = np.arange(self._samples) / self._samples
        total = np.zeros((self._slots, self._receivers, self._samples), dtype=np.complex128)
        for range_m, share in zip(LEAKAGE_M, LEAKAGE_SHARE, strict=True):
            level = self.settings.leakage * self.settings.noise_lsb * share
            level_db = LEAKAGE_SPREAD_DB * rng.standard_normal(shape)
            phase = 2j * np.pi * rng.random(shape)
            total += level * 10.0 ** (level_db / 20.0) * np.exp(phase + 2j * np.pi * range_m / profile.range_bin_m * n)
        return total

    def _draw_image(self, rng: np.random.Generator) -> Complex64 | None:
        """Factor of the conjugate per receiver [chips, 1, rx]."""
        phase = np.exp(2j * np.pi * rng.random((self._chips, 1, self._rx)))
        level_db = self.settings.iq_image_db
        return None if level_db is None else (math.pow(10.0, level_db / 20.0) * phase).astype(np.complex64)

    def _draw_calibration(self, rng: np.random.Generator) -> None:
        """What the calibration measures, errors included."""
        shape, settings = (self._slots, self._receivers), self.settings
        level_db, angle, shift = (rng.standard_normal(shape) for _ in range(3))
        error = 10.0 ** (settings.residual_db * level_db / 20.0) * np.exp(
            1j * np.radians(settings.residual_deg) * angle
        )
        shift_error = settings.residual_bins * shift
        # measured in the middle of the chirp: an error of the delay turns no phase there
        self._measured_gain = self.gain * error * np.exp(-1j * np.pi * shift_error)
        self._measured_shift = self.shift_bins + shift_error

    def _captured(self, samples: Complex128) -> Complex64:
        """[slots, receivers, samples] to [chips, slots, samples * rx]."""
        parts = samples.reshape(self._slots, self._chips, self._rx, self._samples).transpose(1, 0, 3, 2)
        return np.ascontiguousarray(parts, dtype=np.complex64).reshape(self._chips, self._slots, -1)

    def if_response(self, cells: int) -> Complex64:
        """Receiver's response to echoes by beat frequency, complex64 [cells + 1] over one sampling rate."""
        if not self.settings.high_pass:
            return np.ones(cells + 1, dtype=np.complex64)
        profile = self.radar.schedule.profile
        jf = 1j * np.arange(cells + 1) * profile.sample_rate_hz / cells
        first_hz, second_hz = HPF1_HZ[profile.hpf1], HPF2_HZ[profile.hpf2]
        return np.asarray(jf / (jf + first_hz) * jf / (jf + second_hz), dtype=np.complex64)

    def jitter_s(self, number: int, loop: int) -> Float64 | None:
        """How late every chirp of a loop starts [slots]; None: all on time."""
        if not self.settings.start_jitter_s:
            return None
        rng = np.random.default_rng((self.seed, self._index, _JITTER, number, loop))
        return np.asarray(self.settings.start_jitter_s * rng.integers(0, 2, self._slots), dtype=np.float64)

    def frequency_noise_hz(self, number: int, loop: int) -> Float64 | None:
        """Deviation of the carrier's frequency at every chirp's samples [slots, samples]; None: none.

        Phase noise that falls by 20 dB per decade is white noise of the frequency, of density 2 L(f) f^2. An echo
        delayed by tau shows the phase 2 pi tau times the deviation (pi f tau << 1). All channels share it.
        """
        level = self.settings.phase_noise_dbc_hz
        if level is None:
            return None
        density_hz = 2.0 * math.pow(10.0, 0.1 * level) * 1e12
        rng = np.random.default_rng((self.seed, self._index, _FREQUENCY, number, loop))
        rate_hz = self.radar.schedule.profile.sample_rate_hz
        return math.sqrt(0.5 * density_hz * rate_hz) * rng.standard_normal((self._slots, self._samples))

    def distort(self, signal: Complex64) -> None:
        """Second harmonic and IQ image of what reaches the ADC.

        Args:
            signal: complex64 [chips, slots, samples * rx], changed.
        """
        if self.settings.second_harmonic_dbc is not None:
            factor = math.pow(10.0, self.settings.second_harmonic_dbc / 20.0) / FULL_SCALE_LSB
            signal += np.float32(factor) * signal * signal
        if self._image is not None:
            parts = signal.reshape(self._chips, -1, self._rx)
            parts += self._image * parts.conj()

    def digitise(self, signal: Complex64, number: int, loop: int, adc: Int16) -> None:
        """Add the noise of one loop and round.

        Args:
            signal: complex64 [chips, slots, samples * rx], without noise.
            number, loop: decide the noise, with seed and radar.
            adc: int16 [chips, loops, slots, samples * rx * 2], this loop is overwritten.
        """
        low, high = self.seed & _LOW, (self.seed >> 32) ^ (self._index << 31)
        digitise(
            *(signal.view(np.float32), self._deviation, np.uint64(low), np.uint64(high), np.uint64(number)),
            *(loop, adc),
        )

    def calibration(self, reference_range_m: float = math.inf) -> Calibration:
        """What a calibration of this board holds, with its errors; dead channels as if they were alive.

        Args:
            reference_range_m: of the reflector whose wavefront the phases contain; infinite: none.
        """
        transmit_m, receive_m = self.radar.array.element_offsets_m()
        baked_m = curvature_m(reference_range_m, transmit_m[:, None], receive_m[None, :])
        wave = np.exp(2j * np.pi * baked_m / self.radar.schedule.profile.wavelength_m)
        return Calibration(
            gain=(1.0 / (self._measured_gain * wave)).astype(np.complex64),
            range_shift_bins=self._measured_shift,
            reference_range_m=reference_range_m,
            board=f"simulated, seed {self.seed}, {self.radar.radar}",
            made_with=Waveform.of(self.radar.schedule),
        )
