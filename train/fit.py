# SPDX-License-Identifier: Apache-2.0
"""Training: a schedule over a time budget, averaged weights, exact continuation."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge.config import require
from edge.errors import ConfigError, ModelError
from train.batches import Batch, collate, endless
from train.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from train.dataset import CLASSES, CompletionDataset, mean_shape
from train.losses import LossSettings, LossTerms, Matcher, completion_loss
from train.nearest import nearest_distance
from train.network import COARSE_POINTS, PATCH_CELLS, SCALE_M, WIDTHS, CompletionNetwork

CHECKPOINT = "checkpoint.pt"
_RATE_WINDOW = 0.05
_NOT_IN_RESULT = (
    "budget_s",
    "steps",
    "workers",
    "threads",
    "device",
    "checkpoint_s",
    "validate_s",
    "log_s",
    "tensorboard",
)
"""Settings that may change when a run is continued."""


@dataclass(frozen=True, slots=True)
class FitSettings:
    """How the network is trained.

    Args:
        width: name in ``network.WIDTHS``.
        seed: of weights, order, patch cells and matched points.
        budget_s: training time; progress is elapsed / budget, so a run of any length ends with a low rate.
        steps: optimizer steps instead of a time (0: the time counts).
        batch: samples of a step.
        rate, final_rate: learning rate after warm-up and at the end (cosine between them).
        warmup_share: share of the budget over which the rate rises from 0.
        weight_decay, clip: AdamW's decay and the largest gradient norm.
        average: decay of the exponential moving average of the weights.
        cells: of the 16 patch cells, how many random ones are computed in a step.
        workers, threads: data processes; threads of the network and of the losses.
        device: "cpu", "cuda" or "cuda:0".
        checkpoint_s, validate_s, log_s: intervals of training time.
        validation_samples: samples of the validation split, evenly spread over it.
        tensorboard: also write event files into the run folder.
        loss: see there.
    Raises:
        ConfigError: a number outside its range.
    """

    width: str = "edge"
    seed: int = 0
    budget_s: float = 3600.0
    steps: int = 0
    batch: int = 16
    rate: float = 1e-3
    final_rate: float = 1e-5
    warmup_share: float = 0.03
    weight_decay: float = 1e-4
    clip: float = 1.0
    average: float = 0.999
    cells: int = 4
    workers: int = 1
    threads: int = 2
    device: str = "cpu"
    checkpoint_s: float = 180.0
    validate_s: float = 600.0
    log_s: float = 20.0
    validation_samples: int = 96
    tensorboard: bool = False
    loss: LossSettings = field(default_factory=LossSettings)

    def __post_init__(self) -> None:
        require(self.width in WIDTHS, "fit.width", self.width, ", ".join(WIDTHS))
        require(self.budget_s > 0 and self.steps >= 0, "fit.budget_s", self.budget_s, "> 0 (and steps >= 0)")
        require(self.batch >= 1, "fit.batch", self.batch, ">= 1")
        require(0 < self.final_rate <= self.rate, "fit.rate", self.rate, ">= final_rate > 0")
        require(0 <= self.warmup_share < 1, "fit.warmup_share", self.warmup_share, "0..1")
        require(1 <= self.cells <= PATCH_CELLS, "fit.cells", self.cells, f"1..{PATCH_CELLS}")
        require(self.workers >= 0 and self.threads >= 1, "fit.threads", self.threads, ">= 1 (and workers >= 0)")
        require(0 <= self.average < 1, "fit.average", self.average, "0..1")


def learning_rate(progress: float, settings: FitSettings) -> float:
    """Linear warm-up, then a half cosine from ``rate`` to ``final_rate``; progress 0..1."""
    if progress < settings.warmup_share:
        return settings.rate * max(progress / settings.warmup_share, 0.01)
    phase = min(1.0, (progress - settings.warmup_share) / (1 - settings.warmup_share))
    return settings.final_rate + (settings.rate - settings.final_rate) * 0.5 * (1 + math.cos(math.pi * phase))


class Trainer:
    """One run in one folder (checkpoint.pt, log.jsonl).

    Args:
        settings: how.
        train, validation: data; both in metres.
        folder: of the run.
        resume: continue the run of the folder.
    Raises:
        ConfigError: the folder holds a run and ``resume`` is False, or that run had other settings.
        ModelError: the checkpoint cannot be read.
    """

    def __init__(
        self,
        settings: FitSettings,
        train: CompletionDataset,
        validation: CompletionDataset,
        folder: Path,
        resume: bool = False,
    ) -> None:
        self.settings, self.train, self.validation, self.folder = settings, train, validation, folder
        torch.set_num_threads(settings.threads)
        self.device = torch.device(settings.device)
        path = folder / CHECKPOINT
        if path.exists() and not resume:
            raise ConfigError(f"run folder {folder.name} holds a run", action="pass --resume or name another folder")
        torch.manual_seed(settings.seed)
        network = CompletionNetwork(WIDTHS[settings.width], len(CLASSES))
        self.state = load_checkpoint(path) if resume else self._start(network)
        self._check_settings()
        network.load_state_dict(self.state.model)
        self.network = network.to(self.device)
        self.average = {name: value.to(self.device) for name, value in self.state.average.items()}
        self.optimizer = torch.optim.AdamW(self.network.parameters(), settings.rate, weight_decay=settings.weight_decay)
        if self.state.optimizer:
            self.optimizer.load_state_dict(self.state.optimizer)
        self.matcher = Matcher(settings.threads)
        self.board = self._board() if settings.tensorboard else None

    def _start(self, network: CompletionNetwork) -> Checkpoint:
        network.start_from(mean_shape(self.train, COARSE_POINTS))
        weights = {name: value.clone() for name, value in network.state_dict().items()}
        average = {name: value.clone() for name, value in weights.items()}
        return Checkpoint(weights, average, {}, 0, 0, 0.0, self._description(), [])

    def _description(self) -> dict[str, Any]:
        """Settings, and what the data were drawn from."""
        return asdict(self.settings) | {"data": self.train.description}

    def _check_settings(self) -> None:
        now = self._description()
        for name, value in self.state.settings.items():
            if name in now and name not in _NOT_IN_RESULT and value != now[name]:
                raise ConfigError(f"the run was started with another fit.{name}", value=now[name], allowed=str(value))
        self.state.settings = now

    def _board(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(self.folder / "tensorboard"))

    @property
    def progress(self) -> float:
        """Share of the budget that is spent, 0..1."""
        if self.settings.steps:
            return min(1.0, self.state.step / self.settings.steps)
        return min(1.0, self.state.elapsed_s / self.settings.budget_s)

    def run(self) -> list[dict[str, float]]:
        """Train until the budget is spent or the process is told to stop; returns the validation history.

        SIGINT and SIGTERM end the run after the current step with a checkpoint; a kill loses at most
        ``checkpoint_s``.
        """
        settings, state = self.settings, self.state
        last_log = last_save = last_validation = state.elapsed_s
        batches = endless(self.train, settings.batch, settings.seed, state.step, settings.workers)
        with _stop_on_signal() as stop:
            clock = time.monotonic()
            while self.progress < 1 and not stop:
                terms = self.step(next(batches).to(self.device))
                now = time.monotonic()
                state.elapsed_s += now - clock
                clock = now
                if state.elapsed_s - last_log >= settings.log_s:
                    self._log(terms)
                    last_log = state.elapsed_s
                if state.elapsed_s - last_validation >= settings.validate_s:
                    self.validate()
                    last_validation = state.elapsed_s
                    clock = time.monotonic()
                if state.elapsed_s - last_save >= settings.checkpoint_s:
                    self.save()
                    last_save = state.elapsed_s
                    clock = time.monotonic()
        if not stop:
            self.validate()
        self.save()
        return state.history

    def step(self, batch: Batch) -> LossTerms:
        """One optimizer step; its chance decisions derive from (seed, step) alone."""
        settings, state = self.settings, self.state
        generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + state.step)
        cells = torch.randperm(PATCH_CELLS, generator=generator)[: settings.cells].to(self.device)
        progress = self.progress
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(progress, settings)
        output = self.network(batch.points_m, batch.counts, cells)
        self._check_finite(output.fine)
        terms = completion_loss(output, batch.truth_m, batch.labels, progress, settings.loss, self.matcher, generator)
        self.optimizer.zero_grad(set_to_none=True)
        terms.total.backward()  # type: ignore[no-untyped-call]
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), settings.clip)
        self._check_finite(norm)
        self.optimizer.step()
        decay = min(settings.average, (1 + state.step) / (10 + state.step))
        with torch.no_grad():
            for name, value in self.network.state_dict().items():
                self.average[name].lerp_(value, 1 - decay)
        state.step += 1
        state.samples += len(batch.counts)
        return terms

    def _check_finite(self, value: torch.Tensor) -> None:
        if not torch.isfinite(value).all():
            raise ModelError(
                f"training diverged at step {self.state.step}: output or gradient is not finite",
                action="start again with a lower rate; the last checkpoint is as it was",
            )

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Mean unsquared Chamfer distance in cm by class, and class accuracy, of the averaged weights."""
        weights = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.network.load_state_dict(self.average)
        distance_cm: dict[int, list[float]] = {}
        right = []
        count = min(self.settings.validation_samples, len(self.validation))
        for index in np.linspace(0, len(self.validation) - 1, count).astype(int):
            sample = self.validation[int(index)]
            batch = collate([sample]).to(self.device)
            output = self.network(batch.points_m, batch.counts)
            fine = output.fine[0].cpu().numpy()
            both = nearest_distance(fine, sample.truth).mean() + nearest_distance(sample.truth, fine).mean()
            distance_cm.setdefault(sample.label, []).append(50 * float(both))
            right.append(int(output.logits.argmax()) == sample.label)
        self.network.load_state_dict(weights)
        result = {f"cd_{CLASSES[label]}_cm": float(np.mean(values)) for label, values in sorted(distance_cm.items())}
        result["cd_macro_cm"] = float(np.mean(list(result.values())))
        result |= {"class_accuracy": float(np.mean(right)), "samples": self.state.samples}
        self.state.history.append(result | {"elapsed_s": self.state.elapsed_s})
        self._write("validation", result)
        return result

    def save(self) -> None:
        """Write the checkpoint."""
        state = self.state
        state.model = {name: value.cpu() for name, value in self.network.state_dict().items()}
        state.average = {name: value.cpu() for name, value in self.average.items()}
        state.optimizer = self.optimizer.state_dict()
        save_checkpoint(self.folder / CHECKPOINT, state)

    def _log(self, terms: LossTerms) -> None:
        cm = 100 * SCALE_M
        speed = self.state.samples / max(self.state.elapsed_s, 1e-9)
        left_s = self.state.elapsed_s * (1 / max(self.progress, 1e-9) - 1)
        self._write(
            "train",
            {
                "coarse_cm": terms.coarse.item() * cm,
                "fine_cm": terms.fine.item() * cm,
                "cross_entropy": terms.label.item(),
                "rate": self.optimizer.param_groups[0]["lr"],
                "samples": self.state.samples,
                "samples_per_s": speed,
                "left_s": left_s,
            },
        )

    def _write(self, kind: str, values: dict[str, float]) -> None:
        record: dict[str, Any] = {"kind": kind, "step": self.state.step, "elapsed_s": self.state.elapsed_s} | values
        if self.board:
            for name, value in values.items():
                self.board.add_scalar(f"{kind}/{name}", value, self.state.samples)
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "log.jsonl").open("a") as file:
            file.write(json.dumps(record) + "\n")
        shown = "  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in record.items())
        print(shown, flush=True)


@contextmanager
def _stop_on_signal() -> Iterator[list[int]]:
    """A list that becomes non-empty when SIGINT or SIGTERM arrives; the handlers before are put back."""
    received: list[int] = []
    before = {
        number: signal.signal(number, lambda n, _: received.append(n)) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
