# SPDX-License-Identifier: Apache-2.0
"""Poses continued after the newest one: exact on straight and even drives, bounded on others, never far ahead."""

from __future__ import annotations

import numpy as np
import pytest

from edge.errors import ConfigError, PoseError
from edge.frames import Float64, Pose
from edge.odometry.track import VELOCITY_SPAN_S, PoseTrack
from edge.odometry.transforms import extrapolate

MS = 1_000_000
STEP_NS = 10 * MS
LAST_NS = 50 * STEP_NS


def yaw(angle_rad: float) -> Float64:
    return np.array([0.0, 0.0, np.sin(angle_rad / 2), np.cos(angle_rad / 2)])


def circle(t_ns: int) -> Pose:
    """Radius 5 m, 1 rad/s, looking along the track."""
    angle = 1e-9 * t_ns
    return Pose(t_ns, 5 * np.array([np.cos(angle), np.sin(angle), 0.0]), yaw(angle + np.pi / 2))


def straight(t_ns: int) -> Pose:
    return Pose(t_ns, np.array([2e-9 * t_ns, 1.0, 0.8]), yaw(0.3))


def track_of(pose_at: object, ahead_s: float = 0.04) -> PoseTrack:
    track = PoseTrack(max_gap_s=0.1, ahead_s=ahead_s)
    for n in range(51):
        track.add(pose_at(n * STEP_NS))  # type: ignore[operator]
    return track


@pytest.mark.parametrize("ahead_ns", [1, 5 * MS, 40 * MS])
def test_a_straight_drive_goes_on(ahead_ns: int) -> None:
    track = track_of(straight)
    pose, velocity = track.at(LAST_NS + ahead_ns), track.velocity_rig_m_s(LAST_NS + ahead_ns)
    assert pose is not None
    assert velocity is not None
    assert pose.t_ns == LAST_NS + ahead_ns
    np.testing.assert_allclose(pose.position_m, straight(LAST_NS + ahead_ns).position_m, atol=1e-12)
    np.testing.assert_allclose(velocity, [2.0 * np.cos(0.3), -2.0 * np.sin(0.3), 0.0], atol=1e-9)


def test_a_turn_goes_on_within_half_the_acceleration_times_the_time_squared() -> None:
    """Error of the secant: v^2 / r = 5 m/s^2 over the span and the time ahead: a (s t + t^2) / 2; the turn is exact."""
    track = track_of(circle)
    for ahead_ns in (10 * MS, 40 * MS):
        pose, true = track.at(LAST_NS + ahead_ns), circle(LAST_NS + ahead_ns)
        assert pose is not None
        t_s = 1e-9 * ahead_ns
        limit_m = 5.0 * (VELOCITY_SPAN_S * t_s + t_s**2) / 2
        assert 0.5 * limit_m < np.linalg.norm(pose.position_m - true.position_m) < 1.01 * limit_m
        assert abs(pose.quaternion_xyzw @ true.quaternion_xyzw) == pytest.approx(1.0, abs=1e-12)


def test_not_farther_and_not_unless_asked() -> None:
    track = track_of(straight)
    assert track.at(LAST_NS + 40 * MS + 1) is None
    assert track.velocity_rig_m_s(LAST_NS + 40 * MS + 1) is None
    assert "after last pose" in track.why_none(LAST_NS + 41 * MS)
    assert track_of(straight, ahead_s=0.0).at(LAST_NS + 1) is None


def test_a_pose_alone_behind_a_gap_is_not_continued() -> None:
    track = PoseTrack(max_gap_s=0.1, ahead_s=0.04)
    assert track.at(0) is None
    track.add(straight(0))
    assert track.at(1) is None
    track.add(straight(500 * MS))
    assert track.at(501 * MS) is None
    assert track.velocity_rig_m_s(501 * MS) is None
    track.add(straight(510 * MS))
    pose = track.at(515 * MS)
    assert pose is not None
    np.testing.assert_allclose(pose.position_m, straight(515 * MS).position_m, atol=1e-12)


def test_bad_arguments() -> None:
    with pytest.raises(ConfigError, match="ahead_s"):
        PoseTrack(max_gap_s=0.1, ahead_s=0.2)
    for t_ns in (0, 9 * MS):
        with pytest.raises(PoseError, match="extrapolate"):
            extrapolate(straight(0), straight(10 * MS), t_ns)
