# SPDX-License-Identifier: Apache-2.0
"""Kernels over the maps of several radial speeds: strongest of them, and which of them a cell belongs to."""

from __future__ import annotations

from typing import Any

from numba import float32, float64, int8, int64, njit, types

OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy", "boundscheck": False, "cache": True}


@njit(types.void(float32[:, ::1], int64, float32[:, ::1], int8[:, ::1], float32[:, ::1]), **OPTIONS)
def keep_strongest(power, k, best, which, kept):  # type: ignore[no-untyped-def]
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


@njit(
    types.void(
        *(float32[:, :, ::1], float32[:, ::1], int8[:, ::1], float32[::1], float32[:, ::1], float64, float64),
        *(float32[:, ::1], float32[:, ::1], int8[::1], int8[::1], float32[:, ::1], int8[::1], float32[:, ::1]),
    ),
    **OPTIONS,
)
def give_to_owners(  # type: ignore[no-untyped-def]
    maps, best, which, pattern, response, prominent, weakest, sums, line, shown, owner, share, centre, power
):
    """Each cell's power from the map of the target that explains it; the strongest map's where none does.

    Range bin by range bin, strongest first: a target at the strongest cell not yet explained is charged with what a
    point of its power shows in each cell's strongest map. A cell whose strongest power is no more is a lobe of the
    targets and shows the map of the one with most power there. That target's speed stands between maps where the
    parabola through three of them peaks at its place; a lobe's amplitude is linear in speed, its power quadratic, so
    that the same three maps give the lobe at that speed.

    Args:
        maps: [K, angle, range].
        best, which: their largest values and whose they are.
        pattern: [angle], received over compensated power.
        response: [2 * n + 1, 2 * angles], bound of a point's power by difference of the maps (n: none) and of the
            angle bins (``angles``: none).
        prominent: least ratio of a range bin's largest power to its mean that makes it worth the search.
        weakest: power of the weakest target over the strongest's.
        sums: [2, range] scratch.
        line: [3, angle] scratch.
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
            shown[a] = which[a, r]
            owner[a] = int8(-1)
        strength, least = largest[r], float32(weakest) * largest[r]
        for found in range(len(centre)):
            peak = 0
            while line[0, peak] != strength or line[0, peak] <= line[1, peak]:
                peak += 1
            k = shown[peak]
            middle = min(max(int64(k), 1), len(maps) - 2)
            before, at, after = maps[middle - 1, peak, r], maps[middle, peak, r], maps[middle + 1, peak, r]
            bend = before - float32(2) * at + after
            offset = float32(0.5) * (before - after) / bend if bend < 0 else float32(k - middle)
            least_offset, most_offset = max(k - middle - 0.5, -1.0), min(k - middle + 0.5, 1.0)
            offset = float32(min(max(offset, least_offset), most_offset))
            share[found, 0] = float32(0.5) * offset * (offset - float32(1))
            share[found, 1] = float32(1) - offset * offset
            share[found, 2] = float32(0.5) * offset * (offset + float32(1))
            centre[found] = int8(middle)
            begin, first = angles - peak, same - k
            own, strongest = response[same], float32(0)
            for a in range(angles):
                line[1, a] += strength * response[first + shown[a], begin + a]
            for a in range(angles):
                lobe = strength * own[begin + a]
                nearer = lobe > line[2, a]
                line[2, a] = lobe if nearer else line[2, a]
                owner[a] = int8(found) if nearer else owner[a]
            for a in range(angles):
                left = line[0, a] if line[0, a] > line[1, a] else float32(0)
                strongest = max(strongest, left)
            strength = strongest
            if strength <= least:
                break
        for a in range(angles):
            if line[0, a] <= line[1, a]:
                t = owner[a]
                m = centre[t]
                value = share[t, 0] * maps[m - 1, a, r] + share[t, 1] * maps[m, a, r] + share[t, 2] * maps[m + 1, a, r]
                power[a, r] = max(value, float32(0))
