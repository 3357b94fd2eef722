# SPDX-License-Identifier: Apache-2.0
"""The network: channel counts of the paper, its exact symmetries, and the short decoder against the written-out one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from edge.errors import ConfigError
from train.network import COARSE_POINTS, SCALE_M, WIDTHS, CompletionNetwork, Width, patch_grid


@pytest.fixture
def network() -> CompletionNetwork:
    torch.manual_seed(1)
    return CompletionNetwork(WIDTHS["tiny"], 4)


def cloud(points: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(points, 3, generator=generator) * torch.tensor([2.0, 0.8, 0.5]) + torch.tensor([3.0, -7.0, 1.0])


@pytest.mark.parametrize(("name", "parameters"), [("paper", 7_385_347), ("edge", 2_455_939)])
def test_parameters_without_the_class_head(name: str, parameters: int) -> None:
    network = CompletionNetwork(WIDTHS[name], 4)
    counted = sum(p.numel() for key, p in network.named_parameters() if not key.startswith("class"))
    assert counted == parameters


def written_out(network: CompletionNetwork, points_m: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The paper's figure, layer by layer for one cloud, every input of the folding concatenated for every point."""
    center = (points_m.amax(0) + points_m.amin(0)) / 2 * torch.tensor([1, 1, 0])
    points = (points_m - center) / SCALE_M
    first = network.point2(network.point1(points).relu())
    both = torch.cat([first, first.amax(0).expand_as(first)], 1)
    second = network.local2(network.local1(both).relu())
    feature = second.amax(0)
    coarse = network.coarse3(network.coarse2(network.coarse1(feature).relu()).relu()).view(-1, 3)
    local = second[torch.cdist(coarse, points).argmin(1)]
    rows = []
    for cell in patch_grid():
        wide = torch.cat([cell.expand(len(coarse), 2), coarse, local, feature.expand(len(coarse), -1)], 1)
        rows.append(coarse + network.fold3(network.fold2(network.fold1(wide).relu()).relu()))
    fine = torch.stack(rows, 1).reshape(-1, 3)
    logits = network.class2(network.class1(feature).relu())
    return coarse * SCALE_M + center, fine * SCALE_M + center, logits


@pytest.mark.parametrize("width", [WIDTHS["tiny"], Width((8, 16), (24, 40), 20, 12, 8)])
def test_short_form_equals_the_written_out_form(width: Width) -> None:
    torch.manual_seed(0)
    network = CompletionNetwork(width, 4).double()
    points = cloud(300).double()
    with torch.no_grad():
        output = network(points, [300])
        coarse, fine, logits = written_out(network, points)
    torch.testing.assert_close(output.coarse[0], coarse, atol=1e-9, rtol=0)
    torch.testing.assert_close(output.fine[0], fine, atol=1e-9, rtol=0)
    torch.testing.assert_close(output.logits[0], logits, atol=1e-9, rtol=0)


def test_gradient_of_the_short_form_equals_the_written_out_one() -> None:
    torch.manual_seed(0)
    network = CompletionNetwork(WIDTHS["tiny"], 4).double()
    points = cloud(200).double()
    gradients = []
    for output in (network(points, [200]), written_out(network, points)):
        loss = sum(part.flatten()[: 3 * COARSE_POINTS].sin().sum() for part in output[:3])
        network.zero_grad()
        loss.backward()
        gradients.append(torch.cat([p.grad.flatten() for p in network.parameters()]))
    torch.testing.assert_close(gradients[0], gradients[1], atol=1e-8, rtol=1e-8)


def test_single_precision_error_is_small(network: CompletionNetwork) -> None:
    points = cloud(500)
    with torch.no_grad():
        fine = network(points, [500]).fine
        exact = network.double()(points.double(), [500]).fine
    torch.testing.assert_close(fine.double(), exact, atol=1e-5, rtol=0)


def test_batch_of_unequal_clouds_equals_each_alone(network: CompletionNetwork) -> None:
    counts = [64, 700, 65]
    clouds = [cloud(n, seed) for seed, n in enumerate(counts)]
    with torch.no_grad():
        together = network(torch.cat(clouds), counts)
        for row, (points, count) in enumerate(zip(clouds, counts, strict=True)):
            alone = network(points, [count])
            torch.testing.assert_close(together.fine[row], alone.fine[0], atol=1e-5, rtol=0)
            torch.testing.assert_close(together.logits[row], alone.logits[0], atol=1e-5, rtol=0)


def test_order_and_repetition_of_points_do_not_matter(network: CompletionNetwork) -> None:
    points = cloud(400)
    order = torch.randperm(400, generator=torch.Generator().manual_seed(3))
    repeated = torch.cat([points[order], points[:150], points[:50]])
    with torch.no_grad():
        reference = network(points, [400])
        for changed in (points[order], repeated):
            output = network(changed, [len(changed)])
            torch.testing.assert_close(output.fine, reference.fine, atol=1e-5, rtol=0)
            torch.testing.assert_close(output.logits, reference.logits, atol=1e-5, rtol=0)


def test_shift_in_the_plane_shifts_the_output_and_height_does_not() -> None:
    """x and y are relative to the input, z is not: a cloud 1 m higher is another input."""
    torch.manual_seed(1)
    network = CompletionNetwork(WIDTHS["tiny"], 4).double()
    points, shift = cloud(300).double(), torch.tensor([12.5, -40.0, 0.0], dtype=torch.float64)
    with torch.no_grad():
        here, there = network(points, [300]), network(points + shift, [300])
        higher = network(points + torch.tensor([0, 0, 1]), [300])
    torch.testing.assert_close(there.fine, here.fine + shift, atol=1e-9, rtol=0)
    torch.testing.assert_close(there.coarse, here.coarse + shift, atol=1e-9, rtol=0)
    assert (higher.coarse - here.coarse - torch.tensor([0, 0, 1])).abs().max() > 0.1


def test_some_cells_are_a_subset_of_all(network: CompletionNetwork) -> None:
    points, cells = cloud(128), torch.tensor([3, 11])
    with torch.no_grad():
        some = network(points, [128], cells).fine.view(1, COARSE_POINTS, 2, 3)
        every = network(points, [128]).fine.view(1, COARSE_POINTS, 16, 3)
    torch.testing.assert_close(some, every[:, :, cells], atol=1e-6, rtol=0)


def test_start_shape_is_what_the_untrained_network_answers_nearly(network: CompletionNetwork) -> None:
    shape = np.random.default_rng(0).uniform(-1, 1, (COARSE_POINTS, 3)).astype(np.float32)
    network.start_from(shape)
    points = cloud(100)
    center = (points.amax(0) + points.amin(0)) / 2
    with torch.no_grad():
        coarse = network(points, [100]).coarse[0] - center * torch.tensor([1, 1, 0])
    error = (coarse.numpy() - shape).astype(np.float64)
    assert np.sqrt((error**2).mean()) < 0.1
    with pytest.raises(ConfigError, match="1024"):
        network.start_from(shape[:-1])


def test_one_point_is_enough(network: CompletionNetwork) -> None:
    with torch.no_grad():
        output = network(torch.tensor([[1.0, 2.0, 3.0]]), [1])
    assert torch.isfinite(output.fine).all()
    assert functional.softmax(output.logits, 1).sum() == pytest.approx(1)
