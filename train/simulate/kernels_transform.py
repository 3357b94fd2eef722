# SPDX-License-Identifier: Apache-2.0
"""Inverse FFT of the beat grid and the channels' response, vectorised across receivers and neighbouring samples.

Radix 4, decimation in frequency, planes of real and imaginary parts. After two stages the sixteen parts of a group
change places with its rows: from then on they are the lanes, and sixteen neighbouring samples of four receivers lie
side by side at the end. Unsigned indices spare the inner loops Numba's wrap-around of negative ones, which would keep
them from vectorising.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import complex128, njit, uint64
from numpy.typing import NDArray

from edge.kernels_arrays import Complex128, Float32, Int64

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

RX = 4
"""Receivers of a group; their float32 values are moved as one complex128."""
PARTS = 16
"""Of the grid after two stages; also samples that lie side by side at the end."""


def twiddles(cells: int) -> NDArray[np.float32]:
    """Factors of all stages one after the other: those of the first two repeated for every receiver, then scalars."""
    tables = []
    length = cells
    while length > 2:
        turns = np.outer(np.arange(1, 4), np.arange(length // 4)) / length
        factors = np.stack((np.cos(2.0 * np.pi * turns), np.sin(2.0 * np.pi * turns)), axis=1).reshape(6, -1)
        wide = length > cells // PARTS
        tables.append(np.repeat(factors, RX, axis=1).ravel() if wide else factors.T.ravel())
        length //= 4
    return np.concatenate(tables).astype(np.float32)


def row_of_block(cells: int) -> NDArray[np.int64]:
    """Row of the transform that holds samples 16 b to 16 b + 15: the digits of b in the stages' order."""
    rest = cells // PARTS
    row, block, length, weight = np.zeros(rest, dtype=np.int64), np.arange(rest), rest, 1
    while length > 1:
        radix = 4 if length > 2 else 2
        length //= radix
        row += (block // weight) % radix * length
        weight *= radix
    return row


@njit(inline="always")
def _butterfly(
    work: Float32,
    x: np.uint64,
    q: np.uint64,
    im: np.uint64,
    w1r: np.float32,
    w1i: np.float32,
    w2r: np.float32,
    w2i: np.float32,
    w3r: np.float32,
    w3i: np.float32,
) -> None:
    """Radix-4 butterfly of the inverse transform on work[x + {0, q, 2q, 3q}], then the twiddles."""
    ar, ai = work[x], work[x + im]
    br, bi = work[x + q], work[x + q + im]
    cr, ci = work[x + q + q], work[x + q + q + im]
    dr, di = work[x + q + q + q], work[x + q + q + q + im]
    sr, si, tr, ti = ar + cr, ai + ci, ar - cr, ai - ci
    ur, ui, vr, vi = br + dr, bi + di, di - bi, br - dr
    work[x], work[x + im] = sr + ur, si + ui
    yr, yi = tr + vr, ti + vi
    work[x + q], work[x + q + im] = yr * w1r - yi * w1i, yr * w1i + yi * w1r
    yr, yi = sr - ur, si - ui
    work[x + q + q], work[x + q + q + im] = yr * w2r - yi * w2i, yr * w2i + yi * w2r
    yr, yi = tr - vr, ti - vi
    work[x + q + q + q], work[x + q + q + q + im] = yr * w3r - yi * w3i, yr * w3i + yi * w3r


@njit(inline="always")
def _wide_stage(
    work: Float32, begin: np.uint64, twiddle: Float32, first: np.uint64, groups: np.uint64, q: np.uint64, im: np.uint64
) -> None:
    """Stage over ``q`` = quarter x receivers contiguous lanes, twiddles expanded to the lanes."""
    two = q + q
    for g in range(groups):
        start = begin + (two + two) * g
        for lane in range(q):
            t = first + lane
            w1r, w1i, w2r = twiddle[t], twiddle[t + q], twiddle[t + two]
            w2i, w3r, w3i = twiddle[t + two + q], twiddle[t + two + two], twiddle[t + two + two + q]
            _butterfly(work, start + lane, q, im, w1r, w1i, w2r, w2i, w3r, w3i)


@njit(inline="always")
def _narrow_stage(
    work: Float32,
    twiddle: Float32,
    first: np.uint64,
    groups: np.uint64,
    quarter: np.uint64,
    lanes: np.uint64,
    im: np.uint64,
) -> None:
    """Stage whose inner loop runs over the parts and receivers; twiddles are scalars."""
    for g in range(groups):
        for p in range(quarter):
            t = first + uint64(6) * p
            w1r, w1i, w2r = twiddle[t], twiddle[t + uint64(1)], twiddle[t + uint64(2)]
            w2i, w3r, w3i = twiddle[t + uint64(3)], twiddle[t + uint64(4)], twiddle[t + uint64(5)]
            start = (uint64(4) * quarter * g + p) * lanes
            for lane in range(lanes):
                _butterfly(work, start + lane, quarter * lanes, im, w1r, w1i, w2r, w2i, w3r, w3i)


@njit(inline="always")
def _pair_stage(work: Float32, groups: np.uint64, lanes: np.uint64, im: np.uint64) -> None:
    """Final radix-2 stage of lengths 2 * 4^k."""
    for g in range(groups):
        for lane in range(lanes):
            x = uint64(2) * g * lanes + lane
            y = x + lanes
            ar, ai, br, bi = work[x], work[x + im], work[y], work[y + im]
            work[x], work[x + im] = ar + br, ai + bi
            work[y], work[y + im] = ar - br, ai - bi


@njit(inline="always")
def _change_places(grid: Complex128, begin: np.uint64, plane: np.uint64, rest: np.uint64, work: Complex128) -> None:
    """Rows of every part side by side, lower digit of the sample first: complex128 moves four receivers at once."""
    for p in range(uint64(2)):
        for low in range(uint64(4)):
            for high in range(uint64(4)):
                source = begin + p * plane + (uint64(4) * low + high) * rest
                target = p * uint64(PARTS) * rest + uint64(4) * high + low
                for r in range(rest):
                    work[target + uint64(PARTS) * r] = grid[source + r]


@cache
def transformer(cells: int, samples: int, margin: int) -> Callable[..., None]:
    """Kernel from grids to the samples of all channels.

    Args:
        cells: length of the transform, a power of two from 64.
        samples: of the window; the first is sample -16 * (samples / 32) of the transform.
        margin: rows before cell 0, which belong to the end of the period; a multiple of 4.
    Returns:
        Kernel of (grid float32 [groups * 2 * (margin + cells) * RX], destroyed; twiddle; row_of int64; work float32
        [2 * cells * RX]; correction float32 [samples * RX]; response, leakage, signal float32 [groups * samples *
        LANES]): signal = transform * correction * response + leakage.
    """
    plane, rest, im = np.uint64((margin + cells) * RX), np.uint64(cells // PARTS), np.uint64(cells * RX)
    begin_row, period = np.uint64(margin * RX), np.uint64(cells * RX)
    lanes, one = np.uint64(PARTS * RX), np.uint64(1)
    four_planes = np.uint64(margin + cells)
    before, blocks, points = samples // (2 * PARTS), -(-samples // PARTS), np.uint64(samples * RX)

    @njit(**OPTIONS)
    def transform(
        grid: Float32,
        twiddle: Float32,
        row_of: Int64,
        work: Float32,
        correction: Float32,
        response: Float32,
        leakage: Float32,
        signal: Float32,
    ) -> None:
        packed, packed_work = grid.view(complex128), work.view(complex128)  # type: ignore[call-overload]
        for g in range(uint64(len(grid)) // (plane + plane)):
            begin = g * (plane + plane)
            for p in range(uint64(2)):
                for x in range(begin_row):
                    grid[begin + p * plane + period + x] += grid[begin + p * plane + x]
            first = begin + begin_row
            _wide_stage(grid, first, twiddle, uint64(0), one, im // uint64(4), plane)
            _wide_stage(grid, first, twiddle, uint64(6) * im // uint64(4), uint64(4), im // uint64(16), plane)
            _change_places(packed, first // uint64(4), four_planes, rest, packed_work)
            offset, length, groups = uint64(6) * (im // uint64(4) + im // uint64(16)), rest, one
            while length > uint64(2):
                quarter = length // uint64(4)
                _narrow_stage(work, twiddle, offset, groups, quarter, lanes, im)
                offset, groups, length = offset + uint64(6) * quarter, groups * uint64(4), quarter
            if length == uint64(2):
                _pair_stage(work, groups, lanes, im)
            for block in range(blocks):
                source = uint64(row_of[(block - before) % len(row_of)]) * lanes
                place = uint64(block) * lanes
                target = g * points + place
                for lane in range(min(lanes, points - place)):
                    x, out = source + lane, uint64(2) * (target + lane)
                    level = correction[place + lane]
                    re, im_part = work[x] * level, work[x + im] * level
                    gain_re, gain_im = response[out], response[out + one]
                    signal[out] = re * gain_re - im_part * gain_im + leakage[out]
                    signal[out + one] = re * gain_im + im_part * gain_re + leakage[out + one]

    return transform  # type: ignore[no-any-return]
