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
from edge.dsp.imager import RowGeometry
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
        margin_db: over the next echo of the search window; None: there is none.
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
    geometry = RowGeometry.of(radar)
    taper = window("hann", geometry.count, (geometry.count - 1) / 2)
    weight = geometry.channel_weight(taper)
    used = kept & (weight > 0.0)
    amplitude = np.log(10.0) / 20.0 * (level_db[used] - level_db[used].mean())
    variance = np.mean(np.radians(residual_deg[used]) ** 2) + np.mean(amplitude**2)
    power = variance * np.square(weight).sum() / weight.sum() ** 2 * np.log(geometry.count)
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
