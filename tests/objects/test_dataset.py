# SPDX-License-Identifier: Apache-2.0
"""The data set: deterministic, balanced, one frame for input and truth, nothing padded, nothing shared by splits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from edge.errors import ConfigError
from train.dataset import CLASSES, CompletionDataset, DatasetSettings, Sample, mean_shape
from train.perturb import PerturbSettings

SMALL = DatasetSettings(truth_points=2048, max_points=512, epoch_samples=64, parametric_objects=6)


@pytest.fixture(scope="module")
def train() -> CompletionDataset:
    return CompletionDataset("train", SMALL, 3)


def test_samples_are_as_promised(train: CompletionDataset) -> None:
    for index in range(32):
        sample = train[index]
        assert sample.partial.dtype == sample.truth.dtype == np.float32
        assert sample.partial.flags.c_contiguous
        assert sample.truth.flags.c_contiguous
        assert 64 <= len(sample.partial) <= 512
        assert sample.truth.shape == (2048, 3)
        assert sample.label == index % 4
        assert sample.object_id.startswith(CLASSES[sample.label] + "/")
        assert len(np.unique(sample.partial, axis=0)) == len(sample.partial)
        assert abs(sample.truth[:, 2].min()) < 0.1  # on the ground, but for the error of its height
        low, high = sample.partial.min(axis=0), sample.partial.max(axis=0)
        np.testing.assert_allclose(low[:2] + high[:2], 0, atol=1e-5)


def test_input_lies_on_the_truth(train: CompletionDataset) -> None:
    """Both are in one frame: most input points are near the complete surface."""
    for index in range(16):
        sample = train[index]
        distance = cKDTree(sample.truth).query(sample.partial)[0]
        assert np.median(distance) < 0.15, sample.object_id


def test_determinism_in_seed_epoch_and_index(train: CompletionDataset) -> None:
    again = CompletionDataset("train", SMALL, 3)
    np.testing.assert_array_equal(train[5].partial, again[5].partial)
    np.testing.assert_array_equal(train[5].truth, again[5].truth)
    other = CompletionDataset("train", SMALL, 4)[5]
    assert not np.array_equal(other.truth, train[5].truth)
    before = train[5].truth
    train.set_epoch(1)
    assert not np.array_equal(train[5].truth, before)
    train.set_epoch(0)
    np.testing.assert_array_equal(train[5].truth, before)


def test_evaluation_does_not_change_with_the_epoch() -> None:
    test = CompletionDataset("test", SMALL, 3)
    before = test[9]
    test.set_epoch(7)
    np.testing.assert_array_equal(test[9].partial, before.partial)
    assert len(test) == 4 * 12 * 8


def test_the_object_lies_behind_what_was_seen_of_it() -> None:
    """x points away from the radar: what is hidden lies at higher x, as often to the left as to the right."""
    data = CompletionDataset("train", SMALL, 1)
    samples = [data[index] for index in range(0, 64, 4)]  # cars
    behind = np.array([sample.truth.mean(axis=0) - sample.partial.mean(axis=0) for sample in samples])
    assert np.mean(behind[:, 0] > 0) > 0.85  # a cloud of its rear half alone may lie behind its middle
    assert abs(behind[:, 1].mean()) < behind[:, 0].mean() / 2


def test_errors_of_sight_and_ground_are_as_large_as_set() -> None:
    """The same draws without the errors differ by a turn about z and a shift."""
    exact = CompletionDataset("val", replace(SMALL, sight_sigma_deg=0.0, ground_sigma_m=0.0), 0)
    wrong = CompletionDataset("val", replace(SMALL, sight_sigma_deg=4.0, ground_sigma_m=0.03), 0)
    turns_deg, heights_m = [], []
    for index in range(0, 384, 6):
        before, after = exact[index], wrong[index]
        heights_m.append(float((after.truth - before.truth)[:, 2].mean()))
        old, new = (s.truth[:, :2] - s.truth[:, :2].mean(axis=0) for s in (before, after))
        cross = old[:, 0] * new[:, 1] - old[:, 1] * new[:, 0]
        turns_deg.append(np.degrees(np.arctan2(cross.sum(), (old * new).sum())))
        np.testing.assert_allclose(np.hypot(*old.T), np.hypot(*new.T), atol=1e-5)
    assert np.std(turns_deg) == pytest.approx(4.0, rel=0.3)
    assert np.std(heights_m) == pytest.approx(0.03, rel=0.3)


def test_heading_is_random_but_not_in_the_box_frame() -> None:
    box = CompletionDataset("val", replace(SMALL, box_frame=True), 0)
    free = CompletionDataset("val", SMALL, 0)
    for index in (0, 9, 17):
        long = np.ptp(box[index].truth, axis=0)
        assert long[0] > 1.5 * long[1]  # a car, along x
        low, high = box[index].truth.min(axis=0), box[index].truth.max(axis=0)
        np.testing.assert_allclose(low[:2] + high[:2], 0, atol=0.3)  # 2048 points rarely hit the tip of a mirror
        assert free[index].object_id == box[index].object_id
    directions = []
    for index in range(40):
        xy = free[index].truth[:, :2]
        directions.append(np.linalg.eigh(np.cov(xy.T))[1][:, 1])
    angles = np.degrees([np.arctan2(d[1], d[0]) % np.pi for d in directions])
    assert np.ptp(angles) > 120


def test_splits_share_no_object(object_data: Path) -> None:
    settings = replace(SMALL, objects_dir=object_data)
    train, val, test = (set(CompletionDataset(s, settings, 0).object_ids) for s in ("train", "val", "test"))
    assert train
    assert val
    assert test
    assert not train & val
    assert not train & test
    assert not val & test
    data = CompletionDataset("test", settings, 0)
    drawn = {data.mesh(i).object_id for i in range(0, len(data), 8)}
    assert drawn == test
    assert all(data.mesh(i).provenance != "own" for i in range(0, len(data), 8))


def test_library_and_parametric_objects_are_mixed(object_data: Path) -> None:
    data = CompletionDataset("train", replace(SMALL, objects_dir=object_data), 0)
    origins = {data.mesh(i).provenance for i in range(40)}
    assert "own" in origins
    assert origins & {"A", "B", "C"}
    assert "P" in origins


def test_riders_are_drawn_for_half_of_the_two_wheelers(object_data: Path) -> None:
    """Of the library's, in train only; the share is a setting."""
    only_library = dict.fromkeys(CLASSES, (1.0, 0.0, 0.0))
    settings = replace(SMALL, objects_dir=object_data, origin_share=only_library)  # type: ignore[arg-type]
    data = CompletionDataset("train", settings, 0)
    ridden = ["@" in data.mesh(index).object_id for index in range(64) if index % 4 in (1, 2)]
    assert 0.25 < np.mean(ridden) < 0.75
    never = CompletionDataset("train", replace(settings, rider_share=0.0), 0)
    assert not any("@" in never.mesh(index).object_id for index in range(32))
    test = CompletionDataset("test", settings, 0)
    assert not any("@" in test.mesh(index).object_id for index in range(0, len(test), 8))


def test_parametric_evaluation_objects_differ_from_training_ones() -> None:
    train, test = CompletionDataset("train", SMALL, 0), CompletionDataset("test", SMALL, 0)
    assert not {train.mesh(i).object_id for i in range(64)} & {test.mesh(i).object_id for i in range(0, len(test), 8)}


def test_loader_with_workers_gives_the_same_samples(train: CompletionDataset) -> None:
    def keep(batch: list[Sample]) -> list[Sample]:
        return batch

    loader = torch.utils.data.DataLoader(train, batch_size=8, num_workers=1, collate_fn=keep)
    first = next(iter(loader))
    np.testing.assert_array_equal(first[3].partial, train[3].partial)


def test_mean_shape_covers_the_data(train: CompletionDataset) -> None:
    shape = mean_shape(train, 512)
    assert shape.shape == (512, 3)
    assert shape.dtype == np.float32
    np.testing.assert_array_equal(shape, mean_shape(train, 512))
    assert shape[:, 2].min() >= -0.1
    assert 1.0 < shape[:, 2].max() < 3.0
    assert mean_shape(train, 7).shape == (7, 3)


def test_settings_that_cannot_work_are_refused(train: CompletionDataset) -> None:
    with pytest.raises(ConfigError, match="min_points"):
        DatasetSettings(min_points=100, max_points=50)
    with pytest.raises(ConfigError, match="origin_share"):
        DatasetSettings(origin_share={"car": (1, 0, 0)})
    with pytest.raises(ConfigError, match="split"):
        CompletionDataset("holdout", SMALL, 0)  # type: ignore[arg-type]
    with pytest.raises(IndexError):
        train[64]


def test_paper_settings_work_too() -> None:
    sample = CompletionDataset("train", replace(SMALL, perturbation=PerturbSettings.paper()), 0)[0]
    assert len(sample.partial) == 512  # several copies of 400..1500 points, cut at the limit
