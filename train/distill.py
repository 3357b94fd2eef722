# SPDX-License-Identifier: Apache-2.0
"""Distillation: a small network learns from a trained wide one beside the truth."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from edge.config import require
from train.batches import Batch
from train.checkpoint import load_checkpoint
from train.losses import Matcher, chamfer
from train.network import PATCH_CELLS, Completion, CompletionModel
from train.networks.registry import of_checkpoint


@dataclass(frozen=True, slots=True)
class DistillSettings:
    """Weights of what is learned from the teacher; each 0 or more.

    Args:
        fine: Chamfer distance to the teacher's fine points.
        feature: squared difference of the cosine similarities between the batch's global features, which needs no layer
            between features of different widths (Tung and Mori 2019).
        logits: Kullback-Leibler divergence of the softened classes (Hinton et al. 2015).
        temperature: of the softening.
    Raises:
        ConfigError: a negative weight, or a temperature that is not positive.
    """

    fine: float = 0.5
    feature: float = 0.1
    logits: float = 0.02
    temperature: float = 2.0

    def __post_init__(self) -> None:
        for name in ("fine", "feature", "logits"):
            require(getattr(self, name) >= 0, f"distill.{name}", getattr(self, name), ">= 0")
        require(self.temperature > 0, "distill.temperature", self.temperature, "> 0")


class Teacher:
    """A trained network that only answers.

    Args:
        path: its checkpoint.
        student: must have the same frame.
        device: where it answers.
        settings: weights.
    Raises:
        ModelError: the checkpoint cannot be read.
        ConfigError: another frame or other input columns than the student's.
    """

    def __init__(self, path: Path, student: CompletionModel, device: torch.device, settings: DistillSettings) -> None:
        checkpoint = load_checkpoint(path)
        self.settings = settings
        self.network = of_checkpoint(checkpoint).to(device)
        self.sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        require(self.network.frame == student.frame, "frame of the teacher", self.network.frame, student.frame)
        require(self.network.columns <= student.columns, "input columns of the teacher", self.network.columns, "fewer")

    def loss(
        self, batch: Batch, output: Completion, share: int, matcher: Matcher, generator: torch.Generator
    ) -> Tensor:
        """Weighted sum of the terms, a scalar in network units.

        Args:
            batch: what the student saw.
            output: what it answered.
            share: of 16, of the teacher's patch cells.
            matcher: finds neighbours.
            generator: draws the cells.
        """
        network, settings = self.network, self.settings
        cells = torch.randperm(network.cells, generator=generator)[: max(1, share * network.cells // PATCH_CELLS)]
        with torch.no_grad():
            wise = network(batch.points_m, batch.counts, cells.to(batch.points_m.device))
        total = settings.fine * chamfer(output.fine, wise.fine, matcher) / network.scale
        if output.feature is not None and wise.feature is not None:
            total = total + settings.feature * functional.mse_loss(_alike(output.feature), _alike(wise.feature))
        if output.logits.shape[1] and wise.logits.shape[1]:
            own, other = (
                functional.log_softmax(x.float() / settings.temperature, 1) for x in (output.logits, wise.logits)
            )
            divergence = functional.kl_div(own, other, reduction="batchmean", log_target=True)
            total = total + settings.logits * settings.temperature**2 * divergence
        return total


def _alike(feature: Tensor) -> Tensor:
    """Cosine similarities within a batch: [b, channels] -> [b, b]."""
    unit = functional.normalize(feature.float(), dim=1)
    return unit @ unit.T
