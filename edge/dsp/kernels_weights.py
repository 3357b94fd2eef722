# SPDX-License-Identifier: Apache-2.0
"""Kernel that solves for weights with level lobes: least squares, reweighted by the error (Lawson 1961).

A channel's phase towards a point is linear in its element and in its slot. Entries of the normal matrix depend on the
differences of two channels only, and most pairs share theirs: the cascade's 144 channels have 621 different ones among
10440 pairs. Responses are sums over slots of sums over elements. Points are innermost everywhere; sums over them are
float32, whose rounding the ridge outweighs by far.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import boolean, float32, float64, int64, njit

from edge.kernels_arrays import Bool, Float32, Float64, Int64

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

KEPT_EMPHASIS = 0.2
PLANE, WHOLE = float64[:, ::1], int64[:, ::1]


@njit(inline="always")
def _copy(source: Float64, target: Float64) -> None:
    """Value by value: a copy of a slice would compile a second for its error message."""
    for i in range(len(target)):
        target[i] = source[i]


@njit(inline="always")
def _turns(step: Float64, out: Float32) -> None:
    """out [(cos, sin), n, points] = exp(j n step), by recurrence."""
    for p in range(len(step)):
        out[0, 0, p], out[1, 0, p] = 1.0, 0.0
    if out.shape[1] > 1:
        for p in range(len(step)):
            out[0, 1, p], out[1, 1, p] = np.cos(step[p]), np.sin(step[p])
    for n in range(2, out.shape[1]):
        for p in range(len(step)):
            re, im, cosine, sine = out[0, n - 1, p], out[1, n - 1, p], out[0, 1, p], out[1, 1, p]
            out[0, n, p] = re * cosine - im * sine
            out[1, n, p] = re * sine + im * cosine


@njit(inline="always")
def _right_hand_side(
    step: Float64, share: Float64, wanted: Float64, place: Float64, emphasis: Float32, right: Float64
) -> None:
    """Sum over points of emphasis share^2 wanted cos(phase), by channel."""
    right[:] = 0.0
    for p in range(len(share)):
        if wanted[p] != 0.0:
            scale = emphasis[p] * share[p] * share[p] * wanted[p]
            for c in range(len(right)):
                right[c] += scale * np.cos(place[0, c] * step[0, p] + place[1, c] * step[1, p])


@njit(inline="always")
def _normal_matrix(
    along: Float32,
    late: Float32,
    share: Float64,
    emphasis: Float32,
    pair: Int64,
    of: Int64,
    ridge: float,
    sums: Float64,
    normal: Float64,
) -> None:
    """Lower triangle of sum over points of emphasis share^2 cos(difference of two channels' phases), and the ridge."""
    points = len(share)
    for s in range(late.shape[1]):
        for p in range(points):
            scale = emphasis[p] * float32(share[p] * share[p])
            late[2, s, p], late[3, s, p] = late[0, s, p] * scale, late[1, s, p] * scale
    for n in range(pair.shape[1]):
        e, s, both, other = pair[0, n], abs(pair[1, n]), float32(0), float32(0)
        for p in range(points):
            both += along[0, e, p] * late[2, s, p]
        for p in range(points):
            other += along[1, e, p] * late[3, s, p]
        sums[n] = float64(both) - other if pair[1, n] >= 0 else float64(both) + other
    for i in range(normal.shape[0]):
        for k in range(i + 1):
            normal[i, k] = sums[of[i, k]]
        normal[i, i] += ridge


@njit(inline="always")
def _solve(normal: Float64, x: Float64) -> None:
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


@njit(inline="always")
def _respond(
    along: Float32,
    late: Float32,
    share: Float64,
    beyond: Bool,
    index: Int64,
    weight: Float64,
    part: Float32,
    error: Float32,
) -> np.float32:
    """error [point] = share |response|; returns the largest beyond the main lobe.

    ``part`` [4, points] holds the sums of one slot and of all of them.
    """
    points, largest = len(share), float32(0)
    part[:] = float32(0)
    for s in range(late.shape[1]):
        for p in range(points):
            part[0, p], part[1, p] = float32(0), float32(0)
        for c in range(len(weight)):
            if index[1, c] == s:
                e, w = index[0, c], float32(weight[c])
                for p in range(points):
                    part[0, p] += w * along[0, e, p]
                    part[1, p] += w * along[1, e, p]
        for p in range(points):
            part[2, p] += part[0, p] * late[0, s, p] - part[1, p] * late[1, s, p]
            part[3, p] += part[0, p] * late[1, s, p] + part[1, p] * late[0, s, p]
    for p in range(points):
        error[p] = float32(share[p]) * np.sqrt(part[2, p] * part[2, p] + part[3, p] * part[3, p])
        largest = max(largest, error[p]) if beyond[p] else largest
    return largest


@njit(inline="always")
def _reweigh(error: Float32, beyond: Bool, largest: np.float32, emphasis: Float32) -> None:
    """Emphasis of the points beyond the main lobe by their error, its mean kept."""
    before, after = 0.0, 0.0
    for p in range(len(error)):
        if beyond[p]:
            before += emphasis[p]
            emphasis[p] *= KEPT_EMPHASIS + error[p] / largest
            after += emphasis[p]
    for p in range(len(error)):
        if beyond[p]:
            emphasis[p] *= before / after


@njit(
    float64(
        *(PLANE, PLANE, boolean[::1], PLANE, WHOLE, WHOLE, WHOLE, float64, float64, float64, int64),
        *(float32[:, :, ::1], float32[:, :, ::1], float32[:, ::1], float64[::1], PLANE, PLANE),
    ),
    **OPTIONS,
)
def level_lobes(
    step: Float64,
    point: Float64,
    beyond: Bool,
    place: Float64,
    index: Int64,
    pair: Int64,
    of: Int64,
    main_lobe: float,
    ridge: float,
    level: float,
    rounds: int,
    along: Float32,
    late: Float32,
    line: Float32,
    sums: Float64,
    normal: Float64,
    weight: Float64,
) -> float:
    """Real weights of the lowest maximum of |response| beyond the main lobe; ends early once it is below ``level``.

    A channel's response to point p has the phase place[0] step[0, p] + place[1] step[1, p].

    Args:
        step: float64 [2, points], phase from element to element and from slot to slot.
        point: float64 [2, points], how much each counts, and the wanted response, real.
        beyond: bool [points], where the error is to be level; elsewhere it counts ``main_lobe`` times.
        place: float64 [2, n], element and slot of every channel, from the middle.
        index: int64 [2, n], the same, counted from 0.
        pair: int64 [2, pairs], different differences of two channels in elements (not negative) and in slots.
        of: int64 [n, n], which of them two channels have.
        main_lobe, ridge, level, rounds: as said, at most so many; the ridge is relative to the mean over points.
        along, late, line: float32 [2, elements, points], [4, slots, points] and [6, points] scratch.
        sums, normal: float64 [pairs] and [n, n] scratch.
        weight: float64 [3, n], receives the best weights, which sum to 1, and the last; scratch.
    Returns:
        The maximum.
    """
    points, share = len(beyond), point[0]
    emphasis, error, part = line[0], line[1], line[2:]
    best, w, right = weight[0], weight[1], weight[2]
    for p in range(points):
        emphasis[p] = (1.0 if beyond[p] else main_lobe) / points
    _turns(step[0], along)
    _turns(step[1], late)
    _right_hand_side(step, share, point[1], place, emphasis, right)
    lowest = 1e30
    for _ in range(rounds):
        _normal_matrix(along, late, share, emphasis, pair, of, ridge, sums, normal)
        _copy(right, w)
        _solve(normal, w)
        w /= w.sum()
        largest = _respond(along, late, share, beyond, index, w, part, error)
        if largest < lowest:
            lowest = largest  # type: ignore[assignment]
            _copy(w, best)
        if largest <= level:
            break
        _reweigh(error, beyond, largest, emphasis)
    return lowest
