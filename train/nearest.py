# SPDX-License-Identifier: Apache-2.0
"""Exact nearest neighbours in 3-D by a uniform grid (numba kernel)."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.frames import Float32, Float64

_SHELLS = 5
_BLOCK = 256


@numba.njit(cache=True, nogil=True, error_model="numpy")
def nearest(query: Float32, target: Float32, index: NDArray[np.int32]) -> None:
    """Index of the nearest target point of every query point.

    Cells are visited in growing shells around the query's own cell. A point outside shell r is at least r cells away
    from the query's projection onto the grid's box, and the box is convex, so the search ends exactly when
    best^2 <= (r cell)^2 + |query - projection|^2. A query that needs more than five shells is compared with all.

    Args:
        query: [q, 3], C-contiguous, finite.
        target: [t, 3], t >= 1, finite.
        index: [q], written.
    """
    count = target.shape[0]
    low = np.empty(3, np.float32)
    high = np.empty(3, np.float32)
    for axis in range(3):
        low[axis] = target[:, axis].min()
        high[axis] = target[:, axis].max()
    extent = max(high[0] - low[0], max(high[1] - low[1], high[2] - low[2]))
    side = min(64, max(1, int(0.5 * np.sqrt(count))))
    cell = max(np.float32(extent / side), np.float32(1e-9))
    size = np.empty(3, np.int64)
    for axis in range(3):
        size[axis] = int((high[axis] - low[axis]) / cell) + 1
    start = np.zeros(size[0] * size[1] * size[2] + 1, np.int32)
    home = np.empty(count, np.int32)
    for i in range(count):
        code = 0
        for axis in range(3):
            code = code * size[axis] + min(size[axis] - 1, int((target[i, axis] - low[axis]) / cell))
        home[i] = code
        start[code + 1] += 1
    for code in range(len(start) - 1):
        start[code + 1] += start[code]
    order = np.empty(count, np.int32)
    fill = start[:-1].copy()
    for i in range(count):
        order[fill[home[i]]] = i
        fill[home[i]] += 1
    center = np.empty(3, np.int64)
    columns = np.ascontiguousarray(target.T)
    sorted_by_cell = target[order]
    for q in range(query.shape[0]):
        outside = np.float32(0)
        for axis in range(3):
            inside = min(max(query[q, axis], low[axis]), high[axis])
            outside += (query[q, axis] - inside) ** 2
            center[axis] = min(size[axis] - 1, int((inside - low[axis]) / cell))
        index[q] = _near(query[q], sorted_by_cell, order, start, size, center, cell, outside)
        if index[q] < 0:
            index[q] = _far(query[q, 0], query[q, 1], query[q, 2], columns)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _near(
    point: Float32,
    target: Float32,
    order: NDArray[np.int32],
    start: NDArray[np.int32],
    size: NDArray[np.int64],
    center: NDArray[np.int64],
    cell: np.float32,
    outside: np.float32,
) -> int:
    """Nearest target of one point, shell by shell; -1 when the shells do not settle it."""
    best = np.float32(np.inf)
    found = -1
    for r in range(_SHELLS + 2):
        if r > 0 and best <= ((r - 1) * cell) ** 2 + outside:
            return found
        if r > _SHELLS:
            return -1
        for x in range(max(0, center[0] - r), min(size[0] - 1, center[0] + r) + 1):
            for y in range(max(0, center[1] - r), min(size[1] - 1, center[1] + r) + 1):
                face = abs(x - center[0]) == r or abs(y - center[1]) == r
                column = (x * size[1] + y) * size[2]
                low, high = max(0, center[2] - r), min(size[2] - 1, center[2] + r)
                for part in range(1 if face or r == 0 else 2):  # a face's cells follow each other
                    first, last = low, high
                    if not face and r > 0:
                        first = last = center[2] + (2 * part - 1) * r
                        if first < 0 or first >= size[2]:
                            continue
                    for k in range(start[column + first], start[column + last + 1]):
                        dx = point[0] - target[k, 0]
                        dy = point[1] - target[k, 1]
                        dz = point[2] - target[k, 2]
                        distance = dx * dx + dy * dy + dz * dz
                        if distance < best:
                            best = distance
                            found = order[k]
    return -1


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _far(x: float, y: float, z: float, columns: Float32) -> int:
    """Nearest of all targets (columns [3, t]): the least of every block first, then the place in the best block."""
    count = columns.shape[1]
    best = np.float32(np.inf)
    block = 0
    for begin in range(0, count, _BLOCK):
        least = np.float32(np.inf)
        for i in range(begin, min(count, begin + _BLOCK)):
            dx, dy, dz = x - columns[0, i], y - columns[1, i], z - columns[2, i]
            least = min(least, dx * dx + dy * dy + dz * dz)
        if least < best:
            best, block = least, begin
    best = np.float32(np.inf)
    found = block
    for i in range(block, min(count, block + _BLOCK)):
        dx, dy, dz = x - columns[0, i], y - columns[1, i], z - columns[2, i]
        distance = dx * dx + dy * dy + dz * dz
        if distance < best:
            best, found = distance, i
    return found


def nearest_index(query: Float32, target: Float32) -> NDArray[np.int32]:
    """Index of the nearest target point of every query point: int32 [q] (see ``nearest``).

    Raises:
        ConfigError: no target, or values that are not finite.
    """
    require(len(target) >= 1, "nearest.target", len(target), ">= 1 point")
    require(bool(np.isfinite(query).all() and np.isfinite(target).all()), "points", "NaN or infinity", "finite")
    index = np.empty(len(query), np.int32)
    nearest(np.ascontiguousarray(query), np.ascontiguousarray(target), index)
    return index


def nearest_distance(query: Float32, target: Float32) -> Float64:
    """Distance from every query point to its nearest target point: float64 [q], in the points' unit."""
    difference = query.astype(np.float64) - target[nearest_index(query, target)]
    distance: Float64 = np.sqrt((difference * difference).sum(axis=1))
    return distance
