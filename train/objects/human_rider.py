# SPDX-License-Identifier: Apache-2.0
"""A rider from the CC0 human model: seated, hands around the grips, feet on pedals, pegs or floor."""

from __future__ import annotations

import math

import numpy as np

from edge.frames import Float64
from train.objects.human import DETAIL_M, WORLD, HumanModel, about_y, align, build, compact
from train.objects.primitives import Part
from train.objects.reduce import merge_near
from train.objects.rider import Contacts, Skeleton, fit_stature, foot_pitch, helmet, limbs, settle, trunk_lean

_BEND = {"pelvis": 0.5, "spine_01": 0.8, "spine_02": 1.05, "spine_03": 1.2, "neck_01": 0.7, "head": 0.25}
"""Share of the trunk's lean that each bone takes: the back is rounded, the eyes look ahead."""
_BEND_NAMES = {bone.split("_")[0] for bone in _BEND}
_FINGERS = ("index", "middle", "ring", "pinky")
_CURL_RAD = math.radians(55)


def human_rider(model: HumanModel, contacts: Contacts, rng: np.random.Generator) -> list[Part]:
    """A person of the model on a machine; stature to fit it, a helmet where the feet are on pegs.

    Args:
        model: the body. contacts: where it touches the machine, metres, x forward.
    """
    stature = fit_stature(contacts, float(np.clip(rng.normal(1.70, 0.09), 1.5, 1.98)))
    age = float(np.interp(stature, (1.0, 1.5), (0.12, 0.28))) if stature < 1.45 else float(rng.uniform(0.4, 0.85))
    body = model.shape(build(rng, age)) @ WORLD.T
    used, faces = compact(model.faces)
    low, high = body[used][:, 2].min(), body[used][:, 2].max()
    body = body * (stature / (high - low))
    heads = model.heads(body)
    skeleton = _skeleton(model, heads, float(body[used][:, 2].min()))

    def pose_at(pelvis: Float64) -> tuple[Float64, Float64]:
        turns, shift = _pose(model, heads, skeleton, contacts, pelvis)
        _, moved = model.chain(heads, turns)
        return model.bend(body, heads, turns) + shift, moved[model.bones.index("head")] + shift

    limb_bones = [n for n, bone in enumerate(model.bones) if bone.split("_")[0] not in _BEND_NAMES]
    trunk = np.flatnonzero(model.weights[:, limb_bones].sum(axis=1) < 0.3)
    trunk = np.intersect1d(trunk, used)
    pelvis = settle(contacts, stature, lambda place: pose_at(place)[0][trunk])
    posed, head = pose_at(pelvis)
    posed = posed + model.clothes(posed, rng)
    parts = [merge_near(posed[used], faces.astype(np.int64), DETAIL_M)]
    if not contacts.pedals:
        parts.append(helmet(head + np.array([0.03, 0, 0.045]) * stature, stature))
    return parts


def _skeleton(model: HumanModel, heads: Float64, ground: float) -> Skeleton:
    """Lengths between the joints of a body at rest."""
    at = {bone: heads[number] for number, bone in enumerate(model.bones)}

    def apart(first: str, second: str) -> float:
        return float(np.linalg.norm(at[first] - at[second]))

    hips, shoulders = (0.5 * (at[name + "_l"] + at[name + "_r"]) for name in ("thigh", "upperarm"))
    return Skeleton(
        thigh=apart("thigh_l", "calf_l"),
        shank=apart("calf_l", "foot_l"),
        upper_arm=apart("upperarm_l", "lowerarm_l"),
        forearm=apart("lowerarm_l", "hand_l") + 0.8 * apart("hand_l", "middle_01_l"),
        torso=float(np.linalg.norm(shoulders - hips)),
        hip=apart("thigh_l", "thigh_r") / 2,
        shoulder=apart("upperarm_l", "upperarm_r") / 2,
        ankle=float(at["foot_l"][2] - ground),
        ball=float(at["ball_l"][0] - at["foot_l"][0]),
    )


def _pose(
    model: HumanModel, heads: Float64, skeleton: Skeleton, contacts: Contacts, pelvis: Float64
) -> tuple[dict[str, Float64], Float64]:
    """Rotation of the bones, and the shift of the whole body that brings the middle of the hips to ``pelvis``."""
    number = {bone: n for n, bone in enumerate(model.bones)}
    lean = trunk_lean(contacts, skeleton, pelvis)
    turns = {bone: about_y(share * lean) for bone, share in _BEND.items()}
    _, moved = model.chain(heads, turns)
    hips = moved[[number["thigh_l"], number["thigh_r"]]]
    shift: Float64 = pelvis - hips.mean(axis=0)
    hips, shoulders = hips + shift, moved[[number["upperarm_l"], number["upperarm_r"]]] + shift
    joints = limbs(contacts, skeleton, hips, shoulders)
    for side, start in (("l", 0), ("r", 1)):
        for limb, bones, first in (
            ("leg", ("thigh", "calf", "foot"), hips[start]),
            ("arm", ("upperarm", "lowerarm", "hand"), shoulders[start]),
        ):
            middle, end = joints[side + limb]
            names = [f"{bone}_{side}" for bone in bones]
            rest = [heads[number[name]] for name in names]
            turns[names[0]] = align(rest[1] - rest[0], middle - first)
            turns[names[1]] = align(rest[2] - rest[1], end - middle)
        turns[f"foot_{side}"] = about_y(-foot_pitch(contacts))
        turns |= _fist(heads, number, side, turns[f"lowerarm_{side}"])
    return turns, shift


def _fist(heads: Float64, number: dict[str, int], side: str, forearm: Float64) -> dict[str, Float64]:
    """Palm down, fingers curled about the grip; ``forearm`` is the rotation that the hand would inherit."""
    sign = 1.0 if side == "l" else -1.0
    along = forearm @ (heads[number[f"middle_01_{side}"]] - heads[number[f"hand_{side}"]])
    along = along / np.linalg.norm(along)
    knuckles = sign * (forearm @ (heads[number[f"pinky_01_{side}"]] - heads[number[f"index_01_{side}"]]))
    flat = knuckles - (knuckles @ along) * along
    left = np.array([0.0, 1, 0]) - along[1] * along
    hand = align(flat, left) @ forearm
    turns = {f"hand_{side}": hand}
    axis = left / np.linalg.norm(left)
    for finger in _FINGERS:
        for joint in (1, 2, 3):
            turns[f"{finger}_{joint:02d}_{side}"] = _about(axis, joint * _CURL_RAD) @ hand
    return turns


def _about(axis: Float64, angle: float) -> Float64:
    """Rotation about a unit vector (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: Float64 = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return turn
