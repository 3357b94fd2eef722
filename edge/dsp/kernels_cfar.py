# SPDX-License-Identifier: Apache-2.0
"""CFAR kernels on power [angle, range], periodic in angle, cut at both ends of range.

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

from numba import boolean, float32, int32, int64, njit, types, uint64

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}


MATRIX = float32[:, ::1]
MEAN_ARGUMENTS = (MATRIX, float32[::1], int64, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX)


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
def _sum_along_range(line, ranges, guard, train, full, side, row):  # type: ignore[no-untyped-def]
    """Box and guardless sums along range of one loaded row."""
    for r in range(ranges):
        outer = float32(0)
        for d in range(train - guard):
            outer += line[0, r + d] + line[0, r + train + guard + 1 + d]
        inner = float32(0)
        for d in range(2 * guard + 1):
            inner += line[0, r + train - guard + d]
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

    @njit(types.void(*MEAN_ARGUMENTS), **OPTIONS)
    def kernel(power, pattern, first, inverse_count, floor, line, full, side, noise):  # type: ignore[no-untyped-def]
        angles, ranges = power.shape
        for a in range(angles):
            _load(power, pattern, a, first, train_range, line)
            _sum_along_range(line, ranges, guard_range, train_range, full, side, a + train_angle)
        _close(full, angles, train_angle)
        _close(side, angles, train_angle)
        for a in range(angles):
            for r in range(ranges):
                total = float32(0)
                for d in range(train_angle - guard_angle):
                    total += full[a + d, r] + full[a + train_angle + guard_angle + 1 + d, r]
                for d in range(2 * guard_angle + 1):
                    total += side[a + train_angle - guard_angle + d, r]
                noise[a, r] = total * inverse_count[0, r]

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
def _is_peak(power, pattern, a, r):  # type: ignore[no-untyped-def]
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
        noise: [A, R], as received.
        factor: [R].
        first: first tested range cell.
        cells: int64 [A R / 4], receives flat indices a R + r.
        estimate: float32 [A R / 4], receives the noise of each.
    Returns:
        Peaks found.
    """
    angles, ranges = power.shape
    count, begin = 0, uint64(first)
    for a in range(angles):
        above, level = float32(0), pattern[a]
        for d in range(ranges - first):
            c = begin + uint64(d)
            above += float32(1) if power[a, c] * level > factor[c] * noise[a, c] else float32(0)
        if above > float32(0):
            for r in range(first, ranges):
                if power[a, r] * level > factor[r] * noise[a, r] and _is_peak(power, pattern, a, r):
                    cells[count] = a * ranges + r
                    estimate[count] = noise[a, r]
                    count += 1
    return count


@njit(inline="always")
def _pad(power, pattern, first, train, padded):  # type: ignore[no-untyped-def]
    """Copy the tested ranges, as received, into ``padded`` [A, R + 2 train]; its other cells hold -1, count nowhere."""
    angles, ranges = power.shape
    begin = uint64(first)
    for a in range(angles):
        for d in range(ranges - first):
            padded[a, begin + uint64(train + d)] = power[a, begin + uint64(d)] * pattern[a]


@njit(inline="always")
def _exceeds_rank(padded, a, r, guard_angle, train_angle, guard, train, factor, allowed):  # type: ignore[no-untyped-def]
    """True when at most ``allowed`` ring cells x have factor x >= the cell's power, that is power > factor x_(k)."""
    angles = padded.shape[0]
    bound = padded[a, r + train]
    begin, behind = uint64(r), uint64(r + train + guard + 1)
    count = float32(0)
    for da in range(-train_angle, train_angle + 1):
        row = (a + da + angles) % angles
        if abs(da) > guard_angle:
            for d in range(2 * train + 1):
                count += float32(1) if padded[row, begin + uint64(d)] * factor >= bound else float32(0)
        else:
            for d in range(train - guard):
                count += float32(1) if padded[row, begin + uint64(d)] * factor >= bound else float32(0)
                count += float32(1) if padded[row, behind + uint64(d)] * factor >= bound else float32(0)
        if count > allowed:
            return False
    return True


@njit(inline="always")
def _select(bits, count, rank):  # type: ignore[no-untyped-def]
    """Place of the ``rank``-th smallest (1 = least) of the first ``count`` values, which are given as bit patterns.

    Floats that are not negative are ordered as their patterns read as integers, and -1 stands below all; a bisection
    with vectorised counting finds the pattern without a branch per value.
    """
    low, high = int32(0), int32(0x7F800000)
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
def _ordered_statistic(padded, a, r, guard_angle, train_angle, guard, train, allowed, scratch, bits):  # type: ignore[no-untyped-def]
    """x_(k) of the ring around one cell."""
    angles = padded.shape[0]
    count = 0
    for da in range(-train_angle, train_angle + 1):
        row = (a + da + angles) % angles
        for d in range(2 * train + 1):
            if abs(da) > guard_angle or abs(d - train) > guard:
                scratch[count] = padded[row, r + d]
                count += 1
    return scratch[_select(bits, count, count - allowed)]


@njit(inline="always")
def _mark_peaks(power, pattern, a, mark):  # type: ignore[no-untyped-def]
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
        kernel(power [A, R], pattern [A], first, factor float32 [R], allowed int64 [R] = N - k, padded [A, R + 2
        train_range] of -1, mark float32 [R], scratch float32 [cells of the box], bits (scratch as int32), cells,
        estimate) -> peaks found; as in ``mean_peaks``, but the noise is x_(k).
    """
    signature = int64(
        *(float32[:, ::1], float32[::1], int64, float32[::1], int64[::1], float32[:, ::1], float32[::1]),
        *(float32[::1], int32[::1], int64[::1], float32[::1]),
    )

    @njit(signature, **OPTIONS)
    def kernel(power, pattern, first, factor, allowed, padded, mark, scratch, bits, cells, estimate):  # type: ignore[no-untyped-def]
        angles, ranges = power.shape
        count = 0
        _pad(power, pattern, first, train_range, padded)
        for a in range(angles):
            _mark_peaks(power, pattern, a, mark)
            for r in range(first, ranges):
                if mark[r] == float32(0) or (mark[r] == float32(1) and not _is_peak(power, pattern, a, r)):
                    continue
                if _exceeds_rank(
                    padded, a, r, guard_angle, train_angle, guard_range, train_range, factor[r], allowed[r]
                ):
                    cells[count] = a * ranges + r
                    estimate[count] = _ordered_statistic(
                        padded, a, r, guard_angle, train_angle, guard_range, train_range, allowed[r], scratch, bits
                    )
                    count += 1
        return count

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
    def kernel(power, pattern, first, factor, allowed, padded, decided):  # type: ignore[no-untyped-def]
        _pad(power, pattern, first, train_range, padded)
        for a in range(power.shape[0]):
            for r in range(first, power.shape[1]):
                decided[a, r] = _exceeds_rank(
                    padded, a, r, guard_angle, train_angle, guard_range, train_range, factor[r], allowed[r]
                )

    return kernel
