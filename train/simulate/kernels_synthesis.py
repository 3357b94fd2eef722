# SPDX-License-Identifier: Apache-2.0
"""Kernels of the synthesis: phasors with Gaussian weights on an oversampled grid of beats.

A group is four receivers of one chip and one slot; its grid is a plane of real and one of imaginary parts [cell, RX].
Four cells of four receivers are one register of AVX-512. A Gaussian moved by some cells is the same Gaussian times a
ratio that itself changes by a constant factor, so the loop over the cells only multiplies (L. Greengard, J.-Y. Lee,
Accelerating the nonuniform fast Fourier transform, SIAM Review 46, 2004, section 3).

With the place of a scatterer at f cells from the middle of its cells, a receiver a cells from its group's middle and a
lane o cells from its step's middle, the weight exp(-b d^2) of the first step has d = edge + f + a - o. It is a product
of factors of f, of a - o, and exp(-2 b f (a - o)); the next step's is this times exp(8 b d - 16 b).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numba import float32, int32, njit, uint64

from edge.kernels_arrays import Complex64, Float32, Float64, Int32
from train.simulate.kernels_legs import LANES, LEG_PLANES, OPTIONS, RX, exponential


@njit(inline="always")
def _short_exponential(y: np.float32) -> np.float32:
    """exp(y) for |y| < 0.96, error 2.3e-6: least squares of the relative error, reweighted to level it."""
    p = float32(0.0417559088) + y * (float32(0.00864033939) + y * float32(0.00134940962))
    p = float32(0.499966318) + y * (float32(0.166536757) + y * p)
    return float32(1.00000169) + y * (float32(1.00001274) + y * p)


@njit(**OPTIONS)
def filter_amplitudes(
    count: int,
    points: Float64,
    amplitude: Complex64,
    centre_m: Float64,
    cells_per_m: float,
    offset_m: float,
    table: Complex64,
    filtered: Float32,
) -> None:
    """Amplitudes times the receiver's response at each scatterer's beat frequency, as (re, im) rows.

    Args:
        count: scatterers.
        points: float64 [2 legs, 3, capacity], places as the transmitters and as the receivers see them.
        amplitude: complex64 [count].
        centre_m: float64 [3], phase centre.
        cells_per_m, offset_m: grid cells per metre of path, and what is taken off the path.
        table: complex64 [cells + 1], response by cell.
        filtered: float32 [2, capacity], overwritten.
    """
    for k in range(count):
        path_m = -offset_m
        for leg in range(2):
            x, y, z = points[leg, 0, k] - centre_m[0], points[leg, 1, k] - centre_m[1], points[leg, 2, k] - centre_m[2]
            path_m += math.sqrt(x * x + y * y + z * z)
        cell = min(max(path_m * cells_per_m, 0.0), len(table) - 1.001)
        whole = int(cell)
        part = float32(cell - whole)
        factor = table[whole] + part * (table[whole + 1] - table[whole])
        filtered[0, k] = amplitude[k].real * factor.real - amplitude[k].imag * factor.imag
        filtered[1, k] = amplitude[k].real * factor.imag + amplitude[k].imag * factor.real


@njit(inline="always")
def _plan(
    count: int,
    re: Float32,
    im: Float32,
    cell_out: Float32,
    mean: Float32,
    rate: Float32,
    late: np.float32,
    turned: Float32,
    base: Int32,
    width: int,
    b: np.float32,
    outer: np.float32,
    first_ratio: np.float32,
    plan: Float32,
    start: Int32,
) -> None:
    """First cell of every scatterer, place from its middle, and what it brings to the weights of one group."""
    room = len(turned) // 2
    for k in range(count):
        place = cell_out[k] + mean[k] + rate[k] * late
        below = np.floor(place)
        away = place - below - float32(0.5)
        start[k] = (base[k] + int32(below) - int32(width - 1)) * RX
        falling, rising = exponential(float32(-2) * b * away), exponential(float32(2) * b * away)
        level = outer * exponential(-b * away * away)
        for _ in range(width - 2):
            level *= falling
        rising *= rising
        cosine, sine = turned[k] * level, turned[k + room] * level
        plan[0, k] = away
        plan[1, k], plan[2, k] = re[k] * cosine - im[k] * sine, re[k] * sine + im[k] * cosine
        plan[3, k] = first_ratio * rising * rising


@njit(inline="always")
def _turn(size: np.uint64, span: np.uint64, state: Float32, turn: Float32) -> None:
    """Turn phasors (re, then im from ``span`` on): one flat loop, which vectorises."""
    for x in range(size):
        re, im = state[x], state[x + span]
        cosine, sine = turn[x], turn[x + span]
        state[x], state[x + span] = re * cosine - im * sine, re * sine + im * cosine


@njit(inline="always")
def _add(
    count: int,
    span: np.uint64,
    legs: Float32,
    plan: Float32,
    start: Int32,
    short: bool,
    steps: np.uint64,
    lanes: np.uint64,
    imaginary: np.uint64,
    bend: np.float32,
    begin: np.uint64,
    grid: Float32,
) -> None:
    """Add all scatterers to one group's grid, ``steps`` times four cells each."""
    for k in range(uint64(count)):
        away, a, c, ratio = plan[0, k], plan[1, k], plan[2, k], plan[3, k]
        o, leg = begin + uint64(start[k]), k * lanes
        for n in range(lanes):
            x = leg + n
            y, step = away * legs[x + span + span], ratio * legs[x + span + span + span]
            weight = _short_exponential(y) if short else exponential(y)
            cosine, sine = legs[x], legs[x + span]
            re, im = (a * cosine - c * sine) * weight, (a * sine + c * cosine) * weight
            for j in range(steps):
                grid[o + lanes * j + n] += re
                grid[o + imaginary + lanes * j + n] += im
                re *= step
                im *= step
                step *= bend


@cache
def spreader(width: int, shape: float, plane: int) -> Callable[..., None]:
    """Kernel that writes the grids of all groups for one loop.

    Args:
        width: cells to either side of a scatterer, even.
        shape: of the weights exp(-shape distance^2).
        plane: floats of one plane of a group's grid.
    Returns:
        Kernel of (count, re, im, cell_out [slots, capacity], cell_back [2, chips, capacity], base int32 [capacity],
        swing, swing_step [chips, 2 * capacity], legs [chips, LEG_PLANES * span], turn [chips, 2 * span], run, onward,
        plan float32 [4, capacity], start int32 [capacity], grid float32 [chips * slots * 2 * plane]). The swings turn
        from slot to slot, the legs after every ``run`` slots, after the last only if there is an ``onward`` loop; 0:
        nothing moves. Plan and start are scratch, the grid is overwritten.
    """
    steps, lanes, imaginary = np.uint64(width // 2), np.uint64(LANES), np.uint64(plane)
    edge, short = width - 2, width == 4
    b, outer = np.float32(shape), np.float32(math.exp(-shape * edge * edge))
    first_ratio = np.float32(math.exp(8.0 * shape * edge - 16.0 * shape))
    bend = np.float32(math.exp(-32.0 * shape))

    @njit(**OPTIONS)
    def spread(
        count: int,
        re_out: Float32,
        im_out: Float32,
        cell_out: Float32,
        cell_back: Float32,
        base: Int32,
        swing: Float32,
        swing_step: Float32,
        legs: Float32,
        turn: Float32,
        run: int,
        onward: bool,
        plan: Float32,
        start: Int32,
        grid: Float32,
    ) -> None:
        slots, begin, room = len(re_out), uint64(0), uint64(swing.shape[1] // 2)
        for chip in range(len(legs)):
            table, turns, span = legs[chip], turn[chip], uint64(legs.shape[1] // LEG_PLANES)
            mean, rate, turned = cell_back[0, chip], cell_back[1, chip], swing[chip]
            for slot in range(slots):
                re, im, cell, late = re_out[slot], im_out[slot], cell_out[slot], float32(slot - 0.5 * (slots - 1))
                _plan(count, re, im, cell, mean, rate, late, turned, base, width, b, outer, first_ratio, plan, start)
                for x in range(begin, begin + imaginary + imaginary):
                    grid[x] = float32(0)
                _add(count, span, table, plan, start, short, steps, lanes, imaginary, bend, begin, grid)
                if run > 0:
                    _turn(uint64(count), room, turned, swing_step[chip])
                    if (slot + 1) % run == 0 and (onward or slot + 1 < slots):
                        _turn(uint64(count) * lanes, span, table, turns)
                begin += imaginary + imaginary

    return spread  # type: ignore[no-any-return]
