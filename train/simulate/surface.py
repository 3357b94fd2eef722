# SPDX-License-Identifier: Apache-2.0
"""An object as its radar sees it: curved patches, edges, diffuse and persistent points, drawn once from a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from edge.config import require
from edge.frames import Float32, Float64
from train.objects.mesh import Mesh
from train.objects.sampling import Int32, bounds, face_areas
from train.simulate import kernels_surface as kernels
from train.simulate.materials import Material
from train.simulate.points import Parts, Patches, Points, board_factors, draw_points
from train.simulate.surface_settings import SurfaceSettings as SurfaceSettings

WELD_M = 1e-4
LEAST_FACE_M2 = 1e-9
VISIBILITY_SIDE_M = 0.5
"""Longest side of the triangles that hide others: those that reach behind the camera are left out as a whole."""


@dataclass(frozen=True, slots=True)
class Surface:
    """One object, drawn once, so that every frame sees the same scatterers; all in the Mesh frame.

    Args:
        label: index into CLASSES.
        patches, points: what reflects.
        vertices, faces: float32 [n, 3], int32 [m, 3], what hides.
        low_m, high_m: float64 [3], bounding box.
        wavelength_m: for which it was made.
    """

    label: int
    patches: Patches
    points: Points
    vertices: Float32
    faces: Int32
    low_m: Float64
    high_m: Float64
    wavelength_m: float


@dataclass(frozen=True, slots=True)
class Placed:
    """A surface in the world.

    Args:
        surface: the object.
        position_m: float64 [3] of the Mesh frame's origin at t = 0; z of the ground is 0.
        yaw_rad: of the object's x axis off the world's.
        velocity_m_s: float64 [3], world, constant.
    """

    surface: Surface
    position_m: Float64
    yaw_rad: float = 0.0
    velocity_m_s: Float64 = field(default_factory=lambda: np.zeros(3))

    def at(self, t_s: float) -> Placed:
        """The object ``t_s`` later."""
        return replace(self, position_m=np.asarray(self.position_m) + t_s * np.asarray(self.velocity_m_s))

    @property
    def rotation(self) -> Float64:
        """Mesh frame to world, float64 [3, 3]."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def make_surface(
    mesh: Mesh, settings: SurfaceSettings, nearest_m: float, wavelength_m: float, rng: np.random.Generator
) -> Surface:
    """Prepare a mesh for the radar.

    Args:
        mesh: two-sided triangle soup.
        settings: how; the mesh's class decides its material.
        nearest_m: least distance from which it will be seen; decides the size of the patches.
        wavelength_m: of the radar at the middle of the chirp.
        rng: of everything random; the same generator state gives the same surface.
    Raises:
        ConfigError: a distance or wavelength that cannot be.
    """
    require(nearest_m > 0, "surface nearest_m", nearest_m, "> 0 m")
    require(1e-4 < wavelength_m < 1.0, "surface wavelength_m", wavelength_m, "0.0001..1 m")
    material = settings.material(mesh.label)
    vertices, faces = clean(mesh.vertices, mesh.faces)
    normals, areas = np.empty((len(faces), 3)), np.empty(len(faces))
    kernels.face_normals(vertices, faces, normals, areas)
    number = np.empty(len(faces), np.int32)
    count = kernels.components(faces, len(vertices), number)
    parts = _draw_parts(material, settings, np.bincount(number, areas, count).astype(np.float64), wavelength_m, rng)
    patches, part = _patches(vertices, faces, (normals, areas, number), parts, settings, nearest_m, wavelength_m)
    points = draw_points(vertices, faces, number, patches, part, parts, material, settings, rng, mesh.label)
    shade_bary, shade_owner = _subdivided(vertices, faces, VISIBILITY_SIDE_M, settings.max_patches)
    shade = np.einsum("pij,pjk->pik", shade_bary, vertices[faces[shade_owner]]).reshape(-1, 3)
    shade_faces = np.arange(len(shade), dtype=np.int32).reshape(-1, 3)
    low_m, high_m = (bound.astype(np.float64) for bound in bounds(vertices))
    return Surface(mesh.label, patches, points, np.ascontiguousarray(shade), shade_faces, low_m, high_m, wavelength_m)


def clean(vertices: Float32, faces: Int32) -> tuple[Float32, Int32]:
    """Vertices of equal place (0.1 mm) made one; faces without area and doubled faces left out.

    Returns:
        float32 [n, 3], int32 [m, 3].
    Raises:
        ConfigError: no face is left.
    """
    grid = np.rint(vertices.astype(np.float64) / WELD_M).astype(np.int64)
    grid -= grid.min(axis=0)
    key = (grid[:, 0] << 42) | (grid[:, 1] << 21) | grid[:, 2]
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    welded = np.asarray(inverse, dtype=np.int32)[faces]
    a, b, c = welded.T
    welded = welded[(a != b) & (b != c) & (a != c)]
    a, b, c = np.sort(welded, axis=1).astype(np.int64).T
    _, kept = np.unique((a << 42) | (b << 21) | c, return_index=True)
    welded, vertices = welded[np.sort(kept)], np.ascontiguousarray(vertices[first])
    areas = np.empty(len(welded))
    face_areas(vertices, welded, areas)
    welded = np.ascontiguousarray(welded[areas > LEAST_FACE_M2])
    require(len(welded) > 0, "mesh faces", 0, "at least one triangle larger than 0.1 mm")
    return vertices, welded


def _draw_parts(
    material: Material, settings: SurfaceSettings, area_m2: Float64, wavelength_m: float, rng: np.random.Generator
) -> Parts:
    """What every component of the mesh is made of."""
    count = len(area_m2)
    reflection = rng.uniform(*material.reflection, count)
    reflection[np.argmax(area_m2)] = rng.uniform(*material.largest_reflection)
    reflection = np.minimum(reflection * 10 ** (settings.reflection_db / 20), 1.0)
    height_m = _log_uniform(material.roughness_m, count, rng)
    roughness = 0.5 * np.square(4 * np.pi * height_m / wavelength_m)
    diffuse = _log_uniform(material.diffuse, count, rng) * 10 ** (settings.diffuse_db / 10)
    # What roughness takes from the coherent part is scattered diffusely.
    diffuse = np.minimum(diffuse + np.square(reflection) * -np.expm1(-2 * roughness), 1.0)
    imbalance_db = rng.normal(0.0, material.imbalance_db * settings.imbalance_scale, count)
    edge = rng.uniform(*material.edge, count) * np.exp(2j * np.pi * rng.random(count))
    return Parts(reflection, roughness, diffuse, imbalance_db, edge)


def _log_uniform(limits: tuple[float, float], count: int, rng: np.random.Generator) -> Float64:
    return np.asarray(np.exp(rng.uniform(math.log(limits[0]), math.log(limits[1]), count)))


def _subdivided(vertices: Float32, faces: Int32, side_m: float, most: int) -> tuple[Float32, Int32]:
    """Barycentric sub-triangles [p, 3, 3] and their faces [p]; a longer side is taken when there are too many."""
    room = 4096
    while True:
        barycentric, owner = np.empty((room, 3, 3), np.float32), np.empty(room, np.int32)
        count = kernels.subdivide(vertices, faces, side_m, barycentric, owner)
        if count <= room:
            return barycentric[:count], owner[:count]
        if count > most and count > len(faces):
            side_m *= max(1.02, math.sqrt(count / most))
        room = min(count, max(most, len(faces)))


def _patches(
    vertices: Float32,
    faces: Int32,
    of_faces: tuple[Float64, Float64, Int32],
    parts: Parts,
    settings: SurfaceSettings,
    nearest_m: float,
    wavelength_m: float,
) -> tuple[Patches, Int32]:
    """Curved patches of all faces, and the component of each."""
    normals, areas, number = of_faces
    corner = np.empty((len(faces), 3, 3), np.float32)
    crease_cosine = math.cos(math.radians(settings.crease_deg))
    kernels.corner_normals(faces, len(vertices), normals, areas, crease_cosine, corner)
    side_m = math.sqrt(2.0) * max(settings.patch_share * math.sqrt(wavelength_m * nearest_m), settings.patch_least_m)
    barycentric, owner = _subdivided(vertices, faces, side_m, settings.max_patches)
    shape, flat = np.empty((len(owner), 4, 3), np.float32), np.empty((len(owner), 3), np.float32)
    area, spread = np.empty(len(owner), np.float32), np.empty(len(owner), np.float32)
    kernels.patches(vertices, faces, corner, settings.phong, barycentric, owner, shape, flat, area, spread)
    part = number[owner]
    reflection, roughness = parts.reflection.astype(np.float32)[part], parts.roughness.astype(np.float32)[part]
    board = board_factors(parts.imbalance_db)[part]
    return Patches(shape, flat, area, spread, reflection, roughness, board), part
