# SPDX-License-Identifier: Apache-2.0
"""Rigid-body transforms against closed forms: axis rotations, the rotation vector's exponential, group laws."""

from __future__ import annotations

import numpy as np
import pytest

from edge.errors import PoseError
from edge.frames import Float64, Pose
from edge.odometry.transforms import (
    compose,
    interpolate,
    inverse,
    multiply,
    quaternion,
    rotation_matrix,
    slerp,
    transform_points,
)

ANGLES_RAD = (0.0, 1e-9, 1e-4, 0.3, np.pi / 2, np.pi - 1e-7, np.pi)


def about(axis: Float64, angle_rad: float) -> Float64:
    """Quaternion of a rotation about a unit axis."""
    return np.append(np.sin(angle_rad / 2) * axis, np.cos(angle_rad / 2))


def yaw(angle_rad: float) -> Float64:
    return about(np.array([0.0, 0.0, 1.0]), angle_rad)


def rodrigues(axis: Float64, angle_rad: float) -> Float64:
    """Rotation matrix from the axis' cross-product matrix, independent of quaternions."""
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle_rad) * k + (1 - np.cos(angle_rad)) * k @ k


def random_axis(rng: np.random.Generator) -> Float64:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def test_yaw_of_90_degrees_turns_forward_to_the_left() -> None:
    np.testing.assert_allclose(rotation_matrix(yaw(np.pi / 2)) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_matrix_and_quaternion_agree_with_rodrigues(angle_rad: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        axis = random_axis(rng)
        matrix = rodrigues(axis, angle_rad)
        np.testing.assert_allclose(rotation_matrix(about(axis, angle_rad)), matrix, atol=1e-14)
        found = quaternion(matrix)
        assert abs(abs(found @ about(axis, angle_rad)) - 1) < 1e-14
        assert found[3] >= 0
        np.testing.assert_allclose(rotation_matrix(found), matrix, atol=1e-14)


@pytest.mark.parametrize(
    "matrix", [np.diag([1.0, 1.0, -1.0]), 2 * np.eye(3), np.full((3, 3), np.nan), np.zeros((3, 3)), np.eye(4)]
)
def test_what_is_no_rotation_is_refused(matrix: Float64) -> None:
    with pytest.raises(PoseError, match="no rotation"):
        quaternion(matrix)


def test_quaternion_without_direction_is_refused() -> None:
    with pytest.raises(PoseError, match="no direction"):
        rotation_matrix(np.zeros(4))


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.75, 1.0])
@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
@pytest.mark.parametrize("angle_rad", [0.0, 1e-8, 3e-5, 0.02, 1.0, 3.0])
def test_slerp_turns_at_constant_rate_the_short_way(share: float, signs: tuple[int, int], angle_rad: float) -> None:
    axis = random_axis(np.random.default_rng(2))
    found = slerp(signs[0] * about(axis, 0.4), signs[1] * about(axis, 0.4 + angle_rad), share)
    np.testing.assert_allclose(found, signs[0] * about(axis, 0.4 + share * angle_rad), atol=2e-15)


def test_compose_applies_the_second_first_and_inverse_undoes_it() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        a = Pose(1, rng.normal(size=3), about(random_axis(rng), rng.uniform(-3, 3)))
        b = Pose(2, rng.normal(size=3), about(random_axis(rng), rng.uniform(-3, 3)))
        points = rng.normal(size=(5, 3))
        expected = transform_points(a, transform_points(b, points))
        np.testing.assert_allclose(transform_points(compose(a, b), points), expected, atol=1e-13)
        assert compose(a, b).t_ns == 2
        np.testing.assert_allclose(transform_points(inverse(a), transform_points(a, points)), points, atol=1e-13)
        product = rotation_matrix(multiply(a.quaternion_xyzw, b.quaternion_xyzw))
        np.testing.assert_allclose(
            product, rotation_matrix(a.quaternion_xyzw) @ rotation_matrix(b.quaternion_xyzw), atol=1e-14
        )


def test_known_transform() -> None:
    pose = Pose(0, np.array([10.0, 20.0, 1.0]), yaw(np.pi / 2))
    found = transform_points(pose, np.array([[2.0, 0.0, 0.5]], np.float32))
    np.testing.assert_allclose(found, [[10.0, 22.0, 1.5]], atol=1e-12)
    assert found.dtype == np.float64


def test_interpolation_is_exact_at_the_ends_and_with_times_near_2_to_the_62() -> None:
    t0 = 2**62 + 1
    a, b = Pose(t0, np.zeros(3), yaw(0.0)), Pose(t0 + 8, np.array([8.0, -4.0, 2.0]), -yaw(0.8))
    assert interpolate(a, b, t0) is a
    assert interpolate(a, b, t0 + 8) is b
    middle = interpolate(a, b, t0 + 3)  # float64 steps are 1024 ns here
    assert middle.t_ns == t0 + 3
    np.testing.assert_allclose(middle.position_m, [3.0, -1.5, 0.75], rtol=1e-15)
    np.testing.assert_allclose(middle.quaternion_xyzw, yaw(0.3), atol=1e-15)


@pytest.mark.parametrize("t_ns", [9, 21])
def test_no_extrapolation(t_ns: int) -> None:
    a, b = Pose(10, np.zeros(3), yaw(0.0)), Pose(20, np.ones(3), yaw(0.0))
    with pytest.raises(PoseError, match="cannot interpolate"):
        interpolate(a, b, t_ns)
    with pytest.raises(PoseError, match="cannot interpolate"):
        interpolate(b, a, 15)
