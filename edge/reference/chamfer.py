# SPDX-License-Identifier: Apache-2.0
"""Chamfer distance between two point sets, from its definition."""

from __future__ import annotations

import numpy as np

from edge.config import require
from edge.frames import Float32, Float64

CHUNK = 1024


def nearest_distance_m(points_m: Float32 | Float64, others_m: Float32 | Float64) -> Float64:
    """Distance of every point to the nearest of the others.

    Args:
        points_m: [n, 3] metres.
        others_m: [m, 3] metres, at least one.
    Returns:
        float64 [n] metres.
    """
    require(len(others_m) > 0, "others_m", len(others_m), "at least one point")
    centre = np.asarray(others_m, dtype=np.float64).mean(axis=0)
    b = np.asarray(others_m - centre, dtype=np.float64)
    b_square = np.einsum("ij,ij->i", b, b)
    result = np.empty(len(points_m))
    for start in range(0, len(points_m), CHUNK):
        a = np.asarray(points_m[start : start + CHUNK] - centre, dtype=np.float64)
        square = np.einsum("ij,ij->i", a, a)[:, None] + b_square - 2.0 * (a @ b.T)
        result[start : start + CHUNK] = np.sqrt(np.maximum(square.min(axis=1), 0.0))
    return result


def chamfer_l1_m(a_m: Float32 | Float64, b_m: Float32 | Float64) -> float:
    """CD-L1: mean of both directions' mean distance to the nearest neighbour, metres (unsquared).

    Args:
        a_m, b_m: [n, 3] and [m, 3] metres, not empty.
    """
    return float(0.5 * (nearest_distance_m(a_m, b_m).mean() + nearest_distance_m(b_m, a_m).mean()))
