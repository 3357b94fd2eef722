# SPDX-License-Identifier: Apache-2.0
"""Simulated radar clouds varied in training, so that a few thousand drive-bys are not learned by heart.

A drive-by costs a second and more to simulate, a training sample 30 ms: every cloud is seen many times. What may differ
from one look to the next without asking the simulator again: how long the window was, what stood before the object, how
large the object is, and which stray points came along. All functions are pure; metres, z up, ground z = 0.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edge.frames import Float32
from train.nearest import nearest_index

__all__ = ["STRETCH_SIGMA", "borrowed", "hidden", "strays", "stretch", "window", "with_strays"]

LEAST_FRAMES, BEGINNING_SHARE = 12, 0.5
HIDDEN_RADIUS_SHARE = (0.1, 0.35)
STRETCH_SIGMA = (0.06, 0.04, 0.05)
"""Along, across and up; those of the scans of cars (``objects.deform``)."""
STRAY_SHARE = (0.005, 0.1)
STRAY_M = 0.4
"""A point farther from the surface is no point of the object: wrongly associated, a side lobe, a ghost."""
_MARGIN_M = 0.5
_GROUND_SIGMA_M = 0.1


def window(frame_number: NDArray[np.int64], frames: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Points of a shorter window: frames in a row, log-uniform in number, anywhere or from the beginning.

    The beginning, what is known of an object while it comes nearer, is what the vehicle asks about first.

    Args:
        frame_number: int64 [n], from 0. frames: of the whole window, >= 1.
    Returns:
        bool [n]: seen in the short window.
    """
    least = min(LEAST_FRAMES, frames)
    count = round(math.exp(rng.uniform(math.log(least), math.log(frames))))
    first = 0 if rng.random() < BEGINNING_SHARE else int(rng.integers(frames - count + 1))
    return np.asarray((frame_number >= first) & (frame_number < first + count))


def hidden(points: Float32, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Points that something between radar and object hides: those in a ball about one of them.

    Args:
        points: float32 [n, 3], n >= 1.
    Returns:
        bool [n]: true where a point is hidden. The radius is a share ``HIDDEN_RADIUS_SHARE`` of the cloud's diagonal.
    """
    middle = points[rng.integers(len(points))]
    diagonal_m = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    radius_m = diagonal_m * rng.uniform(*HIDDEN_RADIUS_SHARE)
    return np.asarray(((points - middle) ** 2).sum(axis=1) < radius_m**2)


def stretch(rng: np.random.Generator) -> Float32:
    """An object of another size: factors along its own x, y and z.

    Returns:
        float32 [3]; the standard deviation of their logarithms is ``STRETCH_SIGMA``.
    """
    return np.asarray(np.exp(rng.normal(0, STRETCH_SIGMA)), np.float32)


def with_strays(cloud: Float32, most: int, rng: np.random.Generator) -> Float32:
    """The cloud and, after its points, stray ones: anywhere around it, and images of its own below the ground.

    Args:
        cloud: float32 [n, 3]. most: points of the result at most.
    Returns:
        float32 [n + strays, 3]; each kind is a log-uniform share ``STRAY_SHARE`` of n in half of the calls.
    """
    added = [cloud]
    around, below = rng.random(2) < 0.5
    if around:
        low, high = cloud.min(axis=0) - _MARGIN_M, cloud.max(axis=0) + _MARGIN_M
        low[2] = max(low[2], 0.0)
        added.append(rng.uniform(low, high, (_stray_count(len(cloud), rng), 3)).astype(np.float32))
    if below:
        image = cloud[rng.integers(len(cloud), size=_stray_count(len(cloud), rng))].copy()
        image[:, 2] = rng.normal(0, _GROUND_SIGMA_M, len(image)) - image[:, 2]
        added.append(image)
    return np.concatenate(added)[:most].astype(np.float32)


def strays(cloud: Float32, surface: Float32) -> Float32:
    """Points of a cloud [n, 3] that lie more than ``STRAY_M`` from the object's surface, sampled as [m, 3]: [k, 3]."""
    nearest = surface[nearest_index(np.ascontiguousarray(cloud), np.ascontiguousarray(surface))]
    return np.asarray(cloud[((cloud - nearest) ** 2).sum(axis=1) > STRAY_M**2], np.float32)


def borrowed(points: int, stray: Float32, of: int, most: int, rng: np.random.Generator) -> Float32:
    """Strays of another cloud for this one, in the share that the other had.

    Args:
        points: of this cloud. stray: float32 [k, 3], of a cloud of ``of`` points. most: points of the result at most.
    Returns:
        float32 [<= k, 3], each of ``stray`` once at most, in random order.
    """
    return rng.permutation(stray)[: min(most, math.ceil(len(stray) / of * points))]


def _stray_count(points: int, rng: np.random.Generator) -> int:
    return math.ceil(points * math.exp(rng.uniform(*np.log(STRAY_SHARE))))
