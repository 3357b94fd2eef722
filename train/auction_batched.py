# SPDX-License-Identifier: Apache-2.0
"""Optimal assignment of many pairs of equal point sets at once on tensors: the auction for the GPU."""

from __future__ import annotations

import torch
from torch import Tensor

from edge.config import require


@torch.no_grad()
def assign_batched(first: Tensor, second: Tensor, tolerance: float = 0.01) -> Tensor:
    """Partner in ``second`` of every point of ``first``: bijections that nearly minimise the mean distance.

    Jacobi auction with eps scaling (Bertsekas 1988): all free points bid at once, every target goes to the highest
    bid. As in ``train.auction`` the total is within n eps of the optimum, and the last eps of every pair of clouds is
    ``tolerance`` times the mean least distance, a lower bound of the optimum.

    Args:
        first, second: float32 [b, n, 3], finite, n >= 1; on any device.
        tolerance: relative excess of the mean distance over the optimum that is accepted.
    Returns:
        int64 [b, n], permutations.
    Raises:
        ConfigError: different shapes, values that are not finite, or a tolerance outside 0..1.
    """
    require(first.shape == second.shape and first.shape[1] >= 1, "point sets", tuple(second.shape), f"{first.shape}")
    require(bool((first.isfinite() & second.isfinite()).all()), "point sets", "NaN or infinity", "finite")
    require(0 < tolerance < 1, "tolerance", tolerance, "0..1")
    batch, n = first.shape[:2]
    if n == 1:
        return torch.zeros(batch, 1, dtype=torch.int64, device=first.device)
    cost = torch.cdist(first.float(), second.float(), compute_mode="donot_use_mm_for_euclid_dist")
    highest = cost.amax((1, 2))
    final = torch.maximum(tolerance * cost.amin(2).mean(1), 1e-5 * highest + 1e-12)
    eps = torch.maximum(final, highest / 8)
    auction = _Auction(cost.flatten(0, 1), batch, n)
    again = torch.ones(batch, dtype=torch.bool, device=first.device)
    while True:
        auction.settle(again, eps)
        again = eps > final
        if not again.any():
            return auction.partner.view(batch, n)
        eps = torch.maximum(final, eps / 4)


class _Auction:
    """Prices [b n] of the targets and who has whom, over several eps; rows and targets are numbered through the batch.

    Args:
        cost: [b n, n].
        batch, n: sizes.
    """

    def __init__(self, cost: Tensor, batch: int, n: int) -> None:
        self.cost, self.n = cost, n
        self.price = cost.new_zeros(batch, n)
        self.partner = torch.full((batch * n,), -1, dtype=torch.int64, device=cost.device)
        self.owner = self.partner.clone()

    def settle(self, clouds: Tensor, eps: Tensor) -> None:
        """Auction anew in these clouds (bool [b]) with eps [b] until everyone has a partner."""
        fresh = clouds.repeat_interleave(self.n)
        self.partner[fresh] = -1
        self.owner[fresh] = -1
        rows = fresh.nonzero()[:, 0]
        while len(rows):
            self._round(rows, eps)
            rows = (self.partner < 0).nonzero()[:, 0]

    def _round(self, rows: Tensor, eps: Tensor) -> None:
        """Every free row bids for its best target: so much that the second best would be as good, plus eps."""
        cloud = torch.div(rows, self.n, rounding_mode="floor")
        two = (self.cost[rows] + self.price[cloud]).topk(2, dim=1, largest=False)
        target = two.indices[:, 0] + cloud * self.n
        price = self.price.view(-1)
        bid = price[target] + (two.values[:, 1] - two.values[:, 0]) + eps[cloud]
        highest = torch.full_like(price, -torch.inf).scatter_reduce_(0, target, bid, "amax")
        among = torch.where(bid == highest[target], rows, -1)
        winner = torch.full_like(self.owner, -1).scatter_reduce_(0, target, among, "amax")
        won = winner[target] == rows
        rows, target = rows[won], target[won]
        losers = self.owner[target]
        self.partner[losers[losers >= 0]] = -1
        self.owner[target] = rows
        self.partner[rows] = target % self.n
        price[target] = bid[won]
