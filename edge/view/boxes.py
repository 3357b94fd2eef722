# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes: the upright box of least ground area that holds a shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.frames import Float64

ANGLES = 90
"""Orientations that are tried, one a degree: a box turned by 90 degrees is the same box."""
STRAY_SHARE = 0.01
"""Share of the points that may lie beyond each face: single stray points do not make a box."""
MOST_POINTS = 2048


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box.

    Args:
        center_m: float64 [3].
        size_m: float64 [3], length (the longer side), width, height.
        yaw_rad: of the length, -pi/2 .. pi/2, from x towards y.
    """

    center_m: Float64
    size_m: Float64
    yaw_rad: float

    def corners(self) -> Float64:
        """float64 [8, 3]: lower four, then upper four, each around."""
        signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2.0
        flat = signs * self.size_m[:2] @ _turn(self.yaw_rad).T + self.center_m[:2]
        heights = self.center_m[2] + np.array([-0.5, 0.5]) * self.size_m[2]
        return np.concatenate([np.column_stack([flat, np.full(4, height)]) for height in heights])

    def edges(self) -> Float64:
        """float64 [12, 2, 3], segments."""
        corners = self.corners()
        around = [(k, (k + 1) % 4) for k in range(4)]
        pairs = around + [(a + 4, b + 4) for a, b in around] + [(k, k + 4) for k in range(4)]
        return np.array([[corners[a], corners[b]] for a, b in pairs])


def fit_box(xyz_m: NDArray[np.floating]) -> Box:
    """The upright box of least ground area, from the 1 % to the 99 % quantile along each of its axes.

    Args:
        xyz_m: [n, 3], n >= 1, z up.
    Returns:
        The box in the same frame; the yaw is that of the longer side, so front and back are not told apart.
    """
    step = -(-len(xyz_m) // MOST_POINTS)
    points = np.asarray(xyz_m[::step], np.float64)
    angles = np.arange(ANGLES) * (np.pi / 2 / ANGLES)
    middle = points[:, :2].mean(axis=0)
    x, y = (points[:, :2] - middle).T
    cosines, sines = np.cos(angles)[:, None], np.sin(angles)[:, None]
    along, across = _span(cosines * x + sines * y), _span(-sines * x + cosines * y)
    area = (along[1] - along[0]) * (across[1] - across[0])
    best = int(np.argmin(area))
    low, high = np.array([along[0][best], across[0][best]]), np.array([along[1][best], across[1][best]])
    bottom, top = _span(points[None, :, 2])
    center = _turn(angles[best]) @ ((low + high) / 2) + middle
    (length, width), yaw = high - low, float(angles[best])
    if width > length:
        length, width, yaw = width, length, yaw + np.pi / 2 if yaw <= 0 else yaw - np.pi / 2
    height = float(top[0] - bottom[0])
    return Box(np.array([*center, bottom[0] + height / 2]), np.array([length, width, height]), yaw)


def _span(values: Float64) -> tuple[Float64, Float64]:
    """Lower and upper quantile along the last axis, nearest rank."""
    last = values.shape[-1] - 1
    ranks = [round(STRAY_SHARE * last), round((1.0 - STRAY_SHARE) * last)]
    ordered = np.partition(values, ranks, axis=-1)
    return ordered[..., ranks[0]], ordered[..., ranks[1]]


def _turn(yaw_rad: float) -> Float64:
    return np.array([[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]])
