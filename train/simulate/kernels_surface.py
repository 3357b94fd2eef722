# SPDX-License-Identifier: Apache-2.0
"""Kernels of a mesh's preparation: corner normals with a crease, components, Phong-tessellated sub-patches, edges."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge.frames import Float32, Float64
from train.objects.sampling import Int32

Int64 = NDArray[np.int64]

STACK = 128
"""Triangles that wait during the bisection of one face; a face needs as many as its depth plus one."""
MAX_DEPTH = 40


@njit(cache=True, nogil=True, error_model="numpy")
def _cross(a: Float64, b: Float64, out: Float64) -> float:  # pragma: no cover - compiled
    """a x b into ``out``; returns its length."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])


@njit(cache=True, nogil=True, error_model="numpy")
def face_normals(vertices: Float32, faces: Int32, normals: Float64, areas: Float64) -> None:  # pragma: no cover
    """Unit normals float64 [m, 3] and areas [m], m^2; the normal's sense means nothing, of a sliver it is zero."""
    u, v, w = np.empty(3), np.empty(3), np.empty(3)
    for f in range(len(faces)):
        for k in range(3):
            u[k] = np.float64(vertices[faces[f, 1], k]) - vertices[faces[f, 0], k]
            v[k] = np.float64(vertices[faces[f, 2], k]) - vertices[faces[f, 0], k]
        length = _cross(u, v, w)
        areas[f] = 0.5 * length
        scale = 1.0 / length if length > 1e-12 else 0.0
        for k in range(3):
            normals[f, k] = w[k] * scale


@njit(cache=True, nogil=True, error_model="numpy")
def corner_normals(
    faces: Int32, vertex_count: int, normals: Float64, areas: Float64, crease_cosine: float, out: Float32
) -> None:  # pragma: no cover - compiled
    """Area-weighted mean normal at every corner over the faces of the vertex that lie within the crease angle.

    Args:
        faces: int32 [m, 3]; normals, areas: of the faces.
        crease_cosine: |cos| of the angle between two faces from which on they are one smooth surface; the sense of a
            face's normal is ignored.
        out: float32 [m, 3, 3], out: face, corner, xyz; on the side of the face's own normal.
    """
    first = np.zeros(vertex_count + 1, np.int64)
    for f in range(len(faces)):
        for k in range(3):
            first[faces[f, k] + 1] += 1
    for v in range(vertex_count):
        first[v + 1] += first[v]
    around = np.empty(3 * len(faces), np.int32)
    filled = first[:-1].copy()
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            around[filled[v]] = f
            filled[v] += 1
    for f in range(len(faces)):
        nx, ny, nz = normals[f, 0], normals[f, 1], normals[f, 2]
        for k in range(3):
            v = faces[f, k]
            x, y, z = 0.0, 0.0, 0.0
            for i in range(first[v], first[v + 1]):
                g = around[i]
                cosine = nx * normals[g, 0] + ny * normals[g, 1] + nz * normals[g, 2]
                if abs(cosine) >= crease_cosine:
                    weight = areas[g] if cosine > 0 else -areas[g]
                    x, y, z = x + weight * normals[g, 0], y + weight * normals[g, 1], z + weight * normals[g, 2]
            length = math.sqrt(x * x + y * y + z * z)
            if length > 1e-12:
                out[f, k, 0], out[f, k, 1], out[f, k, 2] = x / length, y / length, z / length
            else:
                out[f, k, 0], out[f, k, 1], out[f, k, 2] = nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy")
def components(faces: Int32, vertex_count: int, out: Int32) -> int:  # pragma: no cover - compiled
    """Number of every face's connected component int32 [m] into ``out``; returns how many components there are."""
    parent = np.arange(vertex_count)
    for f in range(len(faces)):
        for k in range(1, 3):
            a, b = faces[f, 0], faces[f, k]
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            parent[max(a, b)] = min(a, b)
    number = np.full(vertex_count, -1, np.int32)
    count = 0
    for f in range(len(faces)):
        a = faces[f, 0]
        while parent[a] != a:
            a = parent[a]
        if number[a] < 0:
            number[a] = count
            count += 1
        out[f] = number[a]
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _longest(corner: Float64, points: Float64) -> tuple[int, float]:  # pragma: no cover - compiled
    """Corner opposite of which the longest side lies, and its squared length; ``points`` [3, 3] is overwritten.

    ``corner`` [6, 3]: rows 0..2 barycentric coordinates of a sub-triangle, rows 3..5 the face's vertices.
    """
    for i in range(3):
        for k in range(3):
            points[i, k] = corner[i, 0] * corner[3, k] + corner[i, 1] * corner[4, k] + corner[i, 2] * corner[5, k]
    best, longest = 0, -1.0
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        length = 0.0
        for k in range(3):
            length += (points[a, k] - points[b, k]) ** 2
        if length > longest:
            best, longest = i, length
    return best, longest


@njit(cache=True, nogil=True, error_model="numpy")
def subdivide(
    vertices: Float32, faces: Int32, longest_m: float, barycentric: Float32, owner: Int32
) -> int:  # pragma: no cover - compiled
    """Longest-side bisection of every face until no side exceeds ``longest_m``; returns the number of sub-triangles.

    Args:
        vertices, faces: float32 [n, 3], int32 [m, 3].
        longest_m: wanted, metres.
        barycentric: float32 [p, 3, 3], out: sub-triangle, corner, coordinate; nothing is written beyond p.
        owner: int32 [p], out: the face.
    """
    stack, depth = np.empty((STACK, 3, 3)), np.empty(STACK, np.int64)
    work, points = np.empty((6, 3)), np.empty((3, 3))
    limit, count, room = longest_m * longest_m, 0, len(owner)
    for f in range(len(faces)):
        for i in range(3):
            for k in range(3):
                work[3 + i, k] = vertices[faces[f, i], k]
                stack[0, i, k] = 1.0 if i == k else 0.0
        depth[0], top = 0, 1
        while top > 0:
            top -= 1
            work[:3] = stack[top]
            apex, length = _longest(work, points)
            if length <= limit or depth[top] >= MAX_DEPTH or top + 2 > STACK:
                if count < room:
                    barycentric[count] = work[:3]
                    owner[count] = f
                count += 1
                continue
            a, b = (apex + 1) % 3, (apex + 2) % 3
            level = depth[top] + 1
            for half in range(2):
                for k in range(3):
                    middle = 0.5 * (work[a, k] + work[b, k])
                    stack[top, apex, k] = work[apex, k]
                    stack[top, a, k] = work[a, k] if half == 0 else middle
                    stack[top, b, k] = middle if half == 0 else work[b, k]
                depth[top] = level
                top += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _curved(
    weights: Float32, corners: Float64, normals: Float32, share: float, point: Float64, normal: Float64
) -> None:  # pragma: no cover - compiled
    """Point and normal of a Phong-tessellated face at barycentric ``weights`` [3].

    Source: Boubekeur and Alexa, "Phong tessellation", ACM Trans. Graph. 27(5), 2008.
    """
    for k in range(3):
        point[k] = weights[0] * corners[0, k] + weights[1] * corners[1, k] + weights[2] * corners[2, k]
        normal[k] = weights[0] * normals[0, k] + weights[1] * normals[1, k] + weights[2] * normals[2, k]
    x, y, z = point[0], point[1], point[2]
    for i in range(3):
        away = 0.0
        away += (x - corners[i, 0]) * normals[i, 0] + (y - corners[i, 1]) * normals[i, 1]
        away += (z - corners[i, 2]) * normals[i, 2]
        for k in range(3):
            point[k] -= share * weights[i] * away * normals[i, k]
    length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    for k in range(3):
        normal[k] /= max(length, 1e-9)


@njit(cache=True, nogil=True, error_model="numpy")
def patches(
    vertices: Float32,
    faces: Int32,
    corner: Float32,
    share: float,
    barycentric: Float32,
    owner: Int32,
    shape: Float32,
    flat: Float32,
    area: Float32,
    spread: Float32,
) -> None:  # pragma: no cover - compiled
    """Curved sub-patches from barycentric sub-triangles.

    Args:
        vertices, faces, corner: the mesh and its corner normals [m, 3, 3].
        share: of Phong tessellation, 0 flat .. 1.
        barycentric, owner: from ``subdivide``.
        shape: float32 [p, 4, 3], out: centre, unit normal and the two sides from the first corner, metres.
        flat: float32 [p, 3], out: the centre on the flat face (for visibility).
        area: float32 [p], out: m^2.
        spread: float32 [p], out: variance per axis of the interpolated normal inside the patch, rad^2.
    """
    triangle, bent, normals = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    u, v, w = np.empty(3), np.empty(3), np.empty(3)
    for p in range(len(owner)):
        f = owner[p]
        for i in range(3):
            for k in range(3):
                triangle[i, k] = vertices[faces[f, i], k]
        for i in range(3):
            _curved(barycentric[p, i], triangle, corner[f], share, bent[i], normals[i])
        variance = 0.0
        for k in range(3):
            shape[p, 0, k] = (bent[0, k] + bent[1, k] + bent[2, k]) / 3.0
            u[k], v[k] = bent[1, k] - bent[0, k], bent[2, k] - bent[0, k]
            shape[p, 2, k], shape[p, 3, k] = u[k], v[k]
            mean = (normals[0, k] + normals[1, k] + normals[2, k]) / 3.0
            flat[p, k] = 0.0
            for i in range(3):
                variance += (normals[i, k] - mean) ** 2
                flat[p, k] += (barycentric[p, 0, i] + barycentric[p, 1, i] + barycentric[p, 2, i]) / 3 * triangle[i, k]
        length = _cross(u, v, w)
        area[p] = 0.5 * length
        for k in range(3):
            shape[p, 1, k] = w[k] / max(length, 1e-12)
        spread[p] = variance / 24.0


@njit(cache=True, nogil=True, error_model="numpy")
def crease_edges(
    vertices: Float32,
    faces: Int32,
    key: Int64,
    order: Int64,
    crease_cosine: float,
    out: Int32,
    bulge: Float32,
    owner: Int32,
) -> int:  # pragma: no cover - compiled
    """Edges at which exactly two faces meet at an angle; returns how many.

    Args:
        vertices, faces: the mesh without doubled faces.
        key: int64 [3 m], number of the undirected edge opposite to corner k of face f at 3 f + k.
        order: int64 [3 m], positions of ``key`` in ascending order.
        crease_cosine: cosine of the angle between the planes from which on the edge is sharp.
        out: int32 [3 m, 2], out: vertices of the edge.
        bulge: float32 [3 m, 3], out: sum of both unit directions from the edge into the faces; it points to the inside
            of a convex edge.
        owner: int32 [3 m], out: one of its faces.
    """
    inward, along = np.empty((2, 3)), np.empty(3)
    count, start, total = 0, 0, len(key)
    while start < total:
        end = start + 1
        while end < total and key[order[end]] == key[order[start]]:
            end += 1
        if end - start == 2:
            for i in range(2):
                f, k = order[start + i] // 3, order[start + i] % 3
                a, b, c = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3], faces[f, k]
                length, shadow = 0.0, 0.0
                for d in range(3):
                    along[d] = np.float64(vertices[b, d]) - vertices[a, d]
                    inward[i, d] = np.float64(vertices[c, d]) - vertices[a, d]
                    length += along[d] * along[d]
                    shadow += along[d] * inward[i, d]
                norm = 0.0
                for d in range(3):
                    inward[i, d] -= along[d] * shadow / max(length, 1e-18)
                    norm += inward[i, d] ** 2
                for d in range(3):
                    inward[i, d] /= max(math.sqrt(norm), 1e-12)
            # Flat: the directions oppose each other. A fold that is nearly closed is a doubled sheet, not a crease.
            cosine = -(inward[0, 0] * inward[1, 0] + inward[0, 1] * inward[1, 1] + inward[0, 2] * inward[1, 2])
            if -0.985 < cosine < crease_cosine:
                out[count, 0], out[count, 1], owner[count] = a, b, f
                for d in range(3):
                    bulge[count, d] = inward[0, d] + inward[1, d]
                count += 1
        start = end
    return count
