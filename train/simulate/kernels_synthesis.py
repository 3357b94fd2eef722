# SPDX-License-Identifier: Apache-2.0
"""Kernels of the synthesis: exact paths to phasors, and phasors with Gaussian weights on an oversampled grid of beats.

A group is four receivers of one chip and one slot; its grid is a plane of real and one of imaginary parts [cell, RX].
Four cells of four receivers are one register of AVX-512. A Gaussian moved by some cells is the same Gaussian times a
ratio that itself changes by a constant factor, so the loop over the cells only multiplies (L. Greengard, J.-Y. Lee,
Accelerating the nonuniform fast Fourier transform, SIAM Review 46, 2004, section 3).

With the place of a scatterer at f cells from the middle of its cells, a receiver a cells from its group's mean and a
lane o cells from its step's middle, the weight exp(-b d^2) of the first step has d = edge + f + a - o. It is a product
of factors of f, of a - o, and exp(-2 b f (a - o)); the next step's is this times exp(8 b d - 16 b).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import float32, int32, njit, uint64

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

RX = 4
"""Receivers of one group."""
CELLS = 4
"""Grid cells that are written in one step."""
LANES = CELLS * RX
LEG_PLANES = 4
"""Of receive legs, [capacity * LANES] each: weighted phasor (re, im), exponent of the weight over f, ratio of steps."""
MEAN, RATE, MEAN_RATE = RX, RX + 1, 2 * RX + 1
"""Rows of the paths' scratch: a group's receivers, their mean, how they change, and the mean of that."""
BLOCK = 64
"""Scatterers of a block: distances are taken receiver by receiver over a block, so that they vectorise."""


@njit(inline="always")
def _phasor(turns):  # type: ignore[no-untyped-def]
    """Cosine and sine of 2 pi turns: float64 in, float32 out, error 4e-7; least-squares polynomials of the half."""
    r = float32(turns - np.floor(turns + 0.5))
    t = r * r
    sine = float32(0.0820504019) - float32(0.00702838654) * t
    sine = float32(2.55016332) + t * (float32(-0.599252198) + t * sine)
    sine = r * (float32(3.14159265) + t * (float32(-5.16771276) + t * sine))
    cosine = float32(0.234937314) - float32(0.0243963245) * t
    cosine = float32(4.05870916) + t * (float32(-1.335212) + t * cosine)
    cosine = float32(1.0) + t * (float32(-4.93480214) + t * cosine)
    return cosine * cosine - sine * sine, float32(2.0) * sine * cosine


@njit(inline="always")
def _exp(y):  # type: ignore[no-untyped-def]
    """exp(y) for |y| < 1.1: Taylor to y^9, error 7e-7 at the ends."""
    p = float32(1 / 5040) + y * (float32(1 / 40320) + y * float32(1 / 362880))
    p = float32(1 / 24) + y * (float32(1 / 120) + y * (float32(1 / 720) + y * p))
    p = float32(1 / 2) + y * (float32(1 / 6) + y * p)
    return float32(1) + y * (float32(1) + y * p)


@njit(**OPTIONS)
def filter_amplitudes(count, points, amplitude, centre_m, cells_per_m, offset_m, table, filtered):  # type: ignore[no-untyped-def]
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
def _paths(first, size, points, velocity, antenna, t, path, row):  # type: ignore[no-untyped-def]
    """Distances of a block's scatterers to one antenna at time ``t``.

    One array is written in a loop of its own here and below: more would need too many checks for overlaps, and the loop
    would not be vectorised.
    """
    ax, ay, az = antenna[0], antenna[1], antenna[2]
    for i in range(size):
        k = first + i
        x = points[0, k] + velocity[0, k] * t - ax
        y = points[1, k] + velocity[1, k] * t - ay
        z = points[2, k] + velocity[2, k] * t - az
        path[row, i] = math.sqrt(x * x + y * y + z * z)


@njit(inline="always")
def _extend(first, size, path, row, new, shortest, longest):  # type: ignore[no-untyped-def]
    """Shortest and longest legs, ``new``: of the first antenna."""
    begin = uint64(first)
    for i in range(uint64(size)):
        value = path[row, i]
        shortest[begin + i] = value if new or value < shortest[begin + i] else shortest[begin + i]
    for i in range(uint64(size)):
        value = path[row, i]
        longest[begin + i] = value if new or value > longest[begin + i] else longest[begin + i]


@njit(**OPTIONS)
def transmit_legs(  # type: ignore[no-untyped-def]
    count,
    points,
    velocity,
    bend,
    amplitude,
    antennas,
    time_s,
    middle_s,
    scale,
    re,
    im,
    cell,
    base,
    shortest,
    longest,
    path,
):
    """Amplitude times transmit phasor and place on the grid of every slot.

    Args:
        count: scatterers.
        points, velocity: float64 [3, capacity], at time 0, and their change per second.
        bend: float64 [capacity], m/s^2: what the receive paths lengthen by, times (time - middle)^2.
        amplitude: float32 [2, capacity].
        antennas: float64 [slots, 3].
        time_s: float64 [slots].
        middle_s: instant of which the receive paths are a tangent.
        scale: cells and turns per metre of path; turns per metre of every slot's jitter: float64 [2 + slots].
        re, im: float32 [slots, capacity], overwritten: the phasors.
        cell: float32 [slots, capacity], overwritten: cell less ``base``.
        base: int32 [capacity], overwritten: whole cell of slot 0.
        shortest, longest: float64 [capacity], overwritten: legs.
        path: float64 [1, BLOCK], scratch.
    """
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        for m in range(len(time_s)):
            later_s = time_s[m] - middle_s
            turns, later_s2 = scale[1] + scale[2 + m], later_s * later_s
            _paths(first, size, points, velocity, antennas[m], time_s[m], path, 0)
            for i in range(size):
                path[0, i] += bend[first + i] * later_s2
            _extend(first, size, path, 0, m == 0, shortest, longest)
            if m == 0:
                for i in range(size):
                    base[first + i] = int32(path[0, i] * scale[0])
            for i in range(size):
                cell[m, first + i] = float32(path[0, i] * scale[0] - base[first + i])
            for i in range(size):
                cosine, sine = _phasor(path[0, i] * turns)
                k = first + i
                re[m, k] = amplitude[0, k] * cosine - amplitude[1, k] * sine
                im[m, k] = amplitude[0, k] * sine + amplitude[1, k] * cosine


@njit(inline="always")
def _write_legs(legs, first, size, cosines, work, b, factors):  # type: ignore[no-untyped-def]
    """Lanes of a block of scatterers, from cosine, sine, place in the group and exp(b place) of every receiver."""
    span = len(legs) // LEG_PLANES
    for i in range(size):
        o = (first + i) * LANES
        for n in range(RX):
            cosine, sine, away, rise, fall = cosines[n, i], work[0, n, i], work[1, n, i], work[2, n, i], work[3, n, i]
            twice = rise * rise
            level, ratio = fall * fall * fall, twice * twice * twice * twice
            for c in range(CELLS):
                lane, weight = o + c * RX + n, level * factors[0, c]
                legs[lane], legs[lane + span] = weight * cosine, weight * sine
                legs[lane + 2 * span] = float32(-2) * b * (away - float32(c) + float32(1.5))
                legs[lane + 3 * span] = ratio * factors[1, c]
                level *= twice


@njit(inline="always")
def _write_turns(turn, first, size, path, turns_s_per_m):  # type: ignore[no-untyped-def]
    """Cosines and sines of the turn per slot, in the order of the legs' lanes."""
    span = len(turn) // 2
    for i in range(size):
        o = (first + i) * LANES
        for n in range(RX):
            cosine, sine = _phasor(path[RATE + n, i] * turns_s_per_m)
            for lane in range(n, LANES, RX):
                turn[o + lane], turn[o + span + lane] = cosine, sine


@njit(inline="always")
def _rates(first, size, points, velocity, antenna, t, path, n):  # type: ignore[no-untyped-def]
    """Change per second of the distances to receiver n."""
    for i in range(size):
        k = first + i
        x = points[0, k] + velocity[0, k] * t - antenna[0]
        y = points[1, k] + velocity[1, k] * t - antenna[1]
        z = points[2, k] + velocity[2, k] * t - antenna[2]
        dot = x * velocity[0, k] + y * velocity[1, k] + z * velocity[2, k]
        path[RATE + n, i] = dot / math.sqrt(x * x + y * y + z * z)


@njit(inline="always")
def _mean(size, path, row):  # type: ignore[no-untyped-def]
    """Mean of the group's four rows from ``row`` on, in the row after them."""
    for i in range(size):
        path[row + RX, i] = 0.25 * ((path[row, i] + path[row + 1, i]) + (path[row + 2, i] + path[row + 3, i]))


@njit(inline="always")
def _weigh(size, path, n, scale, back_s, shape, edge, cosines, work):  # type: ignore[no-untyped-def]
    """Of receiver n: weighted cosine and sine at slot 0, place in the group, exp(b place) and its inverse."""
    for i in range(size):
        work[1, n, i] = float32((path[n, i] - path[MEAN, i]) * scale[0])
    for i in range(size):
        away = work[1, n, i]
        level = _exp(-shape * away * (away + float32(2) * edge))
        cosine, sine = _phasor((path[n, i] - path[RATE + n, i] * back_s - scale[2]) * scale[1])
        cosines[n, i], work[0, n, i] = level * cosine, level * sine
    for i in range(size):
        work[2, n, i] = _exp(shape * work[1, n, i])
    for i in range(size):
        work[3, n, i] = _exp(-shape * work[1, n, i])


@njit(**OPTIONS)
def receive_legs(  # type: ignore[no-untyped-def]
    count,
    points,
    velocity,
    antennas,
    scale,
    timing,
    shape,
    edge,
    factors,
    legs,
    turn,
    cell,
    base,
    shortest,
    longest,
    path,
    cosines,
    work,
):
    """Receive phasors with their share of the weights, group by group, and how they turn from slot to slot.

    A leg is its tangent at one instant; the transmit leg carries the common curvature.

    Args:
        count, points, velocity: as for ``transmit_legs``.
        antennas: float64 [chips, RX, 3].
        scale: cells and turns per metre, metres taken off the path: float64 [3].
        timing: instants of the tangent and of slot 0, time from slot to slot (0: nothing moves): float64 [3].
        shape, edge: float32; of the weights, and distance from a scatterer to the first step's middle.
        factors: float32 [2, CELLS], constants of a step's cells: of the first step's weight, of its ratio to the next.
        legs: float32 [chips, LEG_PLANES * span], overwritten, span >= capacity * LANES: state at slot 0.
        turn: float32 [chips, 2 * span], overwritten: cosine and sine of the turn per slot.
        cell: float32 [2, chips, capacity], overwritten: middle of the group's cells less ``base``, change per second.
        base, shortest, longest: as for ``transmit_legs``.
        path, cosines, work: scratch; float64 [2 RX + 2, BLOCK], rates 0 when nothing moves, float32 [RX or 4 RX, BLOCK]
    """
    middle_s, back_s, slot_s = timing[0], timing[0] - timing[1], timing[2]
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        for d in range(len(antennas)):
            for n in range(RX):
                _paths(first, size, points, velocity, antennas[d, n], middle_s, path, n)
                _extend(first, size, path, n, d == 0 and n == 0, shortest, longest)
                if slot_s > 0.0:
                    _rates(first, size, points, velocity, antennas[d, n], middle_s, path, n)
            if d == 0:
                for i in range(size):
                    base[first + i] = int32(path[0, i] * scale[0])
            _mean(size, path, 0)
            _mean(size, path, RX + 1)
            for i in range(size):
                cell[0, d, first + i] = float32((path[MEAN, i] - scale[2]) * scale[0] - base[first + i])
            for i in range(size):
                cell[1, d, first + i] = float32(path[MEAN_RATE, i] * scale[0])
            for n in range(RX):
                _weigh(size, path, n, scale, back_s, shape, edge, cosines, work)
            _write_legs(legs[d], first, size, cosines, work, shape, factors)
            if slot_s > 0.0:
                _write_turns(turn[d], first, size, path, slot_s * scale[1])


@njit(inline="always")
def _plan(count, re, im, cell_out, mean, drift, base, width, b, outer, first_ratio, plan, start):  # type: ignore[no-untyped-def]
    """First cell of every scatterer, place from its middle, and what it brings to the weights of one group."""
    for k in range(count):
        place = cell_out[k] + mean[k] + drift[k]
        below = np.floor(place)
        away = place - below - float32(0.5)
        start[k] = (base[k] + int32(below) - int32(width - 1)) * RX
        falling, rising = _exp(float32(-2) * b * away), _exp(float32(2) * b * away)
        level = outer * _exp(-b * away * away)
        for _ in range(width - 2):
            level *= falling
        rising *= rising
        plan[0, k] = away
        plan[1, k], plan[2, k] = re[k] * level, im[k] * level
        plan[3, k] = first_ratio * rising * rising


@njit(inline="always")
def _turn_legs(size, span, legs, turn):  # type: ignore[no-untyped-def]
    """Receive phasors of one group to the next slot: one flat loop, which vectorises."""
    for x in range(size):
        re, im = legs[x], legs[x + span]
        cosine, sine = turn[x], turn[x + span]
        legs[x], legs[x + span] = re * cosine - im * sine, re * sine + im * cosine


@njit(inline="always")
def _add(count, span, legs, plan, start, steps, lanes, imaginary, bend, begin, grid):  # type: ignore[no-untyped-def]
    """Add all scatterers to one group's grid, ``steps`` times four cells each."""
    for k in range(uint64(count)):
        away, a, c, ratio = plan[0, k], plan[1, k], plan[2, k], plan[3, k]
        o, leg = begin + uint64(start[k]), k * lanes
        for n in range(lanes):
            x = leg + n
            weight, step = _exp(away * legs[x + span + span]), ratio * legs[x + span + span + span]
            cosine, sine = legs[x], legs[x + span]
            re, im = (a * cosine - c * sine) * weight, (a * sine + c * cosine) * weight
            for j in range(steps):
                grid[o + lanes * j + n] += re
                grid[o + imaginary + lanes * j + n] += im
                re *= step
                im *= step
                step *= bend


@cache
def spreader(width: int, shape: float, plane: int, moving: bool) -> Callable[..., None]:
    """Kernel that adds scatterers to the grids of all groups.

    Args:
        width: cells to either side of a scatterer, even.
        shape: of the weights exp(-shape distance^2).
        plane: floats of one plane of a group's grid.
        moving: turn the legs from slot to slot.
    Returns:
        Kernel of (count, re, im [slots, capacity], cell_out [slots, capacity], cell_back [2, chips, capacity],
        time_s [slots] from the tangent's instant, base int32 [capacity], legs [chips, LEG_PLANES * span], turn [chips,
        2 * span], drift float32 [capacity], plan float32 [4, capacity], start int32 [capacity], grid float32 [chips *
        slots * 2 * plane]), the last three scratch, the grid added to.
    """
    steps, lanes, imaginary = np.uint64(width // 2), np.uint64(LANES), np.uint64(plane)
    edge = width - 2
    b, outer = np.float32(shape), np.float32(math.exp(-shape * edge * edge))
    first_ratio = np.float32(math.exp(8.0 * shape * edge - 16.0 * shape))
    bend = np.float32(math.exp(-32.0 * shape))

    @njit(**OPTIONS)
    def spread(count, re_out, im_out, cell_out, cell_back, time_s, base, legs, turn, drift, plan, start, grid):  # type: ignore[no-untyped-def]
        slots, begin = len(time_s), uint64(0)
        for chip in range(len(legs)):
            leg_table, turns, span = legs[chip], turn[chip], uint64(legs.shape[1] // LEG_PLANES)
            mean, rate = cell_back[0, chip], cell_back[1, chip]
            for slot in range(slots):
                t = float32(time_s[slot])
                for k in range(count):
                    drift[k] = rate[k] * t
                _plan(
                    count,
                    re_out[slot],
                    im_out[slot],
                    cell_out[slot],
                    mean,
                    drift,
                    base,
                    width,
                    b,
                    outer,
                    first_ratio,
                    plan,
                    start,
                )
                _add(count, span, leg_table, plan, start, steps, lanes, imaginary, bend, begin, grid)
                if moving:
                    _turn_legs(uint64(count) * lanes, span, leg_table, turns)
                begin += imaginary + imaginary

    return spread  # type: ignore[no-any-return]
