# SPDX-License-Identifier: Apache-2.0
"""Building blocks of the parametric objects: tubes, lofts, lathes, superellipsoids, capsules, boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.frames import Float32, Float64
from train.objects.sampling import Int32, face_areas

Part = tuple[Float64, NDArray[np.int64]]
"""Vertices float64 [n, 3] in metres and faces int64 [m, 3]."""


def vec(x: float, y: float, z: float) -> Float64:
    """A point or offset, float64 [3]."""
    return np.array([x, y, z], dtype=float)


def join(parts: Sequence[Part]) -> tuple[Float32, Int32]:
    """One triangle soup of many parts, without faces that have no area: vertices float32 [n, 3], faces int32 [m, 3]."""
    offsets = np.cumsum([0] + [len(v) for v, _ in parts[:-1]])
    vertices = np.concatenate([v for v, _ in parts]).astype(np.float32)
    faces = np.concatenate([f + o for (_, f), o in zip(parts, offsets, strict=True)]).astype(np.int32)
    areas = np.empty(len(faces))
    face_areas(vertices, faces, areas)
    return vertices, faces[areas > 1e-9]


def grid(points: Float64, *, around: bool = True) -> Part:
    """Quads between neighbouring sections, two triangles each.

    Args:
        points: float64 [sections, m, 3].
        around: the last point of a section is joined to its first.
    """
    sections, m, _ = points.shape
    column = np.arange(m if around else m - 1)
    a = (np.arange(sections - 1)[:, None] * m + column).ravel()
    b = (np.arange(sections - 1)[:, None] * m + (column + 1) % m).ravel()
    faces = np.concatenate([np.stack([a, b, a + m], 1), np.stack([b, b + m, a + m], 1)])
    return points.reshape(-1, 3), faces


def fan(ring: Float64) -> Part:
    """A cap: triangles from the centre of a closed ring [m, 3]."""
    m = len(ring)
    index = np.arange(m)
    faces = np.stack([index, (index + 1) % m, np.full(m, m)], 1)
    return np.vstack([ring, ring.mean(axis=0)]), faces


def loft(points: Float64) -> list[Part]:
    """Closed sections [sections, m, 3] joined to a body with caps at both ends."""
    return [grid(points), fan(points[0]), fan(points[-1])]


def frame_of(axis: ArrayLike) -> Float64:
    """A rotation [3, 3] whose third column is the unit vector along ``axis``."""
    w = np.asarray(axis, dtype=float)
    w = w / np.linalg.norm(w)
    helper = np.array([0.0, 1, 0]) if abs(w[1]) < 0.9 else np.array([1.0, 0, 0])
    u = np.cross(helper, w)
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(w, u), w], axis=1)


def circle(sides: int) -> Float64:
    """Unit circle in the plane of the first two axes, float64 [sides, 3]."""
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], axis=1)


def tube(path: ArrayLike, radius: ArrayLike, sides: int = 8) -> Part:
    """A round tube along a polyline, open at the ends.

    Args:
        path: [k, 3], k >= 2.
        radius: one, or [k].
        sides: of the cross section.
    """
    center = np.asarray(path, dtype=float)
    radii = np.broadcast_to(np.asarray(radius, dtype=float), len(center))
    tangent = np.gradient(center, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    u = frame_of(tangent[0])[:, 0]
    rings = []
    for point, w, r in zip(center, tangent, radii, strict=True):
        u = u - (u @ w) * w
        u /= np.linalg.norm(u)
        rings.append(point + r * circle(sides) @ np.stack([u, np.cross(w, u), w]))
    return grid(np.stack(rings))


def curve(points: ArrayLike, count: int = 12) -> Float64:
    """A smooth path through points [k, 3] (Catmull-Rom), float64 [count, 3]."""
    p = np.asarray(points, dtype=float)
    p = np.vstack([2 * p[0] - p[1], p, 2 * p[-1] - p[-2]])
    t = np.linspace(0, len(p) - 3, count)
    i = np.minimum(t.astype(int), len(p) - 4)
    s = (t - i)[:, None]
    a, b, c, d = p[i], p[i + 1], p[i + 2], p[i + 3]
    path: Float64 = 0.5 * (2 * b + (c - a) * s + (2 * a - 5 * b + 4 * c - d) * s**2 + (3 * b - a - 3 * c + d) * s**3)
    return path


def lathe(center: ArrayLike, profile: ArrayLike, sides: int = 24) -> Part:
    """A body of revolution about the y axis through ``center``.

    Args:
        center: [3].
        profile: [k, 2], (radius, y).
        sides: steps around.
    """
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.zeros(sides), np.sin(angle)], axis=1)
    r, y = np.asarray(profile, dtype=float).T
    points = r[:, None, None] * ring + y[:, None, None] * np.array([0.0, 1, 0])
    return grid(points + np.asarray(center, dtype=float))


def torus(center: ArrayLike, radius: float, thickness: float, sides: int = 32, section: int = 8) -> Part:
    """A tyre about the y axis: outer radius ``radius`` + ``thickness``, metres."""
    angle = 2 * np.pi * np.arange(section + 1) / section
    profile = np.stack([radius + thickness * np.cos(angle), thickness * np.sin(angle)], axis=1)
    return lathe(center, profile, sides)


def superellipsoid(
    center: ArrayLike,
    half: ArrayLike,
    exponents: tuple[float, float] = (1.0, 1.0),
    rotation: ArrayLike | None = None,
    steps: tuple[int, int] = (12, 9),
) -> Part:
    """Superellipsoid (Barr 1981); exponent 1 is an ellipsoid, towards 0 it becomes a box.

    Args:
        center, half: [3], metres.
        exponents: across the z axis (outline seen from the side), and around it (outline seen from above).
        rotation: [3, 3] applied about the centre.
        steps: around and from pole to pole.
    """

    def power(x: Float64, e: float) -> Float64:
        return np.sign(x) * np.abs(x) ** e

    around = 2 * np.pi * np.arange(steps[0]) / steps[0]
    up = np.linspace(-np.pi / 2, np.pi / 2, steps[1])[:, None]
    flat = power(np.cos(up), exponents[0])
    x = flat * power(np.cos(around), exponents[1])
    y = flat * power(np.sin(around), exponents[1])
    z = power(np.sin(up), exponents[0]) * np.ones(steps[0])
    points = np.stack([x, y, z], axis=2) * np.asarray(half, dtype=float)
    if rotation is not None:
        points = points @ np.asarray(rotation, dtype=float).T
    return grid(points + np.asarray(center, dtype=float))


def capsule(start: ArrayLike, end: ArrayLike, radius_start: float, radius_end: float, sides: int = 10) -> Part:
    """A limb: a cone with round ends between two joints [3], metres."""
    a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.linalg.norm(b - a))
    angle = np.linspace(0, np.pi / 2, 4)
    along = np.concatenate([-radius_start * np.cos(angle), length + radius_end * np.sin(angle)])
    radii = np.concatenate([radius_start * np.sin(angle), radius_end * np.cos(angle)])
    rings = radii[:, None, None] * circle(sides) + along[:, None, None] * np.array([0.0, 0, 1])
    return grid(rings @ frame_of(b - a).T + a)


def box(center: ArrayLike, size: ArrayLike, rotation: ArrayLike | None = None) -> Part:
    """A cuboid with its centre [3] and full size [3], metres."""
    corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    points = corner * np.asarray(size, dtype=float)
    if rotation is not None:
        points = points @ np.asarray(rotation, dtype=float).T
    return points + np.asarray(center, dtype=float), faces


def mirrored(part: Part) -> Part:
    """The same on the other side (y -> -y)."""
    return part[0] * np.array([1.0, -1, 1]), part[1]
