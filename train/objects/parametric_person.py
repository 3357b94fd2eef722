# SPDX-License-Identifier: Apache-2.0
"""People from capsules and superellipsoids: standing or walking at any phase of the gait."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edge.frames import Float64
from train.objects.primitives import Part, capsule, superellipsoid

# Joint angles over the gait cycle, percent of the cycle from heel strike : degrees (Winter, Biomechanics and Motor
# Control of Human Movement; Perry, Gait Analysis). Linear in between is within a degree or two.
_HIP = ((0, 28), (15, 24), (30, 10), (50, -10), (62, -2), (75, 22), (87, 32), (100, 28))
_KNEE = ((0, 4), (12, 17), (30, 7), (40, 4), (50, 10), (62, 38), (72, 60), (85, 32), (95, 5), (100, 4))
_ANKLE = ((0, 0), (7, -7), (30, 6), (45, 11), (52, 5), (63, -17), (75, 0), (100, 0))

TRUNK = slice(12, 14)
"""Chest and belly among the parts of ``flesh``."""


@dataclass(frozen=True, slots=True)
class Body:
    """Sizes of one person, metres; segment lengths are shares of the stature (Drillis and Contini 1966)."""

    stature: float
    girth: float
    clothing: float

    @property
    def thigh(self) -> float:
        """Hip to knee."""
        return 0.245 * self.stature

    @property
    def shank(self) -> float:
        """Knee to ankle."""
        return 0.246 * self.stature

    @property
    def ankle(self) -> float:
        """Height of the ankle."""
        return 0.039 * self.stature

    @property
    def upper_arm(self) -> float:
        """Shoulder to elbow."""
        return 0.180 * self.stature

    @property
    def forearm(self) -> float:
        """Elbow to the middle of the hand."""
        return 0.200 * self.stature

    @property
    def torso(self) -> float:
        """Hip to shoulder."""
        return 0.288 * self.stature

    @property
    def shoulder(self) -> float:
        """Half the distance of the shoulder joints."""
        return 0.105 * self.stature

    @property
    def hip(self) -> float:
        """Half the distance of the hip joints."""
        return 0.052 * self.stature


def random_body(rng: np.random.Generator, *, adult: bool = False) -> Body:
    """A man, woman or child with clothes; stature N(1.765, 0.07) m men, N(1.635, 0.065) m women."""
    kind = rng.random()
    if not adult and kind < 0.15:
        stature = rng.uniform(1.05, 1.5)
    elif kind < 0.55:
        stature = rng.normal(1.765, 0.07)
    else:
        stature = rng.normal(1.635, 0.065)
    return Body(float(np.clip(stature, 1.0, 2.0)), float(rng.normal(1.0, 0.1)), float(rng.uniform(0.004, 0.028)))


def gait_angle(table: tuple[tuple[int, int], ...], phase: float) -> float:
    """Joint angle in radians at a phase 0..1 of the gait cycle."""
    percent, degrees = np.array(table, dtype=float).T
    return math.radians(float(np.interp(100 * (phase % 1.0), percent, degrees)))


def two_link(start: ArrayLike, end: ArrayLike, first: float, second: float, bend: ArrayLike) -> tuple[Float64, Float64]:
    """Middle joint and reached end of a limb of two segments; ``bend`` is the direction the middle joint moves to."""
    a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    reach = float(np.linalg.norm(b - a))
    distance = min(max(reach, abs(first - second) + 1e-3), 0.999 * (first + second))
    axis = (b - a) / max(reach, 1e-9)
    along = (first**2 - second**2 + distance**2) / (2 * distance)
    off = math.sqrt(max(first**2 - along**2, 0.0))
    side = np.asarray(bend, dtype=float)
    side = side - (side @ axis) * axis
    side = side / max(float(np.linalg.norm(side)), 1e-9)
    return a + along * axis + off * side, a + distance * axis


@dataclass(frozen=True, slots=True)
class LegArm:
    """Angles of one side, radians, forward and toes-up positive, from the vertical unless stated.

    Args:
        thigh, shank, upper_arm: of the segment. foot: of the sole from the ground.
    """

    thigh: float
    shank: float
    foot: float
    upper_arm: float


def gait(phase: float, amplitude: float) -> LegArm:
    """One side of the body at a phase 0..1 of its gait cycle; amplitude 0 stands still, 1 is a full stride."""
    thigh = gait_angle(_HIP, phase) * amplitude
    shank = thigh - gait_angle(_KNEE, phase) * amplitude
    foot = shank + gait_angle(_ANKLE, phase) * amplitude
    return LegArm(thigh, shank, foot, -math.radians(20) * amplitude * math.cos(2 * math.pi * phase))


def swing(angle: float, sideways: float = 0.0) -> Float64:
    """Direction of a hanging segment turned forward by ``angle`` about the y axis and to the left by ``sideways``."""
    c = math.cos(angle)
    return np.array([math.sin(angle), c * math.sin(sideways), -c * math.cos(sideways)])


def flesh(body: Body, joints: dict[str, Float64], foot_pitch: tuple[float, float] = (0.0, 0.0)) -> list[Part]:
    """Limbs, trunk and head about joints: pelvis, neck, and for l and r: hip, knee, ankle, shoulder, elbow, hand."""
    h, g, c = body.stature, body.girth, body.clothing
    parts: list[Part] = []
    for side, pitch in zip("lr", foot_pitch, strict=True):
        hip, knee, ankle = (joints[side + name] for name in ("hip", "knee", "ankle"))
        shoulder, elbow, hand = (joints[side + name] for name in ("shoulder", "elbow", "hand"))
        parts.append(capsule(hip, knee, 0.048 * h * g + c, 0.031 * h * g + c))
        parts.append(capsule(knee, ankle, 0.032 * h * g + c, 0.022 * h + c / 2))
        heel = np.array([-math.cos(pitch), 0, -math.sin(pitch)])
        down = np.array([math.sin(pitch), 0, -math.cos(pitch)]) * body.ankle * 0.55
        parts.append(
            capsule(ankle + 0.02 * h * heel + down, ankle - 0.105 * h * heel + 1.25 * down, 0.018 * h, 0.014 * h)
        )
        parts.append(capsule(shoulder, elbow, 0.027 * h * g + c, 0.021 * h * g + c))
        parts.append(capsule(elbow, hand, 0.021 * h * g + c, 0.016 * h))
        parts.append(superellipsoid(hand, np.array([0.024, 0.014, 0.032]) * h, steps=(8, 6)))
    pelvis, neck = joints["pelvis"], joints["neck"]
    spine = neck - pelvis
    up = spine / np.linalg.norm(spine)
    across = joints["lshoulder"] - joints["rshoulder"]
    across = across - (across @ up) * up
    across = across / np.linalg.norm(across)
    turn = np.stack([np.cross(across, up), across, up], axis=1)
    length = float(np.linalg.norm(spine))
    chest = np.array([0.068 * h * g + c, 0.112 * h * g + c, 0.40 * length])
    belly = np.array([0.066 * h * g + c, 0.090 * h * g + c, 0.36 * length])
    parts.append(superellipsoid(pelvis + 0.64 * spine, chest, (0.75, 0.85), turn, (16, 11)))
    parts.append(superellipsoid(pelvis + 0.20 * spine, belly, (0.8, 0.9), turn, (16, 11)))
    head = neck + 0.105 * h * (0.75 * np.array([0, 0, 1.0]) + 0.25 * up)
    parts.append(capsule(neck - 0.02 * h * up, head, 0.034 * h, 0.034 * h))
    parts.append(superellipsoid(head, np.array([0.057, 0.046, 0.071]) * h, (0.95, 1.0), None, (14, 10)))
    return parts


def walking(body: Body, phase: float, amplitude: float, rng: np.random.Generator) -> list[Part]:
    """A person in the gait cycle; ``amplitude`` 0 stands with hanging arms, 1 is a full stride."""
    yaw = math.radians(6) * amplitude * math.cos(2 * math.pi * phase)
    elbow = math.radians(rng.uniform(18, 28)) * (0.4 + 0.6 * amplitude)
    splay = math.radians(rng.uniform(2, 9))
    joints = {"pelvis": np.zeros(3), "neck": np.array([0.02 * body.stature, 0, body.torso + 0.03 * body.stature])}
    pitches = []
    for side, sign, offset in (("l", 1.0, 0.0), ("r", -1.0, 0.5)):
        angles = gait(phase + offset, amplitude)
        hip = np.array([-sign * body.hip * math.sin(yaw), sign * body.hip * math.cos(yaw), 0])
        knee = hip + body.thigh * swing(angles.thigh)
        ankle = knee + body.shank * swing(angles.shank)
        shoulder = np.array([1.5 * body.shoulder * sign * math.sin(yaw), sign * body.shoulder, body.torso])
        upper = shoulder + body.upper_arm * swing(angles.upper_arm, sign * splay)
        hand = upper + body.forearm * swing(angles.upper_arm + elbow, sign * splay / 2)
        joints |= {side + "hip": hip, side + "knee": knee, side + "ankle": ankle}
        joints |= {side + "shoulder": shoulder, side + "elbow": upper, side + "hand": hand}
        pitches.append(angles.foot)
    return flesh(body, joints, (pitches[0], pitches[1]))


def pedestrian(rng: np.random.Generator) -> list[Part]:
    """A random person: 70 % walking, the rest standing."""
    body = random_body(rng)
    if rng.random() < 0.7:
        return walking(body, rng.random(), rng.uniform(0.75, 1.15), rng)
    return walking(body, rng.random(), rng.uniform(0.0, 0.25), rng)
