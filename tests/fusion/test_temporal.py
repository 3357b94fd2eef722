# SPDX-License-Identifier: Apache-2.0
"""Temporal fusion: static points land on themselves, windows by travel and time, faults, the definition."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.config import FusionSettings
from edge.errors import CaptureError, ConfigError, PoseError
from edge.frames import Float64, FusedCloud, PointCloud, Pose
from edge.fusion.temporal import MAX_FRAMES, TemporalFusion, WindowEnd
from edge.reference.temporal import fuse, matrix

FRAME_NS = 16_666_667


def yaw(angle_rad: float, roll_rad: float = 0.0) -> Float64:
    """Quaternion of Rz(yaw) Rx(roll)."""
    s, c, sr, cr = np.sin(angle_rad / 2), np.cos(angle_rad / 2), np.sin(roll_rad / 2), np.cos(roll_rad / 2)
    return np.array([c * sr, s * sr, s * cr, c * cr])


def cloud(number: int, t_ns: int, xyz: Any = ()) -> PointCloud:
    points = np.array(xyz, dtype=np.float32).reshape(-1, 3)
    power = np.arange(len(points), dtype=np.float32)
    return PointCloud(number, t_ns, points, power, power, power)


def straight(speed_m_s: float, frames: int, start_m: float = 0.0, first: int = 0) -> Iterator[tuple[int, Pose]]:
    """Frame numbers and poses of travel along odom +x at 60 frames/s."""
    for k in range(frames):
        x = start_m + speed_m_s * k * FRAME_NS / 1e9
        yield first + k, Pose((first + k) * FRAME_NS, np.array([x, 0.0, 0.0]), yaw(0.0))


def drive(fusion: TemporalFusion, poses: Any, points: Any = ((5.0, 0.0, 0.0),)) -> list[FusedCloud]:
    windows = [fusion.add(cloud(number, pose.t_ns, points), pose) for number, pose in poses]
    return [window for window in windows if window is not None]


def test_points_of_a_static_world_land_on_themselves_while_the_rig_drives_and_turns() -> None:
    """Ten kilometres from the origin of the odometry, through a curve, with a roll."""
    world = np.random.default_rng(1).uniform([9997, -7003, 49], [10_008, -6992, 52], (40, 3))
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, min_frames=10))
    windows = []
    for k in range(400):
        heading = 0.004 * k
        position = np.array([10_000.0 + 2.5 * np.sin(heading), -7_000.0 + 2.5 * (1 - np.cos(heading)), 50.0])
        pose = Pose(k * FRAME_NS, position, yaw(heading, 0.05 * np.sin(0.1 * k)) * (1 - 5e-4))
        seen = (world - position) @ matrix(pose)[:3, :3]
        window = fusion.add(cloud(k, pose.t_ns, seen), pose)
        windows += [window] if window is not None else []
    assert [window.complete for window in windows] == [True]
    for window in windows:
        expected = (world - window.reference.position_m) @ matrix(window.reference)[:3, :3]
        off = window.xyz_m.reshape(-1, len(world), 3) - expected
        assert np.abs(off).max() < 1e-5, "float32 of points some metres away, not of kilometres"


def test_three_metres_at_half_a_metre_a_second_are_360_steps() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0))
    (window,) = drive(fusion, straight(0.5, 361))
    assert window.complete
    assert (window.frames, len(window)) == (361, 361)
    assert window.travel_m == pytest.approx(3.0, abs=1e-6)
    assert (window.t_start_ns, window.t_end_ns) == (0, 360 * FRAME_NS)
    np.testing.assert_array_equal(window.frame_number, np.arange(361))
    np.testing.assert_array_equal(window.reference.position_m, [0, 0, 0])
    np.testing.assert_allclose(window.xyz_m[:, 0], 5.0 + 0.5 * np.arange(361) * FRAME_NS / 1e9, atol=1e-6)
    np.testing.assert_allclose(window.sensor_m, [1.5, 0, 0], atol=1e-6)
    assert fusion.windows == {WindowEnd.TRAVEL: 1}


def test_the_next_window_begins_half_the_travel_later() -> None:
    windows = drive(TemporalFusion(FusionSettings(travel_m=3.0)), straight(0.5, 1000))
    starts = [window.reference.position_m[0] for window in windows]
    np.testing.assert_allclose(starts, [0.0, 1.5, 3.0, 4.5], atol=1e-6)
    assert all(window.complete and window.frames == 361 for window in windows)


@pytest.mark.parametrize("hop_m", [0.5, 3.0])
def test_hop_sets_the_distance_between_windows(hop_m: float) -> None:
    windows = drive(TemporalFusion(FusionSettings(travel_m=3.0, hop_m=hop_m)), straight(0.5, 900))
    starts = np.array([window.reference.position_m[0] for window in windows])
    np.testing.assert_allclose(np.diff(starts), hop_m, atol=1e-6)
    assert len(starts) >= 2


def test_frames_without_points_count_as_frames() -> None:
    (window,) = drive(TemporalFusion(FusionSettings(travel_m=3.0)), straight(0.5, 361), points=())
    assert (window.frames, len(window), window.complete) == (361, 0, True)
    assert window.xyz_m.shape == (0, 3)


def test_a_window_with_too_few_frames_is_incomplete() -> None:
    for min_frames, complete in ((38, False), (37, True)):
        windows = drive(TemporalFusion(FusionSettings(travel_m=3.0, min_frames=min_frames)), straight(5.0, 40))
        assert [(window.frames, window.complete) for window in windows] == [(37, complete)]
        assert windows[0].travel_m == pytest.approx(3.0, abs=1e-6)


def test_slow_travel_closes_by_time_and_the_next_window_overlaps() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, max_time_s=5.0))
    windows = drive(fusion, straight(0.4, 700))
    assert [window.complete for window in windows] == [False, False]
    assert all(window.t_end_ns - window.t_start_ns <= 5_000_000_000 for window in windows)
    assert windows[0].travel_m == pytest.approx(2.0, abs=0.01)
    assert windows[1].reference.position_m[0] == pytest.approx(1.5, abs=0.01)
    assert set(fusion.windows) == {WindowEnd.TIME}


def test_the_next_window_never_begins_with_a_frame_that_is_too_old() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, max_time_s=1.0, max_pose_gap_s=10.0))
    states = [(0.0, 0.0), (0.5, 1.6), (2.0, 1.7)]
    poses = [(k, Pose(round(t_s * 1e9), np.array([x_m, 0, 0]), yaw(0.0))) for k, (t_s, x_m) in enumerate(states)]
    (window,) = drive(fusion, poses)
    assert (window.frames, window.travel_m) == (2, pytest.approx(1.6))
    rest = fusion.flush()
    assert rest is not None
    assert (rest.frames, rest.reference.position_m[0]) == (1, 1.7), "1.6 m lie beyond the hop but 1.5 s back"


def test_standing_with_odometry_jitter_covers_no_travel_and_grows_nothing() -> None:
    rng = np.random.default_rng(3)
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, max_time_s=2.0))
    windows = []
    for k in range(3000):
        pose = Pose(k * FRAME_NS, rng.normal(0, 0.002, 3), yaw(0.0))
        window = fusion.add(cloud(k, pose.t_ns, [[5, 0, 0]]), pose)
        windows += [window] if window is not None else []
    assert len(windows) == 24
    assert all(not window.complete and window.travel_m < 0.02 and window.frames <= 121 for window in windows)


def test_a_stop_inside_a_window_does_not_add_travel() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, max_time_s=60.0))
    poses = [*straight(1.0, 91), *straight(0.0, 300, 1.5, 91), *straight(1.0, 91, 1.5, 391)]
    (window,) = drive(fusion, poses)
    assert window.reference.position_m[0] == 0.0
    assert window.travel_m == pytest.approx(3.0, abs=0.02)
    assert window.frames > 470


def test_a_pose_gap_closes_the_window_and_nothing_reaches_across() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, max_pose_gap_s=0.1))
    windows = drive(fusion, [*straight(0.5, 100), *straight(0.5, 400, 2.0, 110)])
    assert [(window.frames, window.complete) for window in windows] == [(100, False), (361, True)]
    assert windows[1].reference.position_m[0] == 2.0
    assert fusion.windows[WindowEnd.POSE_GAP] == 1


@pytest.mark.parametrize(("x_m", "heading_rad"), [(1.5, 0.0), (0.83, 0.1)])
def test_a_jump_of_the_odometry_closes_the_window(x_m: float, heading_rad: float) -> None:
    jump = Pose(100 * FRAME_NS, np.array([x_m, 0.0, 0.0]), yaw(heading_rad))
    fusion = TemporalFusion(FusionSettings(travel_m=3.0))
    windows = drive(fusion, [*straight(0.5, 100), (100, jump)])
    assert [(window.frames, window.complete) for window in windows] == [(100, False)]
    assert fusion.windows == {WindowEnd.POSE_JUMP: 1}
    last = fusion.flush()
    assert last is not None
    assert (last.frames, last.travel_m) == (1, 0.0)


def test_flush_gives_the_rest_once_and_starts_anew() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0))
    assert fusion.flush() is None
    drive(fusion, straight(0.5, 50))
    window = fusion.flush()
    assert window is not None
    assert (window.frames, window.complete) == (50, False)
    assert fusion.flush() is None
    assert drive(fusion, straight(0.5, 361, 70.0))[0].frames == 361, "time may begin again after a flush"


def test_the_ring_wraps_and_counts_what_it_overwrites() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, capacity=1024))
    points = np.random.default_rng(0).uniform(1, 5, (4, 3))
    windows = drive(fusion, straight(0.5, 600), points)  # 1444 points a window
    assert [(len(window), window.frames, window.complete) for window in windows] == [(1024, 361, False)] * 2
    assert fusion.overwritten == 2 * (4 * 361 - 1024)
    np.testing.assert_array_equal(windows[0].frame_number, np.repeat(np.arange(105, 361), 4))
    np.testing.assert_array_equal(windows[1].frame_number, np.repeat(np.arange(285, 541), 4))
    np.testing.assert_allclose(windows[1].xyz_m[:4, 1:], points[:, 1:], rtol=1e-6)


def test_a_window_that_begins_among_overwritten_points_has_only_those_that_are_left() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, capacity=1024, hop_m=0.1))
    windows = drive(fusion, straight(0.5, 400), np.ones((4, 3)))
    assert len(windows) > 2
    assert fusion.overwritten == 4 * 400 - 1024, "every point once"
    for window in windows:
        last = window.t_end_ns // FRAME_NS
        np.testing.assert_array_equal(window.frame_number, np.repeat(np.arange(last - 255, last + 1), 4))


def test_the_ring_wraps_without_loss_when_windows_fit() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, capacity=1024))
    windows = drive(fusion, straight(0.5, 2000), [[4.0, 1.0, 0.5], [5.0, 0.0, 0.0]])
    assert [len(window) for window in windows] == [722] * len(windows)
    assert len(windows) > 8
    assert fusion.overwritten == 0


def test_a_frame_larger_than_the_ring_keeps_its_last_points() -> None:
    fusion = TemporalFusion(FusionSettings(capacity=1024))
    points = np.stack([np.arange(3000.0), np.zeros(3000), np.zeros(3000)], axis=1)
    drive(fusion, straight(0.5, 1), points)
    window = fusion.flush()
    assert window is not None
    np.testing.assert_array_equal(window.xyz_m[:, 0], np.arange(1976, 3000))
    np.testing.assert_array_equal(window.power_db, np.arange(1976, 3000))
    assert fusion.overwritten == 1976


def test_more_frames_than_a_window_can_hold_close_it() -> None:
    fusion = TemporalFusion(FusionSettings())
    pose = np.array([0.0, 0.0, 0.0])
    windows = [fusion.add(cloud(k, k * 1000), Pose(k * 1000, pose, yaw(0.0))) for k in range(MAX_FRAMES + 5)]
    assert [window.frames for window in windows if window is not None] == [MAX_FRAMES]


def test_what_does_not_fit_in_time_is_refused_and_changes_nothing() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0))
    drive(fusion, straight(0.5, 10))
    ahead = Pose(20 * FRAME_NS, np.zeros(3), yaw(0.0))
    for bad in (Pose(9 * FRAME_NS, np.zeros(3), yaw(0.0)), Pose(3 * FRAME_NS, np.zeros(3), yaw(0.0))):
        with pytest.raises(PoseError, match="not later"):
            fusion.add(cloud(10, bad.t_ns), bad)
    with pytest.raises(PoseError, match="does not belong"):
        fusion.add(cloud(10, 10 * FRAME_NS), ahead)
    with pytest.raises(CaptureError, match="not finite"):
        fusion.add(cloud(10, ahead.t_ns, [[1.0, np.nan, 0.0]]), ahead)
    window = fusion.flush()
    assert window is not None
    assert (window.frames, len(window)) == (10, 10)


@pytest.mark.parametrize("wrong", [{"hop_m": 4.0}, {"hop_m": -1.0}, {"max_speed_m_s": 0.0}, {"max_turn_deg_s": 0.0}])
def test_settings_that_cannot_work_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        FusionSettings(travel_m=3.0, **wrong)


def test_windows_are_the_callers_to_keep() -> None:
    fusion = TemporalFusion(FusionSettings(travel_m=3.0, capacity=1024))
    (window,) = drive(fusion, straight(0.5, 361))
    before = window.xyz_m.copy()
    drive(fusion, straight(0.5, 2000, 3.0, 361), [[9.0, 9.0, 9.0]])
    np.testing.assert_array_equal(window.xyz_m, before)


def random_drive(rng: np.random.Generator, frames: int) -> tuple[list[PointCloud], list[Pose]]:
    """A drive with stops, turns, lost frames, gaps and jumps."""
    t_ns, position, heading, speed = 0, np.array([5000.0, -3000.0, 2.0]), 0.0, 1.0
    clouds, poses = [], []
    for k in range(frames):
        step_ns = int(rng.choice([FRAME_NS, 2 * FRAME_NS, 9 * FRAME_NS], p=[0.9, 0.09, 0.01]))
        speed = float(rng.choice([speed, 0.0, rng.uniform(0, 4)], p=[0.94, 0.03, 0.03]))
        t_ns, heading = t_ns + step_ns, heading + rng.normal(0, 0.01)
        position = position + speed * step_ns * 1e-9 * np.array([np.cos(heading), np.sin(heading), 0.0])
        position = position + (rng.normal(0, 3, 3) if rng.random() < 0.01 else 0.0)
        poses.append(Pose(t_ns, position, yaw(heading, rng.normal(0, 0.002))))
        clouds.append(cloud(k, t_ns, rng.uniform(-8, 8, (rng.integers(0, 5), 3))))
    return clouds, poses


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 2.0]), st.sampled_from([1.0, 6.5]))
def test_windows_and_points_equal_the_definition(seed: int, hop_m: float, max_time_s: float) -> None:
    chosen = FusionSettings(travel_m=2.0, hop_m=hop_m, max_time_s=max_time_s, min_frames=30)
    clouds, poses = random_drive(np.random.default_rng(seed), 300)
    fusion = TemporalFusion(chosen)
    found = [fusion.add(one, pose) for one, pose in zip(clouds, poses, strict=True)]
    windows = [window for window in (*found, fusion.flush()) if window is not None]
    expected = fuse(clouds, poses, chosen)
    assert_equal(windows, expected, poses)
    assert fusion.overwritten == 0
    assert sum(fusion.windows.values()) == len(windows)


def assert_equal(windows: Sequence[FusedCloud], expected: Sequence[Any], poses: Sequence[Pose]) -> None:
    assert [(w.t_start_ns, w.t_end_ns) for w in windows] == [
        (poses[e.first].t_ns, poses[e.last].t_ns) for e in expected
    ]
    for window, truth in zip(windows, expected, strict=True):
        assert (window.frames, window.complete) == (truth.last - truth.first + 1, truth.complete)
        assert window.travel_m == pytest.approx(truth.travel_m, abs=1e-9)
        assert window.reference.t_ns == poses[truth.first].t_ns
        np.testing.assert_allclose(window.xyz_m, truth.xyz_m, atol=1e-5)
        np.testing.assert_allclose(window.sensor_m, truth.sensor_m, atol=1e-6)
