# SPDX-License-Identifier: Apache-2.0
"""Batched point-set operations: fixed number of points, farthest-point sampling, neighbours and maxima over them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from train.networks.kernels import back_to_winners, most_of, nearest_of


def fixed(points: Tensor, counts: Sequence[int], size: int) -> tuple[Tensor, Tensor]:
    """Clouds of different sizes as one tensor: small ones repeated, large ones thinned evenly.

    Returns:
        [b, size, 3], and bool [b, size]: True at the first appearance of a point.
    """
    step = torch.arange(size, device=points.device)
    offset, rows, first = 0, [], []
    for count in counts:
        rows.append((step % count if count <= size else step * count // size) + offset)
        first.append(step < count)
        offset += count
    return points[torch.stack(rows)], torch.stack(first)


@torch.no_grad()
def farthest(points: Tensor, count: int) -> Tensor:
    """Farthest-point sampling from the point farthest from the middle on: [b, n, 3] -> int64 [b, count].

    Each further point is the one farthest from all chosen before (Eldar et al. 1997).
    """
    middle = (points.amax(1, keepdim=True) + points.amin(1, keepdim=True)) / 2
    rows = torch.arange(len(points), device=points.device)
    chosen = (points - middle).square().sum(-1).argmax(1)
    distance = points.new_full(points.shape[:2], float("inf"))
    result = []
    for _ in range(count):
        result.append(chosen)
        distance = torch.minimum(distance, (points - points[rows, chosen][:, None]).square().sum(-1))
        chosen = distance.argmax(1)
    return torch.stack(result, 1)


@torch.no_grad()
def neighbours(queries: Tensor, points: Tensor, count: int, allowed: Tensor | None = None) -> Tensor:
    """Indices of the nearest points: [b, q, 3], [b, p, 3] -> int64 [b, q, count].

    Args:
        queries, points: positions.
        count: how many, at most p.
        allowed: bool, broadcast to [b, q, p]; others come last.
    """
    if not queries.is_cuda:
        index = torch.empty(*queries.shape[:2], count, dtype=torch.int64)
        shape = (*queries.shape[:2], points.shape[1])
        may = np.zeros((len(queries), 0, 0), bool) if allowed is None else allowed.expand(shape).numpy()
        nearest_of(queries.float().numpy(), points.float().numpy(), may, index.numpy())
        return index
    distance = torch.cdist(queries.float(), points.float())
    if allowed is not None:
        distance = distance + 1e6 * ~allowed
    return distance.topk(count, dim=-1, largest=False).indices


class _MostOf(torch.autograd.Function):
    """``kernels.most_of`` of a batch on the CPU."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor) -> Tensor:
        most = values.new_empty(*index.shape[:2], values.shape[-1])
        winner = torch.empty(most.shape, dtype=torch.int64)
        most_of(values.contiguous().numpy(), index.numpy(), most.numpy(), winner.numpy())
        ctx.save_for_backward(winner)
        ctx.rows = values.shape[1]
        return most

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (winner,) = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        into = gradient.new_zeros(len(gradient), ctx.rows, gradient.shape[-1])
        back_to_winners(gradient.numpy(), winner.numpy(), into.numpy())
        return into, None


def most_of_neighbours(values: Tensor, index: Tensor) -> Tensor:
    """Maximum over neighbours, channel by channel: [b, n, c], int64 [b, q, k] -> [b, q, c]."""
    if values.is_cuda or values.dtype != torch.float32:
        return take(values, index).amax(2)
    most: Tensor = _MostOf.apply(values, index)  # type: ignore[no-untyped-call]
    return most


def most_of_groups(values: Tensor) -> Tensor:
    """Maximum over a group, channel by channel: [b, q, k, c] -> [b, q, c]."""
    if values.is_cuda or values.dtype != torch.float32:
        return values.amax(2)
    rows = torch.arange(values.shape[1] * values.shape[2]).view(1, *values.shape[1:3])
    return most_of_neighbours(values.flatten(1, 2), rows.expand(len(values), -1, -1))


def take(values: Tensor, index: Tensor) -> Tensor:
    """Rows of every batch element: [b, n, c], int64 [b, ...] -> [b, ..., c]."""
    flat = index.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).view(*index.shape, values.shape[-1])
