# SPDX-License-Identifier: Apache-2.0
"""How a simulated cloud compares with the true surface: points per frame, distance, coverage, spacing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.frames import Float32, Float64
from train.depth_scan import scan
from train.nearest import nearest_distance
from train.objects.mesh import Mesh
from train.objects.sampling import sample_surface

SURFACE_POINTS = 16_384
NEAR_M, FAR_M, COVER_M = 0.10, 0.20, 0.15
MOST_OBLIQUE = 0.1
"""Cosine below which a pixel's share of the surface is not extrapolated any more."""


@dataclass(frozen=True, slots=True)
class CloudStatistics:
    """Figures of one cloud; of an empty cloud all are 0, spacing is NaN.

    Args:
        points: of the cloud.
        frames: of the window.
        points_per_frame: mean over the window.
        empty_share: share of the window's frames without a point of the cloud.
        within_10cm, within_20cm: share of the points that near to the true surface.
        median_m: median distance of a point from the true surface.
        coverage: share of the surface visible from the track that has a point within 15 cm.
        spacing_m: median distance of a point from its nearest neighbour in the cloud.
    """

    points: int
    frames: int
    points_per_frame: float
    empty_share: float
    within_10cm: float
    within_20cm: float
    median_m: float
    coverage: float
    spacing_m: float


def measure(
    mesh: Mesh,
    cloud_m: Float32,
    frame_number: NDArray[np.int64],
    frames: int,
    eyes_m: Sequence[Float64],
    rng: np.random.Generator,
) -> CloudStatistics:
    """Compare a cloud with the object that it was made from.

    Args:
        mesh: the true object.
        cloud_m: float32 [n, 3] in the frame of the mesh.
        frame_number: int64 [n].
        frames: of the window.
        eyes_m: positions of the rig in the frame of the mesh from which its visible surface is determined.
        rng: for the points on the surface.
    """
    count = len(cloud_m)
    if count == 0:
        return CloudStatistics(0, frames, 0.0, 1.0 if frames else 0.0, 0.0, 0.0, 0.0, 0.0, float("nan"))
    cloud = np.ascontiguousarray(cloud_m, dtype=np.float32)
    away_m = nearest_distance(cloud, sample_surface(mesh.vertices, mesh.faces, SURFACE_POINTS, rng))
    seen_m, area = visible_surface(mesh, eyes_m)
    covered = nearest_distance(seen_m, cloud) <= COVER_M
    return CloudStatistics(
        points=count,
        frames=frames,
        points_per_frame=count / frames,
        empty_share=1.0 - len(np.unique(frame_number)) / frames,
        within_10cm=float(np.mean(away_m <= NEAR_M)),
        within_20cm=float(np.mean(away_m <= FAR_M)),
        median_m=float(np.median(away_m)),
        coverage=float(area[covered].sum() / area.sum()) if len(area) else 0.0,
        spacing_m=spacing_m(cloud),
    )


def visible_surface(
    mesh: Mesh, eyes_m: Sequence[Float64], columns: int = 96, rows: int = 72
) -> tuple[Float32, Float64]:
    """Points that are seen from at least one position, float32 [n, 3], and the surface that each stands for, [n]."""
    middle_m = np.array([0.0, 0.0, 0.5 * float(mesh.size_m[2])])
    points, areas = [np.zeros((0, 3), np.float32)], [np.zeros(0)]
    for eye_m in eyes_m:
        hits = scan(mesh.vertices, mesh.faces, eye_m, middle_m, columns, rows)
        range_m = np.linalg.norm(hits.points - eye_m, axis=1)
        points.append(hits.points)
        areas.append(range_m**2 / np.maximum(hits.cosine, MOST_OBLIQUE) / max(len(hits.points), 1))
    return np.ascontiguousarray(np.concatenate(points)), np.concatenate(areas)


def spacing_m(cloud_m: Float32) -> float:
    """Median distance of a point from its nearest neighbour; NaN below two points."""
    if len(cloud_m) < 2:
        return float("nan")
    points = cloud_m.astype(np.float64)
    square, nearest = np.einsum("ij,ij->i", points, points), np.empty(len(points))
    for first in range(0, len(points), 512):
        part = slice(first, first + 512)
        apart = square[part, None] + square - 2.0 * points[part] @ points.T
        apart[np.arange(len(apart)), first + np.arange(len(apart))] = np.inf
        nearest[part] = apart.min(axis=1)
    return float(np.sqrt(max(np.median(nearest), 0.0)))
