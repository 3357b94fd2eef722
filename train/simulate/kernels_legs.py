# SPDX-License-Identifier: Apache-2.0
"""Kernels of the synthesis: exact paths of every scatterer to every antenna, and their phasors, burst by burst.

A moving path is exact at the first, middle and last chirp of a burst and a parabola between; transmitters and the
middles of the receiving chips are followed so. What a chip's receivers have apart from its middle changes so slowly
that it is a tangent, turned every few chirps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import float32, int32, njit, uint64

from edge.kernels_arrays import Float32, Float64, Int32

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

RX = 4
"""Receivers of one group."""
CELLS = 4
"""Grid cells that are written in one step."""
LANES = CELLS * RX
LEG_PLANES = 4
"""Of receive legs, [capacity * LANES] each: weighted phasor (re, im), exponent of the weight over f, ratio of steps."""
MIDDLE, RATE = RX, RX + 1
"""Rows of the paths' scratch: a group's receivers and their middle, then how these change."""
BLOCK = 128
"""Scatterers of a block: distances are taken receiver by receiver over a block, so that they vectorise."""


@njit(inline="always")
def phasor(turns: float) -> tuple[np.float32, np.float32]:
    """Cosine and sine of 2 pi turns: float64 in, float32 out."""
    return _circle(float32(turns - np.floor(turns + 0.5)))


@njit(inline="always")
def _circle(r: np.float32) -> tuple[np.float32, np.float32]:
    """Cosine and sine of 2 pi r, |r| <= 1/2: error 4e-7; least-squares polynomials of the half."""
    t = r * r
    sine = float32(0.0820504019) - float32(0.00702838654) * t
    sine = float32(2.55016332) + t * (float32(-0.599252198) + t * sine)
    sine = r * (float32(3.14159265) + t * (float32(-5.16771276) + t * sine))
    cosine = float32(0.234937314) - float32(0.0243963245) * t
    cosine = float32(4.05870916) + t * (float32(-1.335212) + t * cosine)
    cosine = float32(1.0) + t * (float32(-4.93480214) + t * cosine)
    return cosine * cosine - sine * sine, float32(2.0) * sine * cosine


@njit(inline="always")
def exponential(y: np.float32) -> np.float32:
    """exp(y) for |y| < 1.1: Taylor to y^9, error 7e-7 at the ends."""
    p = float32(1 / 5040) + y * (float32(1 / 40320) + y * float32(1 / 362880))
    p = float32(1 / 24) + y * (float32(1 / 120) + y * (float32(1 / 720) + y * p))
    p = float32(1 / 2) + y * (float32(1 / 6) + y * p)
    return float32(1) + y * (float32(1) + y * p)


@njit(inline="always")
def _paths(
    first: int, size: np.uint64, points: Float64, velocity: Float64, antenna: Float64, t: float, path: Float64, row: int
) -> None:
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
def _extend(
    first: int, size: np.uint64, path: Float64, row: int, new: bool, shortest: Float64, longest: Float64
) -> None:
    """Shortest and longest legs, ``new``: of the first antenna."""
    begin = uint64(first)
    for i in range(uint64(size)):
        value = path[row, i]
        shortest[begin + i] = value if new or value < shortest[begin + i] else shortest[begin + i]
    for i in range(uint64(size)):
        value = path[row, i]
        longest[begin + i] = value if new or value > longest[begin + i] else longest[begin + i]


@njit(**OPTIONS)
def station_paths(count: int, points: Float64, velocity: Float64, bend: Float64, stations: Float64, timing: Float64,
                  later_s2: Float64, scale: Float64, table: Float32, base: Int32, shortest: Float64, longest: Float64,
                  path: Float64) -> None:  # fmt: skip
    """Paths to every station at the first instant, and as parabolas of x from 0 to 1 what they change over the burst.

    Args:
        count: scatterers.
        points, velocity: float64 [3, capacity], at time 0, and their change per second.
        bend: float64 [capacity], m/s^2.
        stations: float64 [n, 3].
        timing: float64 [n + 1], each station's instant of x = 0; then seconds to x = 1 (0: one instant only).
        later_s2: float64 [n], s^2, times ``bend`` is added to the path.
        scale: cells and turns per metre of path, metres taken off the path: float64 [3].
        table: float32 [4, n, capacity], overwritten: cell less ``base``, fraction of a turn, each at x = 0; turns to be
            added: table[2] x + table[3] x^2.
        base: int32 [capacity], overwritten: whole cell of station 0 at x = 0.
        shortest, longest: float64 [capacity], overwritten: over stations and time.
        path: float64 [3, BLOCK], scratch.
    """
    span_s = timing[len(stations)]
    for m in range(len(stations)):
        begin_s = timing[m]
        cell, turn, rise, bow = table[0, m], table[1, m], table[2, m], table[3, m]
        for first in range(uint64(0), uint64(count), uint64(BLOCK)):
            size = min(uint64(BLOCK), uint64(count) - first)
            _paths(first, size, points, velocity, stations[m], begin_s, path, 0)
            _extend(first, size, path, 0, m == 0, shortest, longest)
            if span_s > 0.0:
                _paths(first, size, points, velocity, stations[m], begin_s + 0.5 * span_s, path, 1)
                _paths(first, size, points, velocity, stations[m], begin_s + span_s, path, 2)
                _extend(first, size, path, 2, False, shortest, longest)
                for i in range(size):
                    rise[first + i] = float32((4.0 * path[1, i] - 3.0 * path[0, i] - path[2, i]) * scale[1])
                for i in range(size):
                    bow[first + i] = float32(2.0 * (path[0, i] - 2.0 * path[1, i] + path[2, i]) * scale[1])
            else:
                for i in range(size):
                    rise[first + i] = float32(0)
                for i in range(size):
                    bow[first + i] = float32(0)
            for i in range(size):
                path[0, i] += bend[first + i] * later_s2[m] - scale[2]
            if m == 0:
                for i in range(size):
                    base[first + i] = int32(path[0, i] * scale[0])
            for i in range(size):
                cell[first + i] = float32(path[0, i] * scale[0] - base[first + i])
            for i in range(size):
                turn[first + i] = float32(path[0, i] * scale[1] - np.floor(path[0, i] * scale[1]))


@njit(inline="always")
def _waves(size: np.uint64, part: Float32, wave: Float32) -> None:
    """Cosines, and ``BLOCK`` further on sines, of turns."""
    for i in range(size):
        part[i] -= np.floor(part[i] + float32(0.5))
    for i in range(size):
        wave[i], wave[i + uint64(BLOCK)] = _circle(part[i])


@njit(**OPTIONS)
def transmit_legs(count: int, table: Float32, base: Int32, x: np.float32, amplitude: Float32, scale: Float32,
                  re: Float32, im: Float32, cell: Float32, part: Float32, wave: Float32) -> None:  # fmt: skip
    """Amplitude times transmit phasor and place on the grid of every slot of one loop.

    Args:
        count: scatterers.
        table, base, x: of ``station_paths``, the transmitters in firing order, each at its own chirp.
        amplitude: float32 [2, capacity].
        scale: cells per turn; turns per cell of every slot's jitter: float32 [1 + slots].
        re, im: float32 [slots, capacity], overwritten: the phasors.
        cell: float32 [slots, capacity], overwritten: cell less ``base``.
        part, wave: float32 [BLOCK] and [2 * BLOCK], scratch.
    """
    level, phase = amplitude[0], amplitude[1]
    for m in range(table.shape[1]):
        begin, turn, rise, bow = table[0, m], table[1, m], table[2, m], table[3, m]
        place, real, imaginary = cell[m], re[m], im[m]
        for first in range(uint64(0), uint64(count), uint64(BLOCK)):
            size = min(uint64(BLOCK), uint64(count) - first)
            for i in range(size):
                part[i] = x * (rise[first + i] + x * bow[first + i])
            for i in range(size):
                place[first + i] = begin[first + i] + scale[0] * part[i]
            for i in range(size):
                part[i] += turn[first + i]
            if scale[1 + m] != float32(0):
                for i in range(size):
                    part[i] += scale[1 + m] * (place[first + i] + float32(base[first + i]))
            _waves(size, part, wave)
            for i in range(size):
                real[first + i] = level[first + i] * wave[i] - phase[first + i] * wave[i + uint64(BLOCK)]
            for i in range(size):
                imaginary[first + i] = level[first + i] * wave[i + uint64(BLOCK)] + phase[first + i] * wave[i]


@njit(inline="always")
def _store(first: int, size: np.uint64, wave: Float32, room: np.uint64, phasors: Float32) -> None:
    """A block's cosines, and sines ``room`` further on."""
    for i in range(size):
        phasors[first + i] = wave[i]
    for i in range(size):
        phasors[first + i + room] = wave[i + uint64(BLOCK)]


@njit(**OPTIONS)
def chip_legs(count: int, table: Float32, x: np.float32, step: np.float32, slots: int, cells_per_turn: np.float32,
              swing: Float32, swing_step: Float32, cell: Float32, part: Float32, wave: Float32) -> None:  # fmt: skip
    """Phasors of the chips' middles at slot 0 of one loop, how they turn from slot to slot, and places on the grid.

    Args:
        count: scatterers.
        table, x: of ``station_paths``, the chips' middles; x of the loop's middle.
        step: of x from slot to slot; 0: nothing moves.
        slots: of a loop.
        cells_per_turn: float32.
        swing, swing_step: float32 [chips, 2 * capacity], overwritten: cosines, then sines.
        cell: float32 [2, chips, capacity], overwritten: at the loop's middle less the table's base, change per slot.
        part, wave: float32 [BLOCK] and [2 * BLOCK], scratch.
    """
    room, back = uint64(swing.shape[1] // 2), float32(0.5 * (slots - 1))
    for d in range(table.shape[1]):
        begin, turn, rise, bow = table[0, d], table[1, d], table[2, d], table[3, d]
        place, drift, turned, turns = cell[0, d], cell[1, d], swing[d], swing_step[d]
        for first in range(uint64(0), uint64(count), uint64(BLOCK)):
            size = min(uint64(BLOCK), uint64(count) - first)
            for i in range(size):
                part[i] = x * (rise[first + i] + x * bow[first + i])
            for i in range(size):
                place[first + i] = begin[first + i] + cells_per_turn * part[i]
            for i in range(size):
                drift[first + i] = step * (rise[first + i] + float32(2) * x * bow[first + i])
            for i in range(size):
                part[i] += turn[first + i] - back * drift[first + i]
            _waves(size, part, wave)
            _store(first, size, wave, room, turned)
            if step > float32(0):
                for i in range(size):
                    part[i] = drift[first + i]
                _waves(size, part, wave)
                _store(first, size, wave, room, turns)
            for i in range(size):
                drift[first + i] *= cells_per_turn


@njit(inline="always")
def _rates(
    first: int, size: np.uint64, points: Float64, velocity: Float64, antenna: Float64, t: float, path: Float64, n: int
) -> None:
    """Change per second of the distances to receiver n."""
    for i in range(size):
        k = first + i
        x = points[0, k] + velocity[0, k] * t - antenna[0]
        y = points[1, k] + velocity[1, k] * t - antenna[1]
        z = points[2, k] + velocity[2, k] * t - antenna[2]
        dot = x * velocity[0, k] + y * velocity[1, k] + z * velocity[2, k]
        path[RATE + n, i] = dot / math.sqrt(x * x + y * y + z * z)


@njit(inline="always")
def _from_middle(size: np.uint64, path: Float64, row: np.uint64, apart: Float64) -> None:
    """What the group's four rows from ``row`` on have more than the row after them, [scatterer, RX]."""
    for i in range(size):
        for n in range(uint64(RX)):
            apart[uint64(RX) * i + n] = path[row + n, i] - path[row + uint64(RX), i]


@njit(inline="always")
def _weigh(size: np.uint64, apart: Float64, rate: Float64, scale: Float64, back_s: float, shape: np.float32,
           edge: np.float32, work: Float32) -> None:  # fmt: skip
    """Place in the group, weighted cosine and sine in the first run, exp(b place), exp(-b place): all receivers."""
    away, cosine, sine, rise, fall = work[0], work[1], work[2], work[3], work[4]
    for i in range(size):
        away[i] = float32(apart[i] * scale[0])
    for i in range(size):
        apart[i] = (apart[i] - rate[i] * back_s) * scale[1]
    for i in range(size):
        fall[i] = float32(apart[i] - np.floor(apart[i] + 0.5))
    for i in range(size):
        rise[i] = exponential(-shape * away[i] * (away[i] + float32(2) * edge))
    for i in range(size):
        cosine[i] = _circle(fall[i])[0] * rise[i]
    for i in range(size):
        sine[i] = _circle(fall[i])[1] * rise[i]
    for i in range(size):
        rise[i] = exponential(shape * away[i])
    for i in range(size):
        fall[i] = exponential(-shape * away[i])


@njit(inline="always")
def _write_legs(legs: Float32, first: int, size: np.uint64, work: Float32, b: np.float32, factors: Float32) -> None:
    """Lanes of a block of scatterers from what ``_weigh`` found."""
    span, rx = uint64(len(legs) // LEG_PLANES), uint64(RX)
    away, cosine, sine, rise, fall = work[0], work[1], work[2], work[3], work[4]
    for i in range(size):
        for c in range(uint64(CELLS)):
            lane, row = (first + i) * uint64(LANES) + c * rx, i * rx
            for n in range(rx):
                x = row + n
                level, twice = fall[x] * fall[x] * fall[x], rise[x] * rise[x]
                for _ in range(c):
                    level *= twice
                level *= factors[0, c]
                legs[lane + n], legs[lane + n + span] = level * cosine[x], level * sine[x]
                legs[lane + n + span + span] = float32(-2) * b * (away[x] + float32(1.5) - float32(c))
                legs[lane + n + span + span + span] = twice * twice * twice * twice * factors[1, c]


@njit(inline="always")
def _write_turns(turn: Float32, first: int, size: np.uint64, rate: Float64, turns_per_m: float, work: Float32) -> None:
    """Cosines and sines of the turn per run, in the order of the legs' lanes."""
    span, rx = uint64(len(turn) // 2), uint64(RX)
    part, cosine, sine = work[0], work[1], work[2]
    for i in range(size * rx):
        part[i] = float32(rate[i] * turns_per_m)
    for i in range(size * rx):
        cosine[i] = _circle(part[i])[0]
    for i in range(size * rx):
        sine[i] = _circle(part[i])[1]
    for i in range(size):
        for c in range(uint64(CELLS)):
            lane, row = (first + i) * uint64(LANES) + c * rx, i * rx
            for n in range(rx):
                turn[lane + n], turn[lane + n + span] = cosine[row + n], sine[row + n]


@njit(**OPTIONS)
def receive_legs(count: int, points: Float64, velocity: Float64, antennas: Float64, middles: Float64, scale: Float64,
                 timing: Float64, shape: np.float32, edge: np.float32, factors: Float32, legs: Float32, turn: Float32,
                 shortest: Float64, longest: Float64, path: Float64, apart: Float64,
                 work: Float32) -> None:  # fmt: skip
    """Phasors of every receiver from the middle of its chip with their share of the weights, and how they turn.

    Args:
        count, points, velocity: as for ``station_paths``.
        antennas: float64 [chips, RX, 3].
        middles: float64 [chips, 3].
        scale: as for ``station_paths``.
        timing: instants of the tangent and of the first run, time from run to run (0: no turns): float64 [3].
        shape, edge: float32; of the weights, and distance from a scatterer to the first step's middle.
        factors: float32 [2, CELLS], constants of a step's cells: of the first step's weight, of its ratio to the next.
        legs: float32 [chips, LEG_PLANES * span], overwritten, span >= capacity * LANES: state in the first run.
        turn: float32 [chips, 2 * span], overwritten: cosine and sine of the turn per run.
        shortest, longest: as for ``station_paths``, of one instant.
        path: float64 [2 * RX + 2, BLOCK], scratch.
        apart, work: float64 [2, RX * BLOCK], float32 [5, RX * BLOCK], scratch.
    """
    middle_s, back_s, run_s = timing[0], timing[0] - timing[1], timing[2]
    for d in range(len(antennas)):
        for first in range(uint64(0), uint64(count), uint64(BLOCK)):
            size = min(uint64(BLOCK), uint64(count) - first)
            for n in range(RX):
                _paths(first, size, points, velocity, antennas[d, n], middle_s, path, n)
                _extend(first, size, path, n, d == 0 and n == 0, shortest, longest)
                _rates(first, size, points, velocity, antennas[d, n], middle_s, path, n)
            _paths(first, size, points, velocity, middles[d], middle_s, path, MIDDLE)
            _rates(first, size, points, velocity, middles[d], middle_s, path, RX)
            _from_middle(size, path, uint64(0), apart[0])
            _from_middle(size, path, uint64(RATE), apart[1])
            _weigh(size * uint64(RX), apart[0], apart[1], scale, back_s, shape, edge, work)
            _write_legs(legs[d], first, size, work, shape, factors)
            if run_s > 0.0:
                _write_turns(turn[d], first, size, apart[1], run_s * scale[1], work)
