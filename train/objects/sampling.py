# SPDX-License-Identifier: Apache-2.0
"""Points uniformly distributed over the area of a triangle mesh."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge.frames import Float32, Float64

Int32 = NDArray[np.int32]


@njit(nogil=True, cache=True, error_model="numpy")
def bounds(points: Float32) -> tuple[Float32, Float32]:  # pragma: no cover - compiled
    """Lowest and highest coordinates of points [n, 3], n >= 1; float32 [3] each."""
    low, high = points[0].copy(), points[0].copy()
    for i in range(1, len(points)):
        for k in range(3):
            low[k] = min(low[k], points[i, k])
            high[k] = max(high[k], points[i, k])
    return low, high


@njit(nogil=True, cache=True, error_model="numpy")
def face_areas(vertices: Float32, faces: Int32, out: Float64) -> float:  # pragma: no cover - compiled
    """Area of every face [m] into ``out`` (m^2); returns the sum."""
    total = 0.0
    for i in range(len(faces)):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        ux = np.float64(vertices[b, 0]) - vertices[a, 0]
        uy = np.float64(vertices[b, 1]) - vertices[a, 1]
        uz = np.float64(vertices[b, 2]) - vertices[a, 2]
        vx = np.float64(vertices[c, 0]) - vertices[a, 0]
        vy = np.float64(vertices[c, 1]) - vertices[a, 1]
        vz = np.float64(vertices[c, 2]) - vertices[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        out[i] = 0.5 * np.sqrt(nx * nx + ny * ny + nz * nz)
        total += out[i]
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def _place(
    vertices: Float32,
    faces: Int32,
    areas: Float64,
    ascending: Float64,
    uniform: Float32,
    order: NDArray[np.int64],
    out: Float32,
) -> None:  # pragma: no cover - compiled
    """Put one point at each ascending area position; the point number i goes to row order[i]."""
    face, reached = 0, areas[0]
    last = len(faces) - 1
    for i in range(len(ascending)):
        while ascending[i] > reached and face < last:
            face += 1
            reached += areas[face]
        s, t = uniform[i, 0], uniform[i, 1]
        if s + t > 1:
            s, t = np.float32(1) - s, np.float32(1) - t
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        row = order[i]
        for k in range(3):
            origin = vertices[a, k]
            out[row, k] = origin + s * (vertices[b, k] - origin) + t * (vertices[c, k] - origin)


def sample_surface(vertices: Float32, faces: Int32, count: int, rng: np.random.Generator) -> Float32:
    """Independent points, uniform by area, in random order (so that any prefix is uniform too).

    The positions along the cumulative area are the order statistics of ``count`` uniform numbers, drawn ascending as
    normalised sums of exponential spacings (Devroye, Non-Uniform Random Variate Generation, V.3), which makes the
    search for the face a merge.

    Args:
        vertices: float32 [n, 3]; faces: int32 [m, 3].
        count: number of points.
        rng: source of chance.
    Returns:
        float32 [count, 3].
    Raises:
        ValueError: the mesh has no area.
    """
    areas = np.empty(len(faces))
    total = face_areas(vertices, faces, areas)
    if not total > 0:
        raise ValueError(f"mesh of {len(faces)} faces has no area")
    spacing = rng.standard_exponential(count + 1)
    ascending = np.cumsum(spacing)
    ascending = ascending[:-1] * (total / ascending[-1])
    points = np.empty((count, 3), np.float32)
    uniform = rng.random((count, 2), dtype=np.float32)
    _place(vertices, faces, areas, ascending, uniform, rng.permutation(count), points)
    return points
