# SPDX-License-Identifier: Apache-2.0
"""Tables the heatmap kernels read, computed once in float64: windows, twiddles, row orders, focusing phasors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.config import WindowName
from edge.frames import Float32, Float64

Int64 = NDArray[np.int64]
Complex128 = NDArray[np.complex128]


def window(name: WindowName, count: int, centre: float) -> Float64:
    """Taper of ``count`` samples, symmetric about index ``centre``; the Hann period is ``count``.

    Args:
        name: "rectangular" or "hann" (Harris 1978, eq. 27).
        count: samples.
        centre: count / 2 for the range window (where the architecture counts t_n from), (count - 1) / 2 for the array.
    Returns:
        float64 [count], largest value about 1.
    """
    if name == "rectangular":
        return np.ones(count)
    return 0.5 + 0.5 * np.cos(2.0 * np.pi * (np.arange(count) - centre) / count)


def next_power_of_two(count: int) -> int:
    """Smallest power of two that is at least ``count``."""
    return 1 << (count - 1).bit_length()


def stage_quarters(points: int) -> list[int]:
    """Quarter length of every radix-4 stage (decimation in frequency); lengths 2 * 4^k end in a radix-2 stage."""
    quarters, length = [], points
    while length >= 4:
        quarters.append(length // 4)
        length //= 4
    return quarters


def twiddles(points: int, sign: int, lanes: int) -> Float32:
    """Twiddles exp(sign j 2 pi p m / n) of all stages, n the stage's length, m = 1, 2, 3, p < n / 4.

    Args:
        points: FFT length.
        sign: of the exponent.
        lanes: 0: six scalars (re, im of m = 1, 2, 3) per p; else six planes with ``lanes`` equal values per p.
    Returns:
        float32, flat, stages one after the other.
    """
    parts = []
    for quarter in stage_quarters(points):
        p = np.arange(quarter)
        phasors = np.exp(sign * 2j * np.pi * np.outer((1, 2, 3), p) / (4 * quarter))
        planes = np.stack((phasors.real, phasors.imag), axis=1).reshape(6, quarter)
        parts.append(planes.T.ravel() if lanes == 0 else np.repeat(planes, lanes, axis=1).ravel())
    return np.concatenate(parts).astype(np.float32)


def frequency_of_row(points: int) -> Int64:
    """Frequency index that stands in each row after the in-place stages (digit reversal, radix 4 first)."""
    rows = np.arange(points)
    frequency = np.zeros(points, dtype=np.int64)
    weight = 1
    for quarter in stage_quarters(points):
        frequency += weight * ((rows // quarter) % 4)
        weight *= 4
    if weight < points:
        frequency += weight * (rows % 2)
    return frequency


def curvature_m(range_m: Float64 | float, transmit_m: Float64, receive_m: Float64) -> Float64:
    """Two-way path beyond 2 r of a boresight point at range r, exact: sqrt(r^2 + a^2) + sqrt(r^2 + b^2) - 2 r.

    Args:
        range_m: ranges above 0; infinite gives 0.
        transmit_m, receive_m: offsets of the antennas from the phase centre; all three broadcast.
    Returns:
        float64 metres.
    """
    r = np.asarray(range_m, dtype=np.float64)
    a2, b2 = np.square(transmit_m), np.square(receive_m)
    return np.asarray(a2 / (np.sqrt(r * r + a2) + r) + b2 / (np.sqrt(r * r + b2) + r))
