# SPDX-License-Identifier: Apache-2.0
"""Kernels over the maps of several radial speeds: strongest of them, and which of them a cell belongs to."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, float64, int8, int64, njit, types

from edge.kernels_arrays import Float32, Int8

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}

BESIDE = 1.01
"""A cell is beside a target where its lobe's amplitude is more than this, times that of the strongest's far lobes."""


@njit(types.void(float32[:, ::1], int64, float32[:, ::1], int8[:, ::1], float32[:, ::1]), **OPTIONS)
def keep_strongest(power: Float32, k: int, best: Float32, which: Int8, kept: Float32) -> None:
    """Copy map ``k`` to ``kept`` and into ``best`` where it is the strongest so far; map 0 forgets what was there.

    Args:
        power: [angle, range], not negative.
        k: number of the map.
        best: [angle, range], largest power so far.
        which: int8 [angle, range], its map.
        kept: [angle, range], receives ``power``.
    """
    number = int8(k)
    for a in range(power.shape[0]):
        for r in range(power.shape[1]):
            value = power[a, r]
            kept[a, r] = value
            larger = k == 0 or value > best[a, r]
            best[a, r] = value if larger else best[a, r]
            which[a, r] = number if larger else which[a, r]


@njit(inline="always")
def _set_between(maps: Float32, k: int, peak: int, r: int, share: Float32) -> np.int8:
    """Shares of three maps at the speed where the parabola through them peaks; returns the middle one's number."""
    middle: int = min(max(int64(k), 1), len(maps) - 2)  # type: ignore[assignment]
    before, at, after = maps[middle - 1, peak, r], maps[middle, peak, r], maps[middle + 1, peak, r]
    bend = before - float32(2) * at + after
    offset = float32(0.5) * (before - after) / bend if bend < 0 else float32(k - middle)
    least_offset, most_offset = max(k - middle - 0.5, -1.0), min(k - middle + 0.5, 1.0)
    offset = float32(min(max(offset, least_offset), most_offset))
    share[0] = float32(0.5) * offset * (offset - float32(1))
    share[1] = float32(1) - offset * offset
    share[2] = float32(0.5) * offset * (offset + float32(1))
    return int8(middle)


@njit(inline="always")
def _charge(
    line: Float32,
    shown: Int8,
    owner: Int8,
    response: Float32,
    first: int,
    begin: int,
    amplitude: np.float32,
    number: int,
) -> np.float32:
    """Add one target's lobes to the bound and note where its own are the largest; returns what exceeds the bound."""
    own, strongest = response[response.shape[0] // 2], float32(0)
    for a in range(len(shown)):
        line[1, a] += amplitude * response[first + shown[a], begin + a]
    for a in range(len(shown)):
        lobe = amplitude * own[begin + a]
        larger = lobe > line[2, a]
        line[2, a] = lobe if larger else line[2, a]
        owner[a] = int8(number) if larger else owner[a]
    for a in range(len(shown)):
        left = line[0, a] if line[0, a] > line[1, a] * line[1, a] else float32(0)
        strongest = max(strongest, left)
    return strongest


@njit(
    types.void(
        *(float32[:, :, ::1], float32[:, ::1], int8[:, ::1], float32[::1], float32[:, ::1], float64, float64),
        *(float32[:, ::1], float32[:, ::1], int8[::1], int8[::1], float32[:, ::1], int8[::1], float32[:, ::1]),
    ),
    **OPTIONS,
)
def give_to_owners(maps: Float32, best: Float32, which: Int8, pattern: Float32, response: Float32, prominent: float,
                   weakest: float, sums: Float32, line: Float32, shown: Int8, owner: Int8, share: Float32, centre: Int8,
                   power: Float32) -> None:  # fmt: skip
    """Each cell's power from the maps of the targets that explain it; the strongest map's where they do not.

    Range bin by range bin, strongest first: a target stands at the strongest cell not yet explained. It adds to the
    bound of every cell what a point of its power shows in that cell's strongest map; amplitudes add up. Cells within
    the bound are lobes: beside a target they show its map, farther off the least power of all targets' maps, because
    each target's lobes are raised in the others' maps. A target's speed is where the parabola through three maps peaks
    at its place; a lobe's amplitude is linear in speed, its power quadratic, so that these maps give it at that speed.

    Args:
        maps: [K, angle, range], K at least 3.
        best, which: their largest values and whose they are.
        pattern: [angle], received over compensated power.
        response: [2 * n + 1, 2 * angles], bound of a point's amplitude by difference of the maps (n: none) and of the
            angle bins (``angles``: none).
        prominent: least ratio of a range bin's largest power to its mean that makes it worth the search.
        weakest: power of the weakest target over the strongest's.
        sums: [2, range] scratch.
        line: [3, angle] scratch: power, bound of the amplitude, amplitude of the owner's lobe.
        shown, owner: int8 [angle] scratch.
        share, centre: float32 [targets, 3] and int8 [targets] scratch; as many targets in a range bin.
        power: [angle, range], overwritten.
    """
    angles, ranges = best.shape
    same = response.shape[0] // 2
    total, largest = sums[0], sums[1]
    sums[:] = float32(0)
    for a in range(angles):
        for r in range(ranges):
            value = best[a, r] * pattern[a]
            power[a, r] = best[a, r]
            total[r] += value
            largest[r] = max(largest[r], value)
    for r in range(ranges):
        if largest[r] * angles <= prominent * total[r]:
            continue
        for a in range(angles):
            line[0, a], line[1, a], line[2, a] = best[a, r] * pattern[a], float32(0), float32(0)
            shown[a], owner[a] = which[a, r], int8(0)
        strength, count = largest[r], 0
        while count < len(centre) and strength > float32(weakest) * largest[r]:
            peak = 0
            while peak < angles - 1 and (line[0, peak] != strength or line[0, peak] <= line[1, peak] * line[1, peak]):
                peak += 1
            k = shown[peak]
            centre[count] = _set_between(maps, k, peak, r, share[count])
            strength = _charge(line, shown, owner, response, same - k, angles - peak, np.sqrt(strength), count)
            count += 1
        beside = float32(BESIDE) * response[same, angles + angles // 2] * np.sqrt(largest[r])
        for a in range(angles):
            if line[0, a] > line[1, a] * line[1, a]:
                continue
            near, least = line[2, a] > beside, float32(1e30)
            for t in range(owner[a] if near else 0, owner[a] + 1 if near else count):
                m = centre[t]
                value = share[t, 0] * maps[m - 1, a, r] + share[t, 1] * maps[m, a, r] + share[t, 2] * maps[m + 1, a, r]
                least = min(least, max(value, float32(0)))
            power[a, r] = least
