# SPDX-License-Identifier: Apache-2.0
"""Neighbours against a k-d tree, the auction against the exact solver, the losses against their written definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from edge.errors import ConfigError
from edge.frames import Float32
from train.auction import assign
from train.auction_batched import assign_batched
from train.losses import LossSettings, Matcher, alpha, chamfer, completion_loss, emd, nearest_blocks
from train.nearest import nearest_distance
from train.network import SCALE_M, Completion
from train.networks.registry import build


def surface(rng: np.random.Generator, points: int, size: tuple[float, float, float] = (2.2, 0.9, 0.7)) -> Float32:
    direction = rng.normal(size=(points, 3))
    return (direction / np.linalg.norm(direction, axis=1, keepdims=True) * size).astype(np.float32)


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return Matcher(1)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    queries=st.integers(1, 300),
    targets=st.integers(1, 3000),
    far=st.sampled_from([0.0, 1.0, 100.0]),
    flat=st.booleans(),
)
def test_neighbours_equal_the_k_d_tree(seed: int, queries: int, targets: int, far: float, flat: bool) -> None:
    rng = np.random.default_rng(seed)
    target, query = surface(rng, targets), surface(rng, queries) * np.float32(1.1) + np.float32(far)
    if flat:
        target[:, 2] = 0
    expected, _ = cKDTree(target.astype(float)).query(query.astype(float))
    np.testing.assert_allclose(nearest_distance(query, target), expected, rtol=1e-5, atol=1e-6)


def test_neighbours_among_equal_points() -> None:
    target = np.ones((50, 3), np.float32)
    np.testing.assert_allclose(nearest_distance(target * 3, target), np.full(50, np.sqrt(12)), rtol=1e-6)


@pytest.mark.parametrize("points", [1, 2, 64, 512])
@pytest.mark.parametrize("shift", [0.0, 0.05, 3.0])
def test_auction_is_within_one_percent_of_the_optimum(points: int, shift: float) -> None:
    rng = np.random.default_rng(points)
    first = surface(rng, points)
    second = surface(rng, points, (2.0, 1.0, 0.6)) + np.float32(shift)
    cost = cdist(first, second)
    rows, columns = linear_sum_assignment(cost)
    partner = assign(first, second, 0.01)
    assert sorted(partner) == list(range(points))
    assert cost[np.arange(points), partner].mean() <= 1.01 * cost[rows, columns].mean() + 1e-6


def test_auction_finds_a_permutation_again_and_matches_a_single_point() -> None:
    rng = np.random.default_rng(0)
    first, order = surface(rng, 256), rng.permutation(256)
    np.testing.assert_array_equal(order[assign(first, first[order])], np.arange(256))
    assert len(set(assign(np.zeros_like(first), first))) == 256
    with pytest.raises(ConfigError):
        assign(first, first[:-1])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(value: float) -> None:
    good = surface(np.random.default_rng(0), 8)
    bad = good.copy()
    bad[3, 1] = value
    for first, second in ((good, bad), (bad, good)):
        with pytest.raises(ConfigError, match="finite"):
            assign(first, second)
        with pytest.raises(ConfigError, match="finite"):
            nearest_distance(first, second)


@pytest.mark.parametrize("squared", [False, True])
def test_chamfer_equals_its_definition(matcher: Matcher, squared: bool) -> None:
    rng = np.random.default_rng(1)
    first, second = surface(rng, 200), surface(rng, 300)
    distance = cdist(first.astype(float), second.astype(float)) ** (2 if squared else 1)
    expected = distance.min(1).mean() + distance.min(0).mean()
    value = chamfer(torch.tensor(first)[None], torch.tensor(second)[None], matcher, squared)
    assert float(value) == pytest.approx(expected if squared else expected / 2, rel=1e-4)


def test_emd_of_a_shifted_cloud_is_the_shift_at_most(matcher: Matcher) -> None:
    first = torch.tensor(surface(np.random.default_rng(2), 128))[None]
    shift = torch.tensor([0.01, 0.0, 0.0])
    assert float(emd(first, first + shift, matcher, 0.01)) == pytest.approx(0.01, rel=1e-3)
    assert float(emd(first, first + shift, matcher, 0.01, squared=True)) == pytest.approx(1e-4, rel=1e-3)


def test_gradients_point_away_from_the_truth(matcher: Matcher) -> None:
    truth = torch.tensor(surface(np.random.default_rng(3), 64))[None]
    prediction = (truth * 1.001).clone().requires_grad_()
    emd(prediction, truth, matcher, 0.01).backward()
    assert prediction.grad is not None
    outward = (prediction.grad * (prediction - truth)).sum(-1)
    assert (outward > 0).all()
    same = truth.clone().requires_grad_()
    chamfer(same, truth, matcher).backward()
    assert same.grad is not None
    assert torch.isfinite(same.grad).all()


def test_total_is_the_weighted_sum_and_the_ramp_rises(matcher: Matcher) -> None:
    rng = np.random.default_rng(4)
    truth = torch.tensor(np.stack([surface(rng, 600) for _ in range(2)]))
    coarse = torch.tensor(np.stack([surface(rng, 1024) for _ in range(2)]))
    output = Completion(coarse, truth * 1.05, torch.zeros(2, 4))
    generator = torch.Generator().manual_seed(0)
    terms = completion_loss(output, truth, torch.tensor([0, 3]), 0.2, LossSettings(), matcher, generator)
    assert float(terms.label) == pytest.approx(np.log(4))
    assert float(terms.total) == pytest.approx(float(terms.coarse + 0.5 * terms.fine + 0.02 * terms.label))
    assert float(terms.fine) == pytest.approx(float(chamfer(truth * 1.05, truth, matcher)) / SCALE_M, rel=1e-4)
    assert [alpha(p) for p in (0, 0.0999, 0.1, 0.3, 1)] == [0.1, 0.1, 0.5, 1.0, 1.0]


@pytest.mark.parametrize(("points", "tolerance"), [(1, 0.01), (2, 0.01), (64, 0.01), (256, 0.01), (256, 0.05)])
def test_batched_auction_is_within_its_tolerance_of_the_optimum(points: int, tolerance: float) -> None:
    rng = np.random.default_rng(points)
    first = np.stack([surface(rng, points) for _ in range(3)])
    second = np.stack([surface(rng, points, (2.0, 1.0, 0.6)) + np.float32(shift) for shift in (0, 0.05, 3)])
    second[0] = first[0][rng.permutation(points)]
    partner = assign_batched(torch.tensor(first), torch.tensor(second), tolerance).numpy()
    for one, other, chosen in zip(first, second, partner, strict=True):
        cost = cdist(one, other)
        rows, columns = linear_sum_assignment(cost)
        assert sorted(chosen) == list(range(points))
        allowed = (1 + tolerance) * cost[rows, columns].mean() + 1e-4 * cost.max() / 8
        assert cost[np.arange(points), chosen].mean() <= allowed


def test_batched_auction_refuses_what_it_cannot_match() -> None:
    cloud = torch.zeros(2, 8, 3)
    assert sorted(assign_batched(cloud, cloud)[1].tolist()) == list(range(8))
    for other in (cloud[:, :7], cloud + torch.nan):
        with pytest.raises(ConfigError):
            assign_batched(cloud, other)


def test_neighbours_by_blocks_equal_the_k_d_tree() -> None:
    rng = np.random.default_rng(5)
    query, target = surface(rng, 5000) * np.float32(1.05) + 40, surface(rng, 700) + 40
    index = nearest_blocks(torch.tensor(query)[None], torch.tensor(target)[None])[0].numpy()
    expected, _ = cKDTree(target.astype(float)).query(query.astype(float))
    found = np.linalg.norm(query.astype(float) - target[index], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def parts(**changes: Tensor | None) -> tuple[Completion, Tensor]:
    rng = np.random.default_rng(6)
    truth = torch.tensor(np.stack([surface(rng, 600) for _ in range(2)]))
    return Completion(truth, truth * 1.1, torch.zeros(2, 4), **changes), truth  # type: ignore[arg-type]


def total(output: Completion, truth: Tensor, matcher: Matcher, **changes: object) -> Tensor:
    settings = LossSettings(**changes)  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(0)
    return completion_loss(output, truth, torch.tensor([0, 3]), 1.0, settings, matcher, generator).total


def test_emd_of_fine_points_is_added_with_its_weight(matcher: Matcher) -> None:
    """A cloud shifted by less than half its spacing: every point's partner is its own, the EMD is the shift."""
    axis = torch.linspace(-1, 1, 6)
    truth = torch.cartesian_prod(axis, axis, axis)[None] * SCALE_M
    shift = torch.tensor([0.1, 0.0, 0.0]) * SCALE_M
    count = truth.shape[1]
    output = Completion(truth, truth + shift, torch.zeros(1, 0))
    terms = [
        completion_loss(
            output, truth, torch.tensor([0]), 1.0, LossSettings(emd_points=count, emd_tolerance=0.01, fine_emd=weight),
            matcher, torch.Generator().manual_seed(0),
        )
        for weight in (0.0, 0.5)
    ]  # fmt: skip
    assert float(terms[1].total - terms[0].total) == pytest.approx(0.5 * 0.1, rel=0.02)
    assert float(terms[1].extra) == pytest.approx(0.5 * 0.1, rel=0.02)
    assert float(terms[1].coarse) == float(terms[0].coarse)


def test_coarse_emd_is_added_with_its_weight_and_wants_the_whole_surface(matcher: Matcher) -> None:
    """As many true points as coarse ones: all are matched. A coarse cloud that covers one half is a half away."""
    network = build("queries", "tiny", "sight", {})
    axis = torch.linspace(-1, 1, 8)
    truth = torch.cartesian_prod(axis, axis, torch.zeros(1))[None] * SCALE_M
    shifted = truth + torch.tensor([0.1, 0.0, 0.0]) * SCALE_M
    crowded = truth * torch.tensor([0.5, 1.0, 1.0]) - torch.tensor([0.5, 0.0, 0.0]) * SCALE_M
    for coarse, expected, rel in ((shifted, 0.1, 0.02), (crowded, 0.5, 0.05)):
        terms = [
            completion_loss(
                Completion(coarse, coarse, torch.zeros(1, 0)), truth, torch.tensor([0]), 1.0,
                LossSettings(emd_points=64, emd_tolerance=0.01, coarse_emd=weight),
                matcher, torch.Generator().manual_seed(0), network,
            )
            for weight in (0.0, 0.5)
        ]  # fmt: skip
        assert float(terms[1].total - terms[0].total) == pytest.approx(0.5 * expected, rel=rel)
        assert float(terms[1].coarse - terms[0].coarse) == pytest.approx(0.5 * expected, rel=rel)


def test_class_weights_weigh_the_samples_of_a_class(matcher: Matcher) -> None:
    output, truth = parts()
    each = [
        float(total(Completion(*(x[i : i + 1].repeat(2, 1, 1) for x in output[:2]), output.logits),
                    truth[i : i + 1].repeat(2, 1, 1), matcher, beta=0.0))
        for i in range(2)
    ]  # fmt: skip
    weighted = float(total(output, truth, matcher, beta=0.0, class_weights=(3.0, 2.0, 2.0, 1.0)))
    assert weighted == pytest.approx((1.5 * each[0] + 0.5 * each[1]) / 2, rel=1e-5)
    for bad in ((1.0, 1.0), (1.0, 1.0, 0.0, 1.0)):
        with pytest.raises(ConfigError, match="class_weights"):
            LossSettings(class_weights=bad)


def test_expected_distance_is_learned_without_moving_points_unless_asked(matcher: Matcher) -> None:
    log_sigma = torch.full((2, 600), -3.0, requires_grad=True)
    output, truth = parts(log_sigma=log_sigma)
    fine = output.fine.clone().requires_grad_()
    output = output._replace(fine=fine)
    distance = chamfer_forth(fine.detach(), truth) / SCALE_M
    for joint in (False, True):
        loss = total(output, truth, matcher, gamma=1.0, joint=joint) - total(output, truth, matcher, gamma=0.0)
        gradient, moved = torch.autograd.grad(loss, (log_sigma, fine))
        expected = (1 - distance * np.exp(3.0)) / 1200
        np.testing.assert_allclose(gradient.numpy(), expected, rtol=1e-3, atol=1e-6)
        assert (moved.abs().max() > 1e-6) == joint


def chamfer_forth(prediction: Tensor, truth: Tensor) -> np.ndarray:
    return np.stack([nearest_distance(p, t) for p, t in zip(prediction.numpy(), truth.numpy(), strict=True)])


def test_plane_of_symmetry_is_found_by_descent(matcher: Matcher) -> None:
    rng = np.random.default_rng(8)
    half = surface(rng, 400)
    cloud = np.concatenate([half, half * [1, -1, 1]]).astype(np.float32)
    cloud[:, 0] += np.abs(cloud[:, 2]) * 0.4 + 0.3 * np.sign(cloud[:, 0])  # no other vertical plane
    cloud = cloud[rng.permutation(800)]
    angle = np.float32(0.4)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], np.float32)
    truth = torch.tensor(cloud @ turn.T)[None].repeat(2, 1, 1)
    raw = torch.tensor([0.0, 1.0, 0.02], requires_grad=True)
    optimizer = torch.optim.Adam([raw], 0.02)
    for _ in range(60):
        plane = torch.cat([torch.nn.functional.normalize(raw[:2], dim=0), raw[2:]]).expand(2, 3)
        output = Completion(truth, truth, torch.zeros(2, 4), plane=plane, center=torch.zeros(2, 3))
        optimizer.zero_grad()
        total(output, truth, matcher, symmetry=1.0).backward()
        optimizer.step()
    x, y, offset = raw.tolist()
    assert np.arctan2(-x, y) == pytest.approx(angle, abs=0.05)
    assert offset == pytest.approx(0, abs=0.02)
