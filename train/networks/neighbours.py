# SPDX-License-Identifier: Apache-2.0
"""Batched point-set operations in plain torch: a fixed number of points, farthest-point sampling, k neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


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
    distance = torch.cdist(queries.float(), points.float())
    if allowed is not None:
        distance = distance + 1e6 * ~allowed
    return distance.topk(count, dim=-1, largest=False).indices


def take(values: Tensor, index: Tensor) -> Tensor:
    """Rows of every batch element: [b, n, c], int64 [b, ...] -> [b, ..., c]."""
    flat = index.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, flat).view(*index.shape, values.shape[-1])
