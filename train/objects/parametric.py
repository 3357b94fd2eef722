# SPDX-License-Identifier: Apache-2.0
"""Parametric road users from a seed: the same seed always gives the same object."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from train.objects.mesh import CLASSES, ClassName, Mesh, stand
from train.objects.parametric_bicycle import bicycle
from train.objects.parametric_car import car
from train.objects.parametric_motorcycle import motorcycle
from train.objects.parametric_person import pedestrian
from train.objects.primitives import Part, join

_GENERATORS: dict[ClassName, Callable[[np.random.Generator], list[Part]]] = {
    "car": car,
    "bicycle": bicycle,
    "motorcycle": motorcycle,
    "pedestrian": pedestrian,
}


def generate(class_name: ClassName, seed: int) -> Mesh:
    """A road user to true scale.

    Args:
        class_name: one of CLASSES.
        seed: which one.
    Returns:
        Mesh on the ground, centred, provenance "own".
    """
    label = CLASSES.index(class_name)
    vertices, faces = join(_GENERATORS[class_name](np.random.default_rng([label, seed])))
    return Mesh(stand(vertices), faces, label, f"{class_name}/parametric_{seed:05d}")
