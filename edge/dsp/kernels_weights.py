# SPDX-License-Identifier: Apache-2.0
"""Kernel that solves for weights with level lobes: least squares, reweighted by the error (Lawson 1961)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import boolean, float64, int64, njit

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

KEPT_EMPHASIS = 0.2


@njit(inline="always")
def _solve(normal, x):  # type: ignore[no-untyped-def]
    """x <- normal^-1 x for a positive definite matrix, of which only the lower triangle is read; it is overwritten."""
    n = len(x)
    for i in range(n):
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= normal[i, k] * normal[j, k]
            normal[i, j] = total / normal[j, j] if j < i else np.sqrt(total)
    for i in range(n):
        for k in range(i):
            x[i] -= normal[i, k] * x[k]
        x[i] /= normal[i, i]
    for i in range(n - 1, -1, -1):
        x[i] /= normal[i, i]
        for k in range(i):
            x[k] -= normal[i, k] * x[i]


@njit(
    float64(
        *(float64[:, ::1], float64[::1], boolean[::1], float64, float64, float64, int64),
        *(float64[:, ::1], float64[:, ::1]),
    ),
    **OPTIONS,
)
def level_lobes(rows, wanted, beyond, main_lobe, ridge, level, rounds, normal, weight):  # type: ignore[no-untyped-def]
    """Real weights of the lowest maximum of |rows w| beyond the main lobe; ends early once it is below ``level``.

    Args:
        rows: float64 [2 * points, n], real and imaginary parts alternate.
        wanted: float64 [points], real.
        beyond: bool [points], where the error is to be level; elsewhere it counts ``main_lobe`` times.
        main_lobe, ridge, level: as said; the ridge is relative to the mean over points.
        rounds: at most.
        normal: float64 [n, n] scratch.
        weight: float64 [2, n], receives the best weights, which sum to 1, and the last.
    Returns:
        The maximum.
    """
    points, n = len(wanted), rows.shape[1]
    emphasis, error = np.empty(points), np.zeros(points)
    for p in range(points):
        emphasis[p] = 1.0 if beyond[p] else main_lobe
    lowest = 1e30
    best, w = weight[0], weight[1]
    for _ in range(rounds):
        normal[:] = 0.0
        w[:] = 0.0
        for p in range(0, points, 2):
            q = min(p + 1, points - 1)
            share, other = emphasis[p] / points, emphasis[q] / points if q > p else 0.0
            ar, ai, br, bi = rows[2 * p], rows[2 * p + 1], rows[2 * q], rows[2 * q + 1]
            for i in range(n):
                fr, fi, gr, gi = share * ar[i], share * ai[i], other * br[i], other * bi[i]
                w[i] += fr * wanted[p] + gr * wanted[q]
                line = normal[i]
                for k in range(i + 1):
                    line[k] += fr * ar[k] + fi * ai[k] + gr * br[k] + gi * bi[k]
        for i in range(n):
            normal[i, i] += ridge
        _solve(normal, w)
        w /= w.sum()
        largest = 0.0
        for p in range(points):
            re, im = 0.0, 0.0
            for i in range(n):
                re += rows[2 * p, i] * w[i]
                im += rows[2 * p + 1, i] * w[i]
            error[p] = np.sqrt(re * re + im * im)
            largest = max(largest, error[p]) if beyond[p] else largest
        if largest < lowest:
            lowest = largest
            for i in range(n):  # a copy of a slice would compile a second for its error message
                best[i] = w[i]
        if largest <= level:
            break
        mean, count = 0.0, 0
        for p in range(points):
            if beyond[p]:
                emphasis[p] *= KEPT_EMPHASIS + error[p] / largest
                mean += emphasis[p]
                count += 1
        for p in range(points):
            if beyond[p]:
                emphasis[p] *= count / mean
    return lowest
