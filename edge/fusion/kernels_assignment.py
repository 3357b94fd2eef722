# SPDX-License-Identifier: Apache-2.0
"""Kernels of the optimal one-to-one assignment between two lists in range order, for the pairs within a range gate.

Rows are the horizontal radar's detections, columns the vertical radar's. The candidates of a row are the columns within
the gate, a window of the column list that only moves forward from row to row; ``weight[start[i] + j - first[i]]``
belongs to row i and column j: the less the better, 0 for one that is worth no more than none. All arithmetic is float64
and unreordered.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, float64, int64, njit, types

from edge.fusion.kernels_association import BINS, COLUMNS, POWER, REAL, UNMATCHED, WHOLE, judge
from edge.kernels_arrays import Float32, Float64, Int64

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "boundscheck": False, "cache": True}


@njit(int64(WHOLE, int64, int64, REAL, float64, WHOLE, WHOLE), **OPTIONS)
def windows(order: Int64, split: int, total: int, common: Float64, gate_m: float, first: Int64, start: Int64) -> int:
    """Candidates of every row.

    Args:
        order: [total], the rows in range order, then, from ``split`` on, the columns in range order.
        split, total: rows; rows and columns.
        common: range from the common origin, by detection.
        gate_m: largest difference.
        first: receives every row's first column.
        start: [rows + 1 or more], receives every row's first candidate and, last, how many there are.
    Returns:
        Candidates of all rows together.
    """
    columns, low, high, candidates = total - split, 0, 0, 0
    for i in range(split):
        r = common[order[i]]
        while low < columns and r - common[order[split + low]] > gate_m:
            low += 1
        high = max(high, low)
        while high < columns and common[order[split + high]] - r <= gate_m:
            high += 1
        first[i], start[i] = low, candidates
        candidates += high - low
    start[split] = candidates
    return candidates


@njit(
    types.void(
        *(WHOLE, int64, REAL, REAL, WHOLE, COLUMNS, COLUMNS, float32[::1], float32[::1]),
        *(float64[:, ::1], REAL, REAL, REAL, WHOLE, WHOLE, REAL),
    ),
    **OPTIONS,
)
def weigh(
    order: Int64,
    split: int,
    common: Float64,
    level: Float64,
    source: Int64,
    horizontal: tuple[Float32, Float32, Float32],
    vertical: tuple[Float32, Float32, Float32],
    speed_h: Float32,
    speed_v: Float32,
    board: Float64,
    up: Float64,
    limits: Float64,
    scales: Float64,
    first: Int64,
    start: Int64,
    weight: Float64,
) -> None:
    """Weight of every candidate: dr^2 / 2 sigma^2 + 2 ln cosh(dL / 2 s) + dv^2 / 2 sigma_v^2 - most, but never above 0.

    Args:
        order, split, common, first, start: as ``windows`` has them.
        level, source: by detection; what can be compared, and the index in the radar's columns.
        horizontal, vertical: columns of the radars.
        speed_h, speed_v: [n], radial speeds, NaN where none was measured: such a pair has no term in dv.
        board, up, limits: as ``judge`` has them; what it refuses weighs 0.
        scales: [4], sigma in m, s in dB, sigma_v in m/s, most.
        weight: [candidates or more], receives the weights.
    """
    for i in range(split):
        h = order[i]
        n = source[h]
        r_h, u = float64(horizontal[0][n]), float64(horizontal[1][n])
        for e in range(start[i], start[i + 1]):
            v = order[split + first[i] + e - start[i]]
            apart, louder = (common[h] - common[v]) / scales[0], abs(level[h] - level[v]) / scales[1]
            worth = 0.5 * apart * apart + louder + 2.0 * np.log(0.5 + 0.5 * np.exp(-louder)) - scales[3]
            faster = (float64(speed_h[n]) - float64(speed_v[source[v]])) / scales[2]
            if faster == faster:
                worth += 0.5 * faster * faster
            weight[e] = 0.0
            if worth < 0.0:
                m = source[v]
                verdict, _, _, _ = judge(r_h, u, float64(vertical[0][m]), float64(vertical[1][m]), board, up, limits)
                if verdict < 0:
                    weight[e] = worth


@njit(inline="always")
def _reach(
    j: int, through: int, distance_j: float, distance: Float64, way: Int64, done: Int64, reached: Int64, count: int
) -> int:
    """Note a path to column j if it is the shortest so far; returns how many columns were reached."""
    if done[j] == 0 and distance_j < distance[j]:
        if distance[j] == np.inf:
            reached[count] = j
            count += 1
        distance[j], way[j] = distance_j, through
    return count


@njit(types.void(int64, int64, WHOLE, WHOLE, REAL, REAL, REAL, REAL, WHOLE, WHOLE, WHOLE, WHOLE), **OPTIONS)
def insert(
    row: int,
    columns: int,
    first: Int64,
    start: Int64,
    weight: Float64,
    row_price: Float64,
    column_price: Float64,
    distance: Float64,
    owner: Int64,
    way: Int64,
    done: Int64,
    reached: Int64,
) -> None:
    """Give one more row a column along the shortest augmenting path (Dijkstra on reduced weights).

    Args:
        row: the row; those before it own a column each.
        columns: real columns; column ``columns + i`` has weight 0 and row i alone may own it: then it has no partner.
        first, start, weight: candidates.
        row_price, column_price: dual variables, updated.
        distance: infinity for every column, and again afterwards.
        owner: row of every column, or -1; updated.
        way, reached: scratch.
        done: 0 for every column, and again afterwards.
    """
    at, here, base, count = row, -1, 0.0, 0
    while True:
        for e in range(start[at], start[at + 1]):
            if weight[e] < 0.0:
                j = first[at] + e - start[at]
                reduced = base + (weight[e] - row_price[at] - column_price[j])
                count = _reach(j, here, reduced, distance, way, done, reached, count)
        j = columns + at
        reduced = base + (-row_price[at] - column_price[j])
        count = _reach(j, here, reduced, distance, way, done, reached, count)
        here, base = -1, np.inf
        for k in range(count):
            if done[reached[k]] == 0 and distance[reached[k]] < base:
                here, base = reached[k], distance[reached[k]]
        done[here] = 1
        if owner[here] < 0:
            break
        at = owner[here]
    row_price[row] += base
    for k in range(count):
        j = reached[k]
        if done[j] == 1 and owner[j] >= 0:
            column_price[j] += distance[j] - base
            row_price[owner[j]] += base - distance[j]
        distance[j], done[j] = np.inf, 0
    while here >= 0:
        before = way[here]
        owner[here] = owner[before] if before >= 0 else row
        here = before


@njit(
    int64(
        *(WHOLE, int64, int64, WHOLE, WHOLE, REAL, float64[:, ::1], int64[:, ::1]),
        *(int64[:, ::1], WHOLE),
    ),
    **OPTIONS,
)
def assign(
    order: Int64,
    split: int,
    total: int,
    first: Int64,
    start: Int64,
    weight: Float64,
    price: Float64,
    scratch: Int64,
    pairs: Int64,
    counts: Int64,
) -> int:
    """Pairs of the one-to-one assignment with the least sum of weights (Hungarian method, shortest augmenting paths).

    Only columns that a path reaches are looked at: the work grows with the crowd in a range bin, not with the frame.

    Args:
        order, split, total, first, start, weight: rows, columns and candidates.
        price: float64 [3, total or more], scratch.
        scratch: int64 [4, total or more], scratch.
        pairs: int64 [2, n], receives the detections in the rows' order.
        counts: BINS (groups of rows whose possible partners overlap), UNMATCHED (detections without possible partner)
            and POWER (detections whose possible partners are better off with others) are increased.
    Returns:
        Pairs.
    """
    columns = total - split
    row_price, column_price, distance = price[0], price[1], price[2]
    owner, way, done, reached = scratch[0], scratch[1], scratch[2], scratch[3]
    row_price[:total], column_price[:total], distance[:total] = 0.0, 0.0, np.inf
    owner[:total], done[:total] = -1, 0
    for row in range(split):
        insert(row, columns, first, start, weight, row_price, column_price, distance, owner, way, done, reached)
    partner = way
    partner[:split] = -1
    for j in range(columns):
        if owner[j] >= 0:
            partner[owner[j]] = j
    found, alone, last = 0, total, -1
    for i in range(split):
        possible = False
        for e in range(start[i], start[i + 1]):
            if weight[e] < 0.0:
                j = first[i] + e - start[i]
                counts[BINS] += not possible and j > last
                possible, last = True, max(last, j)
                alone -= 1 - done[j]
                done[j] = 1
        alone -= possible
        if partner[i] >= 0:
            pairs[0, found], pairs[1, found] = order[i], order[split + partner[i]]
            found += 1
    counts[UNMATCHED] += alone
    counts[POWER] += total - alone - 2 * found
    return found
