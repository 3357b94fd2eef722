# SPDX-License-Identifier: Apache-2.0
"""Optimal assignment of two equal point sets by the auction algorithm with eps scaling (numba kernel)."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.frames import Float32


@numba.njit(cache=True, nogil=True, error_model="numpy")
def auction(cost: Float32, tolerance: float, assignment: NDArray[np.int32]) -> None:
    """Assign every row its own column at a total cost within ``tolerance`` of the optimum.

    Gauss-Seidel auction (Bertsekas 1988): a free row takes the column of least cost + price and raises its price by
    the lead over the second best plus eps. A full assignment is then within n eps of the optimum. The mean over rows
    of the least cost bounds the mean optimal cost from below, so eps = tolerance * that mean keeps the promise.
    Larger eps come first, to find good prices fast.

    Args:
        cost: [n, n] >= 0, C-contiguous.
        tolerance: relative excess over the optimal total that is accepted, > 0.
        assignment: [n], column of every row, written.
    """
    n = cost.shape[0]
    bound = 0.0
    highest = np.float32(0)
    for row in range(n):
        least = cost[row, 0]
        for column in range(n):
            least = min(least, cost[row, column])
            highest = max(highest, cost[row, column])
        bound += least
    final = np.float32(max(tolerance * bound / n, 1e-5 * highest + 1e-12))
    eps = max(final, np.float32(highest / 8))
    price = np.zeros(n, np.float32)
    owner = np.empty(n, np.int32)
    queue = np.empty(n, np.int32)
    while True:
        owner[:] = -1
        for row in range(n):
            queue[row] = row
        free = n
        while free > 0:
            row = queue[free - 1]
            first, second, winner = np.float32(np.inf), np.float32(np.inf), 0
            for column in range(n):
                value = cost[row, column] + price[column]
                if value < second:
                    if value < first:
                        second, first, winner = first, value, column
                    else:
                        second = value
            if n == 1:
                second = first
            price[winner] += second - first + eps
            loser = owner[winner]
            owner[winner] = row
            assignment[row] = winner
            if loser >= 0:
                queue[free - 1] = loser
            else:
                free -= 1
        if eps <= final:
            return
        eps = max(final, np.float32(eps / 4))


def assign(first: Float32, second: Float32, tolerance: float = 0.01) -> NDArray[np.int32]:
    """Partner in ``second`` of every point of ``first``: a bijection that nearly minimises the mean distance.

    Args:
        first, second: float32 [n, 3], finite, equal n >= 1.
        tolerance: relative excess of the mean distance over the optimum that is accepted.
    Returns:
        int32 [n], a permutation.
    Raises:
        ConfigError: different sizes, values that are not finite, or a tolerance outside 0..1.
    """
    require(first.shape == second.shape and len(first) >= 1, "point sets", second.shape, f"{first.shape}")
    require(bool(np.isfinite(first).all() and np.isfinite(second).all()), "point sets", "NaN or infinity", "finite")
    require(0 < tolerance < 1, "tolerance", tolerance, "0..1")
    assignment = np.empty(len(first), np.int32)
    auction(_distances(np.ascontiguousarray(first), np.ascontiguousarray(second)), tolerance, assignment)
    return assignment


@numba.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _distances(first: Float32, second: Float32) -> Float32:
    """All distances, float32 [n, m]."""
    result = np.empty((first.shape[0], second.shape[0]), np.float32)
    for i in range(first.shape[0]):
        for j in range(second.shape[0]):
            dx = first[i, 0] - second[j, 0]
            dy = first[i, 1] - second[j, 1]
            dz = first[i, 2] - second[j, 2]
            result[i, j] = np.sqrt(dx * dx + dy * dy + dz * dz)
    return result
