# SPDX-License-Identifier: Apache-2.0
"""Parametric road users from a seed: the same seed always gives the same object, on any machine, without any file."""

from __future__ import annotations

import numpy as np

from train.objects.mesh import CLASSES, ClassName, Mesh, stand
from train.objects.parametric_bicycle import bicycle
from train.objects.parametric_car import Style, car
from train.objects.parametric_motorcycle import motorcycle
from train.objects.parametric_person import pedestrian
from train.objects.primitives import Part, join
from train.objects.rider import Contacts, own_rider

RIDER_SHARE = 0.5
"""Of parametric two-wheelers, how many have a rider when the seed decides."""


def generate(class_name: ClassName, seed: int, *, rider: bool | None = None, style: Style | None = None) -> Mesh:
    """A road user to true scale.

    Args:
        class_name: one of CLASSES.
        seed: which one.
        rider: a two-wheeler with or without its rider; None = half of them have one, as the seed says.
        style: body style of a car, one of ``parametric_car.STYLES``; None = as the seed says.
    Returns:
        Mesh on the ground, centred, provenance "own".
    """
    rng = _generator(class_name, seed)
    if class_name in ("bicycle", "motorcycle"):
        parts, contacts = two_wheeler(class_name, seed)
        rng = np.random.default_rng([CLASSES.index(class_name), seed, 1])
        if rng.random() < RIDER_SHARE if rider is None else rider:
            parts = parts + own_rider(contacts, rng)
    else:
        parts = car(rng, style) if class_name == "car" else pedestrian(rng)
    vertices, faces = join(parts)
    return Mesh(stand(vertices), faces, CLASSES.index(class_name), f"{class_name}/parametric_{seed:05d}")


def two_wheeler(class_name: ClassName, seed: int) -> tuple[list[Part], Contacts]:
    """The bare machine of a seed, not centred, and where its rider touches it."""
    rng = _generator(class_name, seed)
    return bicycle(rng) if class_name == "bicycle" else motorcycle(rng)


def _generator(class_name: ClassName, seed: int) -> np.random.Generator:
    return np.random.default_rng([CLASSES.index(class_name), seed])
