# SPDX-License-Identifier: Apache-2.0
"""Sampling of well spread points without a loop over them, for graphs in which a loop is dear."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from train.network import exactly
from train.networks.neighbours import fixed

GOLDEN = (5**0.5 - 1) / 2


@lru_cache(maxsize=8)
def order(size: int) -> tuple[int, ...]:
    """A permutation of ``size`` places of which every beginning is spread evenly over them (golden ratio)."""
    return tuple(np.argsort(np.arange(size) * GOLDEN % 1.0, kind="stable").tolist())


def shuffled(points: Tensor, counts: Sequence[int], size: int) -> tuple[Tensor, Tensor]:
    """Clouds of different sizes as one tensor, in ``order``: small ones repeated, large ones thinned evenly.

    Args:
        points: [sum(counts), 3].
        counts: points of each cloud.
        size: points of each afterwards.
    Returns:
        [b, size, 3], and bool [b, size]: False for a point that repeats another.
    """
    cloud, first = fixed(points, counts, size)
    rows = torch.tensor(order(size), device=points.device)
    return cloud[:, rows], first[:, rows]


@torch.no_grad()
def spread(points: Tensor, first: Tensor, count: int) -> Tensor:
    """The ``count`` points with the largest distance to all points before them.

    Any two of them are at least as far apart as the smallest of these distances. Farthest-point sampling (Eldar et al.
    1997) finds the order too, and each point has to wait for the one before it; here the order is given (``order``).
    On the clouds of the tests the largest hole is at most twice as large, the mean distance equal.

    Args:
        points: [b, n, 3].
        first: bool [b, n], False for a point that repeats another, True for the first of all; repetitions count for
            nothing and are taken last, in their order.
        count: at most n.
    Returns:
        int64 [b, count], rising: a nearly equal distance decides who is among them, not who stands where.
    """
    with exactly(points):
        return _spread(points, first, count)


def _spread(points: Tensor, first: Tensor, count: int) -> Tensor:
    size = points.shape[1]
    norms = points.square().sum(-1)
    later = torch.full((size, size), float("inf"), dtype=points.dtype, device=points.device).triu()
    others = norms + torch.where(first, 0.0, float("inf")).to(points.dtype)
    own = torch.cat([-2 * points, torch.ones_like(norms)[..., None]], -1)
    other = torch.cat([points, others[..., None]], -1).mT
    # one cloud after the other: size x size distances fit into the cache, those of a batch do not
    nearest = torch.stack([torch.addmm(later, *pair).amin(1) for pair in zip(own, other, strict=True)]) + norms
    last = -torch.arange(1, size + 1, dtype=points.dtype, device=points.device)
    nearest = torch.where(first, nearest, last)
    return nearest.topk(count, dim=1).indices.sort(1).values
