# SPDX-License-Identifier: Apache-2.0
"""Random variation of a mesh: free-form deformation, scale, mirror image and lean."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from edge.frames import Float32, Float64
from train.objects.mesh import CLASSES, Mesh
from train.objects.sampling import bounds

LATTICE = (4, 3, 3)
"""Control points along x, y and z (Sederberg and Parry, Free-form deformation of solid geometric models, 1986)."""


@dataclass(frozen=True, slots=True)
class DeformSettings:
    """How much a training object is varied; shares of the object's own extent unless a unit is given.

    Args:
        lattice_sigma: standard deviation of the control points of a car along x, y, z.
        car_scale_sigma: standard deviation of the scale of a car along x, y, z.
        other_scale_sigma: standard deviation of the one scale of every other object.
        mirror: swap left and right in half of the samples.
        max_lean_deg: a two-wheeler leans by a uniform angle up to this, to either side.
    """

    lattice_sigma: tuple[float, float, float] = (0.05, 0.02, 0.035)
    car_scale_sigma: tuple[float, float, float] = (0.06, 0.04, 0.05)
    other_scale_sigma: float = 0.04
    mirror: bool = True
    max_lean_deg: float = 12.0


@njit(nogil=True, cache=True, error_model="numpy")
def _apply_lattice(vertices: Float32, low: Float64, size: Float64, offset: Float64) -> Float32:  # pragma: no cover
    """Trivariate Bernstein sum of the control points' offsets [4, 3, 3, 3] in metres, added to every vertex."""
    out = np.empty_like(vertices)
    bx, by, bz = np.empty(4), np.empty(3), np.empty(3)
    for i in range(len(vertices)):
        s = (vertices[i, 0] - low[0]) / size[0]
        t = (vertices[i, 1] - low[1]) / size[1]
        u = (vertices[i, 2] - low[2]) / size[2]
        r = 1.0 - s
        bx[0], bx[1], bx[2], bx[3] = r * r * r, 3 * s * r * r, 3 * s * s * r, s * s * s
        by[0], by[1], by[2] = (1 - t) * (1 - t), 2 * t * (1 - t), t * t
        bz[0], bz[1], bz[2] = (1 - u) * (1 - u), 2 * u * (1 - u), u * u
        for k in range(3):
            out[i, k] = vertices[i, k]
        for a in range(4):
            for b in range(3):
                ab = bx[a] * by[b]
                for c in range(3):
                    w = ab * bz[c]
                    for k in range(3):
                        out[i, k] += w * offset[a, b, c, k]
    return out


def free_form(vertices: Float32, sigma: tuple[float, float, float], rng: np.random.Generator) -> Float32:
    """Deform with a random lattice that is symmetric about the plane between left and right.

    Args:
        vertices: float32 [n, 3].
        sigma: standard deviation of the control points, as a share of the extent along x, y, z.
    Returns:
        float32 [n, 3].
    """
    low, high = bounds(vertices)
    size = np.maximum(high - low, 1e-6).astype(np.float64)
    offset = rng.normal(size=(*LATTICE, 3)) * np.asarray(sigma) * size
    mirrored = offset[:, ::-1] * np.array([1.0, -1.0, 1.0])
    return _apply_lattice(vertices, low.astype(np.float64), size, (offset + mirrored) / math.sqrt(2))


def lean(vertices: Float32, angle_rad: float) -> Float32:
    """Rotate about the forward axis on the ground; positive leans to the right. float32 [n, 3]."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    rotation = np.array([[1, 0, 0], [0, c, -s], [0, s, c]], np.float32)
    return np.ascontiguousarray(vertices @ rotation.T)


def vary(mesh: Mesh, settings: DeformSettings, rng: np.random.Generator) -> Mesh:
    """A new object near the given one, on the ground and centred again."""
    vertices = mesh.vertices
    if CLASSES[mesh.label] == "car":
        vertices = free_form(vertices, settings.lattice_sigma, rng)
        scale = np.exp(rng.normal(size=3) * np.asarray(settings.car_scale_sigma))
    else:
        scale = np.exp(rng.normal() * settings.other_scale_sigma) * np.ones(3)
    if settings.mirror and rng.random() < 0.5:
        scale[1] = -scale[1]
    vertices = vertices * scale.astype(np.float32)
    if CLASSES[mesh.label] in ("bicycle", "motorcycle"):
        vertices = lean(vertices, math.radians(rng.uniform(-settings.max_lean_deg, settings.max_lean_deg)))
    return mesh.moved(vertices)
