# SPDX-License-Identifier: Apache-2.0
"""Poses of the rig from poses of the vehicle that carries it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from edge.config import RigGeometry
from edge.frames import Float64, Pose
from edge.odometry.transforms import compose, inverse, multiply


def rig_in_vehicle(geometry: RigGeometry) -> tuple[Float64, Float64]:
    """Where the rig is in the vehicle frame (base_link; REP-103: x forward, y left, z up).

    Args:
        geometry: offset and angles of the rig.
    Returns:
        Position float64 [3] in metres; quaternion float64 [4] of Rz(yaw) Ry(pitch) Rx(roll), so that positive pitch
        looks down, as edge/fusion/association.py has it.
    """
    turns = []
    for axis, angle_deg in ((2, geometry.yaw_deg), (1, geometry.pitch_deg), (0, geometry.roll_deg)):
        half = math.radians(angle_deg) / 2.0
        turn = np.array([0.0, 0.0, 0.0, math.cos(half)])
        turn[axis] = math.sin(half)
        turns.append(turn)
    yaw, pitch, roll = turns
    return np.array(geometry.offset_m, dtype=np.float64), multiply(yaw, multiply(pitch, roll))


def rig_poses(vehicle_poses: Iterable[Pose], geometry: RigGeometry) -> Iterator[Pose]:
    """Poses of the rig: each vehicle pose followed by the rig's place in the vehicle, at the same instant."""
    position_m, quaternion_xyzw = rig_in_vehicle(geometry)
    for pose in vehicle_poses:
        yield compose(pose, Pose(pose.t_ns, position_m, quaternion_xyzw))


def in_vehicle(pose: Pose, rig: Pose, geometry: RigGeometry) -> Pose:
    """A frame of the odometry frame as the vehicle sees it.

    Args:
        pose: of that frame in the odometry frame.
        rig: of the rig in the odometry frame, at the instant that is asked about.
        geometry: how the rig stands on the vehicle.
    Returns:
        Its pose in the vehicle frame (base_link), at the instant of ``rig``.
    """
    mounted = Pose(rig.t_ns, *rig_in_vehicle(geometry))
    seen = Pose(rig.t_ns, pose.position_m, pose.quaternion_xyzw)
    return compose(mounted, compose(inverse(rig), seen))
