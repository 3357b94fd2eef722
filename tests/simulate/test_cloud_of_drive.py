# SPDX-License-Identifier: Apache-2.0
"""Clouds of simulated drive-bys: nothing of the pipeline bypassed, truth in the right place, cluster named rightly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.frames import Float64, FusedCloud, ObjectCloud, Pose
from edge.odometry.transforms import rotation_matrix
from edge.pipeline import Pipeline, WindowResult
from train.objects.mesh import Mesh
from train.objects.reference import ObjectRef
from train.simulate.cloud import (
    DriveSpec,
    SimulatedCloud,
    Windows,
    find_target,
    frame_numbers,
    make_drive,
    observe,
    run,
    simulate_cloud,
    truth_in_frame,
)
from train.simulate.drive_by import DriveBy
from train.simulate.randomise import Ranges, draw
from train.simulate.settings import TrackSettings

CAR = ObjectRef("car", "parametric_00001")
EASY = Ranges(
    frames=(90, 90), travel_m=(1.5, 1.5), speed_m_s=(0.5, 2.0), side_m=(4.0, 4.0), along_m=(0.0, 0.0),
    neighbours=(0, 0), wall_share=0.0, mover_share=0.0, windows=("taylor",), p_fa=(1e-5,), residual_deg=(2.0, 2.0),
    ground_share=0.0, ground_margin_m=(0.0,),
)  # fmt: skip
CROOKED = replace(EASY, mounting_deg=(3.0, 3.0), mounting_m=(0.05, 0.05), time_offset_s=(0.1, 0.1), tilt_deg=(0.0, 0.0))


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return CAR.mesh()


@pytest.fixture(scope="module")
def easy() -> SimulatedCloud:
    return simulate_cloud(DriveSpec(CAR, 11, EASY))


@pytest.fixture(scope="module")
def drive(mesh: Mesh) -> DriveBy:
    return make_drive(DriveSpec(CAR, 11, EASY), mesh)


def test_the_cloud_lies_on_the_true_surface(easy: SimulatedCloud, mesh: Mesh) -> None:
    assert easy.status in ("whole", "split")
    assert easy.frames == 30
    assert easy.travel_m == pytest.approx(1.45, abs=0.05)
    assert easy.statistics.points == len(easy.xyz_m) == len(easy.power_db) == len(easy.frame_number) > 50
    assert easy.statistics.within_20cm > 0.9
    assert easy.statistics.median_m < 0.08
    side_m = easy.truth_rotation.T @ (easy.sensor_m - easy.truth_translation_m)
    nearest_m = np.linalg.norm(mesh.vertices[:, :2] - side_m[:2], axis=1).min()
    assert nearest_m == pytest.approx(4.0, abs=0.5)
    assert 0.4 <= side_m[2] <= 1.2


def test_the_truth_follows_mounting_and_time_errors(easy: SimulatedCloud) -> None:
    """3 degrees and 15 cm of wrong stamps move the cloud; the truth by the middle's pose moves with it."""
    made = simulate_cloud(DriveSpec(CAR, 11, CROOKED))
    assert made.statistics.within_20cm > 0.85
    tilt_deg = np.degrees(np.arccos(made.truth_rotation[2, 2]))
    assert 2.0 < tilt_deg < 6.0
    assert np.degrees(np.arccos(easy.truth_rotation[2, 2])) < 1.5


def test_the_same_spec_gives_the_same_cloud(easy: SimulatedCloud) -> None:
    again = simulate_cloud(DriveSpec(CAR, 11, EASY))
    assert (again.xyz_m == easy.xyz_m).all()
    assert (again.frame_number == easy.frame_number).all()
    assert again.statistics == easy.statistics
    assert not np.array_equal(simulate_cloud(DriveSpec(CAR, 12, EASY)).xyz_m, easy.xyz_m)


def test_a_pipeline_of_its_own_gives_the_same_points(drive: DriveBy, easy: SimulatedCloud, mesh: Mesh) -> None:
    windows = Windows()
    pipeline = Pipeline(drive.rig, None, [windows])
    for item in drive:
        pipeline.feed(item)
    pipeline.finish()
    made = observe(easy.spec, mesh, drive, windows.results)
    assert len(made.xyz_m) == pytest.approx(len(easy.xyz_m), rel=0.02)
    shared = run(drive, [])
    for ledgers in (pipeline.ledgers, shared.ledgers):
        assert all(ledger.snapshot().frames_ok == drive.frames for ledger in ledgers.values())


def test_given_settings_are_taken_as_they_are(mesh: Mesh) -> None:
    settings = replace(draw(EASY, 5), track=TrackSettings(40, frame_period_s=0.02, every=4))
    made = make_drive(DriveSpec(CAR, 11, EASY, every=3, settings=settings), mesh)
    assert made.settings is settings
    assert made.frames == 10
    assert made.true_pose(made.t_first_chirp_ns("horizontal", 9)).position_m[0] == pytest.approx(9 * 0.08 * 0.5)
    assert made.placed[0].position_m[0] == pytest.approx(0.5 * 40 * 0.02 * 0.5 + settings.scene.along_m, abs=0.3)


def cloud_at(middle_m: Float64, count: int, window: FusedCloud, spread_m: float = 0.2) -> ObjectCloud:
    """Points about a place of the reported odometry, as an object of the window."""
    rng = np.random.default_rng(count)
    xyz_m = rng.uniform(-spread_m, spread_m, (count, 3)).astype(np.float32)
    pose = Pose(window.t_end_ns, np.asarray(middle_m, dtype=float), np.array([0.0, 0.0, 0.0, 1.0]))
    power, sensor_m = np.zeros(count, np.float32), np.zeros(3)
    return ObjectCloud(0, xyz_m, power, pose, window.t_start_ns, window.t_end_ns, 1.0, 30, True, sensor_m)


def window_of(drive: DriveBy) -> FusedCloud:
    start_ns, end_ns = drive.span_ns
    none, reference = np.zeros((0, 3), np.float32), drive.reported_pose(start_ns)
    numbers = np.zeros(0, np.int64)
    return FusedCloud(none, none[:, 0], numbers, reference, start_ns, end_ns, 1.0, 30, True, np.zeros(3))


@pytest.mark.parametrize(
    ("places", "status"),
    [
        ([], "missing"),
        ([(0.0, 5)], "missing"),
        ([(6.0, 200)], "missing"),
        ([(0.0, 100), (6.0, 300)], "whole"),
        ([(0.0, 100), (0.5, 40)], "split"),
        ([(0.0, 100), (0.5, 10)], "whole"),
    ],
)
def test_the_target_is_the_cluster_in_its_box(
    drive: DriveBy, mesh: Mesh, places: list[tuple[float, int]], status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("train.simulate.cloud.frame_numbers", lambda window, cloud: np.zeros(len(cloud), np.int64))
    window = window_of(drive)
    _, target_m = truth_in_frame(drive, window, Pose(0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
    middle_m = target_m + np.array([0.0, 0.0, 0.6])
    clouds = [cloud_at(middle_m + np.array([0.0, beyond_m, 0.0]), count, window) for beyond_m, count in places]
    found = find_target(mesh, drive, [WindowResult(window, clouds, [])])
    assert found.status == status
    assert found.cloud is (None if status == "missing" else clouds[0])


def test_a_cluster_that_reaches_far_beyond_the_box_is_merged(
    drive: DriveBy, mesh: Mesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("train.simulate.cloud.frame_numbers", lambda window, cloud: np.zeros(len(cloud), np.int64))
    window = window_of(drive)
    _, target_m = truth_in_frame(drive, window, Pose(0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
    wide = cloud_at(target_m, 500, window, spread_m=6.0)
    assert find_target(mesh, drive, [WindowResult(window, [wide], [])]).status == "merged"


def test_frames_of_an_objects_points_are_found_in_the_window(drive: DriveBy) -> None:
    rng = np.random.default_rng(5)
    xyz_m = rng.normal(size=(400, 3)).astype(np.float32)
    window = replace(window_of(drive), xyz_m=xyz_m, power_db=xyz_m[:, 0], frame_number=rng.integers(0, 30, 400))
    member = np.flatnonzero(rng.random(400) < 0.5)
    axes = rotation_matrix(window.reference.quaternion_xyzw)
    origin_m = window.reference.position_m + np.array([1.0, 4.0, -0.8])
    local = (xyz_m[member].astype(float) @ axes.T + window.reference.position_m - origin_m).astype(np.float32)
    cloud = replace(cloud_at(origin_m, 3, window), xyz_m=local)
    assert (frame_numbers(window, cloud) == window.frame_number[member]).all()


def test_a_rig_that_cannot_see_the_scene_is_refused(drive: DriveBy) -> None:
    with pytest.raises(ConfigError, match="radars of rig corridor"):
        simulate_cloud(DriveSpec(CAR, 1, EASY, rig="corridor"))
    drive_right = make_drive(DriveSpec(CAR, 11, EASY), CAR.mesh())
    drive_right.rig = replace(drive.rig, geometry=replace(drive.rig.geometry, yaw_deg=-90.0))
    with pytest.raises(ConfigError, match="yaw_deg"):
        run(drive_right, [])
