# SPDX-License-Identifier: Apache-2.0
"""CFAR kernels on power [angle, range], periodic in angle, cut at both ends of range.

The ring is a box of half widths ``train`` without the box of half widths ``guard``. Ranges below ``first`` belong to no
ring and are not tested. Sums only add: a strong cell inside the guard box never enters the arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import boolean, float32, int64, njit, types

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}
BLOCK = 32
"""Range cells that are looked at together for the rare one above the threshold."""


@njit(inline="always")
def _sum_along_range(power, a, first, guard, train, line, full, side, row):  # type: ignore[no-untyped-def]
    """Box and guardless sums along range of one angle row; ``line`` has ``train`` zeros at both ends."""
    ranges = power.shape[1]
    for r in range(first, ranges):
        line[train + r] = power[a, r]
    for r in range(ranges):
        outer = float32(0)
        for d in range(train - guard):
            outer += line[r + d] + line[r + train + guard + 1 + d]
        inner = float32(0)
        for d in range(2 * guard + 1):
            inner += line[r + train - guard + d]
        side[row, r] = outer
        full[row, r] = outer + inner


@cache
def ring_mean_kernel(guard_angle: int, train_angle: int, guard_range: int, train_range: int) -> Callable[..., Any]:
    """Compile the cell-averaging noise estimate for one ring.

    Args:
        guard_angle, train_angle, guard_range, train_range: half widths in cells.
    Returns:
        kernel(power [A, R], first, inverse_count [R], line [R + 2 train_range] zeroed, full, side
        [A + 2 train_angle, R], noise [A, R]): ``noise`` = mean of the ring's cells.
    """
    matrix = float32[:, ::1]

    @njit(types.void(matrix, int64, float32[::1], float32[::1], matrix, matrix, matrix), **OPTIONS)
    def kernel(power, first, inverse_count, line, full, side, noise):  # type: ignore[no-untyped-def]
        angles, ranges = power.shape
        for a in range(angles):
            _sum_along_range(power, a, first, guard_range, train_range, line, full, side, a + train_angle)
        for t in range(train_angle):
            full[t], side[t] = full[angles + t], side[angles + t]
            below = angles + train_angle + t
            full[below], side[below] = full[train_angle + t], side[train_angle + t]
        for a in range(angles):
            for r in range(ranges):
                total = float32(0)
                for d in range(train_angle - guard_angle):
                    total += full[a + d, r] + full[a + train_angle + guard_angle + 1 + d, r]
                for d in range(2 * guard_angle + 1):
                    total += side[a + train_angle - guard_angle + d, r]
                noise[a, r] = total * inverse_count[r]

    return kernel


@njit(types.void(float32[:, ::1], float32[:, ::1], float32[::1], int64, boolean[:, ::1]), **OPTIONS)
def mean_decisions(power, noise, factor, first, decided):  # type: ignore[no-untyped-def]
    """Decision of every cell: power > factor[range] * noise, before any local-maximum test; False below ``first``."""
    for a in range(power.shape[0]):
        for r in range(power.shape[1]):
            decided[a, r] = r >= first and power[a, r] > factor[r] * noise[a, r]


@njit(inline="always")
def _is_peak(power, a, r):  # type: ignore[no-untyped-def]
    """Largest of its 3 x 3 neighbourhood; of equal neighbours the first in raster order is the peak."""
    angles, ranges = power.shape
    centre = power[a, r]
    for da in range(-1, 2):
        row = (a + da + angles) % angles
        for dr in range(-1, 2):
            c = r + dr
            if (da != 0 or dr != 0) and 0 <= c < ranges:
                value = power[row, c]
                if value > centre or (value == centre and (row < a or (row == a and c < r))):
                    return False
    return True


@njit(int64(float32[:, ::1], float32[:, ::1], float32[::1], int64, int64[::1], float32[::1]), **OPTIONS)
def mean_peaks(power, noise, factor, first, cells, estimate):  # type: ignore[no-untyped-def]
    """Local maxima above the threshold of a noise map.

    Args:
        power, noise: [A, R].
        factor: [R].
        first: first tested range cell.
        cells: int64 [A R / 4], receives flat indices a R + r.
        estimate: float32 [A R / 4], receives the noise of each.
    Returns:
        Peaks found.
    """
    angles, ranges = power.shape
    count = 0
    for a in range(angles):
        for start in range(first, ranges, BLOCK):
            stop = min(start + BLOCK, ranges)
            above = 0
            for r in range(start, stop):
                above += power[a, r] > factor[r] * noise[a, r]
            if above == 0:
                continue
            for r in range(start, stop):
                if power[a, r] > factor[r] * noise[a, r] and _is_peak(power, a, r):
                    cells[count] = a * ranges + r
                    estimate[count] = noise[a, r]
                    count += 1
    return count


@njit(inline="always")
def _at_least(power, row, start, stop, bound, factor):  # type: ignore[no-untyped-def]
    """Cells of a row segment whose scaled power reaches ``bound``."""
    count = 0
    for r in range(start, stop):
        count += power[row, r] * factor >= bound
    return count


@njit(inline="always")
def _exceeds_rank(power, a, r, first, ring, factor, allowed):  # type: ignore[no-untyped-def]
    """True when at most ``allowed`` ring cells x have factor x >= power[a, r], that is power > factor x_(k)."""
    angles, ranges = power.shape
    bound = power[a, r]
    low, high = max(first, r - ring[3]), min(ranges, r + ring[3] + 1)
    left, right = max(first, min(r - ring[2], ranges)), min(ranges, r + ring[2] + 1)
    count = 0
    for da in range(-ring[1], ring[1] + 1):
        row = (a + da + angles) % angles
        if abs(da) > ring[0]:
            count += _at_least(power, row, low, high, bound, factor)
        else:
            count += _at_least(power, row, low, left, bound, factor) + _at_least(power, row, right, high, bound, factor)
        if count > allowed:
            return False
    return True


RING = types.UniTuple(int64, 4)  # type: ignore[no-untyped-call]
"""Half widths guard_angle, train_angle, guard_range, train_range."""


@njit(types.void(float32[:, ::1], int64, RING, float32[::1], int64[::1], boolean[:, ::1]), **OPTIONS)
def rank_decisions(power, first, ring, factor, allowed, decided):  # type: ignore[no-untyped-def]
    """Ordered-statistic decision of every cell: power > factor[range] x_(k), allowed[range] = N - k; exact, slow."""
    for a in range(power.shape[0]):
        for r in range(power.shape[1]):
            decided[a, r] = r >= first and _exceeds_rank(power, a, r, first, ring, factor[r], allowed[r])


@njit(inline="always")
def _select(values, count, rank):  # type: ignore[no-untyped-def]
    """The ``rank``-th smallest (1 = least) of the first ``count`` values, which are reordered (Hoare's selection)."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[rank - 1]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < rank - 1:
            low = i
        if i > rank - 1:
            high = j
    return values[rank - 1]


@njit(inline="always")
def _ordered_statistic(power, a, r, first, ring, allowed, scratch):  # type: ignore[no-untyped-def]
    """x_(k) of the ring around one cell."""
    angles, ranges = power.shape
    count = 0
    for da in range(-ring[1], ring[1] + 1):
        row = (a + da + angles) % angles
        for c in range(max(first, r - ring[3]), min(ranges, r + ring[3] + 1)):
            if abs(da) > ring[0] or abs(c - r) > ring[2]:
                scratch[count] = power[row, c]
                count += 1
    return _select(scratch, count, count - allowed)


@njit(
    int64(float32[:, ::1], int64, RING, float32[::1], int64[::1], float32[::1], float32[::1], int64[::1], float32[::1]),
    **OPTIONS,
)
def rank_peaks(power, first, ring, factor, allowed, peak, scratch, cells, estimate):  # type: ignore[no-untyped-def]
    """Local maxima that the ordered-statistic test accepts; exact.

    Args:
        power: [A, R].
        first: first tested range cell.
        ring: half widths.
        factor: float32 [R].
        allowed: int64 [R], N - k.
        peak: float32 [R], scratch of the local-maximum test.
        scratch: float32 [cells of the ring].
        cells, estimate: as in ``mean_peaks``; the noise is x_(k).
    Returns:
        Peaks found.
    """
    angles, ranges = power.shape
    count = 0
    for a in range(angles):
        above, below = (a + angles - 1) % angles, (a + 1) % angles
        for r in range(1, ranges - 1):
            side = max(max(power[a, r - 1], power[a, r + 1]), max(power[above, r], power[below, r]))
            peak[r] = float32(power[a, r] >= side)
        peak[0], peak[ranges - 1] = float32(1), float32(1)
        for r in range(first, ranges):
            if (
                peak[r] != 0
                and _is_peak(power, a, r)
                and _exceeds_rank(power, a, r, first, ring, factor[r], allowed[r])
            ):
                cells[count] = a * ranges + r
                estimate[count] = _ordered_statistic(power, a, r, first, ring, allowed[r], scratch)
                count += 1
    return count
