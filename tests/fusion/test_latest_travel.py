# SPDX-License-Identifier: Apache-2.0
"""The newest travel as a sliding window beside the windows that close; an object as the vehicle sees it; its age."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.config import FusionSettings, ObjectSettings, RigGeometry
from edge.frames import Float64, PointCloud, Pose
from edge.fusion.objects import ObjectTracker
from edge.fusion.temporal import TemporalFusion
from edge.odometry.transforms import compose, rotation_matrix, transform_points
from edge.odometry.vehicle import in_vehicle, rig_in_vehicle

PERIOD_NS = 20_000_000
STEP_M = 0.05
SETTINGS = FusionSettings(travel_m=1.0, hop_m=0.5, min_frames=10, max_time_s=5.0)
LEFT = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
THING_ODOM_M = np.array([[x, 3.0 + y, 0.3 + z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)])


def pose_at(n: int, step_m: float = STEP_M) -> Pose:
    return Pose(n * PERIOD_NS, np.array([step_m * n, 0.0, 0.8]), LEFT.copy())


def cloud_at(n: int, pose: Pose, points_odom_m: Float64 = THING_ODOM_M) -> PointCloud:
    seen_m = ((points_odom_m - pose.position_m) @ rotation_matrix(pose.quaternion_xyzw)).astype(np.float32)
    zero = np.zeros(len(seen_m), np.float32)
    return PointCloud(n, pose.t_ns, seen_m, zero, zero, zero)


def driven(frames: int, step_m: float = STEP_M, settings: FusionSettings = SETTINGS) -> TemporalFusion:
    fusion = TemporalFusion(settings)
    for n in range(frames):
        fusion.add(cloud_at(n, pose_at(n, step_m)), pose_at(n, step_m))
    return fusion


def test_it_slides_where_the_others_hop() -> None:
    fusion = TemporalFusion(SETTINGS)
    assert fusion.latest() is None
    for n in range(80):
        fusion.add(cloud_at(n, pose_at(n)), pose_at(n))
        newest = fusion.latest()
        assert newest is not None
        first = max(n - 20, 0)
        assert newest.frames == n - first + 1
        assert newest.reference.t_ns == first * PERIOD_NS
        assert newest.travel_m == pytest.approx(STEP_M * (n - first))
        assert newest.complete == (n >= 20)
        assert (newest.frame_number.min(), newest.frame_number.max()) == (first, n)
        assert newest.last is not None
        assert newest.last.t_ns == newest.t_end_ns == n * PERIOD_NS


def test_what_closes_by_travel_is_the_newest_travel() -> None:
    fusion, closed = TemporalFusion(SETTINGS), 0
    for n in range(100):
        window = fusion.add(cloud_at(n, pose_at(n)), pose_at(n))
        newest = fusion.latest()
        if window is not None and newest is not None:
            closed += 1
            np.testing.assert_array_equal(window.xyz_m, newest.xyz_m)
            np.testing.assert_array_equal(window.frame_number, newest.frame_number)
            np.testing.assert_array_equal(window.sensor_m, newest.sensor_m)
            assert (window.frames, window.complete) == (newest.frames, newest.complete)
    assert closed == 8


def test_looking_changes_nothing() -> None:
    seen, unseen = TemporalFusion(SETTINGS), TemporalFusion(SETTINGS)
    for n in range(60):
        a = seen.add(cloud_at(n, pose_at(n)), pose_at(n))
        b = unseen.add(cloud_at(n, pose_at(n)), pose_at(n))
        seen.latest()
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            np.testing.assert_array_equal(a.xyz_m, b.xyz_m)


def test_standing_it_is_as_old_as_a_window_may_be_and_never_complete() -> None:
    newest = driven(400, step_m=0.0).latest()
    assert newest is not None
    assert newest.t_end_ns - newest.t_start_ns == 5_000_000_000
    assert not newest.complete


def test_it_does_not_reach_over_a_gap_or_a_flush() -> None:
    fusion = driven(30)
    far = Pose(40 * PERIOD_NS, np.array([3.0, 0.0, 0.8]), LEFT.copy())
    fusion.add(cloud_at(40, far), far)
    newest = fusion.latest()
    assert newest is not None
    assert newest.frames == 1
    fusion.flush()
    assert fusion.latest() is None


def test_points_that_were_overwritten_make_it_incomplete() -> None:
    settings = replace(SETTINGS, capacity=1024)
    fusion = TemporalFusion(settings)
    many = np.repeat(THING_ODOM_M, 10, axis=0)
    for n in range(40):
        fusion.add(cloud_at(n, pose_at(n), many), pose_at(n))
    newest = fusion.latest()
    assert newest is not None
    assert len(newest) == 1024
    assert not newest.complete


def test_the_vehicle_sees_what_the_rig_sees() -> None:
    geometry = RigGeometry(height_m=0.8, yaw_deg=80.0, pitch_deg=5.0, roll_deg=-3.0, offset_m=(0.4, 0.2, 0.8))
    vehicle = Pose(7, np.array([10.0, -4.0, 0.0]), np.array([0.0, 0.0, np.sin(0.35), np.cos(0.35)]))
    rig = compose(vehicle, Pose(7, *rig_in_vehicle(geometry)))
    thing = Pose(3, np.array([12.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    seen = in_vehicle(thing, rig, geometry)
    assert seen.t_ns == 7
    points_m = np.random.default_rng(0).normal(0, 2, (20, 3))
    np.testing.assert_allclose(
        transform_points(vehicle, transform_points(seen, points_m)), transform_points(thing, points_m), atol=1e-9
    )


def test_objects_know_their_age_and_place_beside_the_vehicle() -> None:
    tracker = ObjectTracker(ObjectSettings(min_points=4, core_points=2), RigGeometry())
    fusion, ages, sides = TemporalFusion(SETTINGS), list[float](), list[float]()
    for n in range(60):
        fusion.add(cloud_at(n, pose_at(n)), pose_at(n))
        if n >= 9 and n % 10 == 9:
            newest = fusion.latest()
            assert newest is not None
            (thing,) = tracker.process(newest)
            ages.append(thing.age_s)
            assert thing.pose_vehicle is not None
            sides.append(float(thing.pose_vehicle.position_m[1]))
            np.testing.assert_allclose(thing.pose_vehicle.position_m[0], 0.05 - STEP_M * n, atol=1e-6)
    np.testing.assert_allclose(ages, 0.2 * np.arange(6))
    np.testing.assert_allclose(sides, 3.05, atol=1e-6)
