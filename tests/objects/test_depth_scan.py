# SPDX-License-Identifier: Apache-2.0
"""The z-buffer against closed formulas and against brute-force ray casting."""

from __future__ import annotations

import numpy as np
import pytest

from train.depth_scan import look_at, project, rasterize, scan
from train.objects.parametric import generate
from train.objects.primitives import box, join, superellipsoid


def cast(vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance along every ray to the nearest face (Moller and Trumbore 1997), float64, infinity when it misses."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    e1, e2 = b - a, c - a
    nearest = np.full(len(rays), np.inf)
    for number, ray in enumerate(rays):
        p = np.cross(ray, e2)
        determinant = (e1 * p).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            u = (s * p).sum(axis=1) / determinant
            q = np.cross(s, e1)
            v = (q @ ray) / determinant
            t = (e2 * q).sum(axis=1) / determinant
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if inside.any():
            nearest[number] = t[inside].min()
    return nearest


def test_a_plane_is_seen_at_its_distance() -> None:
    """A square that faces the camera: every hit lies in its plane, and the picture is filled."""
    vertices = np.array([[0, -1, 0], [0, 1, 0], [0, 1, 2], [0, -1, 2]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    position, target = np.array([5.0, 0, 1]), np.array([0.0, 0, 1])
    hits = scan(vertices, faces, position, target, 60, 60)
    assert len(hits.points) >= 58 * 58
    np.testing.assert_allclose(hits.points[:, 0], 0, atol=1e-5)
    sight = hits.points - position
    np.testing.assert_allclose(hits.cosine, 5 / np.linalg.norm(sight, axis=1), rtol=1e-5)


def test_of_a_sphere_only_the_near_cap_is_visible() -> None:
    """From distance d the visible cap ends where the tangent touches: n . direction >= r / d."""
    radius, distance = 1.0, 4.0
    vertices, faces = join([superellipsoid((0, 0, 0), (radius,) * 3, steps=(96, 65))])
    hits = scan(vertices, faces, np.array([distance, 0.0, 0.0]), np.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(hits.points, axis=1), radius, atol=4e-3)
    assert hits.points[:, 0].min() > radius**2 / distance - 0.03
    # The disc of tangents fills pi / 4 of the square that holds it.
    height = 119
    assert len(hits.points) == pytest.approx(np.pi / 4 * height**2, rel=0.03)


def test_what_is_behind_is_hidden() -> None:
    vertices, faces = join([box((0, 0, 1), (0.02, 3, 2)), box((-2, 0, 1), (0.02, 1, 1))])
    hits = scan(vertices, faces, np.array([6.0, 0, 1]), np.array([0.0, 0, 1]))
    assert hits.points[:, 0].min() > -0.1
    assert set(hits.faces.tolist()) <= set(range(12))


def test_agrees_with_ray_casting_on_a_bicycle() -> None:
    mesh = generate("bicycle", 1)
    position, target = np.array([2.5, 3.0, 0.9]), np.array([0.0, 0, 0.5])
    columns, rows = 40, 30
    camera, rotation, (focal, cu, cv) = project(mesh.vertices, position, target, columns, rows)
    depth = np.empty((rows, columns), np.float32)
    hit = np.empty((rows, columns), np.int32)
    rasterize(camera, mesh.faces, focal, cu, cv, depth, hit)
    v, u = (index.ravel() for index in np.mgrid[:rows, :columns])
    rays = np.stack([(u - cu) / focal, (v - cv) / focal, np.ones(u.size)], axis=1) @ rotation
    expected = cast(mesh.vertices, mesh.faces, position, rays).reshape(rows, columns)
    both = np.isfinite(expected) & np.isfinite(depth)
    assert np.count_nonzero(np.isfinite(expected) != np.isfinite(depth)) <= 2  # rays exactly along an edge
    assert np.count_nonzero(both) > 100
    different = np.abs(expected[both] - depth[both]) > 1e-3
    assert np.count_nonzero(different) <= 2


def test_hits_lie_on_their_faces_and_none_is_behind_another() -> None:
    mesh = generate("car", 2)
    position = np.array([6.0, 4.0, 0.8])
    hits = scan(mesh.vertices, mesh.faces, position, np.array([0.0, 0, 0.7]), 50, 40)
    corner = mesh.vertices[mesh.faces[hits.faces]].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off = np.abs(((hits.points - corner[:, 0]) * normal).sum(axis=1))
    assert np.percentile(off, 99) < 1e-3
    chosen = np.random.default_rng(0).choice(len(hits.points), 60, replace=False)
    rays = hits.points[chosen] - position
    nearest = cast(mesh.vertices, mesh.faces, position, rays.astype(np.float64))
    assert np.count_nonzero(nearest < 0.995) <= 1  # nothing in front of a hit (distance 1 is the hit itself)


def test_nothing_is_seen_behind_the_camera() -> None:
    vertices, faces = join([box((-5, 0, 0.5), (1, 1, 1))])
    assert len(scan(vertices, faces, np.array([0.0, 0, 0.5]), np.array([1.0, 0, 0.5])).points) == 0


def test_camera_axes_are_right_handed() -> None:
    rotation = look_at(np.array([3.0, 1, 1]), np.array([0.0, 0, 0.5]))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert rotation[1, 2] < 0  # rows of the picture go down
