# SPDX-License-Identifier: Apache-2.0
"""A person on a two-wheeler: where they touch it, how limbs reach there, and the project's own body in that pose."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from edge.frames import Float64
from train.objects.parametric_person import TRUNK, Body, flesh, random_body, two_link
from train.objects.primitives import Part, join, superellipsoid, vec

SINK_M = 0.015
"""How far clothes and saddle give way."""
_SEAT_LENGTH_M, _SEAT_HALF_WIDTH_M = (-0.12, 0.06), 0.08
_STATURE_M = (1.0, 2.05)
_LEG_SHARE = (0.75, 0.985)
"""Of a cyclist's leg (hip to ankle), the distance to the farther pedal: longer legs would hit the bar."""


@dataclass(frozen=True, slots=True)
class Contacts:
    """Where a rider touches the machine, metres, the machine's frame.

    Args:
        saddle: float64 [3], middle of the sitting area, on its surface.
        grips: float64 [2, 3], middle of the left and right grip.
        feet: float64 [2, 3], what the ball of the left and right foot rests on.
        pedals: the feet are on pedals (the legs must fit), not on pegs or a floor.
        reach: share of the arm that the hands are away from the shoulders; decides how far the trunk leans forward.
    """

    saddle: Float64
    grips: Float64
    feet: Float64
    pedals: bool
    reach: float = 0.9


@dataclass(frozen=True, slots=True)
class Skeleton:
    """Lengths of a body, metres.

    Args:
        thigh, shank, upper_arm, forearm: between joints; the forearm to the middle of the fist.
        torso: middle of the hips to the height of the shoulders. hip, shoulder: half the distance of the joints.
        ankle: height of the joint above the sole. ball: ball of the foot ahead of the ankle.
    """

    thigh: float
    shank: float
    upper_arm: float
    forearm: float
    torso: float
    hip: float
    shoulder: float
    ankle: float
    ball: float

    @staticmethod
    def of(body: Body) -> Skeleton:
        """Of the project's own person; the sole is where ``flesh`` puts it."""
        sole = 1.25 * 0.55 * body.ankle + 0.014 * body.stature
        return Skeleton(
            body.thigh, body.shank, body.upper_arm, body.forearm, body.torso, body.hip, body.shoulder, sole,
            0.085 * body.stature,
        )  # fmt: skip


def foot_pitch(contacts: Contacts) -> float:
    """Of the sole, toes up, radians: a cyclist's heels are raised."""
    return math.radians(-15) if contacts.pedals else 0.0


def ankles(contacts: Contacts, skeleton: Skeleton) -> Float64:
    """Ankle joints, float64 [2, 3]."""
    c, s = math.cos(foot_pitch(contacts)), math.sin(foot_pitch(contacts))
    place: Float64 = contacts.feet - skeleton.ball * vec(c, 0, s) - skeleton.ankle * vec(s, 0, -c)
    return place


def trunk_lean(contacts: Contacts, skeleton: Skeleton, pelvis: Float64) -> float:
    """Smallest lean of the trunk, radians forward from upright, that brings the hands to the grips.

    Args:
        pelvis: float64 [3], middle of the hip joints.
    """
    grip = contacts.grips.mean(axis=0)
    half = float(np.ptp(contacts.grips[:, 1])) / 2
    wanted = contacts.reach * (skeleton.upper_arm + skeleton.forearm)
    angles = np.radians(np.arange(-4, 66, 1.0))
    shoulder_x = pelvis[0] + skeleton.torso * np.sin(angles)
    shoulder_z = pelvis[2] + skeleton.torso * np.cos(angles)
    away = np.sqrt((grip[0] - shoulder_x) ** 2 + (grip[2] - shoulder_z) ** 2 + (half - skeleton.shoulder) ** 2)
    near = np.flatnonzero(away <= wanted)
    return float(angles[near[0] if len(near) else np.argmin(away)])


def limbs(
    contacts: Contacts, skeleton: Skeleton, hips: Float64, shoulders: Float64
) -> dict[str, tuple[Float64, Float64]]:
    """Both joints of every limb: ``lleg`` -> (knee, ankle), ``larm`` -> (elbow, fist), and the same for r.

    Args:
        hips, shoulders: float64 [2, 3], left and right joint.
    """
    joints: dict[str, tuple[Float64, Float64]] = {}
    place = ankles(contacts, skeleton)
    for number, (side, sign) in enumerate((("l", 1.0), ("r", -1.0))):
        joints[side + "leg"] = two_link(
            hips[number], place[number], skeleton.thigh, skeleton.shank, [1, 0.15 * sign, 0.4]
        )
        joints[side + "arm"] = two_link(
            shoulders[number], contacts.grips[number], skeleton.upper_arm, skeleton.forearm, [-0.3, sign, -0.8]
        )
    return joints


def fit_stature(contacts: Contacts, stature: float) -> float:
    """The stature nearest to the given one whose legs fit the pedals; on pegs only so long that they reach."""
    for _ in range(60):
        skeleton = Skeleton.of(Body(stature, 1.0, 0.01))
        hip = contacts.saddle + vec(0.03, 0, 0.05 * stature)
        distance = float(np.linalg.norm(ankles(contacts, skeleton) - hip, axis=1).max())
        share = distance / (skeleton.thigh + skeleton.shank)
        if share > _LEG_SHARE[1]:
            stature *= 1.02
        elif contacts.pedals and share < _LEG_SHARE[0]:
            stature *= 0.98
        else:
            break
    return float(np.clip(stature, *_STATURE_M))


def settle(contacts: Contacts, stature: float, trunk_at: Callable[[Float64], Float64]) -> Float64:
    """Where the middle of the hip joints must be so that the body sits on the saddle; float64 [3].

    Args:
        stature: metres.
        trunk_at: vertices [n, 3] of the trunk, without limbs, of the body whose hips are at a place.
    """
    pelvis = contacts.saddle + vec(0.03, 0, 0.05 * stature)
    for _ in range(3):
        away = trunk_at(pelvis) - contacts.saddle
        over = (away[:, 0] > _SEAT_LENGTH_M[0]) & (away[:, 0] < _SEAT_LENGTH_M[1])
        over &= np.abs(away[:, 1]) < _SEAT_HALF_WIDTH_M
        if over.any():
            pelvis = pelvis - vec(0, 0, float(away[over, 2].min()) + SINK_M)
    return pelvis


def helmet(center: Float64, stature: float) -> Part:
    """A full-face helmet about the middle of the head."""
    return superellipsoid(center, np.array([0.083, 0.070, 0.080]) * stature, (0.9, 0.95), None, (14, 10))


def own_rider(contacts: Contacts, rng: np.random.Generator) -> list[Part]:
    """The project's own person on the machine; with a helmet where the feet are on pegs."""
    body = random_body(rng, adult=True)
    body = replace(body, stature=fit_stature(contacts, body.stature))
    skeleton = Skeleton.of(body)

    def parts_at(pelvis: Float64) -> list[Part]:
        lean = trunk_lean(contacts, skeleton, pelvis)
        up = vec(math.sin(lean), 0, math.cos(lean))
        side = np.array([[0, 1.0, 0], [0, -1.0, 0]])
        hips = pelvis + skeleton.hip * side
        shoulders = pelvis + skeleton.torso * up + skeleton.shoulder * side
        joints = {"pelvis": pelvis, "neck": pelvis + up * (body.torso + 0.03 * body.stature)}
        for number, name in enumerate("lr"):
            joints |= {name + "hip": hips[number], name + "shoulder": shoulders[number]}
        for name, (middle, end) in limbs(contacts, skeleton, hips, shoulders).items():
            names = ("knee", "ankle") if name.endswith("leg") else ("elbow", "hand")
            joints |= {name[0] + names[0]: middle, name[0] + names[1]: end}
        parts = flesh(body, joints, (foot_pitch(contacts), foot_pitch(contacts)))
        if not contacts.pedals:
            head = joints["neck"] + 0.105 * body.stature * (0.75 * vec(0, 0, 1) + 0.25 * up)
            parts.append(helmet(head, body.stature))
        return parts

    return parts_at(settle(contacts, body.stature, lambda pelvis: join(parts_at(pelvis)[TRUNK])[0].astype(float)))
