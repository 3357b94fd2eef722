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

import numpy as np
from numba import boolean, float32, int64, njit, types, uint8, uint64

from edge.kernels_arrays import Bool, Float32, Int64, UInt8

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}


MATRIX = float32[:, ::1]
MEAN_ARGUMENTS = (MATRIX, float32[::1], int64, MATRIX, MATRIX, float32[::1], float32[::1], MATRIX)
ROWS = 4
"""Angle rows whose sums are made together."""
SPARE_ROWS = ROWS - 1
"""Rows that planes have beyond the angles, so that the last group of rows is a whole one."""
LINES = 2 * ROWS + 2
"""Lines of work space: two for each of the rows, and two more."""
VECTOR = 16
"""float32 values of the widest vector: rows and lines are whole numbers of them, so that loops have no remainder."""
WORD = 8
"""Range cells whose marks are looked at together."""


def whole(cells: int) -> int:
    """``cells`` rounded up to whole vectors: cells of a row of the plane."""
    return -(-cells // VECTOR) * VECTOR


def line_cells(ranges: int, train_range: int) -> int:
    """Cells of a line of work space, which begins with ``whole(train_range)`` zeros."""
    return whole(train_range) + whole(ranges + 2 * train_range) + 3 * VECTOR


@njit(inline="always")
def _receive(
    power: Float32, pattern: Float32, first: int, train_angle: int, ranges: int, pitch: int, plane: Float32
) -> None:
    """Power as received, rows of ``pitch`` cells, zeros below ``first``, ``train_angle`` rows repeated at both ends."""
    angles, begin = power.shape[0], uint64(train_angle * pitch)
    for a in range(angles):
        level, row = pattern[a], begin + uint64(a * pitch)
        for r in range(ranges):
            plane[row + uint64(r)] = power[a, r] * level
        for r in range(first):
            plane[row + uint64(r)] = float32(0)
    behind = begin + uint64(angles * pitch)
    for x in range(train_angle * pitch):
        plane[uint64(x)] = plane[uint64(x) + uint64(angles * pitch)]
        plane[behind + uint64(x)] = plane[begin + uint64(x)]


@njit(inline="always")
def _sums_of_rows(
    plane: Float32, x: np.uint64, pitch: int, width: int
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Sums over ``width`` rows of a column, from cell x and from 1, 2 and 3 rows on; what they share is added once."""
    shared = float32(0)
    if width < ROWS:
        one, two, three, four = shared, shared, shared, shared
        for d in range(width):
            one += plane[x + uint64(d * pitch)]
            two += plane[x + uint64((1 + d) * pitch)]
            three += plane[x + uint64((2 + d) * pitch)]
            four += plane[x + uint64((3 + d) * pitch)]
        return one, two, three, four
    for d in range(ROWS - 1, width):
        shared += plane[x + uint64(d * pitch)]
    before = plane[x + uint64(pitch)] + plane[x + uint64(2 * pitch)]
    after = plane[x + uint64(width * pitch)]
    behind = after + plane[x + uint64((width + 1) * pitch)]
    one, two = shared + (plane[x] + before), shared + (before + after)
    three = shared + (plane[x + uint64(2 * pitch)] + behind)
    return one, two, three, shared + (behind + plane[x + uint64((width + 2) * pitch)])


@njit(inline="always")
def _sums_of_columns(
    plane: Float32,
    a: int,
    apart: int,
    guarded: int,
    ranges: int,
    pitch: int,
    all_rows: bool,
    line: Float32,
    left: int,
    cells: int,
) -> None:
    """Sums over the rows of the rings around angle rows a..a + 3, column by column, into lines of ``cells`` each.

    Lines 0..3 receive the sums over the 2 * ``apart`` rows beyond the guarded ones, lines 4..7 those over the
    ``guarded`` rows, or over ``all_rows``, each from place ``left`` on.
    """
    above = uint64(a * pitch)
    beside, below = above + uint64(apart * pitch), above + uint64((apart + guarded) * pitch)
    share = float32(1) if all_rows else float32(0)
    for r in range(ranges):
        x, y = uint64(r), uint64(left + r)
        near, far = _sums_of_rows(plane, above + x, pitch, apart), _sums_of_rows(plane, below + x, pitch, apart)
        middle = _sums_of_rows(plane, beside + x, pitch, guarded)
        one, two, three, four = near[0] + far[0], near[1] + far[1], near[2] + far[2], near[3] + far[3]
        line[y], line[y + uint64(cells)] = one, two
        line[y + uint64(2 * cells)], line[y + uint64(3 * cells)] = three, four
        line[y + uint64(4 * cells)], line[y + uint64(5 * cells)] = middle[0] + share * one, middle[1] + share * two
        line[y + uint64(6 * cells)] = middle[2] + share * three
        line[y + uint64(7 * cells)] = middle[3] + share * four


@njit(inline="always")
def _sums_along(line: Float32, start: int, width: int, count: int, into: int) -> None:
    """line[into + x] = sum of ``width`` cells from ``start + x`` on, x < ``count``."""
    for n in range(count):
        x = uint64(start) + uint64(n)
        total = float32(0)
        for d in range(width):
            total += line[x + uint64(d)]
        line[uint64(into) + uint64(n)] = total


@cache
def ring_mean_kernel(
    guard_angle: int, train_angle: int, guard_range: int, train_range: int, ranges: int
) -> Callable[..., Any]:
    """Compile the cell-averaging noise estimate for one ring.

    Args:
        guard_angle, train_angle, guard_range, train_range: half widths in cells.
        ranges: R, range cells of the map.
    Returns:
        kernel(power [A, R], pattern [A], first, inverse_count [2, R], floor [2, R], plane [(A + 2 train_angle + 3) *
        whole(R)], line [LINES * line_cells(R, train_range)] zeroed, noise [A + 3, R or more]): ``noise`` = mean of the
        ring's cells; its last 3 rows are work space.
    """
    pitch, left, cells = whole(ranges), whole(train_range), line_cells(ranges, train_range)
    apart, guarded = train_angle - guard_angle, 2 * guard_angle + 1
    outside, inside, behind = train_range - guard_range, 2 * guard_range + 1, train_range + guard_range + 1
    half, count = outside // 2, whole(ranges + 2 * train_range)
    pairs, outer = 2 * ROWS * cells, (2 * ROWS + 1) * cells

    @njit(types.void(*MEAN_ARGUMENTS), **OPTIONS)
    def kernel(
        power: Float32,
        pattern: Float32,
        first: int,
        inverse_count: Float32,
        floor: Float32,
        plane: Float32,
        line: Float32,
        noise: Float32,
    ) -> None:
        _receive(power, pattern, first, train_angle, ranges, pitch, plane)
        for a in range(0, power.shape[0], ROWS):
            _sums_of_columns(plane, a, apart, guarded, ranges, pitch, True, line, left, cells)
            for k in range(ROWS):
                beyond = k * cells + left - train_range
                every = beyond + ROWS * cells
                _sums_along(line, every, 2, count, pairs)
                for r in range(count - train_range):
                    x = uint64(r)
                    total = float32(0)
                    for d in range(half):
                        total += line[x + uint64(pairs + 2 * d)]
                    if outside % 2 == 1:
                        total += line[x + uint64(every) + uint64(outside - 1)]
                    line[x + uint64(outer)] = total
                for r in range(ranges):
                    x = uint64(r)
                    total = line[x + uint64(outer)] + line[x + uint64(outer + behind)]
                    for d in range(inside):
                        total += line[x + uint64(beyond) + uint64(outside + d)]
                    noise[a + k, r] = total * inverse_count[0, r]

    return kernel


@cache
def ring_halves_kernel(
    greatest: bool, guard_angle: int, train_angle: int, guard_range: int, train_range: int, ranges: int
) -> Callable[..., Any]:
    """Compile the greatest-of or smallest-of noise estimate for one ring.

    The sums along range of the nearer half are those of the farther one some cells before: each is made once.

    Args:
        greatest: the larger of both halves' means; else the smaller.
        guard_angle, train_angle, guard_range, train_range, ranges: as in ``ring_mean_kernel``.
    Returns:
        kernel as ``ring_mean_kernel``'s; the mean of half h is its sum times ``inverse_count[h]`` plus ``floor[h]``.
    """
    pitch, left, cells = whole(ranges), whole(train_range), line_cells(ranges, train_range)
    apart, guarded = train_angle - guard_angle, 2 * guard_angle + 1
    outside, behind, count = train_range - guard_range, train_range + guard_range + 1, whole(ranges + train_range)
    outer, inner = 2 * ROWS * cells, (2 * ROWS + 1) * cells

    @njit(types.void(*MEAN_ARGUMENTS), **OPTIONS)
    def kernel(
        power: Float32,
        pattern: Float32,
        first: int,
        inverse_count: Float32,
        floor: Float32,
        plane: Float32,
        line: Float32,
        noise: Float32,
    ) -> None:
        _receive(power, pattern, first, train_angle, ranges, pitch, plane)
        for a in range(0, power.shape[0], ROWS):
            _sums_of_columns(plane, a, apart, guarded, ranges, pitch, False, line, left, cells)
            for k in range(ROWS):
                beyond = k * cells + left - train_range
                _sums_along(line, beyond, train_range, count + VECTOR, outer)
                _sums_along(line, beyond + ROWS * cells, outside, count + VECTOR, inner)
                for r in range(ranges):
                    x = uint64(r)
                    near = line[x + uint64(outer)] + line[x + uint64(inner)]
                    far = line[x + uint64(outer + train_range + 1)] + line[x + uint64(inner + behind)]
                    near = near * inverse_count[0, r] + floor[0, r]
                    far = far * inverse_count[1, r] + floor[1, r]
                    noise[a + k, r] = max(near, far) if greatest else min(near, far)

    return kernel


@njit(types.void(MATRIX, float32[::1], MATRIX, float32[::1], int64, boolean[:, ::1]), **OPTIONS)
def mean_decisions(
    power: Float32, pattern: Float32, noise: Float32, factor: Float32, first: int, decided: Bool
) -> None:
    """Decision of every cell: received power > factor[range] * noise, before any local-maximum test."""
    for a in range(power.shape[0]):
        for r in range(power.shape[1]):
            decided[a, r] = r >= first and power[a, r] * pattern[a] > factor[r] * noise[a, r]


@njit(inline="always")
def _largest(power: Float32, a: int, r: int) -> np.float32:
    """Largest of a cell and those beside it in range."""
    last = power.shape[1] - 1
    return max(max(power[a, max(r - 1, 0)], power[a, min(r + 1, last)]), power[a, r])


@njit(inline="always")
def is_peak(power: Float32, pattern: Float32, a: int, r: int) -> bool:
    """Largest received power of its 3 x 3 neighbourhood; of equal neighbours the first in raster order is the peak."""
    angles, ranges = power.shape
    above = a - 1 if a > 0 else angles - 1
    below = a + 1 if a + 1 < angles else 0
    centre, level = power[a, r] * pattern[a], pattern[a]
    up, down = _largest(power, above, r) * pattern[above], _largest(power, below, r) * pattern[below]
    if up > centre or down > centre or power[a, min(r + 1, ranges - 1)] * level > centre:
        return False
    if r > 0 and power[a, r - 1] * level >= centre:
        return False
    return not ((up == centre and above < a) or (down == centre and below < a))


@njit(inline="always")
def _mark(power: Float32, pattern: Float32, noise: Float32, factor: Float32, first: int, a: int, mark: UInt8) -> None:
    """1 where a tested cell of a row exceeds its threshold and is no less than its neighbours in angle, else 0."""
    angles, ranges = power.shape
    above, below = (a + angles - 1) % angles, (a + 1) % angles
    level, up, down = pattern[a], pattern[above], pattern[below]
    for r in range(ranges):
        centre = power[a, r] * level
        exceeds = uint8(centre > factor[r] * noise[a, r])
        mark[r] = exceeds & uint8(centre >= power[above, r] * up) & uint8(centre >= power[below, r] * down)
    for r in range(first):
        mark[r] = uint8(0)


PEAK_ARGUMENTS = (MATRIX, float32[::1], MATRIX, float32[::1], int64, uint8[::1], int64[::1], int64[::1], float32[::1])


@njit(int64(*PEAK_ARGUMENTS), **OPTIONS)
def mean_peaks(
    power: Float32,
    pattern: Float32,
    noise: Float32,
    factor: Float32,
    first: int,
    mark: UInt8,
    words: Int64,
    cells: Int64,
    estimate: Float32,
) -> int:
    """Local maxima of the received power that exceed the threshold of a noise map.

    Args:
        power: [A, R], compensated for the antenna pattern.
        pattern: [A], received power = power * pattern.
        noise: [A, R] or more, as received.
        factor: [R].
        first: first tested range cell.
        mark: uint8 [whole(R)], zeros beyond R, work space.
        words: the same memory as int64 [whole(R) / 8].
        cells: int64 [A R / 4], receives flat indices a R + r.
        estimate: float32 [A R / 4], receives the noise of each.
    Returns:
        Peaks found.
    """
    angles, ranges = power.shape
    count = 0
    for a in range(angles):
        _mark(power, pattern, noise, factor, first, a, mark)
        for w in range(len(words)):
            if words[w] == 0:
                continue
            for r in range(WORD * w, WORD * w + WORD):
                if mark[r] != 0 and is_peak(power, pattern, a, r):
                    cells[count] = a * ranges + r
                    estimate[count] = noise[a, r]
                    count += 1
    return count
