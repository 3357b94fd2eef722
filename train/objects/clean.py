# SPDX-License-Identifier: Apache-2.0
"""Cleaning of foreign meshes: merged vertices, no degenerate or double faces, no stray parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.frames import Float64
from train.objects.mesh import MeshError
from train.objects.readers import Faces, Soup, load_trimesh

_STRAY_GAP, _STRAY_AREA = 0.15, 0.02
"""A stray part is farther from the rest than this share of its diagonal, and has less than that share of the area."""


@dataclass(frozen=True, slots=True)
class CleanReport:
    """What was done: counts of vertices and faces, and of faces dropped for each reason."""

    source_faces: int
    degenerate: int = 0
    double: int = 0
    stray: int = 0


def clean(soup: Soup) -> tuple[Soup, CleanReport]:
    """Clean a mesh; nothing visible is lost.

    Args:
        soup: vertices [n, 3] and faces [m, 3].
    Raises:
        MeshError: no surface is left. DependencyError: trimesh is not installed.
    """
    trimesh = load_trimesh()
    mesh: Any = trimesh.Trimesh(vertices=soup[0], faces=soup[1], process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    count = len(mesh.faces)
    mesh.update_faces(mesh.nondegenerate_faces(height=1e-9 * float(mesh.scale)))
    degenerate, count = count - len(mesh.faces), len(mesh.faces)
    mesh.update_faces(mesh.unique_faces())
    double = count - len(mesh.faces)
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) == 0:
        raise MeshError("no surface is left after cleaning", value=f"{len(soup[1])} faces, all without area")
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    kept = _near_parts(vertices, faces, np.asarray(mesh.area_faces))
    return compact(vertices, faces[kept]), CleanReport(len(soup[1]), degenerate, double, int(np.count_nonzero(~kept)))


def compact(vertices: Float64, faces: Faces) -> Soup:
    """Without the vertices that no face names."""
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3)


def _near_parts(vertices: Float64, faces: Faces, area: Float64) -> NDArray[np.bool_]:
    """True for faces of parts that belong to the object, bool [m]: a part that floats far off is a leftover."""
    part = _parts(len(vertices), faces)
    count = int(part.max()) + 1
    share = np.bincount(part, area, count) / area.sum()
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for k in range(3):
        np.minimum.at(low, part, vertices[faces[:, k]])
        np.maximum.at(high, part, vertices[faces[:, k]])
    order = np.argsort(-share)
    inside = np.zeros(count, bool)
    inside[order[0]] = True
    box_low, box_high = low[order[0]].copy(), high[order[0]].copy()
    grown = True
    while grown:
        grown = False
        gap = np.maximum(np.maximum(low - box_high, box_low - high), 0)
        near = np.linalg.norm(gap, axis=1) <= _STRAY_GAP * float(np.linalg.norm(box_high - box_low))
        joins = (near | (share >= _STRAY_AREA)) & ~inside
        if joins.any():
            inside |= joins
            box_low, box_high = low[inside].min(axis=0), high[inside].max(axis=0)
            grown = True
    return inside[part]


def _parts(vertices: int, faces: Faces) -> NDArray[np.int64]:
    """Number of the connected part of every face, int64 [m]."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rows, columns = np.concatenate([faces[:, 0], faces[:, 1]]), np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(vertices, vertices))
    _, label = connected_components(graph, directed=False)
    _, number = np.unique(label[faces[:, 0]], return_inverse=True)
    return number.astype(np.int64)
