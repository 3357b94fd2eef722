# SPDX-License-Identifier: Apache-2.0
"""Point scatterers of an object that flat patches do not give: diffuse subset, sharp edges, persistent places."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.frames import Complex64, Float32, Float64
from train.objects.mesh import CLASSES
from train.objects.sampling import Int32
from train.simulate import kernels_surface as kernels
from train.simulate.materials import Material
from train.simulate.surface_settings import SurfaceSettings

Int8 = NDArray[np.int8]
Complex128 = NDArray[np.complex128]

ISOTROPIC, DIFFUSE, EDGE = 0, 1, 2
LIFT_M = 0.01
"""Persistent points stand this far in front of their place, so that the surface around them does not hide them."""
WHEEL_SLICE_M = 0.06
"""What is lower than this above the ground belongs to a wheel or a foot."""
WHEEL_CENTER_M = {"car": 0.32, "bicycle": 0.33, "motorcycle": 0.3, "pedestrian": 0.1}
WHEEL_SHARE = 0.4
"""Of the persistent points that stand at wheels (feet)."""


@dataclass(frozen=True, slots=True)
class Parts:
    """What the connected components of a mesh are made of; columns of one length.

    Args:
        reflection: float64, |Gamma| at normal incidence.
        roughness: float64, (4 pi sigma_h / lambda)^2 / 2.
        diffuse: float64, share rho.
        imbalance_db: float64, power on the horizontal over that on the vertical board.
        edge: complex128, strength D of crease edges with their phase, which a component has in common so that the
            pieces of a straight edge add up.
    """

    reflection: Float64
    roughness: Float64
    diffuse: Float64
    imbalance_db: Float64
    edge: Complex128


@dataclass(frozen=True, slots=True)
class Patches:
    """Flat facets of a curved surface, two-sided; p of them, object frame.

    Args:
        shape: float32 [p, 4, 3], centre, unit normal, and the two sides from the first corner, metres.
        flat: float32 [p, 3], the centre on the mesh's own face, for visibility.
        area: float32 [p], m^2.
        spread: float32 [p], variance per axis of the true normal inside the patch, rad^2.
        reflection: float32 [p], |Gamma| of the component.
        roughness: float32 [p], (4 pi sigma_h / lambda)^2 / 2 of the component.
        board: float32 [p, 2], amplitude factor on the horizontal and the vertical board.
    """

    shape: Float32
    flat: Float32
    area: Float32
    spread: Float32
    reflection: Float32
    roughness: Float32
    board: Float32

    def __len__(self) -> int:
        return len(self.area)


@dataclass(frozen=True, slots=True)
class Points:
    """Point scatterers of one object, object frame; m of them.

    Args:
        position: float32 [m, 3], metres.
        axis: float32 [m, 3], unit: normal of a diffuse point, direction of an edge.
        kind: int8 [m], ISOTROPIC, DIFFUSE (power falls with cos^2) or EDGE (sinc of the angle to its direction).
        amplitude: complex64 [m], sqrt(sigma) exp(j phase) in m, at normal incidence.
        length: float32 [m], of an edge, metres.
        board: float32 [m, 2], amplitude factor on the horizontal and the vertical board.
    """

    position: Float32
    axis: Float32
    kind: Int8
    amplitude: Complex64
    length: Float32
    board: Float32

    def __len__(self) -> int:
        return len(self.kind)


def board_factors(imbalance_db: Float64) -> Float32:
    """Amplitude factors float32 [n, 2] of the two boards whose powers differ by ``imbalance_db`` [n]."""
    half = np.asarray(imbalance_db) / 40.0
    return np.stack([10.0**half, 10.0**-half], axis=1).astype(np.float32)


def draw_points(
    vertices: Float32,
    faces: Int32,
    number: Int32,
    patches: Patches,
    part: Int32,
    parts: Parts,
    material: Material,
    settings: SurfaceSettings,
    rng: np.random.Generator,
    label: int,
) -> Points:
    """All point scatterers of an object.

    Args:
        vertices, faces, number: the cleaned mesh and the component of every face.
        patches, part: its patches and their components.
        parts, material, settings: what it is made of.
        rng: of places, strengths and phases.
        label: class number.
    """
    sharp, bulge, owner = sharp_edges(vertices, faces, settings.crease_deg)
    edges = _edges(vertices, sharp, number[owner], parts, settings, rng)
    diffuse = _diffuse(patches, part, parts, settings.diffuse_points, rng)
    persistent = _persistent(vertices, sharp, bulge, material, settings, CLASSES[label], rng)
    imbalance_db = material.imbalance_db * settings.imbalance_scale
    groups = [diffuse, edges, persistent]
    columns = [np.concatenate([group[k] for group in groups]) for k in range(4)]
    kind = np.repeat(np.array([DIFFUSE, EDGE, ISOTROPIC], np.int8), [len(group[0]) for group in groups])
    board = board_factors(rng.normal(0.0, imbalance_db, len(kind)))
    position, axis, amplitude, length = columns
    return Points(
        position.astype(np.float32),
        axis.astype(np.float32),
        kind,
        amplitude.astype(np.complex64),
        length.astype(np.float32),
        board,
    )


Group = tuple[Float64, Float64, Complex128, Float64]
"""Position [n, 3], axis [n, 3], complex amplitude [n], length [n]."""


def sharp_edges(vertices: Float32, faces: Int32, crease_deg: float) -> tuple[Int32, Float32, Int32]:
    """Crease edges of a mesh.

    Returns:
        Vertices int32 [e, 2]; sum of the unit directions from the edge into its two faces float32 [e, 3], which points
        to the inside of a convex edge; number of one of its faces int32 [e].
    """
    ends = np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1).reshape(-1, 2).astype(np.int64)
    key = (ends.min(axis=1) << 32) | ends.max(axis=1)
    order = np.argsort(key, kind="stable")
    edges, bulge = np.empty((len(key), 2), np.int32), np.empty((len(key), 3), np.float32)
    owner = np.empty(len(key), np.int32)
    cosine = math.cos(math.radians(crease_deg))
    count = kernels.crease_edges(vertices, faces, key, order, cosine, edges, bulge, owner)
    return edges[:count], bulge[:count], owner[:count]


def _phase(count: int, rng: np.random.Generator) -> Complex128:
    return np.asarray(np.exp(2j * np.pi * rng.random(count)))


def _diffuse(patches: Patches, part: Int32, parts: Parts, count: int, rng: np.random.Generator) -> Group:
    """Random patches, as likely as their share of rho A, with exponential power: sigma = 4 rho A cos^2 in the mean."""
    power = np.cumsum(4.0 * parts.diffuse[part] * patches.area)
    picked = np.minimum(np.searchsorted(power, rng.random(count) * power[-1]), len(power) - 1)
    sigma = rng.exponential(power[-1] / max(count, 1), count)
    position, axis = patches.shape[picked, 0], patches.shape[picked, 1]
    return position, axis, np.sqrt(sigma) * _phase(count, rng), np.zeros(count)


def _edges(
    vertices: Float32, sharp: Int32, part: Int32, parts: Parts, settings: SurfaceSettings, rng: np.random.Generator
) -> Group:
    """Pieces of the crease edges; of too many, a random part with the power of all."""
    start, end = vertices[sharp[:, 0]].astype(np.float64), vertices[sharp[:, 1]].astype(np.float64)
    length = np.linalg.norm(end - start, axis=1)
    pieces = np.maximum(np.ceil(length / settings.edge_m).astype(np.int64), 1)
    edge = np.repeat(np.arange(len(sharp)), pieces)
    place = (np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5) / pieces[edge]
    share = 1.0
    if len(edge) > settings.edge_points:
        share = len(edge) / max(settings.edge_points, 1)
        kept = np.sort(rng.permutation(len(edge))[: settings.edge_points])
        edge, place = edge[kept], place[kept]
    along = (end - start) / np.maximum(length, 1e-9)[:, None]
    piece_m = (length / pieces)[edge]
    strength = (parts.edge * parts.reflection)[part[edge]]
    position = start[edge] + place[:, None] * (end - start)[edge]
    return position, along[edge], piece_m * strength * math.sqrt(share / math.pi), piece_m


def _persistent(
    vertices: Float32,
    sharp: Int32,
    bulge: Float32,
    material: Material,
    settings: SurfaceSettings,
    name: str,
    rng: np.random.Generator,
) -> Group:
    """Isotropic points at wheels and concave edges: a stand-in for corners that reflect twice or three times."""
    count = int(rng.integers(material.points[0], material.points[1] + 1))
    wheels = _wheel_places(vertices, name)
    at_wheels = min(round(WHEEL_SHARE * count), len(wheels))
    chosen = wheels[rng.permutation(len(wheels))[:at_wheels]]
    rest = count - at_wheels
    middle = 0.5 * (vertices[sharp[:, 0]] + vertices[sharp[:, 1]]).astype(np.float64)
    outward = middle - np.array([0.0, 0.0, 0.5 * float(vertices[:, 2].max())])
    outward /= np.maximum(np.linalg.norm(outward, axis=1), 1e-9)[:, None]
    length = np.linalg.norm(vertices[sharp[:, 0]] - vertices[sharp[:, 1]], axis=1)
    weight = length * np.maximum(np.einsum("ek,ek->e", bulge, outward), 0.0)
    if weight.sum() > 0:
        place = rng.choice(len(weight), rest, p=weight / weight.sum())
        others = middle[place] + LIFT_M * outward[place]
    else:
        others = vertices[rng.integers(len(vertices), size=rest)].astype(np.float64)
    position = np.concatenate([chosen, others])
    sigma_db = rng.uniform(*material.point_dbsm, count) + settings.points_db
    axis = np.tile([0.0, 0.0, 1.0], (count, 1))
    return position, axis, 10 ** (sigma_db / 20) * _phase(count, rng), np.zeros(count)


def _wheel_places(vertices: Float32, name: str) -> Float64:
    """Outer sides of the wheels (feet), float64 [w, 3]: above what touches the ground in each quarter of the object."""
    low = vertices[vertices[:, 2] < WHEEL_SLICE_M].astype(np.float64)
    places = []
    for front in (False, True):
        for left in (False, True):
            quarter = low[((low[:, 0] > 0) == front) & ((low[:, 1] > 0) == left)]
            if len(quarter) > 0:
                y = quarter[:, 1].max() + LIFT_M if left else quarter[:, 1].min() - LIFT_M
                places.append((quarter[:, 0].mean(), y, WHEEL_CENTER_M[name]))
    return np.array(places, dtype=np.float64).reshape(-1, 3)
