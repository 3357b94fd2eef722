# SPDX-License-Identifier: Apache-2.0
"""Reported poses: truth without errors, statistics of the walks, stamps, mounting."""

from __future__ import annotations

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.frames import Pose
from edge.odometry.transforms import rotation_matrix
from train.simulate.odometry_error import OdometrySettings, reported_poses

PERIOD_NS = 20_000_000
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def drive(settings: OdometrySettings, count: int = 301, step_m: float = 0.01, seed: int = 0) -> list[Pose]:
    stamps = PERIOD_NS * np.arange(count)
    position_m = np.column_stack((step_m * np.arange(count), np.zeros(count), np.full(count, 0.8)))
    return reported_poses(stamps, position_m, np.tile(IDENTITY, (count, 1)), settings, np.random.default_rng(seed))


def test_no_error_reports_the_truth() -> None:
    poses = drive(OdometrySettings.none())
    assert [p.t_ns for p in poses[:3]] == [0, PERIOD_NS, 2 * PERIOD_NS]
    np.testing.assert_allclose([p.position_m for p in poses], [[0.01 * k, 0, 0.8] for k in range(301)], atol=1e-12)
    np.testing.assert_allclose([p.quaternion_xyzw for p in poses], np.tile(IDENTITY, (301, 1)), atol=1e-12)


def test_position_walks_with_the_root_of_the_path() -> None:
    settings = OdometrySettings(walk_m=0.006, height_walk_m=0.002, yaw_walk_deg=0.0, tilt_deg=0.0)
    ends = np.array([drive(settings, 101, 0.04, seed)[-1].position_m for seed in range(400)])
    # 4 m of path: standard deviations 2 * 6 mm, 2 * 2 mm; of 400 draws within 3.5 standard errors
    np.testing.assert_allclose(ends.std(axis=0), [0.012, 0.012, 0.004], rtol=3.5 / np.sqrt(800))
    np.testing.assert_allclose(ends.mean(axis=0), [4.0, 0.0, 0.8], atol=0.003)


def test_yaw_bends_the_path_that_follows() -> None:
    settings = OdometrySettings(walk_m=0.0, height_walk_m=0.0, yaw_walk_deg=0.5, tilt_deg=0.0)
    ends = [drive(settings, 101, 0.04, seed)[-1] for seed in range(400)]
    yaw = np.array([2.0 * np.arctan2(p.quaternion_xyzw[2], p.quaternion_xyzw[3]) for p in ends])
    aside_m = np.array([p.position_m[1] for p in ends])
    # Wiener process w over path s: std w(s) = sigma sqrt(s), std of its integral sigma s^1.5 / sqrt(3)
    np.testing.assert_allclose(np.degrees(yaw.std()), 0.5 * 2.0, rtol=3.5 / np.sqrt(800))
    np.testing.assert_allclose(aside_m.std(), np.radians(0.5) * 4.0**1.5 / np.sqrt(3.0), rtol=0.14)


def test_tilt_has_its_rms_and_correlation_time_and_moves_nothing() -> None:
    settings = OdometrySettings(walk_m=0.0, height_walk_m=0.0, yaw_walk_deg=0.0, tilt_deg=0.2, tilt_s=0.5)
    poses = drive(settings, 20001, 0.0)
    roll = np.degrees(2.0 * np.array([p.quaternion_xyzw[0] for p in poses]))
    assert roll.std() == pytest.approx(0.2, rel=0.15)
    lag = 25  # 0.5 s
    correlation = float(np.mean(roll[lag:] * roll[:-lag]) / np.mean(roll**2))
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.12)
    np.testing.assert_allclose([p.position_m for p in poses], [[0.0, 0.0, 0.8]] * len(poses), atol=1e-12)


def test_mounting_turns_about_the_rig_and_shifts_along_its_axes() -> None:
    settings = OdometrySettings(
        0.0, 0.0, 0.0, 0.0, mounting_deg=(0.0, 0.0, 90.0), mounting_m=(0.1, 0.0, 0.0), time_offset_s=0.01
    )
    pose = drive(settings, 2)[0]
    rotation = rotation_matrix(pose.quaternion_xyzw)
    np.testing.assert_allclose(rotation @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(pose.position_m, [0.0, 0.1, 0.8], atol=1e-12)


def test_same_seed_same_poses_and_impossible_values_are_refused() -> None:
    a, b, c = (drive(OdometrySettings(), seed=seed)[-1].position_m for seed in (3, 3, 4))
    assert (a == b).all()
    assert (a != c).any()
    with pytest.raises(ConfigError, match="tilt_s"):
        OdometrySettings(tilt_s=0.0)
    with pytest.raises(ConfigError, match="walk_m"):
        OdometrySettings(walk_m=-1.0)
