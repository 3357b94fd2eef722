# SPDX-License-Identifier: Apache-2.0
"""Tables the heatmap kernels read, computed once in float64: windows, twiddles, row orders, focusing phasors."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edge.config import HeatmapSettings, WindowName
from edge.dsp.kernels_detect import DEFOCUS_STEP_PER_M
from edge.frames import Float32, Float64

Int64 = NDArray[np.int64]
Complex128 = NDArray[np.complex128]
ENVELOPE_STEPS = 16
"""Points a bin at which a response is searched for its sidelobes."""
DEFOCUS_LEVELS = 32
"""Left-over curvature up to 0.31 / m: a point at 0.8 m and 45 degrees."""


def taper(settings: HeatmapSettings, axis: Literal["range", "angle"], count: int, centre: float) -> Float64:
    """The window that the settings name for one axis, as ``window`` makes it."""
    name = settings.range_window if axis == "range" else settings.angle_window
    return window(name, count, centre, settings.taylor_nbar, settings.taylor_sidelobe_db)


def window(name: WindowName, count: int, centre: float, nbar: int = 4, sidelobe_db: float = 30.0) -> Float64:
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


def response_envelope(taper: Float64 | Complex128, bins: int, null: float = 0.0) -> Float64:
    """Bound of a point's amplitude in a bin, relative to its peak bin, by the distance between the two bins.

    The point stands anywhere within its peak bin; the bound is the largest response beyond the main lobe within 3/2
    bins of the distance, which reaches the top of the nearest sidelobe. It is 1 within the main lobe: what is there is
    a matter of resolution.

    Args:
        taper: [n] before the FFT; complex with the phases that focusing leaves.
        bins: FFT length.
        null: distance at which the main lobe ends, ``main_lobe`` of the flawless taper; 0: of this one.
    Returns:
        float64 [bins], periodic: distances d and bins - d are the same.
    """
    steps = ENVELOPE_STEPS
    response = np.abs(np.fft.fft(taper, steps * bins))
    response /= response.max()
    either = np.maximum(response, np.roll(response[::-1], 1))
    null = null or main_lobe(np.abs(taper), bins)
    middle, either = either[steps // 2], np.where(_distance(len(either)) < null * steps, 0.0, either)
    top = either.copy()
    for shift in range(1, 3 * steps // 2 + 1):
        np.maximum(top, np.maximum(np.roll(either, shift), np.roll(either, -shift)), out=top)
    distance = _distance(bins)
    return np.where(distance <= null, 1.0, np.minimum(top[steps * distance] / middle, 1.0))


def _distance(bins: int) -> Int64:
    """Distance of every bin from bin 0 on a periodic axis."""
    return np.minimum(np.arange(bins), bins - np.arange(bins))


def defocused_envelopes(weight: Float64, element: Int64, curvature_m: Float64, taper: Float64, bins: int) -> Float64:
    """Bounds in angle of a point whose wavefront's curvature focusing leaves in part.

    The two-way path of channel c of a point at (r, u) has q_c (1 - u^2) / (2 r) too much, q_c = a^2 + b^2; where it is
    focused for a point at boresight, q_c x is left with x = -u^2 / (2 r). Steps of q_c from one transmitter to the next
    raise sidelobes far from the peak, its bend those beside it.

    Args:
        weight: [slots, receivers] of every channel; element: int64, its place in the row, -1: none.
        curvature_m: [slots, receivers] q_c over the wavelength, without its mean and its slope along the row.
        taper: [elements], the row's.
        bins: FFT length.
    Returns:
        float64 [levels, bins], as ``response_envelope``, for |x| = level * DEFOCUS_STEP_PER_M.
    """
    null, inside, rows = main_lobe(taper, bins), element >= 0, []
    for level in range(DEFOCUS_LEVELS):
        channel = weight * np.exp(2j * np.pi * curvature_m * level * DEFOCUS_STEP_PER_M)
        row = np.zeros(len(taper), dtype=np.complex128)
        np.add.at(row, element[inside], channel[inside])
        rows.append(response_envelope(row, bins, null))
    return np.stack(rows)


def main_lobe(taper: Float64, bins: int) -> float:
    """Bins from the middle of a point's response to its first minimum."""
    response = np.abs(np.fft.fft(taper, ENVELOPE_STEPS * bins))[: ENVELOPE_STEPS * bins // 2]
    rising = np.diff(response) > 0.0
    null = int(np.argmax(rising)) if rising.any() else len(response)
    return null / ENVELOPE_STEPS


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


def centred_rows(points: int) -> Int64:
    """Row of a map with frequency 0 in its middle that each row after the in-place stages belongs to."""
    return (frequency_of_row(points) + points // 2) % points


def last_stage_order(points: int) -> Int64:
    """Groups of rows before the last stage, in the order of their frequency: the first row of each.

    The last stage (radix 4, or 2 for lengths 2 * 4^k) makes one group's rows p the frequencies k + p' * groups.
    """
    last = 4 if points.bit_length() % 2 else 2
    return np.argsort(frequency_of_row(points)[::last]).astype(np.int64) * last


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
