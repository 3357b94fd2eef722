# SPDX-License-Identifier: Apache-2.0
"""Calibration of one radar from a corner reflector at a known place.

Per channel the echo of the reflector is a tone. Its frequency is where the Hann-windowed spectrum is largest (climbed
on the continuous spectrum, not read from a grid), its phase is taken in the middle of the chirp, where an error of the
frequency turns it least. The exact two-way path |p - A| + |p - B| is taken out of both; what remains is the board:
delays, which must be a transmitter's plus a receiver's and are fitted so, and phases, kept channel by channel. The
phases of a boresight wave from the reflector's range are put back, as the file format states (``reference_range_m``).
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edge.calibration import Calibration, Waveform
from edge.calibration_capture import CaptureMean, Complex128, phasor, range_profile, range_taper
from edge.calibration_checks import (
    Peak,
    find_reflector,
    image_rejection_db,
    require_possible_range,
    require_samples,
    require_still,
)
from edge.calibration_fit import additive_fit, repair_outliers
from edge.calibration_quality import (
    Bool,
    Quality,
    error_sidelobe_db,
    repeatability_deg,
    require_separable,
    residual_deg,
)
from edge.dsp.tables import curvature_m
from edge.errors import CalibrationError
from edge.frames import Complex64, Float64
from edge.reference.point_targets import element_positions_m

if TYPE_CHECKING:
    from edge.rig import Radar

DEAD_DB = 15.0
CLIMB_STEPS_BINS = (0.5, 0.25, 0.1, 0.05, 0.02, 0.01, 0.01)
DEFAULT_SEARCH_M = 0.3


@dataclass(frozen=True, slots=True)
class Reflector:
    """Where the corner reflector stands, from the phase centre of the radar's row.

    Args:
        range_m: distance.
        angle_deg: off boresight in the plane of the array, towards rig +y (horizontal) or +z (vertical).
        search_m: the echo is looked for this far to either side of the range.
    Raises:
        CalibrationError: an impossible angle or window.
    """

    range_m: float
    angle_deg: float = 0.0
    search_m: float = DEFAULT_SEARCH_M

    def __post_init__(self) -> None:
        if not abs(self.angle_deg) <= 60.0:
            raise CalibrationError("impossible reflector angle", value=self.angle_deg, allowed="-60..60 degrees")
        if not 0.0 < self.search_m <= 2.0:
            raise CalibrationError("impossible search window", value=self.search_m, allowed="above 0, up to 2 m")


@dataclass(frozen=True, slots=True, eq=False)
class MadeCalibration:
    """A calibration with what it was made from.

    Args:
        calibration: to save.
        quality: its figures.
        profile: float64 [8 * Ns], range profile, mean power over the channels.
        peak: the reflector in it.
        level_db, residual_deg: float64 [slots, receivers], of each channel as measured.
    """

    calibration: Calibration
    quality: Quality
    profile: Float64
    peak: Peak
    level_db: Float64
    residual_deg: Float64


def make_calibration(
    mean: CaptureMean,
    radar: Radar,
    reflector: Reflector,
    out: Path,
    *,
    amplitude: bool = False,
    board: str = "",
    temperature_c: float | None = None,
    background: CaptureMean | None = None,
) -> MadeCalibration:
    """Calibration from the mean of a capture.

    Args:
        mean: of the capture.
        radar: board, schedule, mounting; its present calibration is not used.
        reflector: where it stands.
        out: file the calibration is meant for, named in errors.
        amplitude: also make the channels equally strong; else phases only, which keeps noise equally strong.
        board, temperature_c: go into the file.
        background: mean of the same place without the reflector, subtracted.
    Raises:
        CalibrationError: the capture cannot become one; says why and what to do.
    """
    schedule = radar.schedule
    require_possible_range(radar, reflector.range_m, reflector.search_m)
    require_samples(mean, schedule)
    taper, bin_m = range_taper(schedule.profile.samples), schedule.profile.range_bin_m
    turn_rad = _turn_rad(mean, reflector, bin_m, schedule.profile.wavelength_m)
    samples = mean.samples - (0.0 if background is None else background.samples)
    profile = range_profile(samples[~mean.dead], taper)
    peak = find_reflector(profile, reflector.range_m / bin_m, reflector.search_m / bin_m)
    path_m = _two_way_path_m(radar, reflector)
    shift, tone, dead = _measure(samples, taper, peak, 0.5 * path_m / bin_m, mean.dead)
    measured = _gain(radar, reflector, path_m, tone, shift, dead)
    gain, shift, repaired = repair_outliers(measured, shift, schedule, out)
    kept = ~dead & (gain == measured.astype(gain.dtype))
    residual, level_db = residual_deg(gain, shift, schedule.profile.samples), -20.0 * np.log10(np.abs(gain))
    rms_deg = float(np.sqrt(np.mean(residual[kept] ** 2)))
    require_separable(rms_deg, out)
    quality = Quality(
        frames=mean.frames,
        loops=mean.loops,
        snr_db=peak.snr_db,
        margin_db=peak.margin_db if np.isfinite(peak.margin_db) else None,
        separability_rms_deg=rms_deg,
        repeatability_rms_deg=repeatability_deg(mean),
        gain_spread_db=float(np.ptp(level_db[kept])),
        delay_spread_bins=float(np.ptp(shift)),
        range_offset_m=float(np.median(shift)) * bin_m,
        sidelobe_db=error_sidelobe_db(radar, residual, np.zeros_like(level_db) if amplitude else level_db, kept),
        image_rejection_db=image_rejection_db(profile),
        saturated_share=mean.saturated_share,
        turn_deg=None if np.isnan(turn_rad) else float(np.degrees(turn_rad)),
        repaired=repaired,
    )
    facts = (reflector.range_m, board, temperature_c, date.today().isoformat(), Waveform.of(schedule), repaired)
    calibration = Calibration(_scaled(gain, amplitude), shift, *facts)
    return MadeCalibration(calibration, quality, profile, peak, level_db, residual)


def _turn_rad(mean: CaptureMean, reflector: Reflector, bin_m: float, wavelength_m: float) -> float:
    """``require_still``, but noise in place of a reflector is called so, and not a moving one."""
    try:
        return require_still(mean, wavelength_m)
    except CalibrationError:
        find_reflector(mean.first_profile, reflector.range_m / bin_m, reflector.search_m / bin_m)
        raise


def _measure(
    samples: Complex128, taper: Float64, peak: Peak, place_bin: Float64, silent: Bool
) -> tuple[Float64, Complex128, Bool]:
    """Delay of every channel as transmitter plus receiver, tone at that delay, and channels without an echo.

    Args:
        samples: complex128 [slots, receivers, sample].
        taper: float64 [sample].
        peak: the reflector.
        place_bin: where the reflector's place alone would put every channel's tone.
        silent: channels known to be dead.
    """
    tone_bin, tone = channel_tones(samples, taper, peak.range_bin)
    level_db = 20.0 * np.log10(np.maximum(np.abs(tone), 1e-6))
    dead = silent | (level_db < np.median(level_db[~silent]) - DEAD_DB)
    delay = tone_bin - place_bin
    shift = additive_fit(np.where(dead, np.median(delay[~dead]), delay))
    return shift, np.einsum("tri,tri->tr", samples, phasor(shift + place_bin, taper)), dead


def channel_tones(samples: Complex128, taper: Float64, near_bin: float) -> tuple[Float64, Complex128]:
    """Frequency and complex amplitude of every channel's tone next to ``near_bin``.

    Climbs the windowed spectrum's logarithm by parabolas of shrinking width, within the Hann main lobe.

    Args:
        samples: complex128 [slots, receivers, sample].
        taper: float64 [sample], about the middle of the chirp, sum 1.
        near_bin: start, bins.
    Returns:
        Bins and amplitudes (phase in the middle of the chirp), [slots, receivers] each.
    """
    bins = np.full(samples.shape[:2], near_bin)

    def spectrum(at: Float64) -> Complex128:
        return np.asarray(np.einsum("tri,tri->tr", samples, phasor(at, taper)))

    for step in CLIMB_STEPS_BINS:
        left, middle, right = (np.log(np.abs(spectrum(bins + k * step)) + 1e-12) for k in (-1, 0, 1))
        bend = left - 2.0 * middle + right
        vertex = 0.5 * (left - right) / np.where(bend < 0.0, bend, -1e-12)
        bins = bins + step * np.clip(np.where(bend < 0.0, vertex, np.sign(right - left)), -1.0, 1.0)
    return bins, spectrum(bins)


def _two_way_path_m(radar: Radar, reflector: Reflector) -> Float64:
    """Exact path [slots, receivers] from every transmitter to the reflector and back to every receiver."""
    along = 1 if radar.radar == "horizontal" else 2
    angle = np.radians(reflector.angle_deg)
    place_m = np.array(radar.mounting.position_m, dtype=np.float64)
    place_m[0] += reflector.range_m * np.cos(angle)
    place_m[along] += reflector.range_m * np.sin(angle)
    out_m, back_m = (np.linalg.norm(place_m - position, axis=1) for position in element_positions_m(radar))
    return np.asarray(out_m[:, None] + back_m)


def _gain(
    radar: Radar,
    reflector: Reflector,
    path_m: Float64,
    tone: Complex128,
    shift: Float64,
    dead: Bool,
) -> Complex128:
    """Factor that makes every channel see a boresight wave from the reflector's range; dead channels far off."""
    transmit_m, receive_m = radar.array.element_offsets_m()
    baked_m = curvature_m(reflector.range_m, transmit_m[:, None], receive_m[None, :])
    place_m = path_m - 2.0 * reflector.range_m - baked_m
    turn = np.exp(2j * np.pi * place_m / radar.schedule.profile.wavelength_m + 1j * np.pi * shift)
    gain = turn / np.where(dead, 1.0, tone)
    middle = np.median(np.abs(gain[~dead]))
    return np.asarray(np.where(dead, 1e3, gain / middle))


def _scaled(gain: Complex64, amplitude: bool) -> Complex64:
    """Phase of the first channel zero; moduli 1, or with mean square 1."""
    turned = gain * np.exp(-1j * np.angle(gain[0, 0]))
    modulus = np.abs(turned)
    scaled = turned / (np.sqrt(np.mean(modulus**2)) if amplitude else modulus)
    return np.asarray(scaled, dtype=np.complex64)
