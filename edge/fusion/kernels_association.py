# SPDX-License-Identifier: Apache-2.0
"""Kernels that pair both radars' detections and place the pairs in space.

Detections of both radars share one index: those of the horizontal radar that are kept come first, ``split`` of them,
then the vertical radar's. All arithmetic is float64 and unreordered, so that no decision depends on the machine.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import boolean, float32, float64, int64, njit, types

from edge.kernels_arrays import Float32, Float64, Int64

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "boundscheck": False, "cache": True}

INVALID, FOV, SIDELOBE, BINS, UNMATCHED, POWER, PAIRS, GEOMETRY, GROUND, HEIGHT, POINTS = range(11)
"""Places in ``counts``."""

COLUMNS = types.UniTuple(float32[::1], 3)  # type: ignore[no-untyped-call]
REAL, WHOLE = float64[::1], int64[::1]


@njit(inline="always")
def _loss_db(cosine: float, pattern: Float64) -> float:
    """One-way loss across the array at a direction cosine; pattern: edge in degrees, loss there, most."""
    angle_deg = np.degrees(np.arcsin(min(max(cosine, -1.0), 1.0)))
    return min(pattern[1] * (angle_deg / pattern[0]) ** 2, pattern[2])  # type: ignore[no-any-return]


@njit(inline="always")
def _is_sidelobe(n: int, range_m: Float32, power_db: Float32, sidelobe: Float64) -> bool:
    """Whether some detection at the same range is stronger by more than sidelobe[0] dB; the same: sidelobe[1] m."""
    r, enough_db = float64(range_m[n]), float64(power_db[n]) + sidelobe[0]
    for m in range(len(range_m)):
        if enough_db < power_db[m] < np.inf and abs(float64(range_m[m]) - r) <= sidelobe[1]:
            return True
    return False


@njit(int64(COLUMNS, REAL, REAL, float64, REAL, int64, WHOLE, REAL, REAL, WHOLE), **OPTIONS)
def describe(
    columns: tuple[Float32, Float32, Float32],
    board: Float64,
    pattern: Float64,
    sine_fov: float,
    sidelobe: Float64,
    start: int,
    source: Int64,
    common: Float64,
    level: Float64,
    counts: Int64,
) -> int:
    """One radar's detections: keep the main lobes in the field of view and give what both radars can compare.

    Args:
        columns: range m, direction cosine, power dB of the radar, float32 [n] each.
        board: [3], phase centre from the common origin, forward and along the array, m; power offset, dB.
        pattern: [3], loss across an array: edge in degrees, one-way loss there in dB, most in dB.
        sine_fov: largest |cosine|.
        sidelobe: [2], a detection this many dB weaker than another one within so many m of range is its sidelobe.
        start: first place to fill.
        source: receives the index in the columns.
        common: receives the range from the common origin.
        level: receives the power less the loss that the other radar has at this cosine: equal in both for one target.
        counts: INVALID, FOV and SIDELOBE are increased.
    Returns:
        One past the last place filled.
    """
    range_m, cosine, power_db = columns
    place = start
    for n in range(len(range_m)):
        r, c, p = float64(range_m[n]), float64(cosine[n]), float64(power_db[n])
        if not (np.isfinite(r) and np.isfinite(c) and np.isfinite(p) and r > 0.0):
            counts[INVALID] += 1
            continue
        if abs(c) > sine_fov:
            counts[FOV] += 1
            continue
        if _is_sidelobe(n, range_m, power_db, sidelobe):
            counts[SIDELOBE] += 1
            continue
        ahead = board[0] * np.sqrt(1.0 - c * c) + board[1] * c
        common[place] = np.sqrt(max(r * r + 2.0 * r * ahead + board[0] ** 2 + board[1] ** 2, 0.0))
        level[place] = p + board[2] - 2.0 * _loss_db(c, pattern)
        source[place] = n
        place += 1
    return place


@njit(inline="always")
def _before(i: int, j: int, key: Float64, tie: Float64) -> bool:
    """Whether i sorts before j: by key, then tie, then index."""
    if key[i] != key[j]:
        return key[i] < key[j]  # type: ignore[no-any-return]
    if tie[i] != tie[j]:
        return tie[i] < tie[j]  # type: ignore[no-any-return]
    return i < j


@njit(types.void(WHOLE, int64, int64, REAL, REAL), **OPTIONS)
def sort(order: Int64, first: int, last: int, key: Float64, tie: Float64) -> None:
    """Heap sort of ``order[first:last]`` by key, then tie, then index, ascending."""
    size = last - first
    for step in range(size // 2 + size):
        root, end = size // 2 - 1 - step, size
        if root < 0:
            root, end = 0, size - 1 - (step - size // 2)
            order[first], order[first + end] = order[first + end], order[first]
        while 2 * root + 1 < end:
            child = 2 * root + 1
            if child + 1 < end and _before(order[first + child], order[first + child + 1], key, tie):
                child += 1
            if not _before(order[first + root], order[first + child], key, tie):
                break
            order[first + root], order[first + child] = order[first + child], order[first + root]
            root = child


@njit(types.void(WHOLE, int64, int64, int64[:, ::1], int64[:, ::1]), **OPTIONS)
def neighbours(order: Int64, total: int, split: int, previous: Int64, following: Int64) -> None:
    """For every place in range order: the nearest place of each radar at or before it, and at or after it.

    Args:
        order: [total], detections in range order.
        split: detections below it are the horizontal radar's.
        previous, following: [2, total or more], receive places, row 0 horizontal; -1 and ``total`` when there is none.
    """
    last_h, last_v = -1, -1
    for k in range(total):
        if order[k] < split:
            last_h = k
        else:
            last_v = k
        previous[0, k], previous[1, k] = last_h, last_v
    last_h, last_v = total, total
    for k in range(total - 1, -1, -1):
        if order[k] < split:
            last_h = k
        else:
            last_v = k
        following[0, k], following[1, k] = last_h, last_v


@njit(boolean(WHOLE, REAL, int64, int64, int64, int64, float64), **OPTIONS)
def _linked(order: Int64, common: Float64, before: int, after: int, first: int, last: int, gate_m: float) -> bool:
    """Whether the places exist inside first..last and differ by the gate at most."""
    return before >= first and after < last and common[order[after]] - common[order[before]] <= gate_m


@njit(int64(WHOLE, REAL, int64, int64, float64, int64[:, ::1], int64[:, ::1]), **OPTIONS)
def cut(order: Int64, common: Float64, first: int, last: int, gate_m: float, previous: Int64, following: Int64) -> int:
    """Where places first..last must be cut: the second part's first place, or ``last`` when they are one range bin.

    A gap that no pair within the gate spans is cut; failing that, when some pair exceeds the gate, the widest gap is.
    """
    widest, widest_m = last, -1.0
    for k in range(first, last - 1):
        h, v, next_h, next_v = previous[0, k], previous[1, k], following[0, k + 1], following[1, k + 1]
        forward = _linked(order, common, h, next_v, first, last, gate_m)
        if not forward and not _linked(order, common, v, next_h, first, last, gate_m):
            return k + 1
        gap_m = common[order[k + 1]] - common[order[k]]
        if gap_m > widest_m:
            widest, widest_m = k + 1, gap_m
    if last - first < 2:
        return last
    one_bin = _linked(order, common, following[0, first], previous[1, last - 1], first, last, gate_m)
    one_bin = one_bin and _linked(order, common, following[1, first], previous[0, last - 1], first, last, gate_m)
    return last if one_bin else widest


@njit(int64(WHOLE, REAL, int64, int64, float64, int64[:, ::1], int64[:, ::1], WHOLE, WHOLE), **OPTIONS)
def divide(
    order: Int64,
    common: Float64,
    total: int,
    split: int,
    gate_m: float,
    previous: Int64,
    following: Int64,
    stack: Int64,
    bound: Int64,
) -> int:
    """Divide all detections into range bins whose members of different radars all lie within the gate.

    Args:
        order: [total], detections in range order.
        common: [total], range from the common origin.
        split: detections below it are the horizontal radar's.
        gate_m: largest difference.
        previous, following, stack: scratch.
        bound: [total + 1 or more], receives the bins' first places and, last, ``total``.
    Returns:
        Bins, those with one radar's detections only included.
    """
    neighbours(order, total, split, previous, following)
    bins, first, depth = 0, 0, 0
    bound[0] = 0
    if total > 0:
        stack[0], depth = total, 1
    while depth > 0:
        last = stack[depth - 1]
        place = cut(order, common, first, last, gate_m, previous, following)
        if place < last:
            stack[depth] = place
            depth += 1
        else:
            bins += 1
            bound[bins], first = last, last
            depth -= 1
    return bins


@njit(int64(WHOLE, int64, int64, int64, WHOLE), **OPTIONS)
def partition(order: Int64, first: int, last: int, split: int, scratch: Int64) -> int:
    """Move the horizontal radar's detections in front, keeping the order; returns the vertical ones' first place."""
    middle, others = first, 0
    for k in range(first, last):
        if order[k] < split:
            order[middle] = order[k]
            middle += 1
        else:
            scratch[others] = order[k]
            others += 1
    for k in range(others):
        order[middle + k] = scratch[k]
    return middle


@njit(int64(WHOLE, REAL, REAL, int64, int64, WHOLE, float64, REAL, WHOLE, int64[:, ::1], WHOLE), **OPTIONS)
def pair(
    order: Int64,
    common: Float64,
    level: Float64,
    split: int,
    bins: int,
    bound: Int64,
    max_db: float,
    key: Float64,
    scratch: Int64,
    pairs: Int64,
    counts: Int64,
) -> int:
    """Pair inside every range bin: by rank of level; unequal counts stop at the first discrepancy beyond ``max_db``.

    Args:
        order: detections in range order, sorted by level inside the bins afterwards.
        common, level: by detection.
        split, bins, bound: as ``divide`` has them.
        key, scratch: scratch.
        pairs: int64 [2, n], receives the detections.
        counts: BINS (with both radars), UNMATCHED and POWER (detections) are increased.
    Returns:
        Pairs.
    """
    for n in range(bound[bins]):
        key[n] = -level[n]
    found = 0
    for b in range(bins):
        first, last = bound[b], bound[b + 1]
        middle = partition(order, first, last, split, scratch)
        horizontals, verticals = middle - first, last - middle
        both = min(horizontals, verticals)
        counts[UNMATCHED] += horizontals + verticals - 2 * both
        if both == 0:
            continue
        counts[BINS] += 1
        sort(order, first, middle, key, common)
        sort(order, middle, last, key, common)
        for rank in range(both):
            h, v = order[first + rank], order[middle + rank]
            if horizontals != verticals and abs(level[h] - level[v]) > max_db:
                counts[POWER] += 2 * (both - rank)
                break
            pairs[0, found], pairs[1, found] = h, v
            found += 1
    return found


@njit(inline="always")
def _locate(r_h: float, u: float, r_v: float, w: float, board: Float64) -> tuple[bool, float, float, float]:
    """Whether a point is seen at (r_h, u) by the horizontal and at (r_v, w) by the vertical radar, and its x, y, z.

    With a, b the boards: y = a_y + r_h u and z = b_z + r_v w are exact; x is the mean of the two solutions
    a_x + sqrt(r_h^2 (1 - u^2) - (z - a_z)^2) and b_x + sqrt(r_v^2 (1 - w^2) - (y - b_y)^2). A negative radicand is
    u^2 + w^2 > 1 as that board sees it.
    """
    y, z = board[0, 1] + r_h * u, board[1, 2] + r_v * w
    square_h = r_h * r_h * (1.0 - u * u) - (z - board[0, 2]) ** 2
    square_v = r_v * r_v * (1.0 - w * w) - (y - board[1, 1]) ** 2
    x = 0.5 * (board[0, 0] + np.sqrt(max(square_h, 0.0)) + board[1, 0] + np.sqrt(max(square_v, 0.0)))
    return square_h >= 0.0 and square_v >= 0.0, x, y, z


@njit(inline="always")
def judge(
    r_h: float, u: float, r_v: float, w: float, board: Float64, up: Float64, limits: Float64
) -> tuple[int, float, float, float]:
    """Why a pair is no point of the kept region (GEOMETRY, GROUND or HEIGHT; -1: it is one), and its x, y, z.

    Args:
        r_h, u, r_v, w: ranges and direction cosines of the horizontal and of the vertical radar.
        board: [2, 3], phase centres in the rig frame of the reference instant.
        up: [4], unit vector up in the rig frame, height of the rig origin.
        limits: [2], lowest and largest height above ground.
    """
    seen, x, y, z = _locate(r_h, u, r_v, w, board)
    height = up[0] * x + up[1] * y + up[2] * z + up[3]
    verdict = -1
    if not seen:
        verdict = GEOMETRY
    elif height < limits[0]:
        verdict = GROUND
    elif height > limits[1]:
        verdict = HEIGHT
    return verdict, x, y, z


@njit(
    int64(
        *(int64[:, ::1], int64, WHOLE, COLUMNS, COLUMNS, float64[:, ::1]),
        *(REAL, REAL, REAL, REAL, float32[:, ::1], float32[:, ::1], WHOLE),
    ),
    **OPTIONS,
)
def solve(
    pairs: Int64,
    found: int,
    source: Int64,
    horizontal: tuple[Float32, Float32, Float32],
    vertical: tuple[Float32, Float32, Float32],
    board: Float64,
    offset_db: Float64,
    pattern: Float64,
    up: Float64,
    limits: Float64,
    xyz: Float32,
    out: Float32,
    counts: Int64,
) -> int:
    """Place the pairs in space and keep those between ground and largest height.

    Args:
        pairs: [2, found], detections; ``source`` gives their index in the radar's columns.
        horizontal, vertical: columns of the radars, as ``describe`` has them.
        board, up, limits: as ``judge`` has them.
        offset_db: [2], added to the radars' powers.
        pattern: [3], as ``describe`` has it.
        xyz: [n, 3], receives the points.
        out: [3, n], receives power dB, horizontal range, vertical range.
        counts: GEOMETRY, GROUND and HEIGHT are increased.
    Returns:
        Points kept.
    """
    range_h, u, power_h = horizontal
    range_v, w, power_v = vertical
    kept = 0
    for n in range(found):
        h, v = source[pairs[0, n]], source[pairs[1, n]]
        r_h, cos_h, r_v, cos_v = float64(range_h[h]), float64(u[h]), float64(range_v[v]), float64(w[v])
        verdict, x, y, z = judge(r_h, cos_h, r_v, cos_v, board, up, limits)
        if verdict >= 0:
            counts[verdict] += 1
        else:
            sum_db = float64(power_h[h]) + offset_db[0] + float64(power_v[v]) + offset_db[1]
            out[0, kept] = 0.5 * sum_db + _loss_db(cos_v, pattern) + _loss_db(cos_h, pattern)
            out[1, kept], out[2, kept] = range_h[h], range_v[v]
            xyz[kept, 0], xyz[kept, 1], xyz[kept, 2] = x, y, z
            kept += 1
    return kept
