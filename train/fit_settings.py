# SPDX-License-Identifier: Apache-2.0
"""Settings of a training run and its schedule."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from edge.config import require
from train.distill import DistillSettings
from train.losses import LossSettings
from train.network import PATCH_CELLS, Frame
from train.networks.registry import NETWORKS, Option

Precision = Literal["fp32", "bf16"]

NOT_IN_RESULT = (
    "budget_s",
    "steps",
    "stop_after_s",
    "workers",
    "threads",
    "device",
    "checkpoint_s",
    "validate_s",
    "log_s",
    "tensorboard",
    "teacher",
    "start",
)
"""Settings that may change when a run is continued (a teacher's file is compared by its content)."""
_STILL_RUNNING = 0.9
"""A run that has come further than this is over; a larger budget starts its schedule anew."""


@dataclass(frozen=True, slots=True)
class FitSettings:
    """How a network is trained.

    Args:
        network, width, options: which, see ``networks.registry``.
        frame: of its input; the data set must agree.
        seed: of weights, order, patch cells and matched points.
        budget_s: training time; progress is elapsed / budget, so a run of any length ends with a low rate.
        steps: optimizer steps instead of a time (0: the time counts).
        stop_after_s: end this process after so much training, to be continued later (0: never).
        batch: samples of a step, of each process.
        rate, final_rate: learning rate after warm-up and at the end (cosine between them).
        warmup_share: share of the budget over which the rate rises from 0.
        weight_decay, clip: AdamW's decay and the largest gradient norm.
        average: decay of the exponential moving average of the weights.
        cells: of 16 shares of the patch, how many random ones are computed in a step.
        precision: "bf16" rounds the inner layers (autocast); coordinates, losses and weights stay in float32.
        workers, threads: data processes; threads of the network and of the losses.
        device: "cpu", "cuda" or "cuda:0".
        checkpoint_s, validate_s, log_s: intervals of training time.
        validation_samples: samples of the validation split, evenly spread over it.
        tensorboard: also write event files into the run folder.
        teacher: checkpoint of a trained network to learn from, "" for none.
        start: checkpoint (its averaged weights) or model folder that the run begins with, "" for none.
        loss, distill: see there.
    Raises:
        ConfigError: a number outside its range.
    """

    network: str = "queries"
    width: str = "edge"
    options: dict[str, Option] = field(default_factory=dict)
    frame: Frame = "sight"
    seed: int = 0
    budget_s: float = 3600.0
    steps: int = 0
    stop_after_s: float = 0.0
    batch: int = 16
    rate: float = 1e-3
    final_rate: float = 1e-5
    warmup_share: float = 0.03
    weight_decay: float = 1e-4
    clip: float = 1.0
    average: float = 0.999
    cells: int = 4
    precision: Precision = "fp32"
    workers: int = 1
    threads: int = 2
    device: str = "cpu"
    checkpoint_s: float = 180.0
    validate_s: float = 600.0
    log_s: float = 20.0
    validation_samples: int = 96
    tensorboard: bool = False
    teacher: str = ""
    start: str = ""
    loss: LossSettings = field(default_factory=LossSettings)
    distill: DistillSettings = field(default_factory=DistillSettings)

    def __post_init__(self) -> None:
        require(self.network in NETWORKS, "fit.network", self.network, ", ".join(NETWORKS))
        widths = NETWORKS[self.network].widths
        require(self.width in widths, "fit.width", self.width, ", ".join(widths))
        require(self.budget_s > 0 and self.steps >= 0, "fit.budget_s", self.budget_s, "> 0 (and steps >= 0)")
        require(self.stop_after_s >= 0, "fit.stop_after_s", self.stop_after_s, ">= 0")
        require(self.batch >= 1, "fit.batch", self.batch, ">= 1")
        require(0 < self.final_rate <= self.rate, "fit.rate", self.rate, ">= final_rate > 0")
        require(0 <= self.warmup_share < 1, "fit.warmup_share", self.warmup_share, "0..1")
        require(1 <= self.cells <= PATCH_CELLS, "fit.cells", self.cells, f"1..{PATCH_CELLS}")
        require(self.precision in ("fp32", "bf16"), "fit.precision", self.precision, "fp32, bf16")
        require(self.workers >= 0 and self.threads >= 1, "fit.threads", self.threads, ">= 1 (and workers >= 0)")
        require(0 <= self.average < 1, "fit.average", self.average, "0..1")


def learning_rate(progress: float, settings: FitSettings) -> float:
    """Linear warm-up, then a half cosine from ``rate`` to ``final_rate``; progress 0..1."""
    if progress < settings.warmup_share:
        return settings.rate * max(progress / settings.warmup_share, 0.01)
    phase = min(1.0, (progress - settings.warmup_share) / (1 - settings.warmup_share))
    return settings.final_rate + (settings.rate - settings.final_rate) * 0.5 * (1 + math.cos(math.pi * phase))


def progress(spent: float, total: float, anchor: list[float]) -> float:
    """Share 0..1 of the schedule.

    Args:
        spent, total: time or steps, of all processes that have carried the run.
        anchor: [spent, progress] when the present budget took over: from there on progress is linear to 1 at ``total``.
    """
    since, before = anchor
    if spent >= total:
        return 1.0
    return min(1.0, before + (1 - before) * (spent - since) / max(total - since, 1e-9))


def new_anchor(spent: float, reached: float, total: float) -> list[float]:
    """Anchor for a changed budget.

    A run under way goes on with the rate that it has; the fall to the final rate is stretched or compressed into what
    is left. One that was over (its rate is low) takes up the schedule at the place that its age has in the new budget.
    """
    return [spent, reached if reached < _STILL_RUNNING else min(1.0, spent / total)]
