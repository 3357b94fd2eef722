# SPDX-License-Identifier: Apache-2.0
"""Keeps the most trusted shapes of a run, however long the run is, and names their class for people."""

from __future__ import annotations

from edge.completion.model import UNKNOWN
from edge.frames import Shape

MAX_SHAPES = 64
"""Objects whose shape a run keeps for its report and its pictures, the most trusted ones."""


def keep_best(shapes: dict[int, Shape], shape: Shape) -> None:
    """Keep the most trusted shape of every object, and of the most trusted ``MAX_SHAPES`` objects.

    Args:
        shapes: identity -> shape, changed in place.
        shape: the newest one.
    """
    known = shapes.get(shape.identity)
    if known is None or shape.confidence >= known.confidence:
        shapes[shape.identity] = shape
    if len(shapes) > MAX_SHAPES:
        del shapes[min(shapes.values(), key=lambda kept: kept.confidence).identity]


def class_text(shape: Shape) -> str:
    """The class; when that is unknown the most likely one with its probability, "unknown (car 0.95?)"."""
    known = {name: share for name, share in shape.class_probability.items() if name != UNKNOWN}
    if shape.class_name != UNKNOWN or not known:
        return shape.class_name
    likely = max(known, key=lambda name: known[name])
    return f"{UNKNOWN} ({likely} {known[likely]:.2f}?)"
