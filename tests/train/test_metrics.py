# SPDX-License-Identifier: Apache-2.0
"""Metrics against brute force and closed forms; the summary against means by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from edge.errors import ConfigError
from train.metrics import emd_distances, emd_excess, shape_metrics, summarize


def test_metrics_equal_brute_force() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.uniform(-1, 1, (n, 3)).astype(np.float32) for n in (150, 220))
    distance = cdist(first.astype(float), second.astype(float))
    forth, back = distance.min(1), distance.min(0)
    result = shape_metrics(first, second, with_emd=False)
    assert result["accuracy_cm"] == pytest.approx(100 * forth.mean(), rel=1e-5)
    assert result["completeness_cm"] == pytest.approx(100 * back.mean(), rel=1e-5)
    assert result["cd_cm"] == pytest.approx(50 * (forth.mean() + back.mean()), rel=1e-5)
    assert result["cd_sum_cm"] == pytest.approx(2 * result["cd_cm"])
    assert result["cd_squared_cm2"] == pytest.approx(1e4 * ((forth**2).mean() + (back**2).mean()), rel=1e-5)
    precision, recall = (forth < 0.1).mean(), (back < 0.1).mean()
    assert result["f_10cm"] == pytest.approx(2 * precision * recall / (precision + recall))
    assert math.isnan(result["emd_cm"])


def test_a_perfect_answer_is_perfect() -> None:
    cloud = np.random.default_rng(1).uniform(-1, 1, (2048, 3)).astype(np.float32)
    result = shape_metrics(cloud[::-1], cloud)
    assert result["cd_cm"] == 0
    assert result["f_5cm"] == result["f_1pct"] == 1
    assert result["emd_cm"] == pytest.approx(0, abs=0.05)


def test_shifted_plane_has_known_distances() -> None:
    x, y = np.meshgrid(np.arange(40) * 0.05, np.arange(40) * 0.05)
    plane = np.stack([x.ravel(), y.ravel(), np.zeros(1600)], 1).astype(np.float32)
    result = shape_metrics(plane + np.float32([0, 0, 0.07]), plane, with_emd=False)
    assert result["cd_cm"] == pytest.approx(7, rel=1e-4)
    assert result["cd_squared_cm2"] == pytest.approx(98, rel=1e-4)
    assert result["f_5cm"] == 0
    assert result["f_10cm"] == 1


def test_emd_equals_the_exact_assignment() -> None:
    rng = np.random.default_rng(2)
    first, second = (rng.normal(size=(300, 3)).astype(np.float32) for _ in range(2))
    cost = cdist(first, second)
    exact = cost[linear_sum_assignment(cost)].mean()
    assert exact <= emd_distances(first, second, 0, 300).mean() * (1 + 1e-6) <= 1.01 * exact


def test_collapsed_answer_has_the_mean_distance_as_emd() -> None:
    truth = np.random.default_rng(3).normal(size=(500, 3)).astype(np.float32)
    distance = emd_distances(np.zeros((1, 3), np.float32), truth, 0, 500)
    assert distance.mean() == pytest.approx(np.linalg.norm(truth, axis=1).mean(), rel=1e-5)


@pytest.mark.parametrize("bad", [np.zeros((0, 3), np.float32), np.full((4, 3), np.nan, np.float32)])
def test_bad_clouds_are_refused(bad: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="prediction"):
        shape_metrics(bad, np.ones((4, 3), np.float32))


def test_summary_is_the_mean_of_class_means_over_whole_objects() -> None:
    summary = summarize([1, 1, 1, 5, math.nan], ["a", "a", "b", "c", "c"], [0, 0, 0, 1, 1])
    assert (summary.mean, summary.median, summary.count) == (3, 1, 4)
    assert summary.low == summary.high == 3
    wide = summarize([0, 10] * 20, [str(i) for i in range(40)], [0] * 40)
    half_width = 1.96 * 5 / math.sqrt(40)
    assert wide.high - wide.mean == pytest.approx(half_width, rel=0.15)
    with pytest.raises(ConfigError):
        summarize([math.nan], ["a"], [0])


def test_two_spheres_shifted_against_each_other() -> None:
    """A sphere shifted by d: the distance to the surface is d |cos|, on average d / 2; every match costs d."""
    direction = np.random.default_rng(4).normal(size=(20_000, 3))
    sphere = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    result = shape_metrics(sphere[:2048] + np.float32([0.2, 0, 0]), sphere[:2048])
    assert result["emd_cm"] == pytest.approx(20, rel=0.011)
    result = shape_metrics(sphere + np.float32([0.2, 0, 0]), sphere, with_emd=False, diagonal_m=4.0)
    assert result["cd_cm"] == pytest.approx(10, rel=0.03)  # gaps between points add to it
    assert result["cd_squared_cm2"] == pytest.approx(2 * 400 / 3, rel=0.03)
    assert result["cd_unit_cm"] == pytest.approx(result["cd_cm"] / 4)
    assert result["f_10cm"] == pytest.approx(0.5, abs=0.02)  # |cos| is uniform


def test_the_auction_is_within_a_percent_of_the_exact_assignment() -> None:
    rng = np.random.default_rng(5)
    first, second = (rng.normal(size=(400, 3)).astype(np.float32) for _ in range(2))
    assert -1e-6 <= emd_excess(first, second, 0, 400) <= 0.01
