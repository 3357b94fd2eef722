# SPDX-License-Identifier: Apache-2.0
"""Evaluation: baselines answer what they say, the gate compares class by class, the floor is near zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from edge.errors import ConfigError, ModelError
from train.baselines import Bank, collapse, input_itself
from train.dataset import CLASSES, CompletionDataset, DatasetSettings, Sample
from train.evaluate import (
    BIKE,
    FLOOR,
    MACRO,
    PAPER,
    Scores,
    evaluate,
    int8_is_faster,
    int8_is_good,
    measure,
    spread,
    table,
)
from train.held_out import Case, HeldOut
from train.network import Completion, CompletionModel, Frame
from train.predictors import Answer, EdgePredictor, TorchPredictor

DATA = DatasetSettings(
    truth_points=2048,
    max_points=300,
    epoch_samples=64,
    parametric_objects=2,
    evaluation_views=1,
    neighbour_probability=0.0,
)


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


def test_eight_bits_must_be_a_tenth_faster() -> None:
    def lasting(times_ms: list[float]) -> Scores:
        return Scores({"time_ms": times_ms}, [str(i) for i in range(4)], [0, 0, 1, 1])

    full = lasting([10, 10, 10, 50])
    assert int8_is_faster({"f": full, "s": lasting([8, 9, 9, 100])}, "f", "s")
    assert not int8_is_faster({"f": full, "s": lasting([9.5, 9.5, 9.5, 1])}, "f", "s")


def test_indices_are_spread_and_unique() -> None:
    assert spread(10, 4) == [0, 3, 6, 9]
    assert spread(3, 100) == [0, 1, 2]


def test_known_predictors_score_what_they_must() -> None:
    cases = HeldOut(CompletionDataset("val", DATA, 0)).spread(8)
    calls: list[int] = []

    def perfect(case: Case) -> Answer:
        calls.append(case.number)
        named = np.eye(4, dtype=np.float32)[case.sample.label]
        return Answer(case.sample.truth, None, named, 1.0, CLASSES[case.sample.label])

    def constant(case: Case) -> Answer:
        return Answer(case.sample.truth, None, np.float32([0, 1, 0, 0]), 0.5, "unknown")

    scores = measure({"perfect": perfect, "constant": constant}, cases, 2)
    assert sorted(calls) == sorted(cases.indices)
    best, same = scores["perfect"], scores["constant"]
    assert best.summary("cd_cm").mean == 0
    assert best.summary("class_right").mean == best.summary("named").mean == 1
    assert sum(np.isfinite(best.values["emd_cm"])) == 2
    assert same.summary("class_right").mean == 0.25  # one class of four
    assert same.summary("paper_class_right", BIKE).mean == 1
    assert same.summary("paper_class_right", PAPER).mean == pytest.approx(1 / 3)
    assert same.summary("named").mean == 0


def test_bikes_are_one_class_of_the_paper() -> None:
    scores = Scores({"cd_cm": [9.0, 1.0, 2.0, 3.0, 30.0]}, list("abcde"), [0, 1, 1, 2, 3])
    assert scores.summary("cd_cm", BIKE).mean == 2
    assert scores.summary("cd_cm", PAPER).mean == pytest.approx((9 + 2 + 30) / 3)
    assert scores.summary("cd_cm", MACRO).mean == pytest.approx((9 + 1.5 + 3 + 30) / 4)
    assert not Scores({"cd_cm": [1.0]}, ["a"], [0]).measured("cd_cm", BIKE)


def test_the_edge_runtime_answers_in_the_frame_of_the_case() -> None:
    predictor = EdgePredictor(Path("models/default"))
    case = HeldOut(CompletionDataset("val", DATA, 0))[0]
    answer = predictor(case)
    expected = predictor.model.run(case.sample.partial)
    np.testing.assert_allclose(answer.fine_m, expected[0], atol=0.02)  # int8: a bearing of 1e-7 may tip a bit
    assert answer.confidence is not None
    assert answer.probability is not None
    assert answer.probability.sum() == pytest.approx(1, abs=1e-3)
    with pytest.raises(ModelError, match="no shape"):
        predictor(case.seen_as(case.sample.partial[:10]))


@pytest.mark.parametrize("frame", ["sight", "box"])
def test_a_network_in_torch_answers_in_metres(frame: Frame) -> None:
    class Echo(CompletionModel):
        def forward(
            self, points_m: torch.Tensor, counts: Sequence[int], cells: torch.Tensor | None = None
        ) -> Completion:
            assert frame == "sight" or points_m.abs().max() < 0.6
            return Completion(points_m[None, :1], points_m[None], torch.zeros(1, 0), torch.zeros(1, 4))

    data = replace(DATA, box_frame=frame == "box")
    case = HeldOut(CompletionDataset("val", data, 0))[0]
    predictor = TorchPredictor(Echo(frame))
    answer = predictor(case)
    np.testing.assert_allclose(answer.fine_m, case.sample.partial, atol=1e-5)
    assert answer.probability is None
    assert answer.sigma_m == pytest.approx(case.diagonal_m if frame == "box" else 5.0)
    assert predictor.box_frame == (frame == "box")
