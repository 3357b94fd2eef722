# SPDX-License-Identifier: Apache-2.0
"""People from the CC0 MakeHuman body when its file is at hand: random build, age, clothes and walking pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.frames import Float64
from train.objects.mesh import CLASSES, Mesh, MeshError, stand
from train.objects.parametric_person import gait, swing
from train.objects.reduce import merge_near
from train.objects.sampling import Int32

WORLD = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]) / 10
"""The file has decimetres, x left, y up, z forward; here metres, x forward, y left, z up."""
DETAIL_M = 0.014
"""Vertices nearer than this are merged: 27,000 triangles become about 10,000; toes and fingers lose their shape."""
HUMAN_ORIGIN = ("makehuman", "CC0-1.0", "MakeHuman community (not required)")
"""Source group, licence and attribution of every person made here."""
_CLOTHED = {"thigh": "leg", "calf": "leg", "pelvis": "leg", "spine": "torso", "clavicle": "torso", "upperarm": "torso",
            "lowerarm": "torso"}  # fmt: skip


@dataclass(frozen=True)
class HumanModel:
    """The body: a neutral shape, displacements that are blended, and a skeleton that bends it.

    Args:
        neutral: float64 [n, 3], the file's axes and decimetres.
        targets: float32 [t, n, 3], displacements, decimetres. factors: names whose product weights each target.
        faces: int32 [m, 3] of the skin.
        bones, parents: names and number of the parent (-1 none), parents first. joints: vertices whose mean is the head
            of each bone.
        weights: float64 [n, bones].
    """

    neutral: Float64
    targets: NDArray[np.int16]
    target_unit: float
    factors: list[list[str]]
    faces: Int32
    bones: list[str]
    parents: list[int]
    joints: list[NDArray[np.int32]]
    weights: Float64

    @staticmethod
    @lru_cache(maxsize=1)
    def load(path: Path) -> HumanModel:
        """Read ``mh_model.npz``.

        Raises:
            MeshError: not such a file.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                z = {name: archive[name] for name in archive.files}
            bones = z["bones"].tolist()
            weights = np.zeros((len(z["base_dm"]), len(bones)))
            rows = np.arange(len(weights))
            for column in range(z["w_idx"].shape[1]):
                np.add.at(weights, (rows, z["w_idx"][:, column].astype(int)), z["w_val"][:, column].astype(float))
            offsets = z["joint_off"]
            return HumanModel(
                neutral=z["base_dm"].astype(float),
                targets=z["target_delta_i16"],
                target_unit=float(z["target_unit_dm"]),
                factors=[name.split("-") for name in z["target_names"].tolist()],
                faces=z["body_faces"].astype(np.int32),
                bones=bones,
                parents=[bones.index(p) if p else -1 for p in z["parents"].tolist()],
                joints=[z["joint_idx"][a:b] for a, b in pairwise(offsets)],
                weights=weights,
            )
        except (OSError, KeyError, ValueError) as error:
            raise MeshError(f"{path.name}: not the human model ({error})", action="restore the file") from error

    def shape(self, values: dict[str, float]) -> Float64:
        """Blended body [n, 3], the file's axes; a target weighs the product of its factors' values (absent: 0)."""
        body = self.neutral.copy()
        for names, target in zip(self.factors, self.targets, strict=True):
            weight = math.prod(values.get(name, 0.0) for name in names)
            if weight > 1e-6:
                body += weight * self.target_unit * target
        return body

    def heads(self, body: Float64) -> Float64:
        """Head of every bone, float64 [bones, 3]."""
        return np.stack([body[vertices].mean(axis=0) for vertices in self.joints])

    def chain(self, heads: Float64, turns: dict[str, Float64]) -> tuple[Float64, Float64]:
        """Rotation [bones, 3, 3] and new head [bones, 3] of every bone.

        Args:
            heads: [bones, 3].
            turns: bone -> its rotation [3, 3] in the world; a bone without one follows its parent.
        """
        rotation = np.empty((len(self.bones), 3, 3))
        moved = np.empty((len(self.bones), 3))
        for number, (bone, parent) in enumerate(zip(self.bones, self.parents, strict=True)):
            inherited = rotation[parent] if parent >= 0 else np.eye(3)
            rotation[number] = turns.get(bone, inherited)
            anchor = moved[parent] + inherited @ (heads[number] - heads[parent]) if parent >= 0 else heads[number]
            moved[number] = anchor
        return rotation, moved

    def bend(self, body: Float64, heads: Float64, turns: dict[str, Float64]) -> Float64:
        """Linear blend skinning of a body [n, 3]; heads and turns as in ``chain``."""
        rotation, moved = self.chain(heads, turns)
        shift = moved - np.einsum("bij,bj->bi", rotation, heads)
        blended = (self.weights @ rotation.reshape(-1, 9)).reshape(-1, 3, 3)
        bent: Float64 = np.einsum("nij,nj->ni", blended, body) + self.weights @ shift
        loose = self.weights.sum(axis=1) < 1e-6
        bent[loose] = body[loose]
        return bent

    def person(self, seed: int) -> Mesh:
        """A random person, on the ground, centred; 70 % walk."""
        rng = np.random.default_rng([CLASSES.index("pedestrian"), seed])
        body = self.shape(build(rng)) @ WORLD.T
        heads = self.heads(body)
        walking = rng.random() < 0.7
        amplitude = rng.uniform(0.75, 1.15) if walking else rng.uniform(0.0, 0.25)
        posed = self.bend(body, heads, self._turns(heads, rng.random(), amplitude, rng))
        posed = posed + self.clothes(posed, rng)
        used, faces = compact(self.faces)
        vertices = posed[used]
        if np.ptp(vertices[:, 2]) > 1.5:  # an adult: stature of the population
            stature = rng.normal(1.70, 0.09)
            vertices = vertices * (float(np.clip(stature, 1.5, 1.98)) / np.ptp(body[used][:, 2]))
        vertices, merged = merge_near(vertices, faces.astype(np.int64), DETAIL_M)
        return Mesh(
            stand(vertices.astype(np.float32)), merged.astype(np.int32), CLASSES.index("pedestrian"),
            f"pedestrian/human_{seed:05d}", HUMAN_ORIGIN[0], "own", *HUMAN_ORIGIN[1:],
        )  # fmt: skip

    def _turns(self, heads: Float64, phase: float, amplitude: float, rng: np.random.Generator) -> dict[str, Float64]:
        """Rotation of the limbs and the trunk for a phase of the gait."""
        at = {bone: heads[number] for number, bone in enumerate(self.bones)}
        yaw = math.radians(6) * amplitude * math.cos(2 * math.pi * phase)
        elbow = math.radians(rng.uniform(18, 28)) * (0.4 + 0.6 * amplitude)
        splay = math.radians(rng.uniform(6, 14))
        turns = {"pelvis": about_z(-yaw), "spine_01": about_z(0.2 * yaw), "spine_03": about_z(1.5 * yaw)}
        turns |= {"spine_02": about_z(0.8 * yaw), "neck_01": np.eye(3)}
        for side, sign, offset in (("_l", 1.0, 0.0), ("_r", -1.0, 0.5)):
            angles = gait(phase + offset, amplitude)
            chain = {
                "thigh": ("calf", swing(angles.thigh, 0.03 * sign)),
                "calf": ("foot", swing(angles.shank, 0.02 * sign)),
                "upperarm": ("lowerarm", swing(angles.upper_arm, splay * sign)),
                "lowerarm": ("hand", swing(angles.upper_arm + elbow, 0.5 * splay * sign)),
            }
            for bone, (following, direction) in chain.items():
                turns[bone + side] = align(at[following + side] - at[bone + side], direction)
            turns["foot" + side] = about_y(-angles.foot)
        return turns

    def clothes(self, posed: Float64, rng: np.random.Generator) -> Float64:
        """Displacement along the normals: torso and arms 0.4-2.8 cm, legs 0.4-2.2 cm, none on head, hands and feet."""
        thick = {"torso": rng.uniform(0.004, 0.028), "leg": rng.uniform(0.004, 0.022)}
        of_bone = np.array([thick.get(_CLOTHED.get(bone.split("_")[0], ""), 0.0) for bone in self.bones])
        a, b, c = (posed[self.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        total = np.empty_like(posed)
        corners = self.faces.T.ravel()
        for axis in range(3):
            total[:, axis] = np.bincount(corners, np.tile(normal[:, axis], 3), len(posed))
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
        thickness: Float64 = self.weights @ of_bone
        return total * thickness[:, None]


def compact(faces: Int32) -> tuple[NDArray[np.int32], Int32]:
    """Vertices in use, and the faces renumbered to them."""
    used, renumbered = np.unique(faces, return_inverse=True)
    return used, renumbered.reshape(-1, 3).astype(np.int32)


def build(rng: np.random.Generator, age: float | None = None) -> dict[str, float]:
    """Values of the factors: gender, age (None: 15 % children, 15 % old), muscle, weight, height, ancestry."""
    gender = float(rng.random() < 0.5)
    kind = rng.random()
    low, high = (0.08, 0.28) if kind < 0.15 else (0.75, 1.0) if kind < 0.30 else (0.4, 0.75)
    drawn = rng.uniform(low, high)
    age = drawn if age is None else age
    values = {"male": gender, "female": 1 - gender, "universal": 1.0}
    if age < 0.5:
        young = max(0.0, (age - 0.1875) * 3.2)
        values |= {
            "baby": max(0.0, 1 - age * 16 / 3),
            "young": young,
            "child": max(0.0, min(1.0, age * 16 / 3) - young),
        }
    else:
        values |= {"old": age * 2 - 1, "young": 2 - age * 2}
    for name, value in (("muscle", rng.normal(0.5, 0.15)), ("weight", rng.normal(0.53, 0.19))):
        value = float(np.clip(value, 0, 1))
        values |= {"max" + name: max(0.0, value * 2 - 1), "min" + name: max(0.0, 1 - value * 2)}
        values["average" + name] = 1 - values["max" + name] - values["min" + name]
    height, proportion = rng.uniform(0.25, 0.75), rng.random()
    values |= {"maxheight": max(0.0, height * 2 - 1), "minheight": max(0.0, 1 - 2 * height)}
    values |= {"idealproportions": max(0.0, proportion * 2 - 1), "uncommonproportions": max(0.0, 1 - 2 * proportion)}
    return values | dict(zip(("african", "asian", "caucasian"), rng.dirichlet((1, 1, 1)).tolist(), strict=True))


def align(before: Float64, after: Float64) -> Float64:
    """Smallest rotation [3, 3] that turns the direction ``before`` into ``after``."""
    a, b = before / np.linalg.norm(before), after / np.linalg.norm(after)
    x, y, z = np.cross(a, b)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: Float64 = np.eye(3) + cross + cross @ cross / (1 + max(float(a @ b), -0.999))
    return turn


def about_z(angle: float) -> Float64:
    """Rotation [3, 3] from x towards y, radians."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def about_y(angle: float) -> Float64:
    """Rotation [3, 3] from z towards x (a nod forward), radians."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
