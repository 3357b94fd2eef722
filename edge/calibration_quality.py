# SPDX-License-Identifier: Apache-2.0
"""Quality figures of a calibration made from a reflector capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge.calibration_capture import CaptureMean
from edge.calibration_fit import phasor_fit
from edge.dsp.tables import window
from edge.errors import CalibrationError
from edge.frames import Float64

if TYPE_CHECKING:
    from edge.rig import Radar

Bool = NDArray[np.bool_]
LARGEST_RESIDUAL_DEG = 12.0


@dataclass(frozen=True, slots=True)
class Quality:
    """How good a calibration is.

    Args:
        frames, loops: averaged.
        snr_db: reflector over the floor of the range profile (clutter and noise), a channel.
        margin_db: over the next echo of the search window (the window's own sidelobes are 31 dB down); None: none.
        separability_rms_deg: phases against transmitter plus receiver, repaired channels left out: coupling, other
            echoes of this range and noise.
        repeatability_rms_deg: phases of the capture's first half against its second half; None: one loop.
        gain_spread_db: strongest over weakest channel, repaired ones left out.
        delay_spread_bins: largest minus smallest fitted range shift.
        range_offset_m: measured minus stated range; the calibration removes it.
        sidelobe_db: highest error sidelobe to expect if all of the separability residual and of the gain's departure
            were error: 10 log10(ln(M) s^2 sum w^2 / (sum w)^2) (Mailloux, Phased Array Antenna Handbook, ch. 7).
        image_rejection_db: nearer over farther half of range; a reflector in the nearer half makes it positive.
        saturated_share: of all codes.
        turn_deg: largest turn of the echo over the capture; None: one loop.
        repaired: channels that were replaced.
    """

    frames: int
    loops: int
    snr_db: float
    margin_db: float | None
    separability_rms_deg: float
    repeatability_rms_deg: float | None
    gain_spread_db: float
    delay_spread_bins: float
    range_offset_m: float
    sidelobe_db: float
    image_rejection_db: float
    saturated_share: float
    turn_deg: float | None
    repaired: tuple[str, ...]


def require_separable(rms_deg: float, out: Path) -> None:
    """Refuse phases that no transmitter and receiver responses explain.

    Raises:
        CalibrationError: more than 12 degrees rms.
    """
    if rms_deg > LARGEST_RESIDUAL_DEG:
        raise CalibrationError(
            f"{out}: the channels' phases do not follow a transmitter and a receiver response",
            value=f"{rms_deg:.1f} deg rms",
            allowed=f"{LARGEST_RESIDUAL_DEG:.0f} deg; real boards have 1 to 4",
            action="another echo shares the reflector's range: move or turn the reflector, or also capture the place "
            "without it (--background)",
        )


def error_sidelobe_db(radar: Radar, residual_deg: Float64, level_db: Float64, kept: Bool) -> float:
    """Highest sidelobe that random errors of this size make on the Hann-tapered row, relative to the peak."""
    array = radar.array
    taper = window("hann", array.count, (array.count - 1) / 2) / array.multiplicity
    weight = np.where(array.position >= 0, taper[array.position], 0.0)
    used = kept & (weight > 0.0)
    amplitude = np.log(10.0) / 20.0 * (level_db[used] - level_db[used].mean())
    variance = np.mean(np.radians(residual_deg[used]) ** 2) + np.mean(amplitude**2)
    power = variance * np.square(weight).sum() / weight.sum() ** 2 * np.log(array.count)
    return float(10.0 * np.log10(max(float(power), 1e-12)))


def residual_deg(gain: NDArray[np.complexfloating[Any]], shift: Float64, samples: int) -> Float64:
    """Departure of every mid-chirp phase from transmitter plus receiver."""
    middle = np.exp(1j * (np.angle(gain) - np.pi * shift * (samples - 1) / samples))
    return np.asarray(np.degrees(np.angle(middle * phasor_fit(middle).conj())))


def repeatability_deg(mean: CaptureMean) -> float | None:
    """Rms phase difference over the channels between the two halves of the capture, common phase removed."""
    loops = mean.history.reshape(mean.frames * mean.loops, -1)
    if len(loops) == 1:
        return None
    middle = len(loops) // 2
    product = loops[:middle].mean(axis=0) * loops[middle:].mean(axis=0).conj()
    product = product[np.abs(product) > 0.0]
    turn = np.angle(product * product.mean().conj())
    return float(np.degrees(np.sqrt(np.mean(turn**2))))


def quality_lines(quality: Quality) -> list[str]:
    """The figures for people, each with what real boards show."""
    rows = [
        ("reflector over the floor", f"{quality.snr_db:.1f} dB a channel", "20 or more"),
        ("over the next echo searched", _known(quality.margin_db, "dB", "no other echo"), "6 or more"),
        ("phases: departure from TX + RX", f"{quality.separability_rms_deg:.1f} deg rms", "1 to 4"),
        ("phases: two halves differ by", _known(quality.repeatability_rms_deg, "deg rms", "one loop"), "below 1"),
        ("gain spread", f"{quality.gain_spread_db:.1f} dB", "1 to 5"),
        ("delay spread", f"{quality.delay_spread_bins:.2f} range bins", "below 1"),
        ("range offset, removed", f"{100 * quality.range_offset_m:+.1f} cm", "within a range bin"),
        ("error sidelobe, at most", f"{quality.sidelobe_db:.1f} dB", "below -25"),
        ("near over far half of range", f"{quality.image_rejection_db:+.1f} dB", "negative only for far reflectors"),
        ("codes at the rails", f"{100 * quality.saturated_share:.3g} %", "below 0.01"),
        ("echo turned", _known(quality.turn_deg, "deg", "one loop"), "below 30"),
    ]
    lines = [f"  {name:<32}{value:>20}   {usual}" for name, value, usual in rows]
    return [*lines, f"  repaired channels: {', '.join(quality.repaired) or 'none'}"]


def _known(value: float | None, unit: str, otherwise: str) -> str:
    return otherwise if value is None else f"{value:.1f} {unit}"
