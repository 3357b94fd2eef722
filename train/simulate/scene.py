# SPDX-License-Identifier: Apache-2.0
"""Objects beside the track: the target, its neighbours, a wall and someone who moves, placed from a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from edge.frames import Float64
from train.objects.mesh import CLASSES, ClassName, Mesh
from train.objects.reference import ObjectRef
from train.simulate.materials import WALL
from train.simulate.settings import SceneSettings
from train.simulate.surface import Placed, Surface, make_surface
from train.simulate.surface_settings import SurfaceSettings

POOL = 2
"""Neighbours of a class to choose from; their surfaces are made once in a process."""
POOL_NEAREST_M = 3.0
"""Distance for which their patches are fine enough."""
WALL_SIZE_M = (14.0, 2.5)
"""Length and height; it has no thickness."""
MOVERS: tuple[ClassName, ...] = ("pedestrian", "bicycle")
IN_FRONT_SHARE = 0.3
"""Of the movers that pass between radar and target."""
NEAREST_M = 1.0
"""Nothing comes nearer to the track."""
Side = Literal["before", "after", "behind"]
SIDES: tuple[Side, ...] = ("before", "after", "behind")


@dataclass(frozen=True, slots=True)
class Box:
    """Bounding box of a placed object on the ground, world x and y."""

    low_m: Float64
    high_m: Float64

    @property
    def middle_m(self) -> Float64:
        """Its middle, float64 [2]."""
        return 0.5 * (self.low_m + self.high_m)


def footprint(mesh: Mesh, position_m: Float64, yaw_rad: float) -> Box:
    """Bounding box on the ground of a mesh that stands at ``position_m`` turned by ``yaw_rad``."""
    turned = mesh.vertices[:, :2].astype(np.float64) @ _turn(yaw_rad).T + position_m[:2]
    return Box(turned.min(axis=0), turned.max(axis=0))


def make_scene(
    mesh: Mesh,
    scene: SceneSettings,
    surface: SurfaceSettings,
    travel_m: float,
    duration_s: float,
    wavelength_m: float,
    seed: int,
) -> list[Placed]:
    """The target first, then neighbours, wall and mover.

    Args:
        mesh: of the target.
        scene, surface: settings; the surface's are those of the target, all else keeps the defaults.
        travel_m: length of the track, which begins at x = 0 and runs along +x.
        duration_s: of the drive.
        wavelength_m: of the radar.
        seed: of everything random.
    Returns:
        Placed objects; static ones but for the mover, whose place is that at t = 0.
    """
    rng = np.random.default_rng((seed, 3))
    made = make_surface(mesh, surface, scene.side_m, wavelength_m, rng)
    yaw_rad = math.radians(scene.yaw_deg)
    at_origin = footprint(mesh, np.zeros(3), yaw_rad)
    where_m = np.array([0.5 * travel_m + scene.along_m, scene.side_m, 0.0])
    where_m[:2] -= (at_origin.middle_m[0], at_origin.low_m[1])
    placed, boxes = [_static(made, where_m, yaw_rad)], [footprint(mesh, where_m, yaw_rad)]
    for side in rng.permutation(np.arange(scene.neighbours) % len(SIDES)):
        placed.append(_neighbour(SIDES[side], boxes, scene, wavelength_m, rng))
    if scene.wall_m > 0:
        behind_m = max(one.high_m[1] for one in boxes) + scene.wall_m
        placed.append(_static(_wall(wavelength_m), np.array([0.5 * travel_m, behind_m, 0.0]), 0.0))
    if scene.mover_speed_m_s != 0:
        placed.append(_mover(boxes[0], scene, duration_s, wavelength_m, rng))
    return placed


def _neighbour(
    side: Side, boxes: list[Box], scene: SceneSettings, wavelength_m: float, rng: np.random.Generator
) -> Placed:
    """An object of the pool on one side of all that stand already; its box is added."""
    mesh, surface = _pool(CLASSES[rng.integers(len(CLASSES))], int(rng.integers(POOL)), wavelength_m)
    yaw_rad, gap_m = rng.uniform(0.0, 2.0 * math.pi), scene.gap_m + rng.exponential(0.5)
    own = footprint(mesh, np.zeros(3), yaw_rad)
    x_m = boxes[0].middle_m[0] - own.middle_m[0] + rng.uniform(-1.0, 1.0)
    y_m = max(boxes[0].low_m[1] + rng.uniform(-0.5, 1.5), NEAREST_M) - own.low_m[1]
    if side == "before":
        x_m = min(one.low_m[0] for one in boxes) - gap_m - own.high_m[0]
    elif side == "after":
        x_m = max(one.high_m[0] for one in boxes) + gap_m - own.low_m[0]
    else:
        y_m = max(one.high_m[1] for one in boxes) + gap_m - own.low_m[1]
    where_m = np.array([x_m, y_m, 0.0])
    boxes.append(footprint(mesh, where_m, yaw_rad))
    return _static(surface, where_m, yaw_rad)


def _mover(
    target: Box, scene: SceneSettings, duration_s: float, wavelength_m: float, rng: np.random.Generator
) -> Placed:
    """Someone who passes along the track, mostly behind the target, at its level in the middle of the drive."""
    name = MOVERS[rng.integers(len(MOVERS))]
    mesh, surface = _pool(name, int(rng.integers(POOL)), wavelength_m)
    forward = rng.random() < 0.5
    yaw_rad = 0.0 if forward else math.pi
    half_m = 0.5 * float(mesh.size_m[1])
    y_m = target.high_m[1] + scene.gap_m + half_m
    if rng.random() < IN_FRONT_SHARE:
        y_m = max(0.5 * target.low_m[1], NEAREST_M + half_m)
    velocity_m_s = scene.mover_speed_m_s * np.array([1.0 if forward else -1.0, 0.0, 0.0])
    where_m = np.array([target.middle_m[0] + rng.uniform(-1.0, 1.0), y_m, 0.0]) - 0.5 * duration_s * velocity_m_s
    return Placed(surface, where_m, yaw_rad, velocity_m_s)


def _static(surface: Surface, position_m: Float64, yaw_rad: float) -> Placed:
    return Placed(surface, position_m, yaw_rad, np.zeros(3))


@lru_cache(maxsize=POOL * len(CLASSES))
def _pool(name: ClassName, number: int, wavelength_m: float) -> tuple[Mesh, Surface]:
    """Neighbour ``number`` of a class, always the same one."""
    mesh = ObjectRef(name, f"parametric_{number:05d}").mesh()
    return mesh, make_surface(mesh, SurfaceSettings(), POOL_NEAREST_M, wavelength_m, np.random.default_rng(number))


@lru_cache(maxsize=2)
def _wall(wavelength_m: float) -> Surface:
    x_m, z_m = 0.5 * WALL_SIZE_M[0], WALL_SIZE_M[1]
    vertices = np.array([[-x_m, 0, 0], [x_m, 0, 0], [x_m, 0, z_m], [-x_m, 0, z_m]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    settings = SurfaceSettings(car=WALL)
    return make_surface(Mesh(vertices, faces, 0, "scene/wall"), settings, 6.0, wavelength_m, np.random.default_rng(0))


def _turn(yaw_rad: float) -> Float64:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])
