# SPDX-License-Identifier: Apache-2.0
"""Keeps the most trusted shapes of a run, however long the run is."""

from __future__ import annotations

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
