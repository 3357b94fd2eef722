# SPDX-License-Identifier: Apache-2.0
"""Simulated clouds as training data: truth where the cloud is, line of sight, mixing, and items that never change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_clouds import Here, fake_cloud, small_plan

from edge.errors import ConfigError, RecordingError
from train.dataset import CompletionDataset, DatasetSettings
from train.nearest import nearest_distance
from train.objects.mesh import MeshError
from train.objects.reference import ObjectRef
from train.simulate.build import build, export_clouds, shard_name
from train.simulate.shards import Cloud, Shard, encode, read_shard
from train.simulate.work import Item
from train.simulated import SimulatedDataset

SETTINGS = DatasetSettings(truth_points=2000, epoch_samples=40, neighbour_probability=0.0)
EXACT = replace(SETTINGS, sight_sigma_deg=0.0, ground_sigma_m=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("simulated") / "set"
    build(small_plan(objects=12, drive_bys=4), target, Here(), fake_cloud)
    return target


def change(folder: Path, target: Path, changed: Callable[[Shard], Shard]) -> Path:
    """Shard 0 of a set, changed, in a folder of its own."""
    target.mkdir()
    (target / shard_name(0)).write_bytes(encode(changed(read_shard(folder / shard_name(0)))))
    return target


def test_the_truth_lies_where_the_cloud_is(folder: Path) -> None:
    for box_frame in (False, True):
        dataset = SimulatedDataset(folder, "val", replace(EXACT, box_frame=box_frame, truth_points=20_000), 0)
        for index in range(len(dataset)):
            sample = dataset[index]
            assert len(sample.partial) == 300
            assert np.median(nearest_distance(sample.partial, sample.truth)) < 0.03


def test_truth_in_the_box_frame_is_the_mesh_itself(folder: Path) -> None:
    dataset = SimulatedDataset(folder, "val", replace(EXACT, box_frame=True), 0)
    sample = dataset[0]
    size_m = ObjectRef.from_text(sample.object_id).mesh().size_m
    np.testing.assert_allclose(np.ptp(sample.truth, axis=0), size_m, rtol=0.1)
    assert abs(float(sample.truth[:, 2].min())) < 0.05


def test_x_points_away_from_the_radar(folder: Path) -> None:
    """The radar of every fake cloud stands at (0.5, -6): the cloud's own +y is away from it, +x is to its right."""
    dataset = SimulatedDataset(folder, "val", EXACT, 0)
    for index, cloud in enumerate(dataset.clouds):
        sample = dataset[index]
        away = cloud.xyz_m[:, :2].mean(axis=0) - cloud.sensor_m[:2]
        along = cloud.xyz_m[:, :2] @ (away / np.linalg.norm(away))
        assert np.ptp(sample.partial[:, 0]) == pytest.approx(np.ptp(along), abs=2e-3)
        middle = (sample.partial[:, :2].max(axis=0) + sample.partial[:, :2].min(axis=0)) / 2
        np.testing.assert_allclose(middle, 0, atol=1e-5)
        assert sample.partial[:, 2].min() == pytest.approx(cloud.xyz_m[:, 2].min(), abs=1e-5)


def test_an_item_depends_on_nothing_but_seed_epoch_and_index(folder: Path) -> None:
    one, other = (SimulatedDataset(folder, "train", SETTINGS, 3, 0.5) for _ in range(2))
    for index in (7, 0, 5):
        one[index]
    for epoch in (0, 2):
        one.set_epoch(epoch)
        other.set_epoch(epoch)
        for index in range(12):
            np.testing.assert_array_equal(one[index].partial, other[index].partial)
            np.testing.assert_array_equal(one[index].truth, other[index].truth)
    one.set_epoch(1)
    assert any(len(one[k].partial) != len(other[k].partial) for k in range(8))


def test_the_share_is_kept_and_the_rest_are_the_samples_without_it(folder: Path) -> None:
    plain = CompletionDataset("train", SETTINGS, 3)
    for share in (0.0, 0.5, 1.0):
        mixed = SimulatedDataset(folder, "train", SETTINGS, 3, share)
        names = {cloud.object for cloud in mixed.clouds}
        simulated = [mixed[k].object_id in names for k in range(len(mixed))]
        assert abs(np.mean(simulated) - share) <= 0.25
        for index in np.flatnonzero(~np.array(simulated)).tolist():
            np.testing.assert_array_equal(mixed[index].partial, plain[index].partial)
    assert [mixed[k].label for k in range(8)] == [k % 4 for k in range(8)]


def test_no_point_of_a_training_cloud_is_new(folder: Path) -> None:
    """Thinned, turned, mirrored: distances between the points stay those of the cloud."""
    dataset = SimulatedDataset(folder, "train", replace(EXACT, vary_clouds=False), 1, 1.0)
    counts = set()
    for index in range(12):
        sample = dataset[index]
        counts.add(len(sample.partial))
        twins = [cloud for cloud in dataset.clouds if cloud.object == sample.object_id]
        heights = np.concatenate([cloud.xyz_m[:, 2] for cloud in twins])
        assert np.isin(np.round(sample.partial[:, 2], 3), np.round(heights, 3)).all()
    assert max(counts) == 300
    assert min(counts) >= SETTINGS.min_points


def test_a_varied_cloud_still_lies_on_its_truth(folder: Path) -> None:
    """Hidden parts, short windows and other sizes take both along; only strays, in a fifth of them, lie elsewhere."""
    for box_frame in (False, True):
        settings = replace(EXACT, box_frame=box_frame, truth_points=20_000)
        dataset = SimulatedDataset(folder, "train", settings, 1, 1.0)
        sizes = {cloud.object: np.array(ObjectRef.from_text(cloud.object).mesh().size_m) for cloud in dataset.clouds}
        stretched, far = 0, 0
        for index in range(24):
            sample = dataset[index]
            distance_m = nearest_distance(sample.partial, sample.truth)
            far += float(np.quantile(distance_m, 0.9)) > 0.1
            assert np.median(distance_m) < 0.03
            assert SETTINGS.min_points <= len(sample.partial) <= SETTINGS.max_points
            assert sample.power_db is not None
            assert len(sample.power_db) == len(sample.partial)
            stretched += not np.allclose(sample.size_m, sizes[sample.object_id], rtol=1e-4)
            if box_frame:
                np.testing.assert_allclose(np.ptp(sample.truth, axis=0), sample.size_m, rtol=0.1)
        assert 5 <= stretched <= 19
        assert far <= 8


def soiled_cloud(item: Item) -> Cloud:
    """30 more points in a clump two metres behind the object, as seen from the radar, and 2.5 m above the ground."""
    cloud = fake_cloud(item)
    middle_m = cloud.translation_m + np.array([0, 0, 2.5])
    away = cloud.xyz_m.mean(axis=0)[:2] - cloud.sensor_m[:2]
    middle_m[:2] += 2 * away / np.linalg.norm(away)
    clump = np.random.default_rng(item.seed).normal(middle_m, 0.05, (30, 3))
    return replace(
        cloud,
        xyz_m=np.concatenate([cloud.xyz_m, clump]).astype(np.float32),
        power_db=np.pad(cloud.power_db, (0, 30)),
        frame_number=np.pad(cloud.frame_number, (0, 30), mode="edge"),
    )


def test_strays_of_other_drive_bys_lie_where_they_lay(tmp_path: Path) -> None:
    build(small_plan(objects=12, drive_bys=4), tmp_path / "set", Here(), soiled_cloud)
    found, most = 0, 0.0
    for box_frame in (False, True):
        dataset = SimulatedDataset(tmp_path / "set", "train", replace(EXACT, box_frame=box_frame), 3, 0.0)
        for index in range(40):
            sample = dataset[index]
            middle = (sample.truth.max(axis=0) + sample.truth.min(axis=0)) / 2
            place = np.array([middle[0] + 2, middle[1], 2.5])
            strays = np.linalg.norm(sample.partial - place, axis=1) < 0.6
            assert not (box_frame and strays.any())
            found += bool(strays.any())
            most = max(most, float(strays.mean()))
    assert 4 <= found <= 20
    assert 0.05 < most < 0.12, "30 of 330 points of the other cloud"


def test_splits_hold_their_own_objects(folder: Path) -> None:
    for split in ("train", "val", "test"):
        dataset = SimulatedDataset(folder, split, SETTINGS, 0)
        assert {ObjectRef.from_text(cloud.object).split for cloud in dataset.clouds} == {split}


def test_merged_missing_failed_and_small_clouds_are_left_out(folder: Path, tmp_path: Path) -> None:
    everything = SimulatedDataset(folder, "train", SETTINGS, 0).clouds

    def spoil(shard: Shard) -> Shard:
        radar = [c for c in shard.clouds if c.kind == "simulated" and shard.objects[c.object].split == "train"]
        few = {k: getattr(radar[1], k)[:20] for k in ("xyz_m", "power_db", "frame_number")}
        return replace(shard, clouds=(replace(radar[0], status="merged"), replace(radar[1], **few), *radar[2:]))

    left = SimulatedDataset(change(folder, tmp_path / "one", spoil), "train", SETTINGS, 0).clouds
    shard = read_shard(folder / shard_name(0))
    assert (
        len(left) == sum(c.kind == "simulated" and c.object in shard.objects for c in everything if _in(shard, c)) - 2
    )


def _in(shard: Shard, cloud: Any) -> bool:
    return cloud.object in shard.objects


def test_another_mesh_under_the_same_name_is_refused(folder: Path, tmp_path: Path) -> None:
    def grow(shard: Shard) -> Shard:
        return replace(shard, objects={n: replace(i, size_m=(9.0, 9.0, 9.0)) for n, i in shard.objects.items()})

    dataset = SimulatedDataset(change(folder, tmp_path / "one", grow), "train", SETTINGS, 0, 1.0)
    with pytest.raises(MeshError, match="not the object that the radar saw"):
        dataset[0]


def test_a_packed_file_serves_as_well(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "set.clouds"
    export_clouds(folder, file)
    packed, whole = (SimulatedDataset(source, "train", SETTINGS, 0, 1.0) for source in (file, folder))
    assert packed.description == whole.description
    for index in range(6):
        np.testing.assert_array_equal(packed[index].partial, whole[index].partial)


def test_several_sets_are_one(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    build(small_plan(objects=8, drive_bys=2, seed=5), other, Here(), fake_cloud)
    for split in ("train", "val"):
        both = SimulatedDataset([folder, other], split, EXACT, 0)  # type: ignore[arg-type]
        parts = [SimulatedDataset(one, split, EXACT, 0) for one in (folder, other)]  # type: ignore[arg-type]
        assert [cloud.seed for cloud in both.clouds] == [cloud.seed for part in parts for cloud in part.clouds]
        assert all(part.identity in both.identity for part in parts)
    assert len(both) == sum(len(part) for part in parts)
    with pytest.raises(RecordingError, match=f"{folder}, {other}: no cloud"):
        SimulatedDataset([folder, other], "val", replace(EXACT, min_points=500), 0)


def test_objects_that_are_not_on_this_machine_are_left_out(folder: Path, tmp_path: Path) -> None:
    def rename(shard: Shard) -> Shard:
        return replace(
            shard,
            clouds=tuple(replace(c, object=c.object.replace("parametric_", "collected-")) for c in shard.clouds),
            objects={n.replace("parametric_", "collected-"): i for n, i in shard.objects.items()},
        )

    with pytest.raises(RecordingError, match="not on this machine"):
        SimulatedDataset(change(folder, tmp_path / "one", rename), "train", SETTINGS, 0)


def test_a_run_is_not_continued_with_other_clouds(folder: Path) -> None:
    half = SimulatedDataset(folder, "train", SETTINGS, 0, 0.5)
    third = SimulatedDataset(folder, "train", SETTINGS, 0, 0.3)
    assert half.description != third.description
    assert set(CompletionDataset("train", SETTINGS, 0).description) < set(half.description)


def test_what_cannot_work_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="simulated_share"):
        SimulatedDataset(folder, "train", SETTINGS, 0, 1.5)
    with pytest.raises(RecordingError, match="not one data set"):
        SimulatedDataset(tmp_path, "train", SETTINGS, 0)
