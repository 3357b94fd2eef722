# SPDX-License-Identifier: Apache-2.0
"""The transformer for the edge: its sampling, where its queries come from, and that a shift of the input shifts it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from train.networks.narrow import mirrored
from train.networks.neighbours import farthest, take
from train.networks.queries import QUERY_WIDTHS, QueryNetwork, QueryOptions
from train.networks.sampling import order, shuffled, spread


def network_of(**options: bool | int) -> QueryNetwork:
    torch.manual_seed(3)
    return QueryNetwork(QUERY_WIDTHS["tiny"], 4, options=QueryOptions(**options)).eval()  # type: ignore[arg-type]


def scan(points: int, seed: int = 0) -> Tensor:
    """Two sides of a car, ten times as dense at one end, in the order in which a passing sensor sees them."""
    rng = np.random.default_rng(seed)
    along = np.sort(np.concatenate([rng.uniform(0, 4.5, points // 2), rng.uniform(0, 0.45, points - points // 2)]))
    front = rng.random(points) < 0.3
    xyz = np.stack([np.where(front, 8, 8 + along), np.where(front, along * 0.4, 2), rng.uniform(0.2, 1.5, points)], 1)
    return torch.from_numpy(xyz.astype(np.float32))


def test_beginnings_of_the_order_are_spread_evenly() -> None:
    for size in (128, 1024):
        rows = order(size)
        assert sorted(rows) == list(range(size))
        for count in (8, 32, 100):
            gaps = np.diff(np.sort([*rows[:count], size + min(rows[:count])]))
            assert gaps.max() <= 3 * size / count


def test_small_clouds_are_repeated_and_large_ones_thinned() -> None:
    points = torch.arange(5 + 300.0)[:, None].expand(-1, 3)
    both, first = shuffled(points, [5, 300], 128)
    assert first.sum(1).tolist() == [5, 128]
    assert sorted(both[0, first[0], 0].tolist()) == [0, 1, 2, 3, 4]
    assert set(both[0, :, 0].tolist()) == {0, 1, 2, 3, 4}
    large = np.sort(both[1, :, 0].numpy()) - 5
    np.testing.assert_array_equal(large, np.arange(128) * 300 // 128)
    assert bool(first[:, 0].all()), "sampling begins with a point that repeats none"


@pytest.mark.parametrize("seed", range(4))
def test_spread_points_are_apart_and_cover_the_rest(seed: int) -> None:
    """Packing: any two are at least as far apart as the smallest of the distances by which they were chosen. Covering:
    the largest hole is at most twice as large as with farthest-point sampling, the mean distance hardly larger."""
    cloud, first = shuffled(scan(700, seed), [700], 1024)
    rows = spread(cloud, first, 64)[0]
    chosen = cloud[0, rows]
    assert len(set(rows.tolist())) == 64
    assert bool(first[0, rows].all())
    own = cloud[0, first[0]]
    distance = torch.cdist(own, own).masked_fill(torch.ones(700, 700).triu().bool(), torch.inf).amin(1)
    apart = torch.cdist(chosen, chosen).masked_fill(torch.eye(64).bool(), torch.inf).amin()
    assert apart >= distance.topk(64).values[-1] - 1e-3
    ours, best = (torch.cdist(own, some).amin(1) for some in (chosen, take(cloud, farthest(cloud, 64))[0]))
    assert ours.max() <= 2 * best.max()
    assert ours.mean() <= 1.1 * best.mean()


def test_repetitions_come_last_in_their_order() -> None:
    cloud, first = shuffled(scan(40), [40], 128)
    rows = spread(cloud, first, 60)[0]
    assert rows[first[0, rows]].tolist() == torch.nonzero(first[0])[:, 0].tolist()
    assert rows[~first[0, rows]].tolist() == torch.nonzero(~first[0])[:20, 0].tolist()


def test_queries_come_from_where_the_score_says() -> None:
    """Scores of the kind alone: after the 32 predicted queries come the 32 proxies, or their 32 mirror images."""
    network, points = network_of(), scan(200)
    with torch.no_grad():
        network.score_place.weight.zero_()
        for layer in (network.score_feature, network.score[0], network.score[2]):
            layer.weight.zero_()  # type: ignore[union-attr, operator]
            layer.bias.zero_()  # type: ignore[union-attr, operator]
        network.score[0].weight[0, 0] = network.score[2].weight[0, 0] = 1  # type: ignore[union-attr, index, operator]
        network.plane.weight.normal_()
        found = []
        for kind in (4, 5):
            network.score_place.weight[0] = 0
            network.score_place.weight[0, kind] = 9
            answer = network(points, [200])
            assert answer.plane is not None
            assert answer.center is not None
            found.append((answer.coarse - answer.center[:, None]) / network.scale)
    torch.testing.assert_close(found[0][:, :32], found[1][:, :32])
    proxies, images = (one[:, 32:] for one in found)
    torch.testing.assert_close(images, mirrored(proxies, answer.plane), atol=1e-5, rtol=0)
    assert float(torch.cdist(proxies[0] * network.scale + answer.center, points).amin(1).max()) < 1e-4


def test_few_points_are_queries_once_each() -> None:
    """20 points are 20 proxies that differ and 12 that repeat: the 32 chosen queries all differ."""
    network = network_of(trim=5)
    with torch.no_grad():
        network.plane.weight.normal_()
        coarse = network(scan(20), [20]).coarse[0]
    apart = torch.cdist(coarse, coarse, compute_mode="donot_use_mm_for_euclid_dist")
    assert float(apart.masked_fill(torch.eye(64).bool(), torch.inf).amin()) > 1e-4


def test_rounding_of_inner_layers_does_not_touch_the_sampling() -> None:
    cloud, first = shuffled(scan(500), [500], 1024)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = spread(cloud, first, 64)
    assert torch.equal(rounded, spread(cloud, first, 64))


def test_a_nearly_equal_distance_moves_no_row() -> None:
    """The 64th and the 65th may change places under a jitter of a micrometre, the others stand where they stood."""
    cloud, first = shuffled(scan(600), [600], 1024)
    jitter = 1e-6 * torch.randn(cloud.shape, generator=torch.Generator().manual_seed(0))
    before, after = spread(cloud, first, 64)[0].tolist(), spread(cloud + jitter, first, 64)[0].tolist()
    assert len(set(before) ^ set(after)) <= 2
    assert before == sorted(before)


def test_a_shift_in_the_plane_shifts_the_answer_and_height_counts() -> None:
    network, points = network_of(trim=5), scan(150)
    step = torch.tensor([3.0, -2.0, 0.0])
    with torch.no_grad():
        before, after = network(points, [150]), network(points + step, [150])
        higher = network(points + torch.tensor([0, 0, 0.5]), [150])
    torch.testing.assert_close(after.fine, before.fine + step, atol=1e-4, rtol=0)
    torch.testing.assert_close(after.logits, before.logits, atol=1e-4, rtol=0)
    assert (higher.fine - before.fine - torch.tensor([0, 0, 0.5])).abs().max() > 1e-3
