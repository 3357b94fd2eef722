# SPDX-License-Identifier: Apache-2.0
"""Evaluation: baselines answer what they say, the gate compares class by class, the floor is near zero."""

from __future__ import annotations

import numpy as np
import pytest

from edge.errors import ConfigError
from train.baselines import Bank, collapse, input_itself
from train.dataset import CLASSES, CompletionDataset, DatasetSettings, Sample
from train.evaluate import FLOOR, MACRO, Scores, evaluate, int8_is_good, spread, table

DATA = DatasetSettings(truth_points=2048, max_points=300, epoch_samples=64, parametric_objects=2, evaluation_views=1)


@pytest.fixture(scope="module")
def train() -> CompletionDataset:
    return CompletionDataset("train", DATA, 0)


def test_retrieval_of_a_known_shape_finds_it(train: CompletionDataset) -> None:
    bank = Bank(train, 12)
    for index in (0, 3):
        sample = train[index]
        whole = Sample(sample.truth + np.float32([3, 0, 0]), sample.truth, sample.label, sample.object_id)
        shifted = bank.retrieve(whole)
        assert np.abs(np.sort(shifted[:, 2]) - np.sort(sample.truth[:, 2])).max() < 0.3
        np.testing.assert_allclose(shifted[:, 2].min(), sample.truth[:, 2].min(), atol=0.1)  # heights are kept
        assert len(shifted) == 2048


def test_simple_baselines(train: CompletionDataset) -> None:
    sample = train[1]
    np.testing.assert_array_equal(input_itself(sample), sample.partial)
    middle = collapse(sample)[0]
    np.testing.assert_allclose(middle * 2, sample.partial.max(0) + sample.partial.min(0), rtol=1e-5, atol=1e-6)
    mean = Bank(train, 8).class_mean(sample)
    assert len(mean) >= len(sample.truth)
    with pytest.raises(ConfigError, match="bank"):
        Bank(train, 3)


def test_evaluation_has_every_baseline_and_a_low_floor(train: CompletionDataset) -> None:
    scores = evaluate({}, CompletionDataset("val", DATA, 0), 4, 1, Bank(train, 8))
    assert len(scores) == 6
    assert scores[FLOOR].summary("cd_cm").mean < 4
    assert scores["collapse to centre"].summary("cd_cm").mean > scores["input as output"].summary("cd_cm").mean
    assert scores[FLOOR].classes == list(CLASSES)
    text = table(scores, [(name, name, MACRO) for name in scores])
    assert text.count("\n") == len(scores) + 1


def made(distances_cm: list[float]) -> Scores:
    return Scores({"cd_cm": distances_cm}, [str(i) for i in range(4)], [0, 0, 1, 1])


def test_gate_looks_at_every_class() -> None:
    full = made([10, 10, 5, 5])
    assert int8_is_good({"f": full, "s": made([10.1, 10.05, 5, 5])}, "f", "s")
    assert not int8_is_good({"f": full, "s": made([9, 9, 5.1, 5.1])}, "f", "s")


def test_indices_are_spread_and_unique() -> None:
    assert spread(10, 4) == [0, 3, 6, 9]
    assert spread(3, 100) == [0, 1, 2]
