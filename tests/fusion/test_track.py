# SPDX-License-Identifier: Apache-2.0
"""The pose track against tracks known in closed form, and the recorded-pose reader against good and bad lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.errors import ConfigError, PoseError
from edge.frames import Float64, Pose
from edge.odometry.recorded import parse_poses, read_poses
from edge.odometry.track import PoseTrack

MS = 1_000_000
HEADER = b"t_ns,x,y,z,qx,qy,qz,qw\n"


def yaw(angle_rad: float) -> Float64:
    return np.array([0.0, 0.0, np.sin(angle_rad / 2), np.cos(angle_rad / 2)])


def straight(start_ns: int, count: int, step_ns: int = 10 * MS, heading_rad: float = 0.5) -> PoseTrack:
    """Drive at 2 m/s along ``heading_rad`` while the rig looks along it."""
    track = PoseTrack(max_gap_s=0.1)
    for n in range(count):
        along_m = 2.0 * n * step_ns * 1e-9
        position_m = along_m * np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
        track.add(Pose(start_ns + n * step_ns, position_m, yaw(heading_rad) * (-1) ** n))
    return track


@pytest.mark.parametrize("start_ns", [0, 2**62])
def test_constant_velocity(start_ns: int) -> None:
    track = straight(start_ns, 20)
    for offset_ns in (0, 1, 3 * MS, 5 * MS + 1, 95 * MS, 190 * MS):
        pose = track.at(start_ns + offset_ns)
        assert pose is not None
        assert pose.t_ns == start_ns + offset_ns
        along_m = 2e-9 * offset_ns
        np.testing.assert_allclose(pose.position_m, [along_m * np.cos(0.5), along_m * np.sin(0.5), 0.0], atol=1e-12)
        assert abs(pose.quaternion_xyzw @ yaw(0.5)) == pytest.approx(1.0, abs=1e-14)
        velocity = track.velocity_rig_m_s(start_ns + offset_ns)
        assert velocity is not None
        np.testing.assert_allclose(velocity, [2.0, 0.0, 0.0], atol=1e-9)


def test_constant_turn() -> None:
    """A circle of radius 5 m at 1 rad/s: chord error r w^2 dt^2 / 8, velocity shortened by sinc(w span / 2)."""
    track = PoseTrack(max_gap_s=0.1)
    for n in range(101):
        angle = 0.01 * n
        track.add(Pose(n * 10 * MS, 5 * np.array([np.cos(angle), np.sin(angle), 0.0]), yaw(angle + np.pi / 2)))
    t_ns = 505 * MS
    pose, velocity = track.at(t_ns), track.velocity_rig_m_s(t_ns)
    assert pose is not None
    assert velocity is not None
    np.testing.assert_allclose(pose.position_m, 5 * np.array([np.cos(0.505), np.sin(0.505), 0.0]), atol=5 * 1e-4 / 8)
    np.testing.assert_allclose(pose.quaternion_xyzw, yaw(0.505 + np.pi / 2), atol=1e-14)
    np.testing.assert_allclose(velocity, [5.0, 0.0, 0.0], atol=5 * 0.025**2 / 6 + 1e-4)


def test_velocity_averages_pose_noise() -> None:
    rng = np.random.default_rng(0)
    track = PoseTrack(max_gap_s=0.1)
    for n in range(400):
        track.add(Pose(n * 10 * MS, np.array([0.02 * n, 0.0, 0.0]) + 1e-3 * rng.normal(size=3), yaw(0.0)))
    speeds = [velocity[0] for n in range(40, 360) if (velocity := track.velocity_rig_m_s(n * 10 * MS)) is not None]
    assert len(speeds) == 320
    assert np.mean(speeds) == pytest.approx(2.0, abs=2e-3)
    assert np.std(speeds) < 1e-3 * np.sqrt(2) / 0.05 * 1.1  # 1 mm each at both ends of 50 ms


def test_a_sample_is_returned_as_it_is() -> None:
    track = straight(0, 3)
    pose = track.at(10 * MS)
    assert pose is not None
    np.testing.assert_array_equal(pose.quaternion_xyzw, -yaw(0.5))


def test_unknown_instants_and_their_reasons() -> None:
    track = PoseTrack(max_gap_s=0.1)
    assert track.at(0) is None
    assert track.why_none(0) == "no pose yet"
    for t_ms in (100, 200, 301, 600):
        track.add(Pose(t_ms * MS, np.zeros(3), yaw(0.0)))
    expected = {
        99: "0.001 s before first pose",
        250: "gap of 0.101 s between poses, more than 0.100 s",
        500: "gap of 0.299 s between poses, more than 0.100 s",
        650: "0.050 s after last pose",
    }
    for t_ms, reason in expected.items():
        assert track.at(t_ms * MS) is None
        assert track.velocity_rig_m_s(t_ms * MS) is None
        assert track.why_none(t_ms * MS) == reason
    assert track.at(150 * MS) is not None  # a gap of exactly max_gap_s is bridged
    assert track.why_none(150 * MS) == ""
    assert track.at(301 * MS) is not None  # a lone sample has a pose but no velocity
    assert track.velocity_rig_m_s(301 * MS) is None


def test_velocity_does_not_reach_over_a_gap() -> None:
    track = PoseTrack(max_gap_s=0.015)
    for t_ms, x_m in ((0, 0.0), (10, 0.01), (30, 5.0), (40, 5.03)):
        track.add(Pose(t_ms * MS, np.array([x_m, 0.0, 0.0]), yaw(0.0)))
    for t_ms, speed in ((0, 1.0), (5, 1.0), (10, 1.0), (30, 3.0), (40, 3.0)):
        velocity = track.velocity_rig_m_s(t_ms * MS)
        assert velocity is not None
        assert velocity[0] == pytest.approx(speed)


@pytest.mark.parametrize("t_ns", [40, 39, -1])
def test_time_must_advance(t_ns: int) -> None:
    track = PoseTrack(max_gap_s=0.1)
    track.add(Pose(40, np.zeros(3), yaw(0.0)))
    with pytest.raises(PoseError, match=rf"got {t_ns}; allowed: > 40 ns; .*clear\(\)"):
        track.add(Pose(t_ns, np.ones(3), yaw(0.0)))
    assert len(track) == 1
    track.clear()
    track.add(Pose(t_ns, np.ones(3), yaw(0.0)))
    assert track.at(t_ns) is not None


def test_memory_is_bounded_by_age_and_by_count() -> None:
    track = PoseTrack(max_gap_s=0.1, keep_s=1.0, capacity=50)
    for n in range(1000):
        track.add(Pose(n * 10 * MS, np.zeros(3), yaw(0.0)))
    assert len(track) == 50
    rare = PoseTrack(max_gap_s=0.1, keep_s=1.0)
    for n in range(1000):
        rare.add(Pose(n * 100 * MS, np.zeros(3), yaw(0.0)))
    assert len(rare) == 11
    assert rare.at(998 * 100 * MS) is not None
    assert "before first pose" in rare.why_none(0)


def test_settings_that_cannot_work_are_refused() -> None:
    for arguments in ({"max_gap_s": 0.0}, {"max_gap_s": np.nan}, {"max_gap_s": 2.0, "keep_s": 1.0}):
        with pytest.raises(ConfigError):
            PoseTrack(**arguments)


def test_csv_and_json_lines_give_the_same_poses(tmp_path: Path) -> None:
    t_ns = 2**62 + 1
    csv, jsonl = tmp_path / "poses.csv", tmp_path / "poses.jsonl"
    csv.write_bytes(HEADER + b"# a comment\n\n" + f"{t_ns},1,2.5,-3e-1,0,0,0,1\n{t_ns + 1}, 2,2,2, 0,0,1,0".encode())
    jsonl.write_text(
        f'{{"t_ns":{t_ns},"x":1,"y":2.5,"z":-0.3,"qx":0,"qy":0,"qz":0,"qw":1}}\n'
        f'{{"qw":0.0,"qz":1,"qy":0,"qx":0,"z":2,"y":2,"x":2,"t_ns":{t_ns + 1}}}\n'
    )
    for path in (csv, jsonl):
        first, second = read_poses(path)
        assert (first.t_ns, second.t_ns) == (t_ns, t_ns + 1)
        np.testing.assert_array_equal(first.position_m, [1.0, 2.5, -0.3])
        np.testing.assert_array_equal(second.quaternion_xyzw, [0.0, 0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"20,0,0,0,0,0,0", "7 columns instead of 8"),
        (b"2_0,0,0,0,0,0,0,1", "not plain decimal"),
        (b"2.0e1,0,0,0,0,0,0,1", "invalid literal for int"),
        (b"20,0,0,a,0,0,0,1", "could not convert"),
        (b"20,0,0,nan,0,0,0,1", "is no pose"),
        (b"20,0,0,0,0,0,0,1.1", "is no pose"),
        (b"20,0,0,0,0,0,0,0", "is no pose"),
        (b"10,0,0,0,0,0,0,1", "time does not advance"),
        (b"9,0,0,0,0,0,0,1", "time does not advance"),
        (b"9223372036854775808,0,0,0,0,0,0,1", "beyond 64 bits"),
        (b"\xff\xfe\x00", "no text"),
        (b"1" * 5000, "too long"),
        (HEADER, "not plain decimal"),
        (b'{"t_ns":20,"x":0,"y":0,"z":0,"qx":0,"qy":0,"qz":0}', "lacks 'qw'"),
        (b'{"t_ns":20.0,"x":0,"y":0,"z":0,"qx":0,"qy":0,"qz":0,"qw":1}', "not an integer"),
        (b'{"t_ns":20,"x":"0","y":0,"z":0,"qx":0,"qy":0,"qz":0,"qw":1}', "not a number"),
        (b'{"t_ns":20,"x":0,"y":0,"z":0,"qx":0,"qy":0,"qz":0,"qw":1,"s":1}', "unknown key 's'"),
        (b'{"t_ns":20', "no pose"),
        (b'{"t_ns":' + b"[" * 1000, "no pose"),
        (b'{"t_ns":20,"x":' + b"9" * 400 + b',"y":0,"z":0,"qx":0,"qy":0,"qz":0,"qw":1}', "no pose"),
    ],
)
def test_bad_line_is_named(line: bytes, reason: str) -> None:
    poses = parse_poses([b"10,0,0,0,0,0,0,1\n", line], "drive.csv")
    assert next(poses).t_ns == 10
    with pytest.raises(PoseError, match=r"^drive\.csv, line 2: ") as caught:
        next(poses)
    assert reason in str(caught.value)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(PoseError, match=r"nowhere\.csv cannot be read"):
        list(read_poses(tmp_path / "nowhere.csv"))


@settings(max_examples=300, deadline=None)
@given(st.one_of(st.binary(max_size=80), st.from_regex(r"[{\[\]}:,\"0-9a-z_. +-]{0,80}").map(str.encode)))
def test_no_line_does_anything_but_a_pose_or_a_pose_error(line: bytes) -> None:
    try:
        poses = list(parse_poses([line], "fuzz"))
    except PoseError:
        poses = []
    assert len(poses) <= 1
