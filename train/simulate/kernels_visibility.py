# SPDX-License-Identifier: Apache-2.0
"""Kernels of the z-buffer: triangles to inverse depth, points against it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge.frames import Float32, Float64
from train.objects.sampling import Int32

UInt8 = NDArray[np.uint8]

NEAR_M = 0.05
"""Triangles with a corner nearer to the camera's plane are left out."""


@njit(cache=True, nogil=True, error_model="numpy")
def to_camera(
    vertices: Float32, rotation: Float64, eye: Float64, out: Float32, window: Float64
) -> None:  # pragma: no cover - compiled
    """Vertices in a camera's frame, and the window of slopes that holds them.

    Args:
        vertices: float32 [n, 3], object frame.
        rotation: float64 [3, 3], rows: the camera's right, down and forward axes in the object's frame.
        eye: float64 [3], the camera in the object's frame.
        out: float32 [n, 3], out: x / z, y / z, 1 / z; all zero for vertices that are not in front.
        window: float64 [4], in and out: lowest x / z and y / z, highest; widened to hold the vertices in front.
    """
    r = rotation
    for i in range(len(vertices)):
        x, y, z = vertices[i, 0] - eye[0], vertices[i, 1] - eye[1], vertices[i, 2] - eye[2]
        ahead = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
        if ahead < NEAR_M:
            out[i, 0], out[i, 1], out[i, 2] = 0.0, 0.0, 0.0
            continue
        inverse = 1.0 / ahead
        u = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z) * inverse
        v = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z) * inverse
        out[i, 0], out[i, 1], out[i, 2] = u, v, inverse
        window[0], window[1] = min(window[0], u), min(window[1], v)
        window[2], window[3] = max(window[2], u), max(window[3], v)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"})
def rasterize(
    camera: Float32, faces: Int32, focal: float, column: float, row: float, inverse_depth: Float32
) -> None:  # pragma: no cover - compiled
    """Greatest inverse depth at every pixel centre; 1 / z is linear in the picture.

    Args:
        camera: float32 [n, 3], from ``to_camera``.
        faces: int32 [m, 3].
        focal, column, row: pixels = focal slope + column (row).
        inverse_depth: float32 [rows, columns], in and out; 0 where nothing is.
    """
    rows, columns = inverse_depth.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ia, ib, ic = camera[a, 2], camera[b, 2], camera[c, 2]
        if ia == 0.0 or ib == 0.0 or ic == 0.0:
            continue
        au, av = focal * camera[a, 0] + column, focal * camera[a, 1] + row
        bu, bv = focal * camera[b, 0] + column, focal * camera[b, 1] + row
        cu, cv = focal * camera[c, 0] + column, focal * camera[c, 1] + row
        low_v, high_v = max(0.0, math.ceil(min(av, bv, cv))), min(rows - 1.0, math.floor(max(av, bv, cv)))
        low_u, high_u = max(0.0, math.ceil(min(au, bu, cu))), min(columns - 1.0, math.floor(max(au, bu, cu)))
        if low_v > high_v or low_u > high_u:
            continue
        area = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if area == 0.0:
            continue
        scale = 1.0 / area
        # Barycentric coordinates are linear: value at the first pixel, steps along columns and rows.
        wa_u, wa_v = (bv - cv) * scale, (cu - bu) * scale
        wb_u, wb_v = (cv - av) * scale, (au - cu) * scale
        wa_row = ((bu - low_u) * (cv - low_v) - (bv - low_v) * (cu - low_u)) * scale
        wb_row = ((cu - low_u) * (av - low_v) - (cv - low_v) * (au - low_u)) * scale
        first_u, width = int(low_u), int(high_u - low_u) + 1
        for v in range(int(low_v), int(high_v) + 1):
            line = inverse_depth[v, first_u : first_u + width]
            for u in range(width):  # without branches: outlines are unpredictable
                wa, wb = wa_row + u * wa_u, wb_row + u * wb_u
                depth = ic + wa * (ia - ic) + wb * (ib - ic)
                inside = (wa >= 0.0) & (wb >= 0.0) & (wa + wb <= 1.0)
                line[u] = max(line[u], depth if inside else np.float32(0.0))
            wa_row += wa_v
            wb_row += wb_v


@njit(cache=True, nogil=True, error_model="numpy")
def test_points(
    points: Float32,
    index: Int32,
    rotation: Float64,
    eye: Float64,
    focal: float,
    column: float,
    row: float,
    inverse_depth: Float32,
    bias: float,
    bit: int,
    seen: UInt8,
) -> None:  # pragma: no cover - compiled
    """Clear ``bit`` of the points that something in the picture hides; points beside the picture keep it.

    A point is hidden when it lies deeper than the nearest pixel shows, which puts outlines in their place, and deeper
    than the four pixels around it show when interpolated, which is exact on a plane however steep.

    Args:
        points: float32 [m, 3], object frame.
        index: int32 [n], which of them.
        rotation, eye: the camera in the object's frame.
        focal, column, row: of the picture.
        inverse_depth: float32 [rows, columns], from ``rasterize``.
        bias: metres that a point may lie deeper than what the picture shows.
        bit: which.
        seen: uint8 [n], in and out.
    """
    r = rotation
    rows, columns = inverse_depth.shape
    for i in range(len(index)):
        p = index[i]
        x, y, z = points[p, 0] - eye[0], points[p, 1] - eye[1], points[p, 2] - eye[2]
        ahead = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
        if ahead < NEAR_M:
            continue
        scale = focal / ahead
        u = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z) * scale + column
        v = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z) * scale + row
        left, top = math.floor(u), math.floor(v)
        if left < 0 or top < 0 or left > columns - 2 or top > rows - 2:
            continue
        fu, fv = u - left, v - top
        a, b = inverse_depth[top, left], inverse_depth[top, left + 1]
        c, d = inverse_depth[top + 1, left], inverse_depth[top + 1, left + 1]
        west, east = (a, b) if fv < 0.5 else (c, d)
        nearest = west if fu < 0.5 else east
        if (ahead - bias) * nearest <= 1.0:
            continue
        between = (1.0 - fv) * ((1.0 - fu) * a + fu * b) + fv * ((1.0 - fu) * c + fu * d)
        if (ahead - bias) * between > 1.0:
            seen[i] &= np.uint8(255 - bit)


@njit(cache=True, nogil=True, error_model="numpy")
def may_hide(other: Float64, own: Float64) -> bool:  # pragma: no cover - compiled
    """Whether one rectangle on the ground plan can stand between the eye and another one.

    It cannot where a line through the eye has them on its two sides, or where a side of either has the other one beyond
    it while the eye and the first one are on its near side.

    Args:
        other, own: float64 [4, 2], corners in order, relative to the eye.
    """
    for pair in range(2):
        corners = other if pair == 0 else own
        for i in range(4):
            x, y = corners[i, 0], corners[i, 1]
            least_own, most_own, least_other, most_other = np.inf, -np.inf, np.inf, -np.inf
            for j in range(4):
                a, b = x * own[j, 1] - y * own[j, 0], x * other[j, 1] - y * other[j, 0]
                least_own, most_own = min(least_own, a), max(most_own, a)
                least_other, most_other = min(least_other, b), max(most_other, b)
            if most_own <= 0.0 <= least_other or most_other <= 0.0 <= least_own:
                return False
            nx, ny = corners[(i + 1) % 4, 1] - y, x - corners[(i + 1) % 4, 0]
            for sign in (1.0, -1.0):
                most_own, least_other = 0.0, np.inf
                for j in range(4):
                    most_own = max(most_own, sign * (nx * own[j, 0] + ny * own[j, 1]))
                    least_other = min(least_other, sign * (nx * other[j, 0] + ny * other[j, 1]))
                if least_other >= most_own:
                    return False
    return True
