# SPDX-License-Identifier: Apache-2.0
"""Held-out cases stand where they say; the oracle, the floor and the alignment find what is known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from train.baselines import FLOOR, ORACLE, Bank, align, floor
from train.dataset import CompletionDataset, DatasetSettings
from train.held_out import Case, HeldOut, Joined, motion
from train.metrics import shape_metrics
from train.nearest import nearest_distance
from train.objects.mesh import Mesh
from train.objects.reference import ObjectRef
from train.objects.sampling import sample_surface
from train.simulate.shards import Cloud, ObjectInfo, Shard, encode
from train.simulated import SimulatedDataset

DATA = DatasetSettings(truth_points=4096, max_points=300, epoch_samples=64, parametric_objects=2, evaluation_views=1)


@pytest.fixture(scope="module")
def cases() -> HeldOut:
    return HeldOut(CompletionDataset("val", DATA, 0))


def rotation(angle_rad: float) -> np.ndarray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_motion_is_recovered() -> None:
    before = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    turn, shift_m = rotation(2.5), np.array([1.0, -2.0, 0.3])
    found, moved_m = motion(before, (before @ turn.T + shift_m).astype(np.float32))
    np.testing.assert_allclose(found, turn, atol=1e-5)
    np.testing.assert_allclose(moved_m, shift_m, atol=1e-5)


def test_a_case_knows_its_pose_and_mesh(cases: HeldOut) -> None:
    for case in cases.spread(4):
        own = case.unposed(case.sample.truth)
        assert np.abs(own.min(axis=0) - case.mesh.vertices.min(axis=0)).max() < 0.15
        np.testing.assert_allclose(case.posed(own), case.sample.truth, atol=1e-4)
        assert shape_metrics(case.resampled(), case.sample.truth, with_emd=False)["cd_cm"] < 7
        other = case.seen_as(case.sample.partial[:50], 12)
        assert (len(other.sample.partial), other.frames, other.frame_number) == (50, 12, None)
    both = Joined([cases.spread(2), cases.spread(3)])
    assert len(both) == 5
    assert both[2].sample.object_id == cases[0].sample.object_id


def test_the_oracle_finds_the_same_shape_wherever_it_stands() -> None:
    train = CompletionDataset("train", DATA, 0)
    bank = Bank(train, 12)
    for index in (0, 5):
        sample = train[index]
        turn, shift_m = rotation(1.0 + index), np.array([3.0, 1.0, 0.0])
        twin = CompletionDataset("train", replace(DATA, box_frame=True), 0)[index]
        first, moved_m = motion(twin.truth, sample.truth)
        truth = (sample.truth @ turn.T + shift_m).astype(np.float32)
        case = Case(replace(sample, truth=truth), 0, "scans", train.mesh(index), turn @ first, turn @ moved_m + shift_m)
        assert shape_metrics(bank.oracle(case), truth, with_emd=False)["cd_cm"] < 0.1
    assert any(name.startswith(ORACLE) for name in bank.predictors())
    assert FLOOR not in bank.predictors()


def test_in_the_box_frame_nothing_is_placed() -> None:
    train = CompletionDataset("train", replace(DATA, box_frame=True), 0)
    bank, sample = Bank(train, 8), train[2]
    seen = replace(sample, partial=sample.truth[:500])
    np.testing.assert_allclose(bank.retrieve(seen), sample.truth, atol=1e-5)


def test_alignment_recovers_turn_and_shift() -> None:
    rng = np.random.default_rng(1)
    along, side = rng.uniform(-2, 2, 1500), rng.uniform(0, 1.5, 500)
    walls = np.concatenate([np.stack([along, 0 * along], 1), np.stack([0 * side - 2, side], 1)])
    shape = rng.permutation(np.column_stack([walls, rng.uniform(0, 1, 2000)])).astype(np.float32)
    turn, shift_m = rotation(0.12), np.array([0.1, -0.08, 0.0])
    query = (shape[:300] @ turn.T + shift_m).astype(np.float32)
    found, moved_m = align(shape, query)
    before = nearest_distance(query, shape).mean()
    assert nearest_distance(query, (shape @ found.T + moved_m).astype(np.float32)).mean() < 0.4 * before
    assert math.atan2(found[1, 0], found[0, 0]) == pytest.approx(0.12, abs=0.04)


def test_floor_is_the_true_surface(cases: HeldOut) -> None:
    case = cases[1]
    assert shape_metrics(floor(case).fine_m, case.sample.truth, with_emd=False)["cd_cm"] < 7


def drive_by(mesh: Mesh) -> Cloud:
    """250 points on the surface, ten frames apart at both ends, turned and moved."""
    rng, turn = np.random.default_rng(0), rotation(0.7)
    points = sample_surface(mesh.vertices, mesh.faces, 250, rng) @ turn.T + (0.2, -0.1, 0)
    frame_number = np.sort(rng.integers(0, 100, 250))
    return Cloud(
        "car/parametric_00000",
        "simulated",
        0,
        1,
        points.astype(np.float32),
        np.full(250, 90, np.float32),
        frame_number,
        np.array([0.5, -6.0, 0.8]),
        turn,
        np.array([0.2, -0.1, 0.0]),
        100,
        3.0,
    )


def test_points_of_a_drive_by_know_when_they_were_seen(tmp_path: Path) -> None:
    ref = ObjectRef.from_text("car/parametric_00000")
    mesh = ref.mesh()
    cloud = drive_by(mesh)
    x_m, y_m, z_m = (round(float(v), 3) for v in mesh.size_m)
    info = ObjectInfo("test", "g", "", "", (x_m, y_m, z_m))
    path = tmp_path / "one.clouds"
    path.write_bytes(encode(Shard("0" * 64, 0, {"car/parametric_00000": info}, (cloud,))))
    for box in (False, True):
        case = HeldOut(SimulatedDataset(path, "test", replace(DATA, box_frame=box), 0))[0]
        assert (case.source, case.frames, case.box_frame) == ("drive-bys", 100, box)
        seen = case.unposed(case.sample.partial)
        in_mesh = (cloud.xyz_m - cloud.translation_m) @ cloud.rotation
        index = np.argmin(((seen[:, None] - in_mesh[None]) ** 2).sum(axis=2), axis=1)
        assert case.frame_number is not None
        np.testing.assert_array_equal(case.frame_number, cloud.frame_number[index])
        assert np.median(nearest_distance(case.sample.partial, case.sample.truth)) < 0.1
