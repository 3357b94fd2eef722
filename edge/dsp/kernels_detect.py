# SPDX-License-Identifier: Apache-2.0
"""Kernels that turn detected cells into detections: the strongest, sub-bin positions, near-field corrections."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, float64, int64, njit, types

from edge.kernels_arrays import Float32, Float64, Int64

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}
LARGEST_PARABOLA = 0.5
DEFOCUS_STEP_PER_M = 0.01
"""Left-over curvature from one level of the bounds in angle to the next."""


@njit(inline="always")
def _sink(value: Float32, index: Int64, root: int, size: int) -> None:
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
def strongest(power: Float32, cells: Int64, count: int, most: int, value: Float32, index: Int64) -> int:
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
def _is_explained(
    value: Float32,
    place: Int64,
    count: int,
    n: int,
    margin: float,
    largest: float,
    range_bound: Float32,
    angle_bound: Float32,
) -> bool:
    """Whether the sidelobes of one of ``count`` peaks bound peak n from above, see ``drop_sidelobes``."""
    a, r = place[0, n], place[1, n]
    for m in range(count):
        if value[n] >= value[m] * (largest * margin):
            continue
        away = max(abs(r - place[1, m]) - place[3, m], 0)
        range_share, angle_share = range_bound[away], angle_bound[place[2, m], abs(a - place[0, m])]
        within = range_share == float32(1) and angle_share == float32(1)
        if not within and value[n] < margin * value[m] * range_share * angle_share:
            return True
    return False


@njit(inline="always")
def _defocus_level(range_m: float, cosine: float, focus_inverse_m: float, levels: int) -> int:
    """Row of the angle bounds for a point at (range, cosine)."""
    inverse = 0.5 / max(range_m, 0.05)
    focused = focus_inverse_m if focus_inverse_m >= 0.0 else inverse
    left = abs((1.0 - min(cosine * cosine, 1.0)) * inverse - focused)
    return min(int64(np.ceil(left / DEFOCUS_STEP_PER_M)), levels - 1)  # type: ignore[call-overload, no-any-return]


SIDELOBE_ARGUMENTS = (float32[:, ::1], float32[::1], int64[::1], int64[::1], int64, float64[::1], float32, float32)


@njit(int64(*SIDELOBE_ARGUMENTS, float32[::1], float32[:, ::1], float32[::1], int64[:, ::1]), **OPTIONS)
def drop_sidelobes(
    power: Float32,
    pattern: Float32,
    cells: Int64,
    index: Int64,
    count: int,
    axes: Float64,
    margin: float,
    largest: float,
    range_bound: Float32,
    angle_bound: Float32,
    value: Float32,
    place: Int64,
) -> int:
    """Leave out peaks that the windows' sidelobes of another peak explain.

    Peak n goes when some peak m has P_n < margin P_m B_r(dr) B_a(da), powers as received. Within the main lobe of both
    axes nothing goes: what is there is a matter of resolution.

    Args:
        power, pattern: [A, R], [A].
        cells: peak n is cell ``cells[index[n]]``.
        index: int64, keeps its order and closes its gaps.
        count: peaks.
        axes: as in ``refine``.
        margin: power ratio.
        largest: the largest bound of either axis that is not 1; none of a peak's sidelobes is stronger.
        range_bound, angle_bound: float32 [R], [level, A], bound of a point's power by distance in bins, 1 in the main
            lobe; the levels are those of the curvature that focusing leaves (edge/dsp/tables.py).
        value: float32 [count or more], work space for the received powers.
        place: int64 [4, count or more], work space for row, column, level and spread of every peak.
    Returns:
        Peaks kept.
    """
    ranges = power.shape[1]
    for n in range(count):
        a, r = cells[index[n]] // ranges, cells[index[n]] % ranges
        place[0, n], place[1, n] = a, r
        value[n], cosine = power[a, r] * pattern[a], axes[2] + a * axes[3]
        place[2, n] = _defocus_level(axes[0] + r * axes[1], cosine, axes[6], len(angle_bound))
        place[3, n] = int64(np.ceil(axes[7] * min(abs(cosine), 1.0)))
    kept = 0
    for n in range(count):
        if not _is_explained(value, place, count, n, margin, largest, range_bound, angle_bound):
            index[kept] = index[n]
            kept += 1
    return kept


@njit(inline="always")
def _offset(minus: float, centre: float, plus: float, spread: float, fit: Float64) -> tuple[float, float]:
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
def _amplitude(power: Float32, pattern: Float32, a: int, r: int) -> float:
    """Received amplitude of a cell; r outside the map gives 0."""
    angles, ranges = power.shape
    row = (a + angles) % angles
    if r < 0 or r >= ranges:
        return 0.0
    return np.sqrt(float64(power[row, r]) * float64(pattern[row]))  # type: ignore[no-any-return]


@njit(inline="always")
def _pattern_at(pattern: Float32, a: int, offset: float) -> float:
    """The antenna pattern ``offset`` rows beside row ``a``, linear between rows."""
    angles = len(pattern)
    beside = (a + 1) % angles if offset > 0.0 else (a + angles - 1) % angles
    share = abs(offset)
    return (1.0 - share) * float64(pattern[a]) + share * float64(pattern[beside])  # type: ignore[no-any-return]


FIT = float64[::1]
"""Coefficients of one axis (edge/dsp/interpolation.py)."""


@njit(
    types.void(
        *(float32[:, ::1], float32[::1], int64[::1], int64[::1], float32[::1], int64),
        *(FIT, FIT, FIT, float32[:, ::1]),
    ),
    **OPTIONS,
)
def refine(
    power: Float32,
    pattern: Float32,
    cells: Int64,
    index: Int64,
    estimate: Float32,
    count: int,
    range_fit: Float64,
    angle_fit: Float64,
    axes: Float64,
    out: Float32,
) -> None:
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
        axes: float64 [8]: range of bin 0, range bin, cosine of row 0, cosine step, range_bias_m2, cosine_bias_m,
            focus_inverse_m, spread (of ``drop_sidelobes``).
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
