# SPDX-License-Identifier: Apache-2.0
"""Kernels that turn detected cells into detections: the strongest, sub-bin positions, near-field corrections."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, float64, int64, njit, types

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}
LARGEST_PARABOLA = 0.5


@njit(inline="always")
def _sink(value, index, root, size):  # type: ignore[no-untyped-def]
    """Restore the min-heap below ``root``."""
    while 2 * root + 1 < size:
        child = 2 * root + 1
        if child + 1 < size and value[child + 1] < value[child]:
            child += 1
        if value[root] <= value[child]:
            return
        value[root], value[child] = value[child], value[root]
        index[root], index[child] = index[child], index[root]
        root = child


@njit(int64(float32[:, ::1], int64[::1], int64, int64, float32[::1], int64[::1]), **OPTIONS)
def strongest(power, cells, count, most, value, index):  # type: ignore[no-untyped-def]
    """Pick the strongest peaks, strongest first (heap selection, n log most).

    Args:
        power: [A, R].
        cells: int64, flat indices of ``count`` peaks.
        most: peaks wanted.
        value: float32 [most], receives their powers, descending.
        index: int64 [most], receives their places in ``cells``.
    Returns:
        Peaks picked: min(count, most).
    """
    ranges = power.shape[1]
    size = min(count, most)
    for n in range(size):
        value[n], index[n] = power[cells[n] // ranges, cells[n] % ranges], n
    for root in range(size // 2 - 1, -1, -1):
        _sink(value, index, root, size)
    for n in range(size, count):
        candidate = power[cells[n] // ranges, cells[n] % ranges]
        if candidate > value[0]:
            value[0], index[0] = candidate, n
            _sink(value, index, 0, size)
    for end in range(size - 1, 0, -1):
        value[0], value[end] = value[end], value[0]
        index[0], index[end] = index[end], index[0]
        _sink(value, index, 0, end)
    return size


@njit(inline="always")
def _offset(minus, centre, plus, spread, fit):  # type: ignore[no-untyped-def]
    """Sub-bin offset, within half a bin, and the factor from the centre amplitude to the peak's."""
    bend = 2.0 * centre - minus - plus
    if fit[9] > 0.0:
        larger = max(plus, minus)
        p = larger / (centre + larger) if plus > minus else -larger / (centre + larger)
    else:
        p = 0.0 if bend <= 0.0 else 0.5 * (plus - minus) / bend
    p = min(max(p, -LARGEST_PARABOLA), LARGEST_PARABOLA)
    p2 = p * p
    d = p + p * (1.0 - 4.0 * p2) * (fit[0] + fit[1] * p2 + spread * (fit[2] + fit[3] * p2))
    d2 = d * d
    return d, fit[4] + d2 * (fit[5] + d2 * fit[6]) + spread * (fit[7] + fit[8] * d2)


@njit(inline="always")
def _amplitude(power, pattern, a, r):  # type: ignore[no-untyped-def]
    """Received amplitude of a cell; r outside the map gives 0."""
    angles, ranges = power.shape
    row = (a + angles) % angles
    if r < 0 or r >= ranges:
        return 0.0
    return np.sqrt(float64(power[row, r]) * float64(pattern[row]))


@njit(inline="always")
def _pattern_at(pattern, a, offset):  # type: ignore[no-untyped-def]
    """The antenna pattern ``offset`` rows beside row ``a``, linear between rows."""
    angles = len(pattern)
    beside = (a + 1) % angles if offset > 0.0 else (a + angles - 1) % angles
    share = abs(offset)
    return (1.0 - share) * float64(pattern[a]) + share * float64(pattern[beside])


FIT = float64[::1]
"""Coefficients of one axis (edge/dsp/interpolation.py)."""


@njit(
    types.void(
        *(float32[:, ::1], float32[::1], int64[::1], int64[::1], float32[::1], int64),
        *(FIT, FIT, FIT, float32[:, ::1]),
    ),
    **OPTIONS,
)
def refine(power, pattern, cells, index, estimate, count, range_fit, angle_fit, axes, out):  # type: ignore[no-untyped-def]
    """Positions and powers of detected cells: interpolated as received, then compensated at their own direction.

    The compensation grows with the angle, so that it shifts the peak of a wide lobe outwards: by more than half a bin
    with eight elements.

    Args:
        power: [A, R], compensated for the antenna pattern.
        pattern: float32 [A], received power = power * pattern.
        cells, index: peak n is cell ``cells[index[n]]``.
        estimate: received noise power, by place in ``cells``.
        count: peaks.
        range_fit, angle_fit: [10], coefficients of the axes.
        axes: float64 [7]: range of bin 0, range bin, cosine of row 0, cosine step, range_bias_m2, cosine_bias_m,
            focus_inverse_m.
        out: float32 [4, count or more], receives range m, direction cosine, power dB, SNR dB.
    """
    angles, ranges = power.shape
    period = angles * axes[3]
    for n in range(count):
        cell = cells[index[n]]
        a, r = cell // ranges, cell % ranges
        cosine = axes[2] + a * axes[3]
        spread = min(cosine * cosine, 1.0)
        centre = _amplitude(power, pattern, a, r)
        dr, height_r = _offset(
            _amplitude(power, pattern, a, r - 1), centre, _amplitude(power, pattern, a, r + 1), spread, range_fit
        )
        da, height_a = _offset(
            _amplitude(power, pattern, a - 1, r), centre, _amplitude(power, pattern, a + 1, r), 0.0, angle_fit
        )
        range_m, cosine = axes[0] + (r + dr) * axes[1], cosine + da * axes[3]
        across = max(1.0 - cosine * cosine, 0.0)
        inverse = 1.0 / max(range_m, axes[1])
        focused = axes[6] if axes[6] >= 0.0 else 0.5 * inverse
        cosine += axes[5] * (0.5 * across * inverse - focused)
        cosine -= period * np.floor(cosine / period + 0.5)
        amplitude = centre * height_r * height_a
        received = amplitude * amplitude
        out[0, n] = range_m - axes[4] * across * inverse
        out[1, n] = cosine
        out[2, n] = 10.0 * np.log10(received / _pattern_at(pattern, a, da))
        out[3, n] = 10.0 * np.log10(received / float64(max(estimate[index[n]], float32(1e-30))))
