# SPDX-License-Identifier: Apache-2.0
"""Losses of the completion networks: EMD of the coarse cloud, Chamfer distance of the fine one, cross entropy."""

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
from train.auction_batched import assign_batched
from train.nearest import nearest_index
from train.network import SCALE_M, Completion, CompletionModel
from train.networks.narrow import mirrored
from train.networks.neighbours import neighbours, take
from train.networks.sampling import spread
from train.objects.mesh import CLASSES

RAMP = ((0.0, 0.1), (0.1, 0.5), (0.3, 1.0))
"""Weight of the fine cloud from a share of the training budget on (PCN's schedule, scaled to the budget)."""
_TINY = 1e-12
_BLOCK = 2048
"""Queries that are compared with all targets at once on the GPU."""


@dataclass(frozen=True, slots=True)
class LossSettings:
    """What is minimised.

    Args:
        squared: the equations of the paper (squared distances, sum of both directions) instead of the unsquared
            distances and the mean of both directions that its figures fit.
        emd_points: random points of both clouds that are matched.
        emd_tolerance: relative excess over the optimal matching that is accepted.
        fine_emd: weight of the EMD of as many random fine points.
        coarse_emd: where the coarse cloud has the Chamfer distance, weight of its EMD to as many well spread true
            points. Every coarse point carries as many fine ones: this is what spreads them over the whole surface.
        beta: weight of the cross entropy.
        gamma: weight of the expected distance's log-likelihood, where the network gives one.
        joint: let that term move the points too (heteroscedastic Chamfer distance); else it only learns to expect.
        symmetry: weight of the plane of symmetry, where the network gives one.
        denoise: weight of the denoised patches, where the network gives them.
        class_weights: relative weight of the samples of every class, () for equal; scaled to a mean of 1.
    Raises:
        ConfigError: a number outside its range.
    """

    squared: bool = False
    emd_points: int = 512
    emd_tolerance: float = 0.05
    fine_emd: float = 0.0
    coarse_emd: float = 0.0
    beta: float = 0.02
    gamma: float = 0.002
    joint: bool = False
    symmetry: float = 0.05
    denoise: float = 0.5
    class_weights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        require(1 <= self.emd_points <= 1024, "loss.emd_points", self.emd_points, "1..1024")
        require(0 < self.emd_tolerance < 1, "loss.emd_tolerance", self.emd_tolerance, "0..1")
        for name in ("fine_emd", "coarse_emd", "beta", "gamma", "symmetry", "denoise"):
            require(getattr(self, name) >= 0, f"loss.{name}", getattr(self, name), ">= 0")
        good = len(self.class_weights) in (0, len(CLASSES)) and all(weight > 0 for weight in self.class_weights)
        require(good, "loss.class_weights", self.class_weights, f"{len(CLASSES)} numbers > 0, or none")

    def weights(self, labels: Tensor) -> Tensor:
        """Weight of every sample: [b]."""
        if not self.class_weights:
            return torch.ones(len(labels), device=labels.device)
        weights = torch.tensor(self.class_weights, device=labels.device)
        return (weights / weights.mean())[labels]


def alpha(progress: float) -> float:
    """Weight of the fine cloud at a share 0..1 of the training budget."""
    return max(value for start, value in RAMP if progress >= start)


@torch.no_grad()
def nearest_blocks(query: Tensor, target: Tensor) -> Tensor:
    """Nearest target of every query point by comparing all, in blocks: [b, q, 3], [b, t, 3] -> int64 [b, q].

    Distances are taken from differences, not from products, so nothing cancels.
    """
    exact = "donot_use_mm_for_euclid_dist"
    blocks = [torch.cdist(part, target, compute_mode=exact).argmin(-1) for part in torch.split(query, _BLOCK, 1)]
    return torch.cat(blocks, 1)


class Matcher:
    """Finds neighbours and assignments of a batch outside the graph, one thread per core; numba releases the GIL."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(max(1, threads))

    def nearest(self, query: Tensor, target: Tensor) -> Tensor:
        """Nearest target of every query point: [b, q, 3], [b, t, 3] -> int64 [b, q]."""
        if query.is_cuda:
            return nearest_blocks(query, target)
        return self._each(nearest_index, query, target)

    def assign(self, first: Tensor, second: Tensor, tolerance: float) -> Tensor:
        """Optimal partner in ``second`` of every point of ``first``: [b, n, 3] twice -> int64 [b, n]."""
        if first.is_cuda:
            return assign_batched(first, second, tolerance)
        return self._each(lambda a, b: assign(a, b, tolerance), first, second)

    def _each(self, function: Callable[[Float32, Float32], np.ndarray], first: Tensor, second: Tensor) -> Tensor:
        pairs = zip(first.detach().cpu().numpy(), second.detach().cpu().numpy(), strict=True)
        rows = list(self._pool.map(lambda pair: function(*pair), pairs))
        return torch.from_numpy(np.stack(rows).astype(np.int64)).to(first.device)


def _length(difference: Tensor, squared: bool) -> Tensor:
    square = difference.square().sum(-1)
    return square if squared else (square + _TINY).sqrt()


def two_ways(prediction: Tensor, truth: Tensor, matcher: Matcher, squared: bool = False) -> tuple[Tensor, Tensor]:
    """Distance of every predicted point to the truth [b, p] and of every true point to the prediction [b, t]."""
    forth = _length(prediction - take(truth, matcher.nearest(prediction, truth)), squared)
    back = _length(take(prediction, matcher.nearest(truth, prediction)) - truth, squared)
    return forth, back


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
    return _joined(*two_ways(prediction, truth, matcher, squared), squared).mean()


def of_patches(first: Tensor, second: Tensor) -> Tensor:
    """Chamfer distance of many small clouds [n, p, 3] and [n, q, 3] about the origin: [n]; all pairs are compared."""
    forth, back = (neighbours(*pair, 1)[..., 0] for pair in ((first.detach(), second), (second, first.detach())))
    return _joined(_length(first - take(second, forth), False), _length(take(first, back) - second, False), False)


def _joined(forth: Tensor, back: Tensor, squared: bool) -> Tensor:
    """Chamfer distance of every sample from its two directions: [b]."""
    return (forth.mean(1) + back.mean(1)) * (1.0 if squared else 0.5)


def emd(first: Tensor, second: Tensor, matcher: Matcher, tolerance: float, squared: bool = False) -> Tensor:
    """Earth mover's distance of equal clouds [b, n, 3]: mean distance under the optimal one-to-one assignment."""
    return _matched(first, second, matcher, tolerance, squared).mean()


def _matched(first: Tensor, second: Tensor, matcher: Matcher, tolerance: float, squared: bool) -> Tensor:
    return _length(first - take(second, matcher.assign(first, second, tolerance)), squared).mean(1)


def _some_matched(
    points: Tensor, truth: Tensor, settings: LossSettings, matcher: Matcher, generator: torch.Generator
) -> Tensor:
    """EMD of random ``emd_points`` of a cloud and as many of the truth: [b]."""
    count = min(settings.emd_points, points.shape[1])
    chosen = torch.randperm(points.shape[1], generator=generator)[:count].to(points.device)
    return _matched(points[:, chosen], truth[:, :count], matcher, settings.emd_tolerance, settings.squared)


def _spread_matched(coarse: Tensor, truth: Tensor, settings: LossSettings, matcher: Matcher) -> Tensor:
    """EMD of a coarse cloud and as many well spread points of the truth (of a random four times as many): [b]."""
    count = min(coarse.shape[1], truth.shape[1])
    some = truth[:, : 4 * count]
    chosen = take(some, spread(some, torch.ones_like(some[..., 0], dtype=torch.bool), count))
    return _matched(coarse[:, :count], chosen, matcher, settings.emd_tolerance, settings.squared)


@dataclass(frozen=True, slots=True)
class LossTerms:
    """One step's losses; distances in network units.

    Args:
        total: what is differentiated.
        coarse: EMD, or where the network asks for it Chamfer distance, with the weighted EMD.
        fine: Chamfer distance.
        label: cross entropy, 0 without a classifier.
        extra: weighted sum of the EMD of fine points, and of what only some networks have: expected distance, plane of
            symmetry, denoised patches.
    """

    total: Tensor
    coarse: Tensor
    fine: Tensor
    label: Tensor
    extra: Tensor


def completion_loss(
    output: Completion,
    truth_m: Tensor,
    labels: Tensor,
    progress: float,
    settings: LossSettings,
    matcher: Matcher,
    generator: torch.Generator,
    network: CompletionModel | None = None,
) -> LossTerms:
    """EMD(coarse) + alpha CD(fine) + beta CE, the paper's loss, in network units, every sample with its class's weight.

    Args:
        output: of the network, in the unit of its input.
        truth_m: [b, t, 3], same unit, random order, t >= ``settings.emd_points``.
        labels: int64 [b].
        progress: share of the training budget, 0..1.
        settings: which form and weights.
        matcher: finds neighbours and assignments.
        generator: draws the points that are matched.
        network: whose scale and kind of loss; None: line of sight, EMD and ramp.
    """
    require(truth_m.shape[1] >= settings.emd_points, "truth points", truth_m.shape[1], ">= loss.emd_points")
    scale = network.scale if network else SCALE_M
    truth, coarse, fine = truth_m / scale, output.coarse / scale, output.fine / scale
    weights = settings.weights(labels)
    if network and network.coarse_loss == "chamfer":
        coarse_loss = _joined(*two_ways(coarse, truth, matcher, settings.squared), settings.squared)
        if settings.coarse_emd:
            coarse_loss = coarse_loss + settings.coarse_emd * _spread_matched(coarse, truth, settings, matcher)
    else:
        coarse_loss = _some_matched(coarse, truth, settings, matcher, generator)
    forth, back = two_ways(fine, truth, matcher, settings.squared)
    fine_loss = _joined(forth, back, settings.squared)
    label_loss = torch.zeros_like(fine_loss)
    if output.logits.shape[1]:
        label_loss = functional.cross_entropy(output.logits.float(), labels, reduction="none")
    extra = _extra(output, truth, forth, scale, settings, matcher)
    if settings.fine_emd:
        extra = extra + settings.fine_emd * _some_matched(fine, truth, settings, matcher, generator)
    rise = alpha(progress) if network is None or network.ramp else 1.0
    total = (weights * (coarse_loss + rise * fine_loss + settings.beta * label_loss + extra)).mean()
    return LossTerms(total, coarse_loss.mean(), fine_loss.mean(), label_loss.mean(), extra.mean())


def _extra(
    output: Completion, truth: Tensor, forth: Tensor, scale: float, settings: LossSettings, matcher: Matcher
) -> Tensor:
    """Weighted losses of what only some networks give, [b]; ``truth`` and ``forth`` in network units."""
    total = forth.new_zeros(len(forth))
    if output.log_sigma is not None:
        distance = forth.sqrt() if settings.squared else forth
        distance = distance if settings.joint else distance.detach()
        # Laplace: ln(2 sigma) + d / sigma; its minimum over sigma is at sigma = E[d].
        log_sigma = output.log_sigma.clamp(-9, 3)
        total = total + settings.gamma * (distance * torch.exp(-log_sigma) + log_sigma).mean(1)
    if output.plane is not None and output.center is not None:
        some = truth[:, : settings.emd_points] - output.center[:, None] / scale
        total = total + settings.symmetry * _joined(*two_ways(mirrored(some, output.plane), some, matcher), False)
    if output.denoised is not None:
        centers, patches = (part / scale for part in output.denoised)
        own = take(truth, neighbours(centers, truth, min(patches.shape[2], truth.shape[1])))
        here = (patches - centers[:, :, None]).flatten(0, 1)  # small numbers: nothing cancels
        each = of_patches(here, (own - centers[:, :, None]).flatten(0, 1)).view(len(centers), -1).mean(1)
        total = total + settings.denoise * each
    return total
