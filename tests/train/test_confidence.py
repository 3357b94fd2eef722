# SPDX-License-Identifier: Apache-2.0
"""Confidence: known weights are recovered, promises are kept, clutter and noise are not trusted, files are checked."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from edge.completion.confidence import HEADS, ConfidenceModel, measures, quadratic
from edge.completion.sight import turned
from edge.errors import ConfigError, ModelError
from edge.frames import Float32
from train.calibration import reliability, risk_coverage
from train.confidence import Observations, fit_confidence, logistic_fit, signed_fit
from train.degrade import CLUTTER, clutter

RNG = np.random.default_rng


def sphere(count: int, radius_m: float = 1.0, seed: int = 0) -> Float32:
    direction = RNG(seed).normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return (radius_m * direction + (0, 0, radius_m)).astype(np.float32)


def test_reliability_of_known_probabilities() -> None:
    chance = RNG(0).uniform(size=40_000)
    event = (RNG(1).uniform(size=40_000) < chance).astype(float)
    kept = reliability(chance, event)
    assert kept.error < 0.015
    assert kept.brier == pytest.approx(1 / 6, abs=0.005)  # mean of p (1 - p) for a uniform p
    wrong = reliability(np.full(1000, 0.8), np.arange(1000) % 2)
    assert wrong.error == pytest.approx(0.3)
    assert (wrong.promised.tolist(), wrong.count.tolist()) == (pytest.approx([0.8]), [1000])
    assert reliability([1.0, 0.0], [1, 0]).error == 0
    for bad in (([1.2], [1]), ([0.5], [0.5]), ([], [])):
        with pytest.raises(ConfigError, match="reliability"):
            reliability(*bad)


def test_risk_coverage_of_known_orders() -> None:
    loss = np.arange(10.0)
    right = risk_coverage(-loss, loss)
    assert right.area == right.best == pytest.approx(np.mean([k / 2 for k in range(10)]))
    assert (right.at(1.0), right.at(0.5), right.at(0.01)) == (4.5, 2.0, 0.0)
    assert risk_coverage(loss, loss).area > risk_coverage(np.zeros(10), np.full(10, 4.5)).area == 4.5
    with pytest.raises(ConfigError, match="risk_coverage"):
        risk_coverage([1.0], [math.nan])


def test_logistic_fit_recovers_known_weights() -> None:
    rng, weights = RNG(2), np.array([0.5, 1.5, -1.0])
    terms = np.concatenate([np.ones((20_000, 1)), rng.normal(size=(20_000, 2))], axis=1)
    event = rng.uniform(size=20_000) < 1 / (1 + np.exp(-terms @ weights))
    np.testing.assert_allclose(logistic_fit(terms, event), weights, atol=0.06)
    always = logistic_fit(terms[:50], np.ones(50, bool))  # separable: the ridge keeps it finite
    assert np.isfinite(always).all()


def observations(count: int, seed: int) -> Observations:
    """Road users whose fate follows from two measures, and clutter about a point away from them."""
    rng, others = RNG(seed), count // 4
    near, points, long = rng.normal(size=count), rng.normal(size=count), rng.normal(size=count)
    good = rng.uniform(size=count) < 1 / (1 + np.exp(-(0.5 + 2 * near + points)))
    right = rng.uniform(size=count) < 1 / (1 + np.exp(-(1.5 + points)))
    names = ("near", "points", "long")
    measured = [dict(zip(names, map(float, one), strict=True)) for one in zip(near, points, long, strict=True)]
    turn = rng.uniform(0, 2 * math.pi, others)
    ring = [{"near": 5 * math.cos(a), "points": float(rng.normal()), "long": 5 * math.sin(a)} for a in turn]
    cd_m = np.concatenate([np.where(good, 0.05, 0.3), np.full(others, np.nan)])
    return Observations(
        measured + ring, cd_m, np.concatenate([right, np.zeros(others, bool)]), np.arange(count + others) < count
    )


def test_fitted_confidence_keeps_its_promises_and_knows_clutter() -> None:
    model, fresh = fit_confidence(observations(2000, 0)), observations(2000, 1)
    trust = [model.trust(one) for one in fresh.measured]
    known = fresh.known
    shape, right = (np.array([getattr(one, name) for one in trust]) for name in ("shape", "class_right"))
    assert reliability(shape[known], fresh.cd_m[known] < 0.15).error < 0.04
    assert reliability(right[known], fresh.right[known]).error < 0.04
    assert 0.5 <= model.unknown_below <= 0.8
    assert (
        np.mean([model.is_unknown(one) for one, k in zip(trust, known, strict=True) if not k]) > 0.9
    )  # a ring about all
    with pytest.raises(ConfigError, match="confidence"):
        fit_confidence(observations(8, 0))


def test_less_is_never_trusted_more() -> None:
    """Even where the data say so by chance: here the fate of shape and class is better with fewer points."""
    data = observations(2000, 0)
    turned_round = replace(data, measured=[one | {"points": -one["points"]} for one in data.measured])
    model = fit_confidence(turned_round)
    one = {"near": 0.5, "long": 0.0}
    few, many = (model.trust(one | {"points": points}) for points in (-2.0, 2.0))
    assert few == many
    few, many = (fit_confidence(data).trust(one | {"points": points}) for points in (-2.0, 2.0))
    assert few.shape < many.shape
    assert few.class_right < many.class_right
    assert few.known == many.known


def test_signed_fit_holds_wrong_signs_at_zero() -> None:
    rng = RNG(5)
    terms = np.concatenate([np.ones((20_000, 1)), rng.normal(size=(20_000, 2))], axis=1)
    event = rng.uniform(size=20_000) < 1 / (1 + np.exp(-terms @ np.array([0.5, 1.5, -1.0])))
    np.testing.assert_allclose(signed_fit(terms, event, np.array([0, 1, -1])), [0.5, 1.5, -1.0], atol=0.06)
    held = signed_fit(terms, event, np.array([0, 1, 1]))
    assert held[2] == 0
    np.testing.assert_allclose(held[:2], logistic_fit(terms[:, :2], event))


def test_measures_of_known_clouds() -> None:
    surface = sphere(16384)
    found = measures(sphere(512, seed=1), surface, np.float32([0.9, 0.1]), 15)
    assert (found["points"], found["frames"], found["near"], found["below"]) == (1, -2, 1, 0)
    assert found["odds"] == pytest.approx(math.log(9), rel=1e-4)
    for name in ("long", "wide", "answer_long"):  # one axis of a unit sphere: deviation 1 / sqrt(3)
        assert found[name] == pytest.approx(math.log2(1 / math.sqrt(3)), abs=0.15)
    assert found["seen"] > 0.95
    far = measures(sphere(512, seed=1) + np.float32([4, 0, 0]), surface, None, 60, 0.25)
    assert far["near"] < 0.05
    assert far["seen"] < 0.05
    assert "odds" not in far
    assert far["sigma"] == -2
    shell = sphere(300, 1.3) - np.float32([0, 0, 0.3])  # 30 cm outside everywhere
    assert 2 ** measures(shell, surface, None, 60)["away"] == pytest.approx(0.3, rel=0.1)
    half = surface[surface[:, 0] < 0]
    assert 0.4 < measures(half, surface, None, 60)["seen"] < 0.75


def test_measures_do_not_depend_on_the_heading() -> None:
    points, fine = clutter("box", RNG(0)), sphere(16384)
    one = measures(points, fine, None, 60)
    for angle_rad in (0.5, 2.0):
        other = measures(turned(points, angle_rad), turned(fine, angle_rad), None, 60)
        assert other == pytest.approx(one, abs=1e-3)


def test_the_manifest_section_is_read_as_written_and_checked() -> None:
    model = fit_confidence(observations(200, 0))
    again = ConfidenceModel.from_dict(model.to_dict())
    assert again == model
    one = {"near": 0.3, "points": -1.0, "long": 0.2}
    assert again.trust(one) == model.trust(dict(reversed(one.items())))
    good = model.to_dict()
    bad: list[dict[str, object]] = [
        {"names": []},
        {"scale": [0.0, 1.0, 1.0]},
        {"mean": [math.nan, 0.0, 0.0]},
        {"unknown_below": 2},
        {"heads": good["heads"] | {"class": (1.0,)}},
        {"heads": {head: good["heads"][head] for head in HEADS[:2]}},
        {"more": 1},
        {"shape_limit_m": "a"},
    ]
    for change in bad:
        with pytest.raises(ModelError, match="confidence section"):
            ConfidenceModel.from_dict(good | change)
    with pytest.raises(ModelError, match="confidence section"):
        ConfidenceModel.from_dict(None)
    with pytest.raises(ModelError, match="near"):
        model.trust({"points": 0.0, "near": math.nan, "long": 0.0})
    assert not replace(model, unknown_below=0.0).is_unknown(model.trust({"near": 0.0, "points": 0.0, "long": 0.0}))


def test_quadratic_terms_in_order() -> None:
    np.testing.assert_array_equal(quadratic(np.array([[2.0, 3.0]])), [[1, 2, 3, 4, 6, 9]])


@pytest.mark.parametrize("kind", CLUTTER)
def test_clutter_looks_like_a_segment(kind: str) -> None:
    for seed in range(3):
        cloud = clutter(kind, RNG(seed))
        assert 64 <= len(cloud) <= 1024
        assert cloud.dtype == np.float32
        assert cloud[:, 2].min() >= 0
        assert cloud[:, 2].max() < 3.8
        np.testing.assert_allclose(cloud[:, :2].max(axis=0), -cloud[:, :2].min(axis=0), atol=1e-5)
