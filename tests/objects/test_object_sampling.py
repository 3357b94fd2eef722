# SPDX-License-Identifier: Apache-2.0
"""Surface samples are uniform by area, and deformations keep what they must keep."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from train.objects.deform import DeformSettings, free_form, lean, vary
from train.objects.mesh import Mesh, MeshError, stand
from train.objects.parametric import generate
from train.objects.primitives import box, join, superellipsoid, torus
from train.objects.sampling import bounds, sample_surface


def test_faces_get_points_in_proportion_to_their_area() -> None:
    """Six sides of a box of 1 x 2 x 4 m: chi-square against the areas from the formula."""
    vertices, faces = join([box((0, 0, 0), (1, 2, 4))])
    points = sample_surface(vertices, faces, 20_000, np.random.default_rng(1))
    half = np.array([0.5, 1.0, 2.0])
    counts = [np.count_nonzero(np.abs(points[:, k] - s * half[k]) < 1e-6) for k in range(3) for s in (-1, 1)]
    assert sum(counts) == len(points)
    areas = np.repeat([2 * 4, 1 * 4, 1 * 2], 2) / (2 * (8 + 4 + 2))
    expected = areas * len(points)
    statistic = float((((np.array(counts) - expected) ** 2) / expected).sum())
    assert chi2.ppf(0.001, 5) < statistic < chi2.ppf(0.999, 5)


def test_points_are_uniform_inside_a_triangle() -> None:
    """In the unit right triangle the distance from the right angle's opposite side has a known distribution."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    points = sample_surface(vertices, np.array([[0, 1, 2]], np.int32), 5000, np.random.default_rng(2))
    # P(x + y <= s) = s^2
    assert kstest((points[:, 0] + points[:, 1]) ** 2, "uniform").pvalue > 1e-3
    # P(x <= t) = 1 - (1 - t)^2
    assert kstest(1 - (1 - points[:, 0]) ** 2, "uniform").pvalue > 1e-3


def test_any_prefix_is_uniform_too() -> None:
    vertices, faces = join([box((0, 0, 0), (1, 1, 1))])
    first = sample_surface(vertices, faces, 16_384, np.random.default_rng(3))[:3000]
    assert np.abs(first.mean(axis=0)).max() < 4 * 0.42 / np.sqrt(3000)


def test_a_torus_has_the_area_of_pappus() -> None:
    """Share of points on the outer half of a torus: (pi R + 2 r) / (2 pi R)."""
    big, small = 0.3, 0.1
    vertices, faces = join([torus((0, 0, 0), big, small, 96, 48)])
    points = sample_surface(vertices, faces, 20_000, np.random.default_rng(4))
    outer = np.mean(np.hypot(points[:, 0], points[:, 2]) > big)
    expected = (np.pi * big + 2 * small) / (2 * np.pi * big)
    assert outer == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / len(points)) + 2e-3)


def test_a_mesh_without_area_is_refused() -> None:
    with pytest.raises(ValueError, match="no area"):
        sample_surface(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32), 10, np.random.default_rng(0))


@pytest.mark.parametrize("faces", [np.empty((0, 3), np.int32), np.array([[0, 1, 3]], np.int32)])
def test_faces_that_do_not_fit_are_refused(faces: np.ndarray) -> None:
    with pytest.raises(MeshError, match="do not fit"):
        Mesh(np.zeros((3, 3), np.float32), faces, 0, "car/broken")


def test_a_vertex_that_is_not_finite_is_refused() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, np.nan], [0, 1, 0]], np.float32)
    with pytest.raises(MeshError, match="not finite"):
        Mesh(vertices, np.array([[0, 1, 2]], np.int32), 0, "car/broken")


def test_standing_puts_the_ground_at_zero_and_centres() -> None:
    points = np.random.default_rng(5).normal(3, 1, (100, 3)).astype(np.float32)
    low, high = bounds(stand(points))
    assert low[2] == 0
    np.testing.assert_allclose(low[:2], -high[:2], atol=1e-5)


def test_free_form_deformation_is_symmetric() -> None:
    """A shape that is its own mirror image stays so."""
    vertices, _ = join([superellipsoid((0, 0, 0.7), (2.2, 0.9, 0.7), steps=(24, 13))])
    mirror = vertices * np.array([1, -1, 1], np.float32)
    there = free_form(vertices, (0.05, 0.02, 0.035), np.random.default_rng(6))
    back = free_form(mirror, (0.05, 0.02, 0.035), np.random.default_rng(6))
    np.testing.assert_allclose(back, there * np.array([1, -1, 1]), atol=1e-5)
    assert np.abs(there - vertices).max() > 0.01


def test_no_deformation_when_sigma_is_zero() -> None:
    vertices, _ = join([box((0, 0, 1), (4, 2, 1.5))])
    np.testing.assert_allclose(free_form(vertices, (0, 0, 0), np.random.default_rng(0)), vertices, atol=1e-6)


def test_lean_turns_about_the_track() -> None:
    """A point 1 m above the ground goes sin(12 deg) to the right and sinks to cos(12 deg)."""
    leaned = lean(np.array([[0.5, 0, 1]], np.float32), np.radians(12))
    np.testing.assert_allclose(leaned, [[0.5, -np.sin(np.radians(12)), np.cos(np.radians(12))]], atol=1e-6)


@pytest.mark.parametrize("name", ["car", "bicycle", "motorcycle", "pedestrian"])
def test_varied_objects_stand_on_the_ground_and_keep_their_size(name: str) -> None:
    rng = np.random.default_rng(7)
    mesh = generate(name, 3)  # type: ignore[arg-type]
    for _ in range(5):
        varied = vary(mesh, DeformSettings(), rng)
        assert varied.vertices[:, 2].min() == pytest.approx(0, abs=1e-6)
        ratio = varied.size_m / mesh.size_m
        assert np.all(ratio[[0, 2]] > 0.7)
        assert np.all(ratio[[0, 2]] < 1.4)
        assert varied.object_id == mesh.object_id
