# SPDX-License-Identifier: Apache-2.0
"""Where a rider would touch a collected two-wheeler: saddle, grips and feet found on the mesh itself."""

from __future__ import annotations

import numpy as np

from edge.frames import Float32, Float64
from train.objects.mesh import CLASSES, Mesh, MeshError
from train.objects.rider import Contacts
from train.objects.sampling import sample_surface

_POINTS = 60_000
_BIN_M = 0.02
_ARM_M = (0.25, 0.95)
"""Plausible distance from saddle to grips in the side view."""


def find_contacts(mesh: Mesh) -> Contacts:
    """Saddle, grips and feet of a bicycle or motorcycle.

    Args:
        mesh: x forward, ground z = 0, centred.
    Raises:
        MeshError: another class, or nothing on it looks like a saddle with a handle bar before it.
    """
    name = CLASSES[mesh.label]
    if name not in ("bicycle", "motorcycle"):
        raise MeshError("only two-wheelers have riders", value=mesh.object_id, allowed="bicycle, motorcycle")
    points = sample_surface(mesh.vertices, mesh.faces, _POINTS, np.random.default_rng(0))
    pedals, problem = name == "bicycle", None
    for attempt in (_bicycle, _long_bicycle) if pedals else (_motorcycle, _seat_far_back):
        try:
            saddle, grips = attempt(points, float(mesh.size_m[0]))
        except MeshError as error:
            problem = problem or error
            continue
        reach = float(np.hypot(grips[0, 0] - saddle[0], grips[0, 2] - saddle[2]))
        if _ARM_M[0] < reach < _ARM_M[1] and -0.25 < grips[0, 2] - saddle[2] < 0.6:
            feet = _pedals(points, saddle) if pedals else _pegs(points, saddle, grips)
            return Contacts(saddle, grips, feet, pedals)
    raise MeshError(
        f"{mesh.object_id}: no place for a rider",
        value=problem.what if problem else "grips out of reach of the saddle",
        allowed=f"a saddle, and grips {_ARM_M[0]}..{_ARM_M[1]} m ahead of it",
        action="use it without a rider",
    )


def _bicycle(points: Float32, length: float) -> tuple[Float64, Float64]:
    saddle = _bicycle_saddle(points, -0.30 * length, 0.06 * length)
    return saddle, _bicycle_grips(points, saddle, -0.25)


def _long_bicycle(points: Float32, length: float) -> tuple[Float64, Float64]:
    """A load stands before the rider, as wide as the bar but lower."""
    saddle = _bicycle_saddle(points, -0.32 * length, -0.12 * length)
    return saddle, _bicycle_grips(points, saddle, 0.05)


def _motorcycle(points: Float32, length: float) -> tuple[Float64, Float64]:
    saddle = _motorcycle_seat(points, -0.20 * length, 0.08 * length, -0.08 * length)
    return saddle, _motorcycle_grips(points, saddle)


def _seat_far_back(points: Float32, length: float) -> tuple[Float64, Float64]:
    """The seat of a scooter is over the rear wheel."""
    saddle = _motorcycle_seat(points, -0.36 * length, -0.10 * length, -0.22 * length)
    return saddle, _motorcycle_grips(points, saddle)


def _top(points: Float32, low_x: float, high_x: float, half_width: float) -> tuple[Float64, Float64]:
    """Upper edge of the side view near the plane of symmetry: bin centres and heights (-inf: nothing there)."""
    edges = np.arange(low_x, high_x, _BIN_M)
    near = points[np.abs(points[:, 1]) < half_width]
    number = np.floor((near[:, 0] - low_x) / _BIN_M).astype(int)
    inside = (number >= 0) & (number < len(edges))
    height = np.full(len(edges), -np.inf)
    np.maximum.at(height, number[inside], near[inside, 2].astype(float))
    return edges + _BIN_M / 2, height


def _bicycle_saddle(points: Float32, low_x: float, high_x: float) -> Float64:
    """The widest part of what stands highest in a stretch."""
    x, height = _top(points, low_x, high_x, 0.05)
    top = float(height.max())
    behind = (points[:, 0] > x[0]) & (points[:, 0] < x[-1])
    cover = points[behind & (points[:, 2] > top - 0.05) & (np.abs(points[:, 1]) < 0.14)]
    wide = cover[np.abs(cover[:, 1]) > 0.6 * np.abs(cover[:, 1]).max()]
    at = float(np.median(wide[:, 0]))
    saddle = np.array([at, 0.0, float(height[np.abs(x - at) < 0.05].max())])
    away = np.abs(points - saddle.astype(np.float32))
    if np.count_nonzero((away[:, 0] < 0.08) & (away[:, 1] > 0.2) & (away[:, 2] < 0.3)) > 50:
        raise MeshError("what stands highest behind the middle is no saddle", action="leave the rider out")
    return saddle


def _motorcycle_seat(points: Float32, low_x: float, high_x: float, usual_x: float) -> Float64:
    """The lowest level stretch of the side view's upper edge, between tank and tail."""
    x, height = _top(points, low_x, high_x, 0.10)
    best, found = np.inf, None
    for k in range(3, len(x) - 3):
        stretch = height[k - 3 : k + 4]
        if stretch.min() < 0.5 or stretch.max() > 1.0:
            continue
        cost = float(height[k]) + 2 * float(np.ptp(stretch)) + 0.3 * abs(float(x[k]) - usual_x)
        if cost < best:
            best, found = cost, np.array([x[k], 0.0, height[k]])
    if found is None:
        raise MeshError("no seat 0.5 to 1 m above ground about the middle of the machine", action="leave the rider out")
    return found


def _wide(points: Float32, saddle: Float64, ahead_m: float, above_m: float) -> Float32:
    """Points well to the side, so far ahead of the saddle and at least so far above it."""
    ahead = (points[:, 0] > saddle[0] + ahead_m) & (points[:, 2] > saddle[2] + above_m)
    upper: Float32 = points[ahead & (np.abs(points[:, 1]) > 0.14)]
    if len(upper) < 20:
        raise MeshError("no handle bar ahead of the saddle", action="leave the rider out")
    return upper


def _bicycle_grips(points: Float32, saddle: Float64, above_m: float) -> Float64:
    """The outer ends of the widest thing ahead of and about as high as the saddle."""
    upper = _wide(points, saddle, 0.2, above_m)
    half = float(np.quantile(np.abs(upper[:, 1]), 0.995))
    return _both_sides(upper[np.abs(upper[:, 1]) > half - 0.035], upper)


def _motorcycle_grips(points: Float32, saddle: Float64) -> Float64:
    """The outer ends of the lowest wide thing ahead of and above the seat; mirrors are above the grips."""
    upper = _wide(points, saddle, 0.22, 0.03)
    half = float(np.quantile(np.abs(upper[:, 1]), 0.97))
    outer = upper[np.abs(np.abs(upper[:, 1]) - (half - 0.05)) < 0.04]
    lowest = float(np.quantile(outer[:, 2], 0.15))
    return _both_sides(outer[np.abs(outer[:, 2] - lowest) < 0.05], upper)


def _both_sides(ends: Float32, wide: Float32) -> Float64:
    """Middle of the end of a bar on the side that shows more of it, and what lies opposite; left and right [2, 3]."""
    sign = 1.0 if np.count_nonzero(ends[:, 1] > 0) * 2 >= len(ends) else -1.0
    side = ends[sign * ends[:, 1] > 0]
    grip = _nearest(side, np.median(side, axis=0))
    across = wide[sign * wide[:, 1] < 0]
    opposite = grip * np.array([1.0, -1, 1])
    other = _nearest(across, opposite) if len(across) else opposite  # the bar may be steered
    return np.stack([grip, other] if sign > 0 else [other, grip])


def _nearest(points: Float32, place: Float64) -> Float64:
    nearest: Float64 = points[np.linalg.norm(points - place, axis=1).argmin()].astype(float)
    return nearest


def _pedals(points: Float32, saddle: Float64) -> Float64:
    """What sticks out farthest on each side below and ahead of the saddle; without any, a crank that stands upright."""
    ahead = points[:, 0] - saddle[0]
    low = points[(ahead > 0.0) & (ahead < 0.55) & (points[:, 2] > 0.05) & (points[:, 2] < 0.55 * saddle[2])]
    feet = []
    for sign in (1.0, -1.0):
        out = sign * low[:, 1]
        reach = float(np.quantile(out, 0.998)) if len(low) else 0.0
        if reach < 0.09:
            feet.append(np.array([saddle[0] + 0.24, 0.14 * sign, 0.30 * saddle[2] + 0.17 * sign]))
            continue
        pedal = low[out > reach - 0.04]
        feet.append(np.array([np.median(pedal[:, 0]), sign * (reach - 0.04), np.quantile(pedal[:, 2], 0.9)]))
    return np.stack(feet)


def _pegs(points: Float32, saddle: Float64, grips: Float64) -> Float64:
    """On the floor of a scooter, else beside the machine between seat and bars at the height of pegs."""
    x = float(saddle[0] + 0.55 * (grips[0, 0] - saddle[0]))
    column = points[(np.abs(points[:, 0] - x) < 0.10) & (np.abs(points[:, 1]) < 0.16)]
    floor = float(np.quantile(column[:, 2], 0.98)) if len(column) else 0.0
    if 0.1 < floor < saddle[2] - 0.28:
        return np.array([[x, 0.11, floor], [x, -0.11, floor]])
    beside = points[(np.abs(points[:, 0] - x) < 0.10) & (np.abs(points[:, 2] - 0.40) < 0.10)]
    half = float(np.clip(np.quantile(np.abs(beside[:, 1]), 0.9) if len(beside) else 0.15, 0.12, 0.24)) + 0.05
    return np.array([[x, half, 0.33], [x, -half, 0.33]])
