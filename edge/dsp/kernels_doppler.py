# SPDX-License-Identifier: Apache-2.0
"""Kernels over loops: channels in order, moved elements spread on the row's grid, Doppler FFT, folds, strongest bin.

A channel is one (slot, receiver) of the row. ``cube`` holds the channels' focused range spectra, [channel, loop,
(re, im), range + PADDING]; range innermost, so that every inner loop runs along it. The padding keeps a channel's rows
from sharing the low bits of their addresses, which would stall loads behind stores.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import complex64, float32, float64, int8, int64, njit, types, uint64

from edge.kernels_arrays import Complex64, Float32, Float64, Int8, Int64

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

PADDING = 16
TAPS = 6
"""Grid cells that one moved element is spread on."""
SPREAD_SHAPE = 12.0
"""b of the spreading function exp(b (sqrt(1 - (2 x / W)^2) - 1)), Barnett et al. 2019, for W = TAPS."""
FRACTIONS = 2048
"""Places within a cell at which the spreading function is known."""
FINE = 8
"""Density is kept at 1 / FINE of an element."""
ROUNDS = 3
"""Rounds of the weights' iteration (Pipe and Menon 1999)."""


@cache
def channel_kernel(points: int, rx: int) -> Callable[..., Any]:
    """Compile the kernel that focuses one loop's spectra and puts each channel's range bins in order.

    Args:
        points: range bins.
        rx: receivers of one device.
    Returns:
        kernel(spectra [block, 2 * points * rx], focus [block, 2, points * rx], rows int64 [points], channel int64
        [block, rx], work [2 * points * rx], loop, cube [channel, loop, 2, points]); channel -1 is left out.
    """
    im = points * rx
    signature = types.void(
        *(float32[:, ::1], float32[:, :, ::1], int64[::1], int64[:, ::1], float32[::1]),
        *(int64, float32[:, :, :, ::1]),
    )

    @njit(signature, **OPTIONS)
    def kernel(
        spectra: Float32, focus: Float32, rows: Int64, channel: Int64, work: Float32, loop: int, cube: Float32
    ) -> None:
        for b in range(len(channel)):
            spectrum = spectra[b]
            for x in range(im):
                fr, fi = focus[b, 0, x], focus[b, 1, x]
                re, i = spectrum[x], spectrum[x + im]
                work[x] = re * fr - i * fi
                work[x + im] = re * fi + i * fr
            for r in range(rx):
                c = channel[b, r]
                if c < 0:
                    continue
                for k in range(points):
                    x = uint64(rows[k] + r)
                    cube[c, loop, 0, k] = work[x]
                    cube[c, loop, 1, k] = work[x + uint64(im)]

    return kernel


@njit(inline="always")
def _smooth(fine: Float64, kernel: Float64, begin: int, end: int, out: Float64) -> None:
    """``out`` = ``fine`` convolved with the symmetric ``kernel`` of odd length, from ``begin`` to before ``end``."""
    first = uint64(begin - len(kernel) // 2)
    for x in range(end - begin):
        out[uint64(begin) + uint64(x)] = 0.0
    for j in range(len(kernel)):
        share = kernel[j]
        for x in range(end - begin):
            out[uint64(begin) + uint64(x)] += share * fine[first + uint64(j) + uint64(x)]


@njit(
    types.void(
        *(float64[::1], int64[::1], float64[:, ::1], float64, float64, int64, int64),
        *(float64[::1], float64[::1], float64[:, ::1], float64[:, ::1], float64[::1], int64[:, ::1]),
        float32[:, :, ::1],
    ),
    **OPTIONS,
)
def plan_spreading(position: Float64, slot: Int64, time: Float64, drift: float, middle: float, loops: int, rounds: int,
                   density: Float64, taper: Float64, shape: Float64, fine: Float64, weight: Float64, first: Int64,
                   taps: Float32) -> None:  # fmt: skip
    """Where every element stands by the time of its chirp, and its weight, spread on the grid of the row.

    Element n of loop l stands at position + drift t. Weights are the inverse density of elements, by the iteration
    w <- w / (w * density)(x), times the taper over the moved aperture; or as they are given. They sum to 1.

    Args:
        position: float64 [channel], in elements from the row's middle.
        slot: int64 [channel].
        time: float64 [loop, slot], from the burst's middle.
        drift: elements per second.
        middle: grid cell of position 0.
        loops: loops used.
        rounds: of the iteration; 0: ``weight`` is given, taper and all.
        density: float64 [odd], what counts as near, at FINE points an element.
        taper: float64 [m], window over the aperture, m points in equal steps from edge to edge.
        shape: float64 [fractions, TAPS], spreading function by the element's fraction of a cell.
        fine: float64 [2, FINE * cells + margins] scratch.
        weight: float64 [loop * channel], given or scratch.
        first: int64 [loop, channel], receives the first of TAPS cells.
        taps: float32 [loop, channel, TAPS], receives the shares.
    """
    channels = len(position)
    lowest, highest = 1e9, -1e9
    for l in range(loops):  # noqa: E741
        for c in range(channels):
            x = position[c] + drift * time[l, slot[c]]
            lowest, highest = min(lowest, x), max(highest, x)
            if rounds > 0:
                weight[l * channels + c] = 1.0
    offset = middle * FINE + len(density) // 2
    begin, end = int(lowest * FINE + offset), int(highest * FINE + offset) + 2
    for _ in range(rounds):
        fine[0] = 0.0
        for n in range(loops * channels):
            x = (position[n % channels] + drift * time[n // channels, slot[n % channels]]) * FINE + offset
            cell = int(x)
            fine[0, cell] += weight[n] * (1.0 - (x - cell))
            fine[0, cell + 1] += weight[n] * (x - cell)
        _smooth(fine[0], density, begin, end, fine[1])
        for n in range(loops * channels):
            x = (position[n % channels] + drift * time[n // channels, slot[n % channels]]) * FINE + offset
            cell = int(x)
            weight[n] /= fine[1, cell] * (1.0 - (x - cell)) + fine[1, cell + 1] * (x - cell)
    total = 0.0
    for n in range(loops * channels):
        x = position[n % channels] + drift * time[n // channels, slot[n % channels]]
        if rounds > 0:
            weight[n] *= taper[int((x - lowest + 0.5) / (highest - lowest + 1.0) * len(taper))]
        total += weight[n]
    for n in range(loops * channels):
        l, c = n // channels, n % channels  # noqa: E741
        x = position[c] + drift * time[l, slot[c]] + middle
        cell = int(x) - (TAPS // 2 - 1)
        first[l, c] = cell
        fraction = int((x - int(x)) * len(shape))
        for j in range(TAPS):
            taps[l, c, j] = weight[n] / total * shape[fraction, j]


@njit(types.void(complex64[:, ::1], float64[:, ::1], float64, float64), **OPTIONS)
def set_turns(turn: Complex64, time: Float64, closing_m_s: float, wavelength_m: float) -> None:
    """exp(j 4 pi c t / lambda): what undoes the closing speed c; turn, time [loop, slot]."""
    for l in range(turn.shape[0]):  # noqa: E741
        for s in range(turn.shape[1]):
            angle = 4.0 * np.pi * closing_m_s * time[l, s] / wavelength_m
            turn[l, s] = complex(np.cos(angle), np.sin(angle))


@njit(
    types.void(
        *(float32[:, :, :, ::1], int64[::1], int64, complex64[:, ::1], int64[:, ::1], float32[:, :, ::1]),
        *(float32[:, ::1], float32[:, :, ::1]),
    ),
    **OPTIONS,
)
def spread(
    cube: Float32, slot: Int64, loops: int, turn: Complex64, first: Int64, taps: Float32, line: Float32, row: Float32
) -> None:
    """Turn every channel of every loop and add it to its cells of the grid.

    Args:
        cube: [channel, loop, (re, im), range].
        slot: int64 [channel].
        loops: loops used.
        turn: complex64 [loop, slot].
        first, taps: as ``plan_spreading`` makes them.
        line: float32 [2, range] scratch.
        row: float32 [(re, im), cell, range], overwritten.
    """
    points = row.shape[2]
    row[:] = float32(0)
    for c in range(len(slot)):
        for l in range(loops):  # noqa: E741
            tr, ti, source = turn[l, slot[c]].real, turn[l, slot[c]].imag, cube[c, l]
            for k in range(points):
                line[0, k] = source[0, k] * tr - source[1, k] * ti
                line[1, k] = source[0, k] * ti + source[1, k] * tr
            for j in range(TAPS):
                cell, tap = first[l, c] + j, taps[l, c, j]
                if tap == 0:
                    continue
                for part in range(2):
                    target, turned = row[part, cell], line[part]
                    for k in range(points):
                        target[k] += tap * turned[k]


@njit(types.void(float32[:, :, :, ::1], float32[:, ::1]), **OPTIONS)
def doppler_fft(cube: Float32, twiddle: Float32) -> None:
    """FFT over loops in place, radix 2, decimation in frequency: bin k stands where its bits are reversed.

    Args:
        cube: [channel, loop, (re, im), range], loops a power of two.
        twiddle: float32 [(re, im), loops / 2], exp(-j 2 pi n / loops).
    """
    channels, loops, _, points = cube.shape
    for c in range(channels):
        half = loops // 2
        while half >= 1:
            step = loops // (2 * half)
            for start in range(0, loops, 2 * half):
                for n in range(half):
                    wr, wi = twiddle[0, n * step], twiddle[1, n * step]
                    upper, lower = cube[c, start + n], cube[c, start + n + half]
                    for k in range(points):
                        ar, ai, br, bi = upper[0, k], upper[1, k], lower[0, k], lower[1, k]
                        dr, di = ar - br, ai - bi
                        upper[0, k] = ar + br
                        upper[1, k] = ai + bi
                        lower[0, k] = dr * wr - di * wi
                        lower[1, k] = dr * wi + di * wr
            half //= 2


@njit(
    types.void(
        *(
            float32[:, :, :, ::1],
            int64,
            int64[:, ::1],
            int64,
            complex64[:, ::1],
            float32[:, :, ::1],
            float32[::1],
            int8[::1],
        ),
    ),
    **OPTIONS,
)
def resolve_folds(
    cube: Float32,
    d: int,
    pairs: Int64,
    distances: int,
    hypothesis: Complex64,
    work: Float32,
    score: Float32,
    fold: Int8,
) -> None:
    """Which multiple of the ambiguous speed the doubled elements agree with, range bin by range bin.

    sum over pairs of late conj(early), grouped by their distance d in slots, has the phase 2 pi f d, f the Doppler
    phase from slot to slot in turns; the hypothesis with the largest real part of the turned sum wins.

    Args:
        cube: [channel, Doppler, (re, im), range].
        d: place of the Doppler bin.
        pairs: int64 [pair, 3], earlier channel, later channel, index of the slot distance.
        distances: different slot distances.
        hypothesis: complex64 [fold, distance], exp(-j 2 pi f d).
        work: float32 [distance, (re, im), range] scratch.
        score: float32 [range] scratch.
        fold: int8 [range], receives the index of the hypothesis.
    """
    points, bin_ = len(score), uint64(d)
    work[:] = float32(0)
    for n in range(len(pairs)):
        a, b, g = uint64(pairs[n, 0]), uint64(pairs[n, 1]), uint64(pairs[n, 2])
        for k in range(points):
            ar, ai, br, bi = cube[a, bin_, 0, k], cube[a, bin_, 1, k], cube[b, bin_, 0, k], cube[b, bin_, 1, k]
            work[g, 0, k] += br * ar + bi * ai
            work[g, 1, k] += bi * ar - br * ai
    for k in range(points):
        score[k] = float32(-1e30)
    for m in range(len(hypothesis)):
        for k in range(points):
            value = float32(0)
            for g in range(distances):
                value += work[g, 0, k] * hypothesis[m, g].real - work[g, 1, k] * hypothesis[m, g].imag
            if value > score[k]:
                score[k] = value
                fold[k] = m


@njit(
    types.void(
        *(float32[:, :, :, ::1], int64, int64[::1], int64[::1], float32[:, :, ::1], int8[::1]),
        *(float32[:, :, ::1], float32[:, :, ::1]),
    ),
    **OPTIONS,
)
def doppler_row(
    cube: Float32, d: int, slot: Int64, element: Int64, turns: Float32, fold: Int8, turn: Float32, row: Float32
) -> None:
    """Undo one Doppler bin's phase between slots and fill the virtual row.

    Args:
        cube: [channel, Doppler, (re, im), range].
        d: place of the Doppler bin.
        slot, element: int64 [channel].
        turns: float32 [fold, slot, (re, im)].
        fold: int8 [range], index of the hypothesis.
        turn: float32 [slot, (re, im), range] scratch.
        row: [(re, im), element, range], overwritten.
    """
    points, bin_ = row.shape[2], uint64(d)
    for s in range(turn.shape[0]):
        for k in range(points):
            turn[s, 0, k] = turns[fold[k], s, 0]
            turn[s, 1, k] = turns[fold[k], s, 1]
    row[:] = float32(0)
    for c in range(len(slot)):
        e, s = uint64(element[c]), uint64(slot[c])
        for k in range(points):
            re, i, tr, ti = cube[c, bin_, 0, k], cube[c, bin_, 1, k], turn[s, 0, k], turn[s, 1, k]
            row[0, e, k] += re * tr - i * ti
            row[1, e, k] += re * ti + i * tr


@njit(types.void(float32[:, ::1], float32, float32[:, ::1]), **OPTIONS)
def keep_larger(other: Float32, keep: float, power: Float32) -> None:
    """power = max(keep power, other), both [angle, range] and not negative; ``keep`` 0 forgets what was there."""
    for a in range(power.shape[0]):
        for k in range(power.shape[1]):
            power[a, k] = max(power[a, k] * keep, other[a, k])
