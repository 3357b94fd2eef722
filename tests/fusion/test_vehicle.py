# SPDX-License-Identifier: Apache-2.0
"""The rig's pose from the vehicle's, against figures worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from edge.config import RigGeometry
from edge.frames import Pose
from edge.fusion.association import up_in_rig
from edge.odometry.transforms import rotation_matrix, transform_points
from edge.odometry.vehicle import rig_in_vehicle, rig_poses

HALF = np.sqrt(0.5)


def test_a_rig_that_looks_left_on_a_vehicle_that_drives_north() -> None:
    """Vehicle at (10, 20) turned to +y; the rig, 1 m ahead of it and 0.5 m to its left, looks to its left: -x."""
    geometry = RigGeometry(yaw_deg=90.0, offset_m=(1.0, 0.5, 0.8))
    vehicle = Pose(7, np.array([10.0, 20.0, 0.0]), np.array([0.0, 0.0, HALF, HALF]))
    (rig,) = rig_poses([vehicle], geometry)
    assert rig.t_ns == 7
    np.testing.assert_allclose(rig.position_m, [9.5, 21.0, 0.8], atol=1e-12)
    np.testing.assert_allclose(transform_points(rig, np.array([[2.0, 0.0, 0.0]])), [[7.5, 21.0, 0.8]], atol=1e-12)


@pytest.mark.parametrize(
    ("turn", "forward", "left"),
    [
        ({"yaw_deg": 90.0}, [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]),
        ({"pitch_deg": 90.0}, [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]),
        ({"roll_deg": 90.0}, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
        ({"yaw_deg": 90.0, "pitch_deg": 90.0}, [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]),
        ({"yaw_deg": 90.0, "roll_deg": 90.0}, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
    ],
)
def test_axes_of_the_rig_in_the_vehicle(turn: dict[str, float], forward: list[float], left: list[float]) -> None:
    _, quaternion = rig_in_vehicle(RigGeometry(**{"yaw_deg": 0.0, **turn}))  # type: ignore[arg-type]
    matrix = rotation_matrix(quaternion)
    np.testing.assert_allclose(matrix[:, 0], forward, atol=1e-12)
    np.testing.assert_allclose(matrix[:, 1], left, atol=1e-12)


def test_up_is_where_the_association_has_it() -> None:
    geometry = RigGeometry(yaw_deg=35.0, pitch_deg=-8.0, roll_deg=4.0)
    _, quaternion = rig_in_vehicle(geometry)
    np.testing.assert_allclose(rotation_matrix(quaternion)[2], up_in_rig(geometry), atol=1e-12)


def test_a_rig_at_the_vehicles_origin_changes_nothing() -> None:
    pose = Pose(3, np.array([1.0, 2.0, 3.0]), np.array([0.6, 0.0, 0.0, 0.8]))
    (same,) = rig_poses([pose], RigGeometry(yaw_deg=0.0, offset_m=(0.0, 0.0, 0.0)))
    np.testing.assert_allclose(same.position_m, pose.position_m, atol=1e-15)
    np.testing.assert_allclose(same.quaternion_xyzw, pose.quaternion_xyzw, atol=1e-15)
