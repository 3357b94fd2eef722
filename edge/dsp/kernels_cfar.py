# SPDX-License-Identifier: Apache-2.0
"""CFAR kernels by means of a ring on power [angle, range], periodic in angle, cut at both ends of range.

Unsigned indices spare the inner loops Numba's wrap-around of negative ones, which would keep them from vectorising.
The ring is a box of half widths ``train`` without the box of half widths ``guard``. Ranges below ``first`` belong to no
ring and are not tested. Sums only add: a strong cell inside the guard box never enters the arithmetic.

Everything is decided on the power as received, power * pattern: the compensation of the antenna pattern would tilt the
noise of a ring.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from numba import boolean, float32, int64, njit, types, uint64

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}


MATRIX = float32[:, ::1]
MEAN_ARGUMENTS = (MATRIX, float32[::1], int64, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX)
ROWS = 4
"""Angle rows whose sums are made together."""
SPARE_ROWS = ROWS - 1
"""Rows that planes have beyond the angles, so that the last group of rows is a whole one."""
BLOCK = 32
"""Range cells of which one must exceed the threshold before any of them is looked at."""


@njit(inline="always")
def _load(power, pattern, a, first, train, line):  # type: ignore[no-untyped-def]
    """One angle row as received into ``line[0]``, which has ``train`` zeros at both ends; zeros below ``first``."""
    ranges, level = power.shape[1], pattern[a]
    for r in range(ranges):
        line[0, train + r] = power[a, r] * level
    for r in range(first):
        line[0, train + r] = float32(0)


@njit(inline="always")
def _close(planes, angles, train_angle):  # type: ignore[no-untyped-def]
    """Repeat ``train_angle`` rows of the periodic axis at either end of a plane [angles + 2 train_angle, ...]."""
    for t in range(train_angle):
        planes[t] = planes[angles + t]
        planes[angles + train_angle + t] = planes[train_angle + t]


@njit(inline="always")
def _sum_of_pairs(cells, pairs, x, width):  # type: ignore[no-untyped-def]
    """Sum of ``width`` cells from ``x`` on; ``pairs[x]`` = cells[x] + cells[x + 1]."""
    total = float32(0)
    for d in range(width // 2):
        total += pairs[x + 2 * d]
    if width % 2 == 1:
        total += cells[x + width - 1]
    return total


@njit(inline="always")
def _sums_of_rows(plane, a, r, width):  # type: ignore[no-untyped-def]
    """Sums over ``width`` rows of one column, from row a, a + 1, a + 2 and a + 3 on; what they share is added once."""
    shared = float32(0)
    if width < ROWS:
        one, two, three, four = shared, shared, shared, shared
        for d in range(width):
            one += plane[a + d, r]
            two += plane[a + 1 + d, r]
            three += plane[a + 2 + d, r]
            four += plane[a + 3 + d, r]
        return one, two, three, four
    for d in range(ROWS - 1, width):
        shared += plane[a + d, r]
    before = plane[a + 1, r] + plane[a + 2, r]
    behind = plane[a + width, r] + plane[a + width + 1, r]
    one, two = shared + (plane[a, r] + before), shared + (before + plane[a + width, r])
    three, four = shared + (plane[a + 2, r] + behind), shared + (behind + plane[a + width + 2, r])
    return one, two, three, four


@cache
def ring_mean_kernel(guard_angle: int, train_angle: int, guard_range: int, train_range: int) -> Callable[..., Any]:
    """Compile the cell-averaging noise estimate for one ring.

    Args:
        guard_angle, train_angle, guard_range, train_range: half widths in cells.
    Returns:
        kernel(power [A, R], pattern [A], first, inverse_count [2, R], floor [2, R], line [4, R + 2 train_range or more]
        zeroed, full, side [A + 2 train_angle + 3, as line], noise [A + 3, R or more]): ``noise`` = mean of the ring's
        cells; its last 3 rows are work space.
    """
    outside, behind = train_range - guard_range, train_range + guard_range + 1
    apart, guarded = train_angle - guard_angle, 2 * guard_angle + 1

    @njit(types.void(*MEAN_ARGUMENTS), **OPTIONS)
    def kernel(power, pattern, first, inverse_count, floor, line, full, side, noise):  # type: ignore[no-untyped-def]
        angles, ranges = power.shape
        for a in range(angles):
            _load(power, pattern, a, first, train_range, line)
            row = a + train_angle
            for x in range(ranges + 2 * train_range - 1):
                line[1, x] = line[0, x] + line[0, x + 1]
            for x in range(ranges + behind):
                line[2, x] = _sum_of_pairs(line[0], line[1], x, outside)
            for r in range(ranges):
                outer = line[2, r] + line[2, r + behind]
                side[row, r] = outer
                full[row, r] = outer + _sum_of_pairs(line[0], line[1], r + outside, 2 * guard_range + 1)
        _close(full, angles, train_angle)
        _close(side, angles, train_angle)
        for a in range(0, angles, ROWS):
            one, two, three, four = noise[a], noise[a + 1], noise[a + 2], noise[a + 3]
            for r in range(ranges):
                near = _sums_of_rows(full, a, r, apart)
                far = _sums_of_rows(full, a + apart + guarded, r, apart)
                one[r], two[r] = near[0] + far[0], near[1] + far[1]
                three[r], four[r] = near[2] + far[2], near[3] + far[3]
            for r in range(ranges):
                beside, share = _sums_of_rows(side, a + apart, r, guarded), inverse_count[0, r]
                one[r], two[r] = (one[r] + beside[0]) * share, (two[r] + beside[1]) * share
                three[r], four[r] = (three[r] + beside[2]) * share, (four[r] + beside[3]) * share

    return kernel


@cache
def ring_halves_kernel(
    greatest: bool, guard_angle: int, train_angle: int, guard_range: int, train_range: int
) -> Callable[..., Any]:
    """Compile the greatest-of or smallest-of noise estimate for one ring.

    The sums along range of the nearer half are those of the farther one some cells before: each is made once.

    Args:
        greatest: the larger of both halves' means; else the smaller.
        guard_angle, train_angle, guard_range, train_range: half widths in cells.
    Returns:
        kernel as ``ring_mean_kernel``'s; the mean of half h is its sum times ``inverse_count[h]`` plus ``floor[h]``.
    """
    beside, behind = train_range - guard_range, train_range + guard_range + 1

    @njit(types.void(*MEAN_ARGUMENTS), **OPTIONS)
    def kernel(power, pattern, first, inverse_count, floor, line, full, side, noise):  # type: ignore[no-untyped-def]
        angles, ranges = power.shape
        for a in range(angles):
            _load(power, pattern, a, first, train_range, line)
            row = a + train_angle
            for x in range(ranges + behind):
                outer = float32(0)
                for d in range(beside):
                    outer += line[0, x + d]
                inner = float32(0)
                for d in range(guard_range):
                    inner += line[0, x + beside + d]
                side[row, x], full[row, x] = outer, outer + inner
        _close(full, angles, train_angle)
        _close(side, angles, train_angle)
        for a in range(angles):
            for x in range(ranges + behind):
                outer = float32(0)
                for d in range(train_angle - guard_angle):
                    outer += full[a + d, x] + full[a + train_angle + guard_angle + 1 + d, x]
                line[1, x] = outer
            for x in range(ranges + behind):
                inner = float32(0)
                for d in range(2 * guard_angle + 1):
                    inner += side[a + train_angle - guard_angle + d, x]
                line[2, x] = inner
            for r in range(ranges):
                near = line[1, r] + line[2, r]
                far = line[1, r + train_range + 1] + line[2, r + behind]
                near = near * inverse_count[0, r] + floor[0, r]
                far = far * inverse_count[1, r] + floor[1, r]
                noise[a, r] = max(near, far) if greatest else min(near, far)

    return kernel


@njit(types.void(MATRIX, float32[::1], MATRIX, float32[::1], int64, boolean[:, ::1]), **OPTIONS)
def mean_decisions(power, pattern, noise, factor, first, decided):  # type: ignore[no-untyped-def]
    """Decision of every cell: received power > factor[range] * noise, before any local-maximum test."""
    for a in range(power.shape[0]):
        for r in range(power.shape[1]):
            decided[a, r] = r >= first and power[a, r] * pattern[a] > factor[r] * noise[a, r]


@njit(inline="always")
def is_peak(power, pattern, a, r):  # type: ignore[no-untyped-def]
    """Largest received power of its 3 x 3 neighbourhood; of equal neighbours the first in raster order is the peak."""
    angles, ranges = power.shape
    centre = power[a, r] * pattern[a]
    for da in range(-1, 2):
        row = (a + da + angles) % angles
        for dr in range(-1, 2):
            c = r + dr
            if (da != 0 or dr != 0) and 0 <= c < ranges:
                value = power[row, c] * pattern[row]
                if value > centre or (value == centre and (row < a or (row == a and c < r))):
                    return False
    return True


@njit(int64(float32[:, ::1], float32[::1], float32[:, ::1], float32[::1], int64, int64[::1], float32[::1]), **OPTIONS)
def mean_peaks(power, pattern, noise, factor, first, cells, estimate):  # type: ignore[no-untyped-def]
    """Local maxima of the received power that exceed the threshold of a noise map.

    Args:
        power: [A, R], compensated for the antenna pattern.
        pattern: [A], received power = power * pattern.
        noise: [A, R] or more, as received.
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
        level = pattern[a]
        for start in range(first, ranges, BLOCK):
            begin, above = uint64(start), float32(1)
            if start + BLOCK <= ranges:
                above = float32(0)
                for d in range(BLOCK):
                    c = begin + uint64(d)
                    above += float32(1) if power[a, c] * level > factor[c] * noise[a, c] else float32(0)
            if above > float32(0):
                for r in range(start, min(start + BLOCK, ranges)):
                    if power[a, r] * level > factor[r] * noise[a, r] and is_peak(power, pattern, a, r):
                        cells[count] = a * ranges + r
                        estimate[count] = noise[a, r]
                        count += 1
    return count
