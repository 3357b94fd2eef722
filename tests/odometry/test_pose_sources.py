# SPDX-License-Identifier: Apache-2.0
"""Placement, counters, the sources that need no device, and which source a rig asks for."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pose_collecting import collect

from edge.board_settings import PoseSettings
from edge.config import RigGeometry
from edge.errors import ConfigError, PoseError
from edge.frames import Float64, Pose
from edge.odometry.external import ExternalSource
from edge.odometry.oak import OakSource
from edge.odometry.paced import PacedSource, recorded_source, straight
from edge.odometry.source import Meter, Placement, PoseSource, make_pose_source, quaternion_turn_rad
from edge.odometry.transforms import quaternion, rotation_matrix
from edge.rig import load_rig

NS = 1_000_000_000
GEOMETRY = RigGeometry(yaw_deg=90.0, pitch_deg=5.0, roll_deg=-3.0, offset_m=(1.5, -0.2, 0.8))
MOUNTED = PoseSettings(position_m=(0.3, 0.4, 1.9), roll_deg=12.0, pitch_deg=-20.0, yaw_deg=135.0)


def matrix(yaw_deg: float, pitch_deg: float, roll_deg: float, position_m: tuple[float, float, float]) -> Float64:
    """Homogeneous matrix of Rz Ry Rx, written out."""
    y, p, r = (math.radians(a) for a in (yaw_deg, pitch_deg, roll_deg))
    rz = np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]])
    ry = np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]])
    rx = np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rz @ ry @ rx, position_m
    return out


def as_matrix(pose: Pose) -> Float64:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_matrix(pose.quaternion_xyzw), pose.position_m
    return out


def as_pose(t_ns: int, m: Float64) -> Pose:
    return Pose(t_ns, m[:3, 3].copy(), quaternion(m[:3, :3]))


RIG = matrix(90.0, 5.0, -3.0, (1.5, -0.2, 0.8))
SENSOR = matrix(135.0, -20.0, 12.0, (0.3, 0.4, 1.9))
VEHICLE = matrix(33.0, 2.0, 1.0, (7.0, -4.0, 0.1))


def test_poses_of_a_mounted_sensor_become_poses_of_the_rig() -> None:
    got = Placement(MOUNTED, GEOMETRY).rig(as_pose(5, VEHICLE @ SENSOR))
    np.testing.assert_allclose(as_matrix(got), VEHICLE @ RIG, atol=1e-12)
    assert got.t_ns == 5


def test_visual_odometry_begins_where_the_vehicle_stood() -> None:
    """Its frame is level, at the sensor's place, with the sensor's heading; the vehicle stood level on the ground."""
    start = matrix(135.0, 0.0, 0.0, (0.3, 0.4, 1.9))
    sensor_in_start = np.linalg.inv(start) @ VEHICLE @ SENSOR
    placement = Placement(MOUNTED, GEOMETRY, from_start=True)
    np.testing.assert_allclose(as_matrix(placement.rig(as_pose(5, sensor_in_start))), VEHICLE @ RIG, atol=1e-12)
    at_start = placement.rig(as_pose(1, np.linalg.inv(start) @ SENSOR))
    np.testing.assert_allclose(as_matrix(at_start), RIG, atol=1e-12)


def test_poses_of_the_rig_stay() -> None:
    pose = as_pose(5, VEHICLE)
    assert Placement(replace(MOUNTED, poses_of="rig"), GEOMETRY).rig(pose) is pose


def test_an_oak_gives_poses_of_the_sensor_only() -> None:
    with pytest.raises(ConfigError, match="poses_of"):
        PoseSettings(kind="oak", poses_of="rig")


def test_turn_between_poses() -> None:
    a, b = as_pose(0, matrix(10.0, 0, 0, (0, 0, 0))), as_pose(1, matrix(-35.0, 0, 0, (0, 0, 0)))
    assert quaternion_turn_rad(a, b) == pytest.approx(math.radians(45.0))
    assert quaternion_turn_rad(a, Pose(1, a.position_m, -a.quaternion_xyzw)) == pytest.approx(0.0, abs=1e-7)


def at(t_ns: int) -> Pose:
    return Pose(t_ns, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def test_meter_counts_refuses_and_takes_the_rate() -> None:
    now = [10 * NS]
    meter = Meter(0.5, lambda: now[0])
    assert meter.health().age_s(now[0]) == math.inf
    times = [10 * NS - (10 - n) * NS // 50 for n in range(10)]
    assert all(meter.accept(at(t_ns)) for t_ns in times)
    assert not meter.accept(at(times[-1]))  # the same again
    assert not meter.accept(at(times[0]))  # older
    assert not meter.accept(at(now[0] + NS))  # of the future
    health = meter.health()
    assert (health.poses, health.refused, health.last_pose_ns) == (10, 3, times[-1])
    assert health.rate_hz == pytest.approx(50.0)
    assert health.age_s(now[0]) == pytest.approx(0.02)
    now[0] += NS
    assert meter.health().rate_hz == 0.0


def test_constant_velocity_is_exact_along_the_vehicles_axis() -> None:
    rig = load_rig("cascade_pair")
    settings = PoseSettings(kind="constant", speed_m_s=3.0, rate_hz=500.0, position_m=(9.0, 9.0, 9.0), yaw_deg=50.0)
    rig = replace(rig, pose=settings, geometry=GEOMETRY)
    source = make_pose_source(rig)
    assert isinstance(source, PacedSource)
    assert isinstance(source, PoseSource)
    assert source.poll(0.0) == []
    source.start()
    got = collect(source, lambda c: len(c.poses) >= 100)
    source.close()
    assert got.kinds == ["started"]
    first = got.poses[0]
    for number, pose in enumerate(got.poses):
        assert pose.t_ns - first.t_ns == number * NS // 500
        x_m = 3.0 * (pose.t_ns - first.t_ns) / NS
        np.testing.assert_allclose(as_matrix(pose), matrix(0, 0, 0, (x_m, 0, 0)) @ RIG, atol=1e-9)
    assert source.poll(0.01) == []
    assert source.health.state == "ended"


def test_constant_poses_keep_their_grid_for_an_hour() -> None:
    poses = straight(PoseSettings(kind="constant", rate_hz=60.0))
    last = [next(poses) for _ in range(60 * 60 + 1)][-1]
    assert last.t_ns == 60 * NS


def file_of(folder: Path, lines: list[str]) -> PoseSettings:
    (folder / "poses.csv").write_text("\n".join(lines) + "\n", encoding="ascii")
    return PoseSettings(kind="recorded", file="poses.csv", poses_of="rig")


def test_recorded_poses_come_at_their_pace_moved_to_now(tmp_path: Path) -> None:
    times = [123, 123 + NS // 50, 123 + NS // 10]
    settings = file_of(tmp_path, [f"{t},{n},0,0.8,0,0,0,1" for n, t in enumerate(times)])
    source = recorded_source(settings, GEOMETRY, tmp_path)
    source.start()
    got = collect(source, lambda c: "ended" in c.kinds)
    assert [pose.t_ns - got.poses[0].t_ns for pose in got.poses] == [t - 123 for t in times]
    assert [pose.position_m[0] for pose in got.poses] == [0.0, 1.0, 2.0]
    assert got.kinds == ["started", "ended"]
    assert source.health.poses == 3
    source.close()


def test_a_bad_line_is_named_after_the_poses_before_it(tmp_path: Path) -> None:
    settings = file_of(tmp_path, ["1,0,0,0,0,0,0,1", "2,0,0,0,0,0,0,1", "3,nonsense"])
    source = recorded_source(settings, GEOMETRY, tmp_path)
    source.start()
    got = collect(source, lambda c: len(c.poses) == 2)
    with pytest.raises(PoseError, match="line 3"):
        source.poll(0.0)
    assert source.poll(0.0) == []
    assert len(got.poses) == 2


@pytest.mark.parametrize("lines", [["# nothing"], ["1,2"]])
def test_a_file_without_poses_does_not_start(tmp_path: Path, lines: list[str]) -> None:
    source = recorded_source(file_of(tmp_path, lines), GEOMETRY, tmp_path)
    with pytest.raises(PoseError, match=r"poses\.csv"):
        source.start()


def test_a_missing_file_does_not_start(tmp_path: Path) -> None:
    source = recorded_source(PoseSettings(kind="recorded", file="none.csv"), GEOMETRY, tmp_path)
    with pytest.raises(PoseError, match=r"none\.csv"):
        source.start()


def test_the_rig_says_which_source(tmp_path: Path) -> None:
    rig = load_rig("cascade_pair")
    assert make_pose_source(replace(rig, pose=PoseSettings())) is None
    assert isinstance(make_pose_source(replace(rig, pose=PoseSettings(kind="oak"))), OakSource)
    assert isinstance(make_pose_source(replace(rig, pose=PoseSettings(kind="zmq"))), ExternalSource)
    recorded = make_pose_source(replace(rig, pose=PoseSettings(kind="recorded", file="a.csv"), directory=tmp_path))
    assert recorded is not None
    assert str(tmp_path / "a.csv") in recorded.name
    for source in (recorded, OakSource(PoseSettings(kind="oak"), GEOMETRY)):
        source.close()  # never started
        assert source.poll(0.0) == []
