# SPDX-License-Identifier: Apache-2.0
"""What of a mesh is visible from a point: a perspective z-buffer fitted to the object, back-projected to 3-D points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from edge.frames import Float32, Float64
from train.objects.sampling import Int32

NOTHING = -1
"""Face number of a pixel that no face covers."""


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


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
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
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        az, bz, cz = camera[a, 2], camera[b, 2], camera[c, 2]
        if az <= 0 or bz <= 0 or cz <= 0:
            continue
        au, av = focal * camera[a, 0] / az + center_u, focal * camera[a, 1] / az + center_v
        bu, bv = focal * camera[b, 0] / bz + center_u, focal * camera[b, 1] / bz + center_v
        cu, cv = focal * camera[c, 0] / cz + center_u, focal * camera[c, 1] / cz + center_v
        area = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if area == 0:
            continue
        first_u = max(0, int(np.ceil(min(au, bu, cu))))
        last_u = min(columns - 1, int(np.floor(max(au, bu, cu))))
        first_v = max(0, int(np.ceil(min(av, bv, cv))))
        last_v = min(rows - 1, int(np.floor(max(av, bv, cv))))
        scale = 1.0 / area
        ia, ib, ic = 1.0 / az, 1.0 / bz, 1.0 / cz
        for v in range(first_v, last_v + 1):
            for u in range(first_u, last_u + 1):
                wa = ((bu - u) * (cv - v) - (bv - v) * (cu - u)) * scale
                wb = ((cu - u) * (av - v) - (cv - v) * (au - u)) * scale
                wc = 1.0 - wa - wb
                if wa >= 0 and wb >= 0 and wc >= 0:
                    z = 1.0 / (wa * ia + wb * ib + wc * ic)
                    if z < depth[v, u]:
                        depth[v, u] = z
                        hit[v, u] = f


def look_at(position: Float64, target: Float64) -> Float64:
    """Rotation from the world to a camera at ``position`` that looks at ``target``: rows right, down, forward [3, 3]."""
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


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
    camera = ((vertices - position.astype(np.float32)) @ rotation.T.astype(np.float32)).astype(np.float32)
    ahead = camera[camera[:, 2] > 1e-3]
    if len(ahead) == 0:
        return camera, rotation, (1.0, 0.0, 0.0)
    slope = ahead[:, :2] / ahead[:, 2:]
    low, high = slope.min(axis=0), slope.max(axis=0)
    extent = np.maximum(high - low, 1e-6)
    focal = float(min((columns - 1) / extent[0], (rows - 1) / extent[1]))
    center_u = (columns - 1) / 2 - focal * float(low[0] + high[0]) / 2
    center_v = (rows - 1) / 2 - focal * float(low[1] + high[1]) / 2
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
    camera, rotation, (focal, center_u, center_v) = project(vertices, position, target, columns, rows)
    depth = np.empty((rows, columns), np.float32)
    hit = np.empty((rows, columns), np.int32)
    rasterize(camera, faces, focal, center_u, center_v, depth, hit)
    v, u = np.nonzero(hit != NOTHING)
    ray = np.stack([(u - center_u) / focal, (v - center_v) / focal, np.ones(len(u))], axis=1)
    points = (ray * depth[v, u][:, None]) @ rotation + position
    seen = hit[v, u]
    return Hits(points.astype(np.float32), seen, _incidence(vertices, faces[seen], points, position))


def _incidence(vertices: Float32, corners: Int32, points: Float64, position: Float64) -> Float32:
    """|cos| between the line of sight to every point and the normal of its face; float32 [n]."""
    a = vertices[corners[:, 0]]
    normal = np.cross(vertices[corners[:, 1]] - a, vertices[corners[:, 2]] - a)
    sight = (points - position).astype(np.float32)
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(sight, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", normal, sight)) / np.maximum(length, 1e-20)
    return cosine.astype(np.float32)
