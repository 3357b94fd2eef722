# SPDX-License-Identifier: Apache-2.0
"""Kernels of the synthesis: exact paths to phasors, and phasors with Gaussian weights on an oversampled grid of beats.

A group is four receivers of one chip and one slot; its grid row holds their complex values as eight floats. A Gaussian
moved by one cell is the same Gaussian times a ratio that itself changes by a constant factor, so the loop over the
cells multiplies only (L. Greengard, J.-Y. Lee, Accelerating the nonuniform fast Fourier transform, SIAM Review 46,
2004, eq. 16).
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
LANES = 2 * RX
"""Floats of one grid row: I and Q of every receiver in turn."""
PAIR = 2 * LANES
"""Floats of two neighbouring rows, which are written together: as many as one register of AVX-512 holds."""
LEG = 4 * PAIR
"""Floats of one scatterer's receive leg: phasor, phasor times j, weight's exponent, weight's ratio."""
BLOCK = 32
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
    """exp(y) for |y| < 0.75: Taylor to y^7, error 3e-6 at the ends, 1e-8 at half of them."""
    p = float32(1 / 120) + y * (float32(1 / 720) + y * float32(1 / 5040))
    p = float32(1 / 2) + y * (float32(1 / 6) + y * (float32(1 / 24) + y * p))
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


@njit(**OPTIONS)
def transmit_legs(  # type: ignore[no-untyped-def]
    count, points, velocity, bend, amplitude, antennas, time_s, middle_s, scale, phasor, cell, base, reach
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
        phasor: float32 [slots, 2, capacity], overwritten.
        cell: float32 [slots, capacity], overwritten: cell less ``base``.
        base: int32 [capacity], overwritten: whole cell of slot 0.
        reach: float64 [2, capacity], overwritten: shortest and longest leg.
    """
    for m in range(len(time_s)):
        t = time_s[m]
        t2 = (t - middle_s) * (t - middle_s)
        ax, ay, az = antennas[m, 0], antennas[m, 1], antennas[m, 2]
        turns = scale[1] + scale[2 + m]
        for k in range(count):
            x = points[0, k] + velocity[0, k] * t - ax
            y = points[1, k] + velocity[1, k] * t - ay
            z = points[2, k] + velocity[2, k] * t - az
            path_m = math.sqrt(x * x + y * y + z * z) + bend[k] * t2
            cosine, sine = _phasor(path_m * turns)
            phasor[m, 0, k] = amplitude[0, k] * cosine - amplitude[1, k] * sine
            phasor[m, 1, k] = amplitude[0, k] * sine + amplitude[1, k] * cosine
            place = path_m * scale[0]
            base[k] = int32(place) if m == 0 else base[k]
            cell[m, k] = float32(place - base[k])
            reach[0, k] = path_m if m == 0 else min(reach[0, k], path_m)
            reach[1, k] = path_m if m == 0 else max(reach[1, k], path_m)


@njit(inline="always")
def _write_leg(legs, o, n, work, i, next_level, next_ratio):  # type: ignore[no-untyped-def]
    """Lanes of receiver n at ``legs[o]``: first for the group's lower, then for its upper cell."""
    cosine, sine, exponent, ratio = work[0, n, i], work[1, n, i], work[2, n, i], work[3, n, i]
    for _ in range(2):
        legs[o + 2 * n], legs[o + 2 * n + 1] = cosine, sine
        legs[o + PAIR + 2 * n], legs[o + PAIR + 2 * n + 1] = -sine, cosine
        legs[o + 2 * PAIR + 2 * n], legs[o + 2 * PAIR + 2 * n + 1] = exponent, exponent
        legs[o + 3 * PAIR + 2 * n], legs[o + 3 * PAIR + 2 * n + 1] = ratio, ratio
        step = work[4, n, i] * next_level
        cosine, sine = cosine * step, sine * step
        exponent, ratio = work[5, n, i], ratio * next_ratio
        o += LANES


@njit(**OPTIONS)
def receive_legs(  # type: ignore[no-untyped-def]
    count, points, velocity, antennas, scale, timing, shape, width, legs, turn, cell, base, reach, path, work
):
    """Receive phasors with their share of the weights, group by group, and how they turn from slot to slot.

    A leg is its tangent at one instant; the transmit leg carries the common curvature. The weight of a cell is a
    product of one factor of the scatterer, one of the receiver and one of both.

    Args:
        count: scatterers.
        points, velocity: float64 [3, capacity].
        antennas: float64 [chips, RX, 3].
        scale: cells and turns per metre, metres taken off the path: float64 [3].
        timing: instants of the tangent and of slot 0, time from slot to slot (0: nothing moves): float64 [3].
        shape, width: of the weights exp(-shape distance^2); the first cell lies ``width`` below the nearest.
        legs: float32 [chips, capacity * LEG], overwritten: state at slot 0.
        turn: float32 [chips, capacity * 2 * PAIR], overwritten: cosine and sine of the turn per slot.
        cell: float32 [2, chips, capacity], overwritten: middle of the group's cells less ``base``, change per second.
        base: int32 [capacity], overwritten.
        reach: float64 [2, capacity], overwritten: shortest and longest leg.
        path, work: float64 [2, RX, BLOCK] and float32 [6, RX, BLOCK], scratch.
    """
    b, edge = float32(shape), float32(width)
    offset_m, middle_s, back_s, slot_s = scale[2], timing[0], timing[0] - timing[1], timing[2]
    next_level, next_ratio = float32(math.exp(shape * (2.0 * width - 1.0))), float32(math.exp(-4.0 * shape))
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        for d in range(len(antennas)):
            for n in range(RX):
                ax, ay, az = antennas[d, n, 0], antennas[d, n, 1], antennas[d, n, 2]
                new = d == 0 and n == 0
                for i in range(size):
                    k = first + i
                    x = points[0, k] + velocity[0, k] * middle_s - ax
                    y = points[1, k] + velocity[1, k] * middle_s - ay
                    z = points[2, k] + velocity[2, k] * middle_s - az
                    path_m = math.sqrt(x * x + y * y + z * z)
                    path[0, n, i] = path_m
                    path[1, n, i] = (x * velocity[0, k] + y * velocity[1, k] + z * velocity[2, k]) / path_m
                    base[k] = int32(path_m * scale[0]) if new else base[k]
                    reach[0, k] = path_m if new else min(reach[0, k], path_m)
                    reach[1, k] = path_m if new else max(reach[1, k], path_m)
            for i in range(size):
                mean_m = 0.25 * (path[0, 0, i] + path[0, 1, i] + path[0, 2, i] + path[0, 3, i])
                mean_m_s = 0.25 * (path[1, 0, i] + path[1, 1, i] + path[1, 2, i] + path[1, 3, i])
                cell[0, d, first + i] = float32((mean_m - offset_m) * scale[0] - base[first + i])
                cell[1, d, first + i] = float32(mean_m_s * scale[0])
                for n in range(RX):
                    work[2, n, i] = float32((path[0, n, i] - mean_m) * scale[0])
            for n in range(RX):
                for i in range(size):
                    away = work[2, n, i]
                    level = _exp(-b * away * (away + float32(2) * edge))
                    cosine, sine = _phasor((path[0, n, i] - path[1, n, i] * back_s - offset_m) * scale[1])
                    work[0, n, i], work[1, n, i] = level * cosine, level * sine
                    rise = _exp(float32(2) * b * away)
                    work[2, n, i], work[5, n, i] = float32(-2) * b * away, float32(-2) * b * (away - float32(1))
                    work[3, n, i], work[4, n, i] = rise * rise, rise
            for i in range(size):
                for n in range(RX):
                    _write_leg(legs[d], (first + i) * LEG, n, work, i, next_level, next_ratio)
            if slot_s > 0.0:
                _write_turns(turn[d], first, size, path, slot_s * scale[1])


@njit(inline="always")
def _write_turns(turn, first, size, path, turns_s_per_m):  # type: ignore[no-untyped-def]
    """Cosines and sines of the turn per slot, in the order of the legs' lanes."""
    for i in range(size):
        o = (first + i) * 2 * PAIR
        for n in range(RX):
            cosine, sine = _phasor(path[1, n, i] * turns_s_per_m)
            for lane in range(2 * n, PAIR, LANES):
                turn[o + lane], turn[o + lane + 1] = cosine, cosine
                turn[o + PAIR + lane], turn[o + PAIR + lane + 1] = sine, sine


@njit(**OPTIONS)
def turn_legs(count, legs, turn):  # type: ignore[no-untyped-def]
    """Receive phasors of one group to the next slot.

    Args:
        count: scatterers.
        legs: float32 [capacity * LEG], changed.
        turn: float32 [capacity * 2 * PAIR].
    """
    pair, leg, both = uint64(PAIR), uint64(LEG), uint64(2 * PAIR)
    for k in range(uint64(count)):
        for n in range(pair):
            value, by_j = legs[k * leg + n], legs[k * leg + pair + n]
            cosine, sine = turn[k * both + n], turn[k * both + pair + n]
            legs[k * leg + n] = cosine * value + sine * by_j
            legs[k * leg + pair + n] = cosine * by_j - sine * value


@cache
def spreader(width: int, shape: float) -> Callable[..., None]:
    """Kernel that adds scatterers to one group's grid, two cells at a time.

    Args:
        width: the first of 2 width + 2 cells lies this far below the nearest.
        shape: of the weights exp(-shape distance^2).
    Returns:
        Kernel of (count, phasor [2, capacity], cell_out [capacity], cell_back [capacity], drift [capacity], time_s,
        base_out, base_back int32 [capacity], legs [capacity * LEG], margin, plan float32 [4, capacity], start int32
        [capacity], grid float32 [rows * LANES]).
    """
    steps, lanes = np.uint64(width + 1), np.uint64(PAIR)
    two, three, leg_size = np.uint64(2 * PAIR), np.uint64(3 * PAIR), np.uint64(LEG)
    b, edge = np.float32(shape), np.float32(math.exp(-shape * width * width))
    first_ratio, bend = np.float32(math.exp(4.0 * shape * (width - 1))), np.float32(math.exp(-8.0 * shape))

    @njit(**OPTIONS)
    def spread(  # type: ignore[no-untyped-def]
        count, phasor, cell_out, cell_back, drift, time_s, base_out, base_back, legs, margin, plan, start, grid
    ):
        t = float32(time_s)
        for k in range(count):
            place = cell_out[k] + cell_back[k] + drift[k] * t
            nearest = np.floor(place + float32(0.5))
            away = place - nearest
            start[k] = (base_out[k] + base_back[k] + int32(nearest) + margin - width) * LANES
            falling, rising = _exp(float32(-2) * b * away), _exp(float32(2) * b * away)
            level = edge * _exp(-b * away * away)
            for _ in range(width):
                level *= falling
            plan[0, k] = away
            plan[1, k], plan[2, k] = phasor[0, k] * level, phasor[1, k] * level
            plan[3, k] = first_ratio * rising * rising
        for k in range(count):
            away, re, im, ratio = plan[0, k], plan[1, k], plan[2, k], plan[3, k]
            o, leg = uint64(start[k]), uint64(k) * leg_size
            for n in range(lanes):
                value = (re * legs[leg + n] + im * legs[leg + lanes + n]) * _exp(away * legs[leg + two + n])
                step = ratio * legs[leg + three + n]
                for j in range(steps):
                    grid[o + lanes * j + n] += value
                    value *= step
                    step *= bend

    return spread  # type: ignore[no-any-return]


@njit(**OPTIONS)
def fold(grid, margin, cells):  # type: ignore[no-untyped-def]
    """Rows before the first beat cell are the last ones of the period.

    Args:
        grid: float32 [groups, rows, LANES], changed.
        margin: rows before cell 0.
        cells: of the period.
    """
    for g in range(grid.shape[0]):
        for r in range(margin):
            for n in range(LANES):
                grid[g, r + cells, n] += grid[g, r, n]
