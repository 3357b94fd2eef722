# SPDX-License-Identifier: Apache-2.0
"""Point-set operations that have kernels on the CPU: equal to their definitions, gradients to torch's."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from train.losses import of_patches
from train.networks.neighbours import most_of_groups, most_of_neighbours, neighbours, take


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("points", "count"), [(1, 1), (40, 40), (300, 1), (300, 32)])
def test_neighbours_are_the_nearest_in_their_order(points: int, count: int) -> None:
    queries, cloud = drawn(3, 20, 3), drawn(3, points, 3, seed=1)
    apart = torch.cdist(queries.double(), cloud.double())
    assert torch.equal(neighbours(queries, cloud, count), apart.argsort(-1)[..., :count])


def test_neighbours_that_are_not_allowed_come_last() -> None:
    queries, cloud = drawn(2, 9, 3), drawn(2, 30, 3, seed=1)
    allowed = drawn(2, 9, 30, seed=2) > 0.8
    for mask in (allowed, allowed[:, :1]):
        apart = torch.cdist(queries.double(), cloud.double()).masked_fill(~mask, torch.inf)
        found = neighbours(queries, cloud, 20, mask)
        kept = mask.expand_as(apart).sum(-1, keepdim=True) > torch.arange(20)
        assert torch.equal(found[kept], apart.argsort(-1)[..., :20][kept])
        assert not mask.expand_as(apart).gather(2, found)[~kept].any()


def test_of_equally_near_points_the_earlier_is_named_first() -> None:
    cloud = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]])[[0, 0, 1, 2, 3]][None]
    assert neighbours(torch.zeros(1, 1, 3), cloud, 5)[0, 0].tolist() == [4, 0, 1, 2, 3]


def both(values: Tensor, index: Tensor, weight: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Maximum and gradient by the kernel, and by gathering and comparing everything."""
    results = []
    for function in (most_of_neighbours, lambda v, i: take(v, i).amax(2)):
        own = values.clone().requires_grad_()
        most = function(own, index)
        (most * weight).sum().backward()
        assert own.grad is not None
        results.append((most.detach(), own.grad))
    return results


def test_most_of_neighbours_and_its_gradient_equal_torchs() -> None:
    values, index = drawn(2, 50, 7), torch.randint(50, (2, 30, 8), generator=torch.Generator().manual_seed(1))
    for (one, other) in zip(*both(values, index, drawn(2, 30, 7, seed=2)), strict=True):
        torch.testing.assert_close(one, other)
    turned = values.mT.contiguous().mT
    assert not turned.is_contiguous()
    assert torch.equal(most_of_neighbours(turned, index), take(values, index).amax(2))


def test_the_first_of_equal_ones_gets_the_gradient() -> None:
    values = torch.ones(1, 4, 2).requires_grad_()
    most_of_neighbours(values, torch.tensor([[[2, 1, 3]]])).sum().backward()
    assert values.grad is not None
    assert values.grad[0].tolist() == [[0, 0], [0, 0], [1, 1], [0, 0]]


def test_most_of_groups_equals_torchs() -> None:
    one, other = (drawn(2, 6, 5, 4).requires_grad_() for _ in range(2))
    torch.testing.assert_close(most_of_groups(one), other.amax(2))
    most_of_groups(one).square().sum().backward()
    other.amax(2).square().sum().backward()
    torch.testing.assert_close(one.grad, other.grad)
    assert most_of_groups(one.bfloat16()).dtype == torch.bfloat16


def test_distance_of_patches_equals_its_definition() -> None:
    first, second = drawn(4, 10, 3), drawn(4, 6, 3, seed=1)
    apart = torch.cdist(first.double(), second.double())
    expected = (apart.amin(2).mean(1) + apart.amin(1).mean(1)) / 2
    torch.testing.assert_close(of_patches(first, second).double(), expected, rtol=1e-5, atol=1e-6)
