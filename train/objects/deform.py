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

BELT_SHARE = 0.62
"""Height of a car's belt line as a share of its own."""


@dataclass(frozen=True, slots=True)
class DeformSettings:
    """How much a training object is varied; shares of the object's own extent unless a unit is given.

    Args:
        overhang_share, wheelbase_share: front overhang, wheelbase and rear overhang of a car are each stretched by a
            uniform share up to this, wheels excepted.
        greenhouse_share: so is the height above the belt line. width_share: so is the width.
        round_wheels: wheels of a car keep their shape and stay on the ground whatever the body does.
        lattice_sigma: standard deviation of the control points of a car along x, y, z.
        car_scale_sigma: standard deviation of the scale of a car along x, y, z.
        other_scale_sigma: standard deviation of the one scale of every other object.
        mirror: swap left and right in half of the samples.
        max_lean_deg: a two-wheeler leans by a uniform angle up to this, to either side.
    """

    overhang_share: float = 0.08
    wheelbase_share: float = 0.08
    greenhouse_share: float = 0.10
    width_share: float = 0.05
    round_wheels: bool = True
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


@dataclass(frozen=True, slots=True)
class Wheels:
    """Of a car standing on the ground, metres: distance of both axles along x, radius."""

    front: float
    rear: float
    radius: float


def find_wheels(vertices: Float32) -> Wheels:
    """Axles above where a car touches the ground; typical shares of the length where it does so nowhere clearly."""
    low, high = bounds(vertices)
    length, half = float(high[0] - low[0]), float(high[1] - low[1]) / 2
    near = vertices[(vertices[:, 2] < 0.08) & (np.abs(vertices[:, 1]) > 0.5 * half)]
    axles, radii = [], [0.075 * length]
    for sign, typical in ((1.0, 0.29), (-1.0, -0.30)):
        wheel = near[sign * near[:, 0] > 0.1 * length]
        touching = wheel[wheel[:, 2] < 0.04, 0]
        axles.append(float(np.median(touching)) if len(touching) else typical * length)
        above = wheel[(wheel[:, 2] > 0.02) & (np.abs(wheel[:, 0] - axles[-1]) < 0.25)]
        if len(above) > 8:  # a circle of radius r that touches the ground: dx^2 + z^2 = 2 r z, inside it less
            square = (above[:, 0] - axles[-1]) ** 2 + above[:, 2] ** 2
            radii.append(float(np.quantile(square / (2 * above[:, 2]), 0.9)))
    return Wheels(axles[0], axles[1], float(np.clip(max(radii[1:], default=radii[0]), 0.26, 0.42)))


def stretch(
    vertices: Float32, wheels: Wheels, front: float, wheelbase: float, rear: float, greenhouse: float, width: float
) -> Float32:
    """Stretch the parts of a car by shares: overhangs and wheelbase along x, what is above the belt line, the width.

    Args:
        vertices: float32 [n, 3], on the ground, centred.
        front, wheelbase, rear, greenhouse, width: 0.05 is 5 % more. The wheels keep their length.
    """
    low, high = bounds(vertices)
    r = wheels.radius
    lengths = np.array([
        (wheels.rear - low[0]) * (1 + rear) - r, 2 * r, (wheels.front - wheels.rear) * (1 + wheelbase) - 2 * r,
        2 * r, (high[0] - wheels.front) * (1 + front) - r,
    ])  # fmt: skip
    knots = np.array([low[0], wheels.rear - r, wheels.rear + r, wheels.front - r, wheels.front + r, high[0]])
    if np.any(np.diff(knots) <= 0) or np.any(lengths <= 0):  # no car: wheels at its very ends
        return vertices
    x = np.interp(vertices[:, 0], knots, low[0] + np.concatenate([[0.0], np.cumsum(lengths)]))
    belt = BELT_SHARE * float(high[2])
    z = vertices[:, 2] + np.maximum(vertices[:, 2] - belt, 0) * greenhouse
    return np.stack([x, vertices[:, 1] * (1 + width), z], axis=1).astype(np.float32)


def _keep_wheels(before: Float32, after: Float32, axles: Float32, wheels: Wheels, scale: float) -> Float32:
    """Put undistorted wheels, grown by ``scale``, at their places in a deformed car and fade into the body around.

    Args:
        before, after: float32 [n, 3]. axles: float32 [2, 3], front and rear axle in ``after``.
    """
    half = float(np.abs(before[:, 1]).max())
    for x, axle in ((wheels.front, axles[0]), (wheels.rear, axles[1])):
        away = np.hypot(before[:, 0] - x, before[:, 2] - wheels.radius) / wheels.radius
        weight = np.clip((1.4 - away) / 0.35, 0, 1) * (np.abs(before[:, 1]) > 0.4 * half)
        round_x, round_z = axle[0] + scale * (before[:, 0] - x), scale * before[:, 2]
        after[:, 0] += weight * (round_x - after[:, 0])
        after[:, 2] += weight * (round_z - after[:, 2])
    return after


def _vary_car(vertices: Float32, settings: DeformSettings, rng: np.random.Generator) -> Float32:
    wheels = find_wheels(vertices)
    shares = (settings.overhang_share, settings.wheelbase_share, settings.overhang_share, settings.greenhouse_share)
    drawn = rng.uniform(-1, 1, 5) * np.array([*shares, settings.width_share])
    axles = np.array([[wheels.front, 0, wheels.radius], [wheels.rear, 0, wheels.radius]], np.float32)
    varied = stretch(np.vstack([vertices, axles]), wheels, *drawn.tolist())
    varied = free_form(varied, settings.lattice_sigma, rng)
    scale = np.exp(rng.normal(size=3) * np.asarray(settings.car_scale_sigma))
    varied = np.ascontiguousarray(varied * scale.astype(np.float32))
    varied, axles = varied[:-2], varied[-2:]
    if not settings.round_wheels:
        return varied
    # The body keeps its height above the axles, and no lip of it digs into the ground.
    varied[:, 2] += float(wheels.radius * scale[2]) - float(axles[:, 2].mean())
    np.maximum(varied[:, 2], 0, out=varied[:, 2])
    return _keep_wheels(vertices, varied, axles, wheels, float(np.sqrt(scale[0] * scale[2])))


def lean(vertices: Float32, angle_rad: float) -> Float32:
    """Rotate about the forward axis on the ground; positive leans to the right. float32 [n, 3]."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    rotation = np.array([[1, 0, 0], [0, c, -s], [0, s, c]], np.float32)
    return np.ascontiguousarray(vertices @ rotation.T)


def vary(mesh: Mesh, settings: DeformSettings, rng: np.random.Generator) -> Mesh:
    """A new object near the given one, on the ground and centred again."""
    vertices = mesh.vertices
    if CLASSES[mesh.label] == "car":
        vertices = _vary_car(vertices, settings, rng)
    else:
        vertices = vertices * np.float32(math.exp(rng.normal() * settings.other_scale_sigma))
    if settings.mirror and rng.random() < 0.5:
        vertices = vertices * np.array([1, -1, 1], np.float32)
    if CLASSES[mesh.label] in ("bicycle", "motorcycle"):
        vertices = lean(vertices, math.radians(rng.uniform(-settings.max_lean_deg, settings.max_lean_deg)))
    return mesh.moved(vertices)
