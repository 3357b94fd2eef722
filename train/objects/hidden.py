# SPDX-License-Identifier: Apache-2.0
"""Faces that cannot be seen from outside, found with a z-buffer from many directions: seats, engines, inner panels."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge.frames import Float32, Float64
from train.depth_scan import project, rasterize
from train.objects.sampling import Int32

_VIEWS = 96
_COLUMNS, _ROWS = 640, 480
_LOWEST_DEG, _HIGHEST_DEG = -12.0, 85.0


def visible_faces(vertices: Float32, faces: Int32, depth_m: float = 0.01) -> NDArray[np.bool_]:
    """Which faces are seen from at least one of 96 directions all round, from below the sills to straight above.

    A face counts as seen when it is the nearest at a pixel, or when its middle lies less than ``depth_m`` behind what
    is nearest there (small faces fall between pixels).

    Args:
        vertices: float32 [n, 3], metres, z up; faces: int32 [m, 3].
        depth_m: metres.
    Returns:
        bool [m].
    """
    center = (vertices.min(axis=0) + vertices.max(axis=0)).astype(np.float64) / 2
    distance = 2.5 * float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0)))
    seen = np.zeros(len(faces), np.bool_)
    depth, hit = np.empty((_ROWS, _COLUMNS), np.float32), np.empty((_ROWS, _COLUMNS), np.int32)
    for direction in _directions():
        camera, _, pinhole = project(vertices, center + distance * direction, center, _COLUMNS, _ROWS)
        rasterize(camera, faces, *pinhole, depth, hit)
        _mark(camera, faces, *pinhole, depth, hit, depth_m, seen)
    return seen


def _directions() -> Float64:
    """Unit vectors on a Fibonacci spiral over the part of the sphere that a road user is seen from, [96, 3]."""
    low, high = math.sin(math.radians(_LOWEST_DEG)), math.sin(math.radians(_HIGHEST_DEG))
    z = low + (high - low) * (np.arange(_VIEWS) + 0.5) / _VIEWS
    azimuth = np.arange(_VIEWS) * math.pi * (3 - math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=1)


@njit(nogil=True, cache=True, error_model="numpy")
def _mark(
    camera: Float32,
    faces: Int32,
    focal: float,
    center_u: float,
    center_v: float,
    depth: Float32,
    hit: Int32,
    depth_m: float,
    seen: NDArray[np.bool_],
) -> None:  # pragma: no cover - compiled
    """Set ``seen`` for faces in the picture and for those whose middle is hardly behind it."""
    rows, columns = depth.shape
    for v in range(rows):
        for u in range(columns):
            if hit[v, u] >= 0:
                seen[hit[v, u]] = True
    for f in range(len(faces)):
        if seen[f]:
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x = (camera[a, 0] + camera[b, 0] + camera[c, 0]) / 3
        y = (camera[a, 1] + camera[b, 1] + camera[c, 1]) / 3
        z = (camera[a, 2] + camera[b, 2] + camera[c, 2]) / 3
        u, v = int(np.floor(focal * x / z + center_u + 0.5)), int(np.floor(focal * y / z + center_v + 0.5))
        if 0 <= u < columns and 0 <= v < rows and z <= depth[v, u] + depth_m:
            seen[f] = True
