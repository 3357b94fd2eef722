# SPDX-License-Identifier: Apache-2.0
"""The line-of-sight frame of the completion network: x horizontal and away from the sensor, z up from the ground.

A flat side does not say which side is behind; where the sensor stood does. Origin and heights are those of the points:
the ground is z = 0, and x and y are centred inside the network.
"""

from __future__ import annotations

import math

import numpy as np

from edge.errors import ModelError
from edge.frames import Float32, Float64

LEAST_DISTANCE_M = 0.01
"""Horizontal distance below which the sensor counts as above the object: there is no direction of sight."""


def bearing_rad(name: str, sensor_m: Float64, xyz_m: Float32) -> float:
    """Horizontal direction of sight, from the sensor to the mean of the points.

    Args:
        name: of the object, for the error.
        sensor_m: float64 [3], mean position of the sensor, in the frame of the points.
        xyz_m: float32 [n, 3], n >= 1, z up.
    Returns:
        Angle about z from the frame's x axis, -pi..pi.
    Raises:
        ModelError: the sensor's position is not finite, or the sensor stands above the points.
    """
    if sensor_m.shape != (3,) or not np.isfinite(sensor_m).all():
        raise ModelError(
            f"{name}: where the sensor stood is not known, so there is no line of sight",
            value=sensor_m.tolist(),
            allowed="three finite coordinates in metres",
            action="give the mean position of the rig over the window (sensor_m)",
        )
    x_m, y_m = xyz_m[:, :2].mean(axis=0, dtype=np.float64) - sensor_m[:2]
    if not math.hypot(x_m, y_m) >= LEAST_DISTANCE_M:
        raise ModelError(
            f"{name}: the sensor stands above it, so there is no line of sight",
            value=f"{math.hypot(x_m, y_m):.3g} m from the middle of its points",
            allowed=f">= {LEAST_DISTANCE_M} m, horizontally",
            action="check the poses of this window",
        )
    return math.atan2(y_m, x_m)


def turned(xyz_m: Float32, angle_rad: float) -> Float32:
    """Points turned about z, x towards y; float32 [n, 3]. By minus the bearing: into the line-of-sight frame."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    rotation = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], np.float32)
    return np.ascontiguousarray(xyz_m @ rotation)
