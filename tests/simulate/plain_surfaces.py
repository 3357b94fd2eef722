# SPDX-License-Identifier: Apache-2.0
"""Surfaces whose reflection is known in closed form, and scenes that hold nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.config import AntennaSettings
from edge.frames import Float64
from train.objects.mesh import Mesh
from train.simulate.ground import GroundSettings
from train.simulate.materials import Material
from train.simulate.optics_settings import OpticsSettings
from train.simulate.points import ISOTROPIC, Patches, Points
from train.simulate.surface import Surface, SurfaceSettings, make_surface

WAVELENGTH_M = 0.0038
PURE = Material((1, 1), (1, 1), (1e-7, 1e-7), (1e-7, 1e-7), (0, 0), (-40, -40), (0, 0), 0.0)
"""Perfect conductor: nothing but physical optics."""
KEEP_ALL = OpticsSettings(keep_db=120.0, floor_db=-200.0, max_scatterers=1_000_000)
EVERYTHING = replace(KEEP_ALL, lobe_end=1e6, lobe_most_deg=90.0)
"""Not even far sidelobes are left out."""
OPEN = AntennaSettings(along_loss_db=0.0, across_loss_db=0.0)
NO_GROUND = GroundSettings(enabled=False)


def settings(**changes: float) -> SurfaceSettings:
    """Pure physical optics of a perfect conductor."""
    fine: dict[str, float] = {"patch_least_m": 5e-4, "max_patches": 5_000_000}
    return SurfaceSettings(car=PURE, diffuse_points=0, edge_points=0, **{**fine, **changes})  # type: ignore[arg-type]


def plate(side_m: float) -> Mesh:
    """Square plate in the plane x = 0 about the origin."""
    h = side_m / 2
    vertices = np.array([[0, -h, -h], [0, h, -h], [0, h, h], [0, -h, h]], np.float32)
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), 0, "test/plate")


def hemisphere(radius_m: float, rings: int) -> Mesh:
    """Half of a sphere about the origin, its pole on +x."""
    theta = np.linspace(0, np.pi / 2, rings + 1)
    phi = np.linspace(0, 2 * np.pi, 4 * rings, endpoint=False)
    x = np.cos(theta)[:, None] * np.ones_like(phi)
    y, z = np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi)
    i, j = np.meshgrid(np.arange(rings), np.arange(len(phi)), indexing="ij")
    k = (j + 1) % len(phi)
    a, b, c, d = (i * len(phi) + j, (i + 1) * len(phi) + j, (i + 1) * len(phi) + k, i * len(phi) + k)
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    vertices = radius_m * np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), 0, "test/hemisphere")


def pure(mesh: Mesh, nearest_m: float, **changes: float) -> Surface:
    """Surface of a perfect conductor."""
    return make_surface(mesh, settings(**changes), nearest_m, WAVELENGTH_M, np.random.default_rng(0))


def point_surface(place_m: tuple[float, float, float], sigma_m2: float) -> Surface:
    """One isotropic point; the patch that a surface needs reflects nothing."""
    place = np.array([place_m], np.float32)
    corner = place - np.float32(0.001)
    shape = np.zeros((1, 4, 3), np.float32)
    shape[0, 1] = (0, 0, 1)
    one = np.ones(1, np.float32)
    patches = Patches(shape, corner, 1e-6 * one, 0 * one, 1e-9 * one, 0 * one, np.ones((1, 2), np.float32))
    kind, amplitude = np.full(1, ISOTROPIC, np.int8), np.full(1, np.sqrt(sigma_m2), np.complex64)
    points = Points(place, np.zeros((1, 3), np.float32), kind, amplitude, 0 * one, np.ones((1, 2), np.float32))
    vertices = np.concatenate([corner, corner + np.float32(1e-3), corner + np.array([[1e-3, 0, 0]], np.float32)])
    low, high = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
    return Surface(0, patches, points, vertices, np.array([[0, 1, 2]], np.int32), low, high, WAVELENGTH_M)


def eye(distance_m: float, tilt_deg: float = 0.0) -> Float64:
    """A place at a distance from the origin, off +x by a tilt towards +y."""
    tilt = np.radians(tilt_deg)
    return distance_m * np.array([np.cos(tilt), np.sin(tilt), 0.0])
