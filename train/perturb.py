# SPDX-License-Identifier: Apache-2.0
"""From a mesh to a cloud like a fused radar cloud: view points, depth map, specular spots, holes, noise spheres.

The paper's augmentation (section 4.3, second part) is camera, depth snapshot, noise spheres, then holes. Everything
marked "ours" below is an addition and has its own switch; ``PerturbSettings.paper()`` turns all of them off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge.completion.sight import turned
from edge.frames import Float32, Float64
from train.depth_scan import Hits, scan
from train.objects.mesh import Mesh
from train.perturb_settings import PerturbSettings

__all__ = [
    "PerturbSettings", "View", "add_artefacts", "base_sample", "cut_holes", "draw_view", "noise_spheres", "perturb",
    "snapshot", "specular_weights",
]  # fmt: skip

AZIMUTH_SECTORS = 8
NEIGHBOUR_GAP_M, NEIGHBOUR_SHARE = (0.4, 1.5), (0.05, 0.6)
_CANDIDATES = 8000
_REPEATED_SIGMA_M = 0.01


@dataclass(frozen=True, slots=True)
class View:
    """Where the radar passes the object, in the object's frame.

    Args:
        azimuth_rad: direction from the object to the middle of the path.
        positions: float64 [views, 3], metres.
        targets: float64 [views, 3], where the camera looks.
    """

    azimuth_rad: float
    positions: Float64
    targets: Float64

    @property
    def middle(self) -> Float64:
        """Middle of the path, float64 [3]."""
        middle: Float64 = self.positions.mean(axis=0)
        return middle

    @property
    def along(self) -> Float64:
        """Unit vector of the path, float64 [2]."""
        return np.array([-math.sin(self.azimuth_rad), math.cos(self.azimuth_rad)])


def draw_view(mesh: Mesh, settings: PerturbSettings, rng: np.random.Generator, sector: int | None = None) -> View:
    """Draw a view point as a car at the road side would have it.

    Args:
        mesh: the object.
        sector: azimuth inside this eighth of the circle (stratified), None = anywhere.
    """
    share = rng.random() if sector is None else (sector % AZIMUTH_SECTORS + rng.random()) / AZIMUTH_SECTORS
    azimuth = 2 * math.pi * share
    size = mesh.size_m
    distance = math.exp(rng.uniform(*np.log(settings.distance_m))) + float(size[0]) / 2
    views = 1
    if rng.random() < settings.path_probability:
        views = int(rng.integers(settings.path_views[0], settings.path_views[1] + 1))
    offset = np.linspace(-0.5, 0.5, views) * settings.path_m if views > 1 else np.zeros(1)
    height = rng.uniform(*settings.height_m)
    c, s = math.cos(azimuth), math.sin(azimuth)
    positions = np.stack(
        [distance * c - offset * s, distance * s + offset * c, np.full(views, height)], axis=1
    )  # on a line at right angles to the direction of the object
    center = np.array([0.0, 0.0, float(size[2]) / 2])
    error = distance * np.tan(np.radians(rng.uniform(-settings.aim_deg, settings.aim_deg, (views, 2))))
    targets = center + np.stack([-s * error[:, 0], c * error[:, 0], error[:, 1]], axis=1)
    return View(azimuth, positions, targets)


def snapshot(mesh: Mesh, view: View, settings: PerturbSettings) -> Hits:
    """Merged hits of all view points on the path."""
    hits = [
        scan(mesh.vertices, mesh.faces, position, target, settings.columns, settings.rows)
        for position, target in zip(view.positions, view.targets, strict=True)
    ]
    return Hits(
        np.concatenate([h.points for h in hits]),
        np.concatenate([h.faces for h in hits]),
        np.concatenate([h.cosine for h in hits]),
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _add_spots(
    points: Float32, spots: NDArray[np.int64], sigma: Float64, strength: Float64, weight: Float64
) -> None:  # pragma: no cover - compiled
    """Add to ``weight`` [n] a Gaussian about each spot (a number of a point) out to eight sigma."""
    for k in range(len(spots)):
        x, y, z = points[spots[k], 0], points[spots[k], 1], points[spots[k], 2]
        scale, reach = -0.5 / (sigma[k] * sigma[k]), 64.0 * sigma[k] * sigma[k]
        for i in range(len(points)):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            square = dx * dx + dy * dy + dz * dz
            if square < reach:
                weight[i] += strength[k] * np.exp(square * scale)


def specular_weights(points: Float32, cosine: Float32, settings: PerturbSettings, rng: np.random.Generator) -> Float64:
    """Weight of every hit when a few spots outshine the rest (ours); sums to 1.

    Spots are drawn with probability cos^8 of the incidence plus a floor for corners and edges, each with its own sigma
    and strength; a fraction of the weight stays spread over everything.
    """
    count = int(rng.integers(settings.specular_spots[0], settings.specular_spots[1] + 1))
    chance = cosine.astype(np.float64) ** 8 + 0.03
    spots = rng.choice(len(points), size=count, p=chance / chance.sum())
    sigma = rng.uniform(*settings.specular_radius_m, size=count)
    strength = rng.exponential(size=count) ** 2 + 0.1  # powers of spots differ by orders of magnitude
    weight = np.zeros(len(points))
    _add_spots(points, spots, sigma, strength, weight)
    background = rng.uniform(*settings.specular_background)
    spread: Float64 = (1 - background) * weight / weight.sum() + background / len(points)
    return spread


def base_sample(hits: Hits, view: View, settings: PerturbSettings, rng: np.random.Generator) -> Float32:
    """Some hundred points of the snapshot: uniform over its pixels or clustered, maybe of a part of the object only."""
    chosen = np.arange(len(hits.points))
    if len(chosen) == 0:
        return hits.points
    if len(chosen) > _CANDIDATES:
        chosen = rng.choice(chosen, _CANDIDATES, replace=False)
    points, cosine = hits.points[chosen], hits.cosine[chosen]
    if rng.random() < settings.pass_probability:
        along = points[:, :2] @ view.along
        low, high = float(along.min()), float(along.max())
        width = (high - low) * rng.uniform(*settings.pass_share)
        start = rng.uniform(low, high - width)
        inside = (along >= start) & (along <= start + width)
        points, cosine = points[inside], cosine[inside]
    count = int(rng.integers(settings.base_points[0], settings.base_points[1] + 1))
    if rng.random() < settings.specular_probability:
        # A spot is detected again and again from frame to frame, a little beside where it was before.
        again = rng.choice(len(points), count, p=specular_weights(points, cosine, settings, rng))
        return points[again] + rng.normal(0, _REPEATED_SIGMA_M, (count, 3)).astype(np.float32)
    return points[rng.choice(len(points), min(count, len(points)), replace=False)]


def _norm(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Length of every row."""
    length: NDArray[np.floating] = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return length


def cut_holes(
    points: Float32, diagonal_m: float, settings: PerturbSettings, rng: np.random.Generator
) -> tuple[Float32, list[tuple[Float32, float]]]:
    """Crop several spheres, the first near the centre of the cloud, as specular surfaces reflect away.

    Args:
        points: float32 [n, 3].
        diagonal_m: 3-D diagonal of the object.
    Returns:
        The points outside all spheres, and the spheres (centre [3], radius in metres) that were cut.
    """
    count = int(rng.integers(settings.hole_count[0], settings.hole_count[1] + 1))
    least = settings.hole_min_keep * len(points)
    cut: list[tuple[Float32, float]] = []
    for number in range(count):
        if len(points) == 0:
            break
        if number == 0:
            distance = _norm(points - points.mean(axis=0))
            nearest = np.argsort(distance)[: max(1, int(0.15 * len(points)))]
            center = points[rng.choice(nearest)]
        else:
            center = points[rng.integers(len(points))]
        radius = float(rng.uniform(*settings.hole_radius_share)) * diagonal_m
        outside = _norm(points - center) > radius
        if np.count_nonzero(outside) >= max(least, 1):
            points = points[outside]
            cut.append((center, radius))
    return points, cut


def noise_spheres(points: Float32, position: Float64, settings: PerturbSettings, rng: np.random.Generator) -> Float32:
    """Replace every point by several on a sphere (or ellipsoid) about it.

    Args:
        points: float32 [n, 3].
        position: float64 [3], the radar.
    Returns:
        float32 [sum of the copies, 3].
    """
    copies = rng.integers(settings.noise_copies[0], settings.noise_copies[1] + 1, size=len(points))
    center = np.repeat(points, copies, axis=0).astype(np.float64)
    ray = center - position
    distance = _norm(ray)[:, None]
    if settings.noise_by_distance:
        factor = rng.uniform(0.5, 1.5)
        largest = np.clip((0.02 * distance + 0.03) * factor, *settings.noise_radius_m)
    else:
        largest = np.full((len(center), 1), rng.uniform(*settings.noise_radius_m))
    radius = largest * np.repeat(rng.random(len(points)), copies)[:, None]
    direction = rng.normal(size=center.shape)
    direction /= _norm(direction)[:, None]
    if rng.random() < settings.ellipsoid_probability:
        ray /= np.maximum(distance, 1e-9)
        radial = (direction * ray).sum(axis=1, keepdims=True)
        flat = np.minimum(1.0, 0.03 / np.maximum(largest, 1e-9))
        direction = direction + (flat - 1.0) * radial * ray
    noisy: Float32 = (center + radius * direction).astype(np.float32)
    return noisy


def add_artefacts(points: Float32, view: View, settings: PerturbSettings, rng: np.random.Generator) -> Float32:
    """Odometry drift, outliers, ghosts of the ground and side-lobe streaks, each with its own chance (ours)."""
    chances = (settings.drift_probability, settings.outlier_probability)
    happens = rng.random(4) < (*chances, settings.ghost_probability, settings.streak_probability)
    count = len(points)
    if happens[0]:
        slope = rng.normal(0, settings.drift_sigma, 2)
        points = points.copy()
        points[:, :2] += (points[:, :2] @ view.along)[:, None] * slope
    added: list[NDArray[np.floating]] = [points]
    if happens[1]:
        low, high = points.min(axis=0) - settings.outlier_margin_m, points.max(axis=0) + settings.outlier_margin_m
        added.append(rng.uniform(low, high, (int(settings.outlier_share * count), 3)))
    if happens[2]:  # mirrored about a ground that is not quite flat; the part that stays above z = 0 survives the clip
        ghost = points[rng.choice(count, int(settings.ghost_share * count), replace=False)]
        ghost[:, 2] = 2 * rng.normal(0, settings.ghost_ground_sigma_m) - ghost[:, 2]
        added.append(ghost)
    if happens[3]:
        added.append(
            _streaks(points[rng.choice(count, int(settings.streak_share * count), replace=False)], view, settings, rng)
        )
    return np.concatenate(added).astype(np.float32)


def with_neighbour(cloud: Float32, most: int, rng: np.random.Generator) -> Float32:
    """The cloud and, after its points, the near part of another one that stands beside it along the path (y).

    The other is the cloud itself, turned at random; 5 to 60 % of its points, 0.4 to 1.5 m away, as the segmentation
    lets it through.

    Args:
        cloud: float32 [n, 3], line-of-sight frame. most: points of the result at most.
    """
    middle = (cloud.max(axis=0) + cloud.min(axis=0)) / 2 * np.array([1, 1, 0], np.float32)
    other = turned(cloud - middle, rng.uniform(-np.pi, np.pi)) + middle
    side = 1.0 if rng.random() < 0.5 else -1.0
    other[:, 1] += side * ((side * cloud[:, 1]).max() + rng.uniform(*NEIGHBOUR_GAP_M)) - _nearest_edge(other, side)
    count = min(most - len(cloud), max(1, round(rng.uniform(*NEIGHBOUR_SHARE) * len(cloud))))
    nearest = np.argsort(side * other[:, 1])[:count]
    return np.concatenate([cloud, other[nearest]]).astype(np.float32)


def _nearest_edge(cloud: Float32, side: float) -> float:
    """y of the edge that faces away from ``side``."""
    return side * float((side * cloud[:, 1]).min())


def _streaks(points: Float32, view: View, settings: PerturbSettings, rng: np.random.Generator) -> Float64:
    """Points moved along their iso-range arc, in azimuth (horizontal radar) or elevation (vertical radar)."""
    ray = points - view.middle
    angle = np.radians(rng.uniform(*settings.streak_deg, len(points))) * rng.choice([-1.0, 1.0], len(points))
    horizontal = rng.random(len(points)) < 0.5
    azimuth = np.arctan2(ray[:, 1], ray[:, 0]) + np.where(horizontal, angle, 0)
    ground = np.hypot(ray[:, 0], ray[:, 1])
    elevation = np.arctan2(ray[:, 2], ground) + np.where(horizontal, 0, angle)
    distance = _norm(ray)
    flat = distance * np.cos(elevation)
    moved = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)
    streaks: Float64 = moved + view.middle
    return streaks


def _final_count(settings: PerturbSettings, rng: np.random.Generator) -> int:
    """Number of points that are kept at most."""
    limit = settings.max_points
    low, high = settings.sparse_points
    if rng.random() < settings.sparse_probability:
        return min(limit, round(math.exp(rng.uniform(math.log(low), math.log(high)))))
    if settings.thin and limit > high:
        return round(math.exp(rng.uniform(math.log(high), math.log(limit))))
    return limit


def perturb(
    mesh: Mesh, settings: PerturbSettings, rng: np.random.Generator, sector: int | None = None
) -> tuple[Float32, Float64]:
    """A partial, holed, noisy cloud of an object in the object's own frame.

    Args:
        mesh: the object, ground z = 0.
        settings: what is done, and how much.
        rng: source of chance; the same state gives the same cloud.
        sector: eighth of the circle the radar stands in, None = anywhere.
    Returns:
        Points float32 [n, 3], n <= max_points, random order, no point repeated (n can be small, even 0, when little is
        seen), and the radar's mean position float64 [3] in the same frame.
    """
    view = draw_view(mesh, settings, rng, sector)
    points = base_sample(snapshot(mesh, view, settings), view, settings, rng)
    diagonal = float(np.linalg.norm(mesh.size_m))
    if settings.noise and settings.noise_first:
        points = noise_spheres(points, view.middle, settings, rng)
    if settings.holes:
        points, _ = cut_holes(points, diagonal, settings, rng)
    if settings.noise and not settings.noise_first:
        points = noise_spheres(points, view.middle, settings, rng)
    if len(points) > 0:
        points = add_artefacts(points, view, settings, rng)
    if settings.clip:
        low, high = settings.clip_z_m
        points = points[(points[:, 2] > low) & (points[:, 2] < high)]
    return points[rng.permutation(len(points))[: _final_count(settings, rng)]], view.middle
