# SPDX-License-Identifier: Apache-2.0
"""Numba kernels behind ``neighbours``: what torch does on a CPU in several passes over large tensors."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from edge.frames import Float32

Int64 = NDArray[np.int64]


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"nnan", "ninf"})
def nearest_of(queries: Float32, points: Float32, allowed: NDArray[np.bool_], index: Int64) -> None:
    """The nearest points of every query, nearest first; of equally near ones the earlier.

    Args:
        queries, points: [b, q, 3] and [b, p, 3], finite.
        allowed: [b, q, p], or [b, 0, 0]: all; others come last.
        index: [b, q, k], k <= p, written.
    """
    for batch in range(len(queries)):
        _nearest_of(queries[batch], points[batch], allowed[batch], index[batch])


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"nnan", "ninf"})
def _nearest_of(queries: Float32, points: Float32, allowed: NDArray[np.bool_], index: Int64) -> None:
    count, size = points.shape[0], index.shape[1]
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    apart = np.empty(count, np.float32)
    best = np.empty(size, np.float32)
    for q in range(len(queries)):
        a, b, c = queries[q]
        for p in range(count):
            apart[p] = (x[p] - a) ** 2 + (y[p] - b) ** 2 + (z[p] - c) ** 2
        if len(allowed):
            for p in range(count):
                apart[p] += np.float32(0) if allowed[q, p] else np.float32(1e12)
        for p in range(size):
            _insert(apart[p], p, p, best, index[q])
        worst = best[size - 1]
        for p in range(size, count):
            if apart[p] < worst:
                _insert(apart[p], p, size - 1, best, index[q])
                worst = best[size - 1]


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _insert(value: np.float32, row: int, place: int, best: Float32, index: Int64) -> None:
    """Put a value, at most that of ``place``, where it belongs in the rising ``best``; that of ``place`` is lost."""
    while place > 0 and best[place - 1] > value:
        best[place] = best[place - 1]
        index[place] = index[place - 1]
        place -= 1
    best[place] = value
    index[place] = row


@numba.njit(cache=True, nogil=True, error_model="numpy")
def most_of(values: Float32, index: Int64, most: Float32, winner: Int64) -> None:
    """Maximum over neighbours, channel by channel; of equal ones the first wins.

    Args:
        values: [b, n, c], C-contiguous.
        index: [b, q, k], rows of ``values``.
        most: [b, q, c], written.
        winner: [b, q, c], the row whose value it is, written.
    """
    for batch in range(len(values)):
        _most_of(values[batch], index[batch], most[batch], winner[batch])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _most_of(values: Float32, index: Int64, most: Float32, winner: Int64) -> None:
    for q in range(len(index)):
        first = index[q, 0]
        for channel in range(values.shape[1]):
            most[q, channel] = values[first, channel]
            winner[q, channel] = first
        for k in range(1, index.shape[1]):
            row = index[q, k]
            for channel in range(values.shape[1]):
                more = values[row, channel] > most[q, channel]
                most[q, channel] = values[row, channel] if more else most[q, channel]
                winner[q, channel] = row if more else winner[q, channel]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def back_to_winners(gradient: Float32, winner: Int64, into: Float32) -> None:
    """Gradient of ``most_of``: [b, q, c] is added to the winners' rows of ``into`` [b, n, c]."""
    for batch in range(len(winner)):
        for q in range(winner.shape[1]):
            for channel in range(gradient.shape[2]):
                into[batch, winner[batch, q, channel], channel] += gradient[batch, q, channel]
