# SPDX-License-Identifier: Apache-2.0
"""Tables the heatmap kernels read, computed once in float64: windows, twiddles, row orders, focusing phasors."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edge.config import HeatmapSettings, WindowName
from edge.frames import Float32, Float64

Int64 = NDArray[np.int64]
Complex128 = NDArray[np.complex128]
ENVELOPE_STEPS = 16
"""Points a bin at which a response is searched for its sidelobes."""


def taper(settings: HeatmapSettings, axis: Literal["range", "angle"], count: int, centre: float) -> Float64:
    """The window that the settings name for one axis, as ``window`` makes it."""
    name = settings.range_window if axis == "range" else settings.angle_window
    return window(name, count, centre, settings.taylor_nbar, settings.taylor_sidelobe_db)


def window(name: WindowName, count: int, centre: float, nbar: int = 5, sidelobe_db: float = 35.0) -> Float64:
    """Taper of ``count`` samples, symmetric about index ``centre``; the period of Hann and Taylor is ``count``.

    Args:
        name: "rectangular", "hann" (Harris 1978, eq. 27) or "taylor" (Taylor 1955; Carrara et al. 1995, app. D.2).
        count: samples.
        centre: count / 2 for the range window (where the architecture counts t_n from), (count - 1) / 2 for the array.
        nbar, sidelobe_db: of the Taylor window: sidelobes kept level, and how far below the peak.
    Returns:
        float64 [count], largest value about 1.
    """
    if name == "rectangular":
        return np.ones(count)
    turn = 2.0 * np.pi * (np.arange(count) - centre) / count
    if name == "hann":
        return 0.5 + 0.5 * np.cos(turn)
    coefficients = taylor_coefficients(nbar, sidelobe_db)
    order = np.arange(1, nbar)
    return np.asarray((1.0 + 2.0 * np.cos(np.outer(turn, order)) @ coefficients) / (1.0 + 2.0 * coefficients.sum()))


def taylor_coefficients(nbar: int, sidelobe_db: float) -> Float64:
    """F_m, m = 1..nbar - 1, of w(x) = 1 + 2 sum_m F_m cos(2 pi m x), |x| <= 1/2 (Carrara et al. 1995, app. D.2).

    F_m = (-1)^(m+1) / 2 prod_{i < nbar} (1 - m^2 / s_i^2) / prod_{i < nbar, i != m} (1 - m^2 / i^2) with zeros moved to
    s_i^2 = s^2 (A^2 + (i - 1/2)^2), s^2 = nbar^2 / (A^2 + (nbar - 1/2)^2), A = arcosh(10^(sidelobe_db / 20)) / pi.
    """
    a2 = (np.arccosh(10.0 ** (sidelobe_db / 20.0)) / np.pi) ** 2
    i = np.arange(1, nbar, dtype=np.float64)
    zeros = nbar**2 / (a2 + (nbar - 0.5) ** 2) * (a2 + (i - 0.5) ** 2)
    m2 = np.square(i)[:, None]
    others = np.where(np.eye(nbar - 1, dtype=bool), 1.0, 1.0 - m2 / np.square(i))
    return np.asarray(-0.5 * (-1.0) ** i * np.prod(1.0 - m2 / zeros, axis=1) / np.prod(others, axis=1))


def response_envelope(taper: Float64, bins: int) -> Float64:
    """Bound of a point's amplitude in a bin, relative to its peak bin, by the distance between the two bins.

    The point stands anywhere within its peak bin, so that a distance of d bins is at least d - 1/2 in truth; the bound
    is the largest response from there on. It is 1 within the main lobe: what is there is a matter of resolution.

    Args:
        taper: [n] before the FFT.
        bins: FFT length.
    Returns:
        float64 [bins], periodic: distance d and bins - d are the same.
    """
    response = np.abs(np.fft.fft(taper, ENVELOPE_STEPS * bins))[: ENVELOPE_STEPS * bins // 2 + 1]
    response /= response[0]
    rising = np.diff(response) > 0.0
    null = int(np.argmax(rising)) if rising.any() else len(response) - 1
    bound = np.maximum.accumulate(response[::-1])[::-1]
    bound = np.where(np.arange(len(bound)) < null, 1.0, np.minimum(bound / response[ENVELOPE_STEPS // 2], 1.0))
    distance = np.minimum(np.arange(bins), bins - np.arange(bins))
    return np.asarray(bound[np.maximum(ENVELOPE_STEPS * distance - ENVELOPE_STEPS // 2, 0)])


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
