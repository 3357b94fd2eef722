# SPDX-License-Identifier: Apache-2.0
"""Surfaces: nothing lost in subdivision, curvature, creases, soups with false winding, points by their share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.errors import ConfigError
from tests.simulate.plain_surfaces import WAVELENGTH_M, hemisphere, plate, pure, settings
from train.objects.library import read_manifest
from train.objects.mesh import Mesh
from train.objects.primitives import box, join
from train.simulate.points import DIFFUSE, EDGE, ISOTROPIC, sharp_edges
from train.simulate.surface import SurfaceSettings, clean, make_surface


def cube(size_m: float = 1.0) -> Mesh:
    return Mesh(*join([box((0, 0, size_m / 2), (size_m, size_m, size_m))]), 0, "test/cube")


def test_patches_have_the_area_of_the_mesh_and_the_size_asked_for() -> None:
    surface = pure(cube(), 4.0)
    assert surface.patches.area.sum() == pytest.approx(6.0, rel=1e-5)
    side = np.linalg.norm(surface.patches.shape[:, 2:], axis=2)
    third = np.linalg.norm(surface.patches.shape[:, 2] - surface.patches.shape[:, 3], axis=1)
    longest = np.maximum(side.max(axis=1), third)
    assert longest.max() <= np.sqrt(2) * 0.3 * np.sqrt(WAVELENGTH_M * 4.0) * (1 + 1e-6)
    # Corner angles of a cube are no curvature: every patch is flat and keeps its face's normal.
    assert surface.patches.spread.max() < 1e-12
    assert np.abs(surface.patches.shape[:, 1]).max(axis=1).min() == pytest.approx(1.0, abs=1e-6)


def test_winding_doubled_faces_and_unwelded_corners_change_nothing() -> None:
    mesh = hemisphere(0.5, 10)
    rng = np.random.default_rng(0)
    soup = mesh.vertices[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(soup), dtype=np.int32).reshape(-1, 3)
    flipped = faces.copy()
    turned = rng.random(len(faces)) < 0.5
    flipped[turned] = flipped[turned][:, [0, 2, 1]]
    doubled = np.concatenate([flipped, faces[::7]]).astype(np.int32)
    kept, whole = pure(replace(mesh, vertices=soup, faces=doubled), 4.0), pure(mesh, 4.0)
    assert kept.patches.area.sum() == pytest.approx(float(whole.patches.area.sum()), rel=1e-5)
    radius = np.linalg.norm(kept.patches.shape[:, 0].astype(np.float64), axis=1)
    assert radius == pytest.approx(np.full(len(radius), 0.5), abs=2e-3)


def test_phong_tessellation_takes_facets_to_the_sphere() -> None:
    flat, curved = pure(hemisphere(0.5, 8), 4.0, phong=0.0), pure(hemisphere(0.5, 8), 4.0)
    inside = [s.patches.shape[:, 0, 0] > 0.1 for s in (flat, curved)]
    errors = [
        np.abs(np.linalg.norm(s.patches.shape[k, 0].astype(np.float64), axis=1) - 0.5).max()
        for s, k in zip((flat, curved), inside, strict=True)
    ]
    assert errors[1] < 0.25 * errors[0]
    outward = np.abs(np.einsum("pk,pk->p", curved.patches.shape[:, 1], curved.patches.shape[:, 0]))
    outward /= np.linalg.norm(curved.patches.shape[:, 0], axis=1)
    assert np.degrees(np.arccos(np.minimum(outward[inside[1]], 1.0))).max() < 4.5
    # A patch of side L on a sphere of radius a: the normal's variance per axis is of the order L^2 / 24 a^2.
    expected = curved.patches.area / 0.5**2 / 12
    assert np.median(curved.patches.spread[inside[1]] / expected[inside[1]]) == pytest.approx(1.35, abs=0.4)


def test_creases_of_a_cube() -> None:
    edges, inward, owner = sharp_edges(*clean(cube().vertices, cube().faces), 40.0)
    assert len(edges) == len(owner) == 12
    vertices, _ = clean(cube().vertices, cube().faces)
    middle = vertices[edges].mean(axis=1) - [0, 0, 0.5]
    assert (np.einsum("ek,ek->e", middle, inward) < -0.5).all()  # convex: both faces lead inwards
    assert len(sharp_edges(*clean(plate(1.0).vertices, plate(1.0).faces), 40.0)[0]) == 0


def test_points_of_each_kind() -> None:
    made = make_surface(cube(), SurfaceSettings(), 4.0, WAVELENGTH_M, np.random.default_rng(0))
    count = np.bincount(made.points.kind, minlength=3)
    least, most = SurfaceSettings().car.points
    assert least <= count[ISOTROPIC] <= most
    assert count[DIFFUSE] == SurfaceSettings().diffuse_points
    assert count[EDGE] == 12 * 20
    edge = made.points.kind == EDGE
    assert made.points.length[edge] == pytest.approx(np.full(240, 0.05), rel=1e-5)
    power_db = 10 * np.log10(np.sum(made.points.board[edge] ** 2, axis=0) / 240)
    assert abs(power_db).max() < 1.5  # imbalance of 2 dB has no preferred board


def test_diffuse_points_hold_the_power_of_the_area() -> None:
    """Sum of 4 rho A over a cube of one material, within the spread of exponential powers."""
    material = replace(settings().car, diffuse=(0.01, 0.01))
    made = make_surface(
        cube(2.0), replace(settings(), car=material, diffuse_points=4000), 8.0, WAVELENGTH_M, np.random.default_rng(0)
    )
    sigma = np.abs(made.points.amplitude.astype(np.complex128)) ** 2
    assert sigma.sum() == pytest.approx(4 * 0.01 * 24.0, rel=0.05)
    # Area-weighted: a sixth of the points on every side.
    side = np.abs(made.points.axis).argmax(axis=1)
    assert np.bincount(side, minlength=3) / 4000 == pytest.approx([1 / 3] * 3, abs=0.03)


def test_same_seed_same_surface_other_seed_another() -> None:
    a, b, c = (make_surface(cube(), SurfaceSettings(), 4.0, WAVELENGTH_M, np.random.default_rng(s)) for s in (1, 1, 2))
    assert a.points.amplitude.tobytes() == b.points.amplitude.tobytes()
    assert a.patches.reflection.tobytes() == b.patches.reflection.tobytes()
    assert a.patches.reflection[0] != c.patches.reflection[0]


def test_too_many_patches_become_coarser() -> None:
    made = pure(cube(3.0), 0.5, max_patches=20_000)
    assert 5_000 < len(made.patches) <= 20_000
    assert made.patches.area.sum() == pytest.approx(54.0, rel=1e-5)


def test_bad_input_is_refused() -> None:
    speck = Mesh(plate(1e-5).vertices, plate(1e-5).faces, 0, "test/speck")
    with pytest.raises(ConfigError, match="mesh faces"):
        pure(speck, 4.0)
    with pytest.raises(ConfigError, match="nearest_m"):
        pure(cube(), 0.0)
    with pytest.raises(ConfigError, match="phong"):
        SurfaceSettings(phong=1.5)
    with pytest.raises(ConfigError, match="reflection"):
        replace(settings().car, reflection=(0.9, 0.5))


def test_every_class_of_the_library(object_data: Path) -> None:
    entries = read_manifest(object_data)
    for label in range(4):
        mesh = next(entry for entry in entries if entry.label == label).load()
        made = make_surface(mesh, SurfaceSettings(), 5.0, WAVELENGTH_M, np.random.default_rng(0))
        assert np.isfinite(made.patches.shape).all()
        assert np.isfinite(made.points.position).all()
        assert (made.points.position[:, 2] > -0.1).all()
        assert len(made.patches) <= SurfaceSettings().max_patches
