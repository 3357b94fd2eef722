# SPDX-License-Identifier: Apache-2.0
"""What of a mesh is visible from a point: a perspective z-buffer fitted to the object, back-projected to 3-D points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from edge.frames import Float32, Float64
from train.objects.sampling import Int32


@dataclass(frozen=True, slots=True)
class Hits:
    """Visible points of a mesh.

    Args:
        points: float32 [n, 3] in the frame of the mesh.
        faces: int32 [n], the face that was hit.
        cosine: float32 [n], |cos| of the angle between the line of sight and the face's normal.
    """

    points: Float32
    faces: Int32
    cosine: Float32


@njit(nogil=True, cache=True, fastmath={"contract", "reassoc", "arcp", "nsz"}, error_model="numpy")
def rasterize(
    camera: Float32, faces: Int32, focal: float, center_u: float, center_v: float, depth: Float32, hit: Int32
) -> None:  # pragma: no cover - compiled
    """Nearest face at every pixel centre.

    Args:
        camera: float32 [n, 3], vertices in the camera frame: x right, y down, z along the view, all z > 0.
        faces: int32 [m, 3].
        focal, center_u, center_v: pinhole, pixels; column = focal x / z + center_u.
        depth: float32 [rows, columns], out: z of the nearest face, infinity where there is none.
        hit: int32 [rows, columns], out: its number, -1 where there is none.
    """
    rows, columns = depth.shape
    depth[:] = np.inf
    hit[:] = -1
    picture = np.empty((len(camera), 3), np.float64)
    for i in range(len(camera)):
        z = camera[i, 2]
        if z > 0:
            picture[i, 0] = focal * camera[i, 0] / z + center_u
            picture[i, 1] = focal * camera[i, 1] / z + center_v
        picture[i, 2] = 1.0 / z if z > 0 else 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ia, ib, ic = picture[a, 2], picture[b, 2], picture[c, 2]
        if ia == 0 or ib == 0 or ic == 0:
            continue
        au, av, bu, bv, cu, cv = (
            picture[a, 0], picture[a, 1], picture[b, 0], picture[b, 1], picture[c, 0], picture[c, 1]
        )  # fmt: skip
        area = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if area == 0:
            continue
        first_u = max(0, int(np.ceil(min(au, bu, cu))))
        last_u = min(columns - 1, int(np.floor(max(au, bu, cu))))
        first_v = max(0, int(np.ceil(min(av, bv, cv))))
        last_v = min(rows - 1, int(np.floor(max(av, bv, cv))))
        if first_u > last_u or first_v > last_v:
            continue
        scale = 1.0 / area
        step_a, step_b = (bv - cv) * scale, (cv - av) * scale  # barycentric weights are linear along a row
        step_z = step_a * ia + step_b * ib - (step_a + step_b) * ic
        for v in range(first_v, last_v + 1):
            start_a = (bu * (cv - v) - (bv - v) * cu) * scale
            start_b = (cu * (av - v) - (cv - v) * au) * scale
            start_z = start_a * ia + start_b * ib + (1.0 - start_a - start_b) * ic
            for u in range(first_u, last_u + 1):
                wa, wb = start_a + u * step_a, start_b + u * step_b
                if wa >= 0 and wb >= 0 and 1.0 - wa - wb >= 0:
                    z = 1.0 / (start_z + u * step_z)
                    if z < depth[v, u]:
                        depth[v, u] = z
                        hit[v, u] = f


def look_at(position: Float64, target: Float64) -> Float64:
    """Rotation from the world to a camera at ``position`` that looks at ``target``; rows right, down, forward."""
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


@njit(nogil=True, cache=True, error_model="numpy")
def _to_camera(vertices: Float32, position: Float64, rotation: Float64, out: Float32) -> Float64:  # pragma: no cover
    """Vertices in the camera frame into ``out`` [n, 3]; lowest and highest slopes x / z, y / z of those ahead [4]."""
    low_u, low_v, high_u, high_v = np.inf, np.inf, -np.inf, -np.inf
    for i in range(len(vertices)):
        x, y, z = vertices[i, 0] - position[0], vertices[i, 1] - position[1], vertices[i, 2] - position[2]
        for k in range(3):
            out[i, k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z
        if out[i, 2] > 1e-3:
            u, v = out[i, 0] / out[i, 2], out[i, 1] / out[i, 2]
            low_u, high_u = min(low_u, u), max(high_u, u)
            low_v, high_v = min(low_v, v), max(high_v, v)
    return np.array([low_u, low_v, high_u, high_v])


@njit(nogil=True, cache=True, error_model="numpy")
def _collect(
    depth: Float32,
    hit: Int32,
    camera: Float32,
    faces: Int32,
    focal: float,
    center_u: float,
    center_v: float,
    points: Float32,
    seen: Int32,
    cosine: Float32,
) -> int:  # pragma: no cover - compiled
    """Pixels that see something: camera-frame points, their faces and incidence; returns how many."""
    count = 0
    rows, columns = depth.shape
    for v in range(rows):
        for u in range(columns):
            f = hit[v, u]
            if f < 0:
                continue
            z = depth[v, u]
            x, y = (u - center_u) / focal * z, (v - center_v) / focal * z
            points[count, 0], points[count, 1], points[count, 2] = x, y, z
            seen[count] = f
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay, az = camera[b, 0] - camera[a, 0], camera[b, 1] - camera[a, 1], camera[b, 2] - camera[a, 2]
            bx, by, bz = camera[c, 0] - camera[a, 0], camera[c, 1] - camera[a, 1], camera[c, 2] - camera[a, 2]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = np.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + z * z))
            cosine[count] = abs(nx * x + ny * y + nz * z) / length if length > 0 else 0.0
            count += 1
    return count


def project(
    vertices: Float32, position: Float64, target: Float64, columns: int, rows: int
) -> tuple[Float32, Float64, tuple[float, float, float]]:
    """Vertices in the frame of a camera whose picture just holds them.

    Args:
        vertices: float32 [n, 3], metres.
        position, target: float64 [3]; the target not straight above or below the position.
        columns, rows: size of the picture.
    Returns:
        Vertices in the camera frame float32 [n, 3]; rotation from world to camera [3, 3]; focal length, middle column
        and middle row of the pinhole in pixels.
    """
    rotation = look_at(position, target)
    camera = np.empty_like(vertices)
    low_u, low_v, high_u, high_v = _to_camera(vertices, position, rotation, camera)
    if low_u > high_u:
        return camera, rotation, (1.0, 0.0, 0.0)
    focal = float(min((columns - 1) / max(high_u - low_u, 1e-6), (rows - 1) / max(high_v - low_v, 1e-6)))
    center_u = (columns - 1) / 2 - focal * (low_u + high_u) / 2
    center_v = (rows - 1) / 2 - focal * (low_v + high_v) / 2
    return camera, rotation, (focal, center_u, center_v)


def scan(
    vertices: Float32, faces: Int32, position: Float64, target: Float64, columns: int = 160, rows: int = 120
) -> Hits:
    """Visible points of a mesh from one position; the picture is fitted to the object.

    Args:
        vertices: float32 [n, 3], metres; faces: int32 [m, 3].
        position: float64 [3], the camera, outside the object and not straight above the target.
        target: float64 [3], where it looks.
        columns, rows: size of the depth map.
    Returns:
        One hit for every pixel that sees the object, in the order of the pixels.
    """
    camera, rotation, pinhole = project(vertices, position, target, columns, rows)
    depth = np.empty((rows, columns), np.float32)
    hit = np.empty((rows, columns), np.int32)
    rasterize(camera, faces, *pinhole, depth, hit)
    points = np.empty((rows * columns, 3), np.float32)
    seen = np.empty(rows * columns, np.int32)
    cosine = np.empty(rows * columns, np.float32)
    count = _collect(depth, hit, camera, faces, *pinhole, points, seen, cosine)
    world = points[:count] @ rotation.astype(np.float32) + position.astype(np.float32)
    return Hits(world, seen[:count], cosine[:count])
