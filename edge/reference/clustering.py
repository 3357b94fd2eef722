# SPDX-License-Identifier: Apache-2.0
"""Density clustering on the ground plane from its definition in float64: every pair of points is compared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.frames import Float64

Int64 = NDArray[np.int64]


def _squared_distance_m2(a_m: Float64, b_m: Float64) -> Float64:
    """Squared distances [len(a), len(b)] in the plane."""
    dx_m, dy_m = (a_m[:, None, axis] - b_m[None, :, axis] for axis in (0, 1))
    return np.asarray(dx_m * dx_m + dy_m * dy_m, np.float64)


def dbscan(xy_m: Float64, neighbour_m: float, core_points: int) -> Int64:
    """DBSCAN labels (Ester, Kriegel, Sander, Xu, KDD 1996) with the border points' cluster made unique.

    Two points are neighbours when their distance is at most ``neighbour_m``. A point with at least ``core_points``
    neighbours, itself included, is a core point; core points connected by neighbourhood form a cluster. A point that is
    not core joins the cluster of its nearest core neighbour (of two equally near, the first).

    Args:
        xy_m: float64 [n, 2].
        neighbour_m: radius of the neighbourhood.
        core_points: neighbours that make a core point.
    Returns:
        int64 [n], clusters numbered by their first core point, -1 for points in none.
    """
    squared_m2 = _squared_distance_m2(xy_m, xy_m)
    near = squared_m2 <= neighbour_m * neighbour_m
    core = near.sum(axis=1) >= core_points
    labels = np.full(len(xy_m), -1, np.int64)
    for seed in np.flatnonzero(core):
        if labels[seed] >= 0:
            continue
        member = np.zeros(len(xy_m), bool)
        front = member.copy()
        front[seed] = True
        while front.any():
            member |= front
            front = near[front].any(axis=0) & core & ~member
        labels[member] = labels.max() + 1
    border = np.where(core, labels, -1)
    labels[~core] = nearest_label(xy_m, border, xy_m[~core], neighbour_m)
    return labels


def nearest_label(xy_m: Float64, labels: Int64, query_m: Float64, neighbour_m: float) -> Int64:
    """Label of the nearest labelled point within ``neighbour_m`` of every query point, -1 where there is none.

    Args:
        xy_m: float64 [n, 2].
        labels: int64 [n], negative points are passed over.
        query_m: float64 [m, 2].
        neighbour_m: largest distance.
    Returns:
        int64 [m]; of equally near points the first decides.
    """
    if not (labels >= 0).any():
        return np.full(len(query_m), -1, np.int64)
    squared_m2 = np.where(labels >= 0, _squared_distance_m2(query_m, xy_m), np.inf)
    nearest = squared_m2.argmin(axis=1)
    reached = squared_m2[np.arange(len(query_m)), nearest] <= neighbour_m * neighbour_m
    return np.where(reached, labels[nearest], -1)
