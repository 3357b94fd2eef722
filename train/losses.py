# SPDX-License-Identifier: Apache-2.0
"""Losses of the completion network: EMD of the coarse cloud, Chamfer distance of the fine one, cross entropy."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from edge.config import require
from edge.frames import Float32
from train.auction import assign
from train.nearest import nearest_index
from train.network import SCALE_M, Completion

RAMP = ((0.0, 0.1), (0.1, 0.5), (0.3, 1.0))
"""Weight of the fine cloud from a share of the training budget on (PCN's schedule, scaled to the budget)."""
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class LossSettings:
    """What is minimised.

    Args:
        squared: the equations of the paper (squared distances, sum of both directions) instead of the unsquared
            distances and the mean of both directions that its figures fit.
        emd_points: random points of both clouds that are matched.
        emd_tolerance: relative excess over the optimal matching that is accepted.
        beta: weight of the cross entropy.
    Raises:
        ConfigError: a number outside its range.
    """

    squared: bool = False
    emd_points: int = 512
    emd_tolerance: float = 0.05
    beta: float = 0.02

    def __post_init__(self) -> None:
        require(1 <= self.emd_points <= 1024, "loss.emd_points", self.emd_points, "1..1024")
        require(0 < self.emd_tolerance < 1, "loss.emd_tolerance", self.emd_tolerance, "0..1")
        require(self.beta >= 0, "loss.beta", self.beta, ">= 0")


def alpha(progress: float) -> float:
    """Weight of the fine cloud at a share 0..1 of the training budget."""
    return max(value for start, value in RAMP if progress >= start)


class Matcher:
    """Finds neighbours and assignments of a batch outside the graph, one thread per core; numba releases the GIL."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(max(1, threads))

    def nearest(self, query: Tensor, target: Tensor) -> Tensor:
        """Nearest target of every query point: [b, q, 3], [b, t, 3] -> int64 [b, q]; blocks of matmul on CUDA."""
        if query.is_cuda:
            return torch.cat([torch.cdist(q, target).argmin(-1) for q in torch.split(query.detach(), 2048, dim=1)], 1)
        return self._each(nearest_index, query, target)

    def assign(self, first: Tensor, second: Tensor, tolerance: float) -> Tensor:
        """Optimal partner in ``second`` of every point of ``first``: [b, n, 3] twice -> int64 [b, n]."""
        return self._each(lambda a, b: assign(a, b, tolerance), first, second)

    def _each(self, function: Callable[[Float32, Float32], np.ndarray], first: Tensor, second: Tensor) -> Tensor:
        pairs = zip(first.detach().cpu().numpy(), second.detach().cpu().numpy(), strict=True)
        rows = list(self._pool.map(lambda pair: function(*pair), pairs))
        return torch.from_numpy(np.stack(rows).astype(np.int64)).to(first.device)


def _length(difference: Tensor, squared: bool) -> Tensor:
    square = difference.square().sum(-1)
    return square if squared else (square + _TINY).sqrt()


def _take(points: Tensor, index: Tensor) -> Tensor:
    return points.gather(1, index[..., None].expand(-1, -1, 3))


def chamfer(prediction: Tensor, truth: Tensor, matcher: Matcher, squared: bool = False) -> Tensor:
    """Chamfer distance, mean over the batch.

    Args:
        prediction: [b, p, 3], differentiable.
        truth: [b, t, 3].
        matcher: finds the neighbours.
        squared: sum of both mean squared distances (the paper's equation) instead of the mean of both mean distances.
    Returns:
        Scalar, in the points' unit (squared: its square).
    """
    forth = _length(prediction - _take(truth, matcher.nearest(prediction, truth)), squared).mean()
    back = _length(_take(prediction, matcher.nearest(truth, prediction)) - truth, squared).mean()
    return forth + back if squared else (forth + back) / 2


def emd(first: Tensor, second: Tensor, matcher: Matcher, tolerance: float, squared: bool = False) -> Tensor:
    """Earth mover's distance of equal clouds [b, n, 3]: mean distance under the optimal one-to-one assignment."""
    return _length(first - _take(second, matcher.assign(first, second, tolerance)), squared).mean()


@dataclass(frozen=True, slots=True)
class LossTerms:
    """One step's losses; distances in network units.

    Args:
        total: what is differentiated.
        coarse: EMD.
        fine: Chamfer distance.
        label: cross entropy.
    """

    total: Tensor
    coarse: Tensor
    fine: Tensor
    label: Tensor


def completion_loss(
    output: Completion,
    truth_m: Tensor,
    labels: Tensor,
    progress: float,
    settings: LossSettings,
    matcher: Matcher,
    generator: torch.Generator,
) -> LossTerms:
    """EMD(coarse) + alpha CD(fine) + beta CE, the paper's loss, in network units.

    Args:
        output: of the network, metres.
        truth_m: [b, t, 3] metres, random order, t >= ``settings.emd_points``.
        labels: int64 [b].
        progress: share of the training budget, 0..1.
        settings: which form and weights.
        matcher: finds neighbours and assignments.
        generator: draws the coarse points that are matched.
    """
    require(truth_m.shape[1] >= settings.emd_points, "truth points", truth_m.shape[1], ">= loss.emd_points")
    truth, coarse, fine = truth_m / SCALE_M, output.coarse / SCALE_M, output.fine / SCALE_M
    chosen = torch.randperm(coarse.shape[1], generator=generator)[: settings.emd_points].to(coarse.device)
    coarse_loss = emd(
        coarse[:, chosen], truth[:, : settings.emd_points], matcher, settings.emd_tolerance, settings.squared
    )
    fine_loss = chamfer(fine, truth, matcher, settings.squared)
    label_loss = functional.cross_entropy(output.logits, labels)
    total = coarse_loss + alpha(progress) * fine_loss + settings.beta * label_loss
    return LossTerms(total, coarse_loss, fine_loss, label_loss)
