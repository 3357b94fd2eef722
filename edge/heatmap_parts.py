# SPDX-License-Identifier: Apache-2.0
"""What a heatmap carries beside its power: a point's look, every Doppler bin, the motion it was steered with."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PointResponse:
    """What a point target looks like in a heatmap: lets a detector undo interpolation and near-field errors.

    Args:
        range_fit, angle_fit: float64 [10] each, coefficients of the sub-bin corrections (edge/dsp/interpolation.py).
        gain: float32 [angle], factor that compensates the antenna gain in the heatmap's power.
        range_bias_m2: the two-way path's mean curvature; a target at (r, u) appears at r + bias (1 - u^2) / r.
        cosine_bias_m: slope of the curvature along the row, which tilts the wavefront.
        focus_inverse_m: 1 / (2 range) whose curvature is compensated everywhere; negative: each range has its own.
        range_correlation, angle_correlation: complex128 [range], [angle], correlation of the noise of two bins by
            their distance (edge/dsp/effective_cells.py); None: bins are independent.
        range_envelope, angle_envelope: float64 [range], [level, angle], largest amplitude of a point about this
            distance in bins away from its peak (edge/dsp/tables.py); level: what focusing leaves of the wavefront's
            curvature, |(1 - u^2) / (2 r) - focus|, in steps of 0.01 / m; None: unknown.
        range_spread_bins: half the spread of the row's ranges to a target at direction cosine 1.
        usable_range_m: what the IF filter passes; echoes that seem to be farther are something else.
    """

    range_fit: Float64
    angle_fit: Float64
    gain: Float32
    range_bias_m2: float
    cosine_bias_m: float
    focus_inverse_m: float
    range_correlation: NDArray[np.complex128] | None = None
    angle_correlation: NDArray[np.complex128] | None = None
    range_envelope: Float64 | None = None
    angle_envelope: Float64 | None = None
    range_spread_bins: float = 0.0
    usable_range_m: float = math.inf


@dataclass(frozen=True, slots=True)
class DopplerMaps:
    """Range-angle power of every Doppler bin of one burst.

    Args:
        power: float32 [Doppler, angle, range], as in Heatmap; the imager's buffer.
        fold: int8 [Doppler, range], multiple of ``interval_m_s`` plus ``most_folds``.
        speed_m_s: float64 [Doppler], radial speed of each bin without folds, positive away, ascending.
        interval_m_s: speeds that differ by this look alike from loop to loop.
        most_folds: largest multiple of the interval.
        delay_s: middle of the burst after its first chirp.
    """

    power: Float32
    fold: NDArray[np.int8]
    speed_m_s: Float64
    interval_m_s: float
    most_folds: int
    delay_s: float


@dataclass(frozen=True, slots=True)
class BurstMotion:
    """The rig's motion that a heatmap was steered with: what it shows is the scene at the middle of the burst.

    Args:
        delay_s: that instant after the first chirp.
        forward_m_s, along_m_s: speeds of the rig along boresight and along the radar's array.
    """

    delay_s: float
    forward_m_s: float
    along_m_s: float
