# SPDX-License-Identifier: Apache-2.0
"""Fewer triangles without any library: vertices of one cell of a grid become one (Rossignac and Borrel 1993)."""

from __future__ import annotations

import numpy as np

from edge.frames import Float64
from train.objects.primitives import Part


def merge_near(vertices: Float64, faces: np.ndarray[tuple[int, ...], np.dtype[np.int64]], cell_m: float) -> Part:
    """Merge the vertices of every cubic cell to their mean; faces that lose their area or repeat are dropped.

    Args:
        vertices: [n, 3], metres. faces: [m, 3].
        cell_m: edge of a cell; no vertex moves farther than its diagonal.
    Returns:
        Vertices float64 [k, 3] and faces int64 [j, 3].
    """
    key = np.floor(vertices / cell_m).astype(np.int64)
    key -= key.min(axis=0)
    extent = key.max(axis=0) + 1
    flat = (key[:, 0] * extent[1] + key[:, 1]) * extent[2] + key[:, 2]
    _, cell = np.unique(flat, return_inverse=True)
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, vertices[:, k]) / count for k in range(3)], axis=1)
    merged = cell[faces]
    kept = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    merged = merged[kept]
    _, first = np.unique(np.sort(merged, axis=1), axis=0, return_index=True)
    merged = merged[np.sort(first)]
    used, compacted = np.unique(merged, return_inverse=True)
    return mean[used], compacted.reshape(-1, 3)


def reduce_to(vertices: Float64, faces: np.ndarray[tuple[int, ...], np.dtype[np.int64]], limit: int) -> Part:
    """The finest grid that leaves at most ``limit`` triangles; the mesh itself when it has no more.

    Args:
        vertices: [n, 3], metres. faces: [m, 3]. limit: >= 1.
    """
    if len(faces) <= limit:
        return vertices, faces
    size = float(np.ptp(vertices, axis=0).max())
    low, high = 0.0, size
    best = merge_near(vertices, faces, size)
    for _ in range(18):
        cell = 0.5 * (low + high)
        part = merge_near(vertices, faces, cell)
        if 0 < len(part[1]) <= limit:
            best, high = part, cell
        elif len(part[1]) == 0:
            high = cell
        else:
            low = cell
    return best
