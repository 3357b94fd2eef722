# SPDX-License-Identifier: Apache-2.0
"""CFAR kernels by an ordered statistic of a ring on power [angle, range]; axes and ring as in kernels_cfar.py.

Whether a cell exceeds a multiple of the k-th smallest of N cells is known by counting those that reach the cell's power
over the factor, without sorting. The statistic itself is only made for the detections that are left in the end.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import boolean, float32, int32, int64, njit, types, uint64

from edge.dsp.kernels_cfar import MATRIX, OPTIONS, is_peak
from edge.kernels_arrays import Bool, Float32, Int32, Int64

INFINITE = np.int32(0x7F800000)
"""Bits of the float32 infinity."""
SELECTED = 64
"""Values are ranked in whole groups of so many, for which vectors have no remainder; infinities fill the last one."""


@njit(inline="always")
def _pad(power: Float32, pattern: Float32, first: int, train_angle: int, train: int, padded: Float32) -> None:
    """Copy the tested ranges, as received, into ``padded`` [A + 2 train_angle, R + 2 train], closed in angle; its other
    cells hold -1 and count nowhere.
    """
    angles, ranges = power.shape
    begin = uint64(first)
    for a in range(angles):
        for d in range(ranges - first):
            padded[train_angle + a, begin + uint64(train + d)] = power[a, begin + uint64(d)] * pattern[a]
    for t in range(train_angle):
        for d in range(padded.shape[1]):  # a copy of a row as a whole would compile a second for its error message
            padded[t, d] = padded[angles + t, d]
            padded[angles + train_angle + t, d] = padded[train_angle + t, d]


@njit(inline="always")
def _reaching(
    padded: Float32,
    row: int | np.uint64,
    column: int | np.uint64,
    rows: int,
    columns: int,
    factor: np.float32,
    bound: np.float32,
) -> np.float32:
    """Cells x of a box that have factor x >= bound; the inner loop goes over rows, the outer one is vectorised."""
    count = float32(0)
    row, column = uint64(row), uint64(column)
    for d in range(columns):
        for t in range(rows):
            count += float32(1) if padded[row + uint64(t), column + uint64(d)] * factor >= bound else float32(0)
    return count


@njit(inline="always")
def _exceeds_rank(
    padded: Float32,
    a: int,
    r: int,
    guard_angle: int,
    train_angle: int,
    guard: int,
    train: int,
    factor: np.float32,
    allowed: int,
) -> bool | np.bool_:
    """True when at most ``allowed`` ring cells x have factor x >= the cell's power, that is power > factor x_(k)."""
    bound = padded[a + train_angle, r + train]
    beside, behind = train_angle - guard_angle, train_angle + guard_angle + 1
    # An even number of columns first: the odd one out would be counted cell by cell.
    count = _reaching(padded, a, r, beside, 2 * train, factor, bound)
    count += _reaching(padded, a + behind, r, beside, 2 * train, factor, bound)
    if count > allowed:
        return False
    count += _reaching(padded, a, r + 2 * train, beside, 1, factor, bound)
    count += _reaching(padded, a + behind, r + 2 * train, beside, 1, factor, bound)
    count += _reaching(padded, a + beside, r, 2 * guard_angle + 1, train - guard, factor, bound)
    count += _reaching(padded, a + beside, r + train + guard + 1, 2 * guard_angle + 1, train - guard, factor, bound)
    return count <= allowed


@njit(inline="always")
def _select(bits: Int32, count: int, rank: int) -> int:
    """Place of the ``rank``-th smallest (1 = least) of the first ``count`` values, which are given as bit patterns.

    Floats that are not negative are ordered as their patterns read as integers, and -1 stands below all; a bisection
    with vectorised counting finds the pattern without a branch per value.
    """
    low, high = int32(0), INFINITE
    while low < high:
        middle = int32(low + ((high - low) >> 1))
        below = float32(0)
        for n in range(count):
            below += float32(1) if bits[n] <= middle else float32(0)
        if below >= rank:
            high = middle
        else:
            low = int32(middle + 1)
    n = 0
    while bits[n] != low:
        n += 1
    return n


@njit(inline="always")
def _ordered_statistic(
    padded: Float32,
    a: int,
    r: int,
    guard_angle: int,
    train_angle: int,
    guard: int,
    train: int,
    allowed: int,
    scratch: Float32,
    bits: Int32,
) -> np.float32:
    """x_(k) of the ring around one cell."""
    count, side = 0, train - guard
    for t in range(2 * train_angle + 1):
        if abs(t - train_angle) > guard_angle:
            for d in range(2 * train + 1):
                scratch[count + d] = padded[a + t, r + d]
            count += 2 * train + 1
        else:
            for d in range(side):
                scratch[count + d] = padded[a + t, r + d]
                scratch[count + side + d] = padded[a + t, r + train + guard + 1 + d]
            count += 2 * side
    whole = -(-count // SELECTED) * SELECTED
    for n in range(count, whole):
        bits[n] = INFINITE
    return scratch[_select(bits, whole, count - allowed)]  # type: ignore[no-any-return]


@njit(inline="always")
def _mark_peaks(power: Float32, pattern: Float32, a: int, mark: Float32) -> None:
    """For every range cell of one row: 2 received more than all 8 neighbours, 1 as much as the largest, 0 less."""
    angles, ranges = power.shape
    above, below = (a + angles - 1) % angles, (a + 1) % angles
    up, here, down = pattern[above], pattern[a], pattern[below]
    for r in range(1, ranges - 1):
        higher = max(max(power[above, r - 1], power[above, r]), power[above, r + 1]) * up
        lower = max(max(power[below, r - 1], power[below, r]), power[below, r + 1]) * down
        largest = max(max(higher, lower), max(power[a, r - 1], power[a, r + 1]) * here)
        centre = power[a, r] * here
        mark[r] = float32(2) if centre > largest else (float32(1) if centre == largest else float32(0))
    mark[0], mark[ranges - 1] = float32(1), float32(1)


@cache
def rank_peaks_kernel(guard_angle: int, train_angle: int, guard_range: int, train_range: int) -> Callable[..., Any]:
    """Compile the search for local maxima that the ordered-statistic test accepts; exact.

    Args:
        guard_angle, train_angle, guard_range, train_range: half widths in cells.
    Returns:
        kernel(power [A, R], pattern [A], first, factor float32 [R], allowed int64 [R] = N - k, padded
        [A + 2 train_angle, R + 2 train_range or more] of -1, mark float32 [R], places int64 [R], cells) -> peaks
        found; cells as in ``mean_peaks``.
    """

    @njit(
        int64(MATRIX, float32[::1], int64, float32[::1], int64[::1], MATRIX, float32[::1], int64[::1], int64[::1]),
        **OPTIONS,
    )
    def kernel(
        power: Float32,
        pattern: Float32,
        first: int,
        factor: Float32,
        allowed: Int64,
        padded: Float32,
        mark: Float32,
        places: Int64,
        cells: Int64,
    ) -> int:
        angles, ranges = power.shape
        count = 0
        _pad(power, pattern, first, train_angle, train_range, padded)
        for a in range(angles):
            _mark_peaks(power, pattern, a, mark)
            marked = 0  # Places first, without a branch: which cells are maxima cannot be predicted.
            for r in range(first, ranges):
                places[marked] = r
                marked += int64(mark[r] > float32(0))
            for n in range(marked):
                r = places[n]
                if mark[r] == float32(1) and not is_peak(power, pattern, a, r):
                    continue
                if _exceeds_rank(
                    padded, a, r, guard_angle, train_angle, guard_range, train_range, factor[r], allowed[r]
                ):
                    cells[count] = a * ranges + r
                    count += 1
        return count

    return kernel


@cache
def rank_noise_kernel(guard_angle: int, train_angle: int, guard_range: int, train_range: int) -> Callable[..., Any]:
    """Compile the ordered statistic around chosen peaks.

    Args:
        guard_angle, train_angle, guard_range, train_range: half widths in cells.
    Returns:
        kernel(padded as ``rank_peaks_kernel``'s left it, ranges R, allowed [R], cells, index int64, count, scratch
        float32 [cells of the box, and up to a multiple of 64], bits (scratch as int32), estimate): estimate[i] = x_(k)
        around cells[i] for the first ``count`` i of ``index``.
    """
    signature = types.void(MATRIX, int64, *3 * (int64[::1],), int64, float32[::1], int32[::1], float32[::1])

    @njit(signature, **OPTIONS)
    def kernel(
        padded: Float32,
        ranges: int,
        allowed: Int64,
        cells: Int64,
        index: Int64,
        count: int,
        scratch: Float32,
        bits: Int32,
        estimate: Float32,
    ) -> None:
        for n in range(count):
            a, r = cells[index[n]] // ranges, cells[index[n]] % ranges
            estimate[index[n]] = _ordered_statistic(
                padded, a, r, guard_angle, train_angle, guard_range, train_range, allowed[r], scratch, bits
            )

    return kernel


@cache
def rank_decisions_kernel(guard_angle: int, train_angle: int, guard_range: int, train_range: int) -> Callable[..., Any]:
    """Compile the ordered-statistic decision of every cell, before any local-maximum test; exact, slow.

    Args:
        guard_angle, train_angle, guard_range, train_range: half widths in cells.
    Returns:
        kernel(power [A, R], pattern [A], first, factor [R], allowed [R], padded, decided bool [A, R]).
    """
    signature = types.void(MATRIX, float32[::1], int64, float32[::1], int64[::1], MATRIX, boolean[:, ::1])

    @njit(signature, **OPTIONS)
    def kernel(
        power: Float32, pattern: Float32, first: int, factor: Float32, allowed: Int64, padded: Float32, decided: Bool
    ) -> None:
        _pad(power, pattern, first, train_angle, train_range, padded)
        for a in range(power.shape[0]):
            for r in range(first, power.shape[1]):
                decided[a, r] = _exceeds_rank(
                    padded, a, r, guard_angle, train_angle, guard_range, train_range, factor[r], allowed[r]
                )

    return kernel
