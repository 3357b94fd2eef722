# SPDX-License-Identifier: Apache-2.0
"""Training: a schedule over a time budget, averaged weights, exact continuation, one process or several."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edge.config import require
from edge.errors import ConfigError, ModelError
from train.batches import Batch, collate, endless, in_frame
from train.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from train.dataset import CLASSES, CompletionDataset, mean_shape
from train.distill import Teacher
from train.fit_settings import NOT_IN_RESULT, FitSettings, learning_rate, new_anchor, progress
from train.import_weights import read_weights
from train.losses import LossTerms, Matcher, completion_loss
from train.nearest import nearest_distance
from train.network import PATCH_CELLS, CompletionModel
from train.networks.registry import build
from train.parallel import Group

__all__ = ["CHECKPOINT", "FitSettings", "Trainer", "learning_rate"]

CHECKPOINT = "checkpoint.pt"


class Trainer:
    """One run in one folder (checkpoint.pt, log.jsonl).

    Under ``torchrun`` every process builds one; together they take the steps that one process with a larger batch
    would, and the first writes the files.

    Args:
        settings: how.
        train, validation: data; both in metres, in the box frame if the network is.
        folder: of the run.
        resume: continue the run of the folder.
    Raises:
        ConfigError: the folder holds a run and ``resume`` is False, that run had other settings, or the data are in
            another frame than the network's.
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
        path = folder / CHECKPOINT
        if path.exists() and not resume:
            raise ConfigError(f"run folder {folder.name} holds a run", action="pass --resume or name another folder")
        for data in (train, validation):
            if data.settings.box_frame != (settings.frame == "box"):
                raise ConfigError("data and network are in different frames", value=data.split, allowed=settings.frame)
        self.group = Group(settings.device)
        self.device = self.group.device
        torch.manual_seed(settings.seed)
        network = build(settings.network, settings.width, settings.frame, settings.options)
        both = settings.loss.coarse_emd == 0 or network.coarse_loss == "chamfer"
        require(both, "loss.coarse_emd", settings.loss.coarse_emd, f"0: the coarse loss of {settings.network} is EMD")
        self.teacher: Teacher | None = None
        if settings.teacher:
            self.teacher = Teacher(Path(settings.teacher), network, self.device, settings.distill)
        self.samples_before = 0
        """Samples that the run whose weights this one began with had seen."""
        self.state = load_checkpoint(path) if resume else self._start(network)
        self.samples_before = int(self.state.settings.get("samples_before", 0))
        self._continue()
        network.load_state_dict(self.state.model)
        self.network = network.to(self.device)
        self.average = {name: value.to(self.device) for name, value in self.state.average.items()}
        self.optimizer = torch.optim.AdamW(self.network.parameters(), settings.rate, weight_decay=settings.weight_decay)
        if self.state.optimizer:
            self.optimizer.load_state_dict(self.state.optimizer)
        self.group.same([*self.network.state_dict().values(), *self.average.values()])
        self.matcher = Matcher(settings.threads)
        self.board = self._board() if settings.tensorboard and self.group.leads else None

    def _start(self, network: CompletionModel) -> Checkpoint:
        if self.settings.start:
            self.samples_before = self._load_start(network, Path(self.settings.start))
        else:
            see = partial(in_frame, frame=network.frame)
            network.start_from(mean_shape(self.train, network.coarse_points, see))
        weights = {name: value.clone() for name, value in network.state_dict().items()}
        average = {name: value.clone() for name, value in weights.items()}
        return Checkpoint(weights, average, {}, 0, 0, 0.0, self._description(), [])

    @staticmethod
    def _load_start(network: CompletionModel, path: Path) -> int:
        """Averaged weights of another run, or those of a shipped model; returns the samples it had seen."""
        trim = 0
        if path.is_dir() or path.suffix == ".onnx":
            weights, samples = read_weights(path, network)
            kind = "a model's graph"
        else:
            earlier = load_checkpoint(path)
            weights, kind = earlier.average, earlier.settings["network"]
            samples = earlier.samples + int(earlier.settings.get("samples_before", 0))
            trim = int(earlier.settings.get("options", {}).get("trim", 0))  # no weight tells
        refusal = ModelError(
            f"{path}: weights of another network",
            value=kind,
            action="fine-tune with the network and width of that run, and at least its options",
        )
        try:
            found = network.load_state_dict(weights, strict=False)
        except RuntimeError as error:
            raise refusal from error
        fits = trim in (0, network.trim_percent) and not found.unexpected_keys
        if not fits or not network.begin_without(found.missing_keys):
            raise refusal
        return samples

    def _description(self) -> dict[str, Any]:
        """Settings, and what the data were drawn from; the batch is that of all processes."""
        own = {"data": self.train.description, "batch": self.settings.batch * self.group.size}
        if self.samples_before:
            own["samples_before"] = self.samples_before
        if self.teacher:
            own["teacher_sha256"] = self.teacher.sha256
        return asdict(self.settings) | own

    def _continue(self) -> None:
        """Compare the settings of a continued run, and join its schedule to the present budget."""
        now, before = self._description(), self.state.settings
        for name, value in before.items():
            if name not in now or name in NOT_IN_RESULT:
                continue
            later = {key: now[name][key] for key in value} if name in ("loss", "distill") else now[name]
            if value != later:
                raise ConfigError(f"the run was started with another fit.{name}", value=now[name], allowed=str(value))
        of = "steps" if self.settings.steps else "budget_s"
        if bool(before["steps"]) == bool(now["steps"]) and before[of] != now[of]:
            spent = self._spent
            reached = progress(spent, before[of], self.state.anchor)
            self.state.anchor = new_anchor(spent, reached, now[of])
        self.state.settings = now

    def _board(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(self.folder / "tensorboard"))

    @property
    def _spent(self) -> float:
        """Steps or seconds, whichever the budget is in."""
        return float(self.state.step) if self.settings.steps else self.state.elapsed_s

    @property
    def progress(self) -> float:
        """Share of the schedule that is done, 0..1."""
        return progress(self._spent, self.settings.steps or self.settings.budget_s, self.state.anchor)

    def batches(self, workers: int) -> Iterator[Batch]:
        """The batches of this process from the run's present step on."""
        settings, group = self.settings, self.group
        return endless(
            self.train, settings.batch, settings.seed, self.state.step, workers, group.rank, group.size,
            settings.frame, self.network.columns,
        )  # fmt: skip

    def run(self) -> list[dict[str, float]]:
        """Train until the budget is spent or the process is told to stop; returns the validation history.

        SIGINT, SIGTERM and ``stop_after_s`` end the run after the current step with a checkpoint; a kill loses at most
        ``checkpoint_s``.
        """
        settings, state = self.settings, self.state
        begin = last_log = last_save = last_validation = state.elapsed_s
        self._logged = state.samples, state.elapsed_s
        batches = self.batches(settings.workers)
        with _stop_on_signal() as stop:
            stopped = False
            clock = time.monotonic()
            while self.progress < 1 and not stopped:
                terms = self.step(next(batches).to(self.device))
                now = time.monotonic()
                state.elapsed_s, stopped = self.group.agree(state.elapsed_s + now - clock, bool(stop))
                stopped |= 0 < settings.stop_after_s <= state.elapsed_s - begin
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
        if not stopped:
            self.validate()
        self.save()
        return state.history

    def step(self, batch: Batch) -> LossTerms:
        """One optimizer step; its chance decisions derive from (seed, step) alone."""
        settings, state, network = self.settings, self.state, self.network
        chance = settings.seed * 1_000_003 + state.step
        generator = torch.Generator().manual_seed(chance)
        torch.manual_seed(chance + self.group.rank)
        some = max(1, settings.cells * network.cells // PATCH_CELLS)
        cells = torch.randperm(network.cells, generator=generator)[:some].to(self.device)
        done = self.progress
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(done, settings)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=settings.precision == "bf16"):
            output = network(batch.points_m, batch.counts, cells)
        self._check_finite(output.fine)
        terms = completion_loss(
            output, batch.truth_m, batch.labels, done, settings.loss, self.matcher, generator, network
        )
        total = terms.total
        if self.teacher:
            total = total + self.teacher.loss(batch, output, settings.cells, self.matcher, generator)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        self.group.average_gradients(network.parameters())
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), settings.clip)
        self._check_finite(norm)
        self.optimizer.step()
        decay = min(settings.average, (1 + state.step) / (10 + state.step))
        with torch.no_grad():
            for name, value in network.state_dict().items():
                self.average[name].lerp_(value, 1 - decay)
        state.step += 1
        state.samples += len(batch.counts) * self.group.size
        return terms

    def _check_finite(self, value: torch.Tensor) -> None:
        if not torch.isfinite(value).all():
            raise ModelError(
                f"training diverged at step {self.state.step}: output or gradient is not finite",
                action="start again with a lower rate; the last checkpoint is as it was",
            )

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Mean unsquared Chamfer distance by class, and class accuracy, of the averaged weights.

        Only the first process does it. Distances in cm; in the box frame those of an object with a diagonal of 1 m.
        """
        if not self.group.leads:
            return {}
        weights = {name: value.clone() for name, value in self.network.state_dict().items()}
        self.network.load_state_dict(self.average)
        self.network.eval()
        distance_cm: dict[int, list[float]] = {}
        right = []
        count = min(self.settings.validation_samples, len(self.validation))
        for index in np.linspace(0, len(self.validation) - 1, count).astype(int):
            sample = in_frame(self.validation[int(index)], self.settings.frame)
            batch = collate([self.validation[int(index)]], self.settings.frame, self.network.columns).to(self.device)
            output = self.network(batch.points_m, batch.counts)
            fine = output.fine[0].float().cpu().numpy()
            both = nearest_distance(fine, sample.truth).mean() + nearest_distance(sample.truth, fine).mean()
            distance_cm.setdefault(sample.label, []).append(50 * float(both))
            if output.logits.shape[1]:
                right.append(int(output.logits.argmax()) == sample.label)
        self.network.load_state_dict(weights)
        self.network.train()
        result = {f"cd_{CLASSES[label]}_cm": float(np.mean(values)) for label, values in sorted(distance_cm.items())}
        result["cd_macro_cm"] = float(np.mean(list(result.values())))
        result |= {"class_accuracy": float(np.mean(right))} if right else {}
        result |= {"samples": self.state.samples}
        self.state.history.append(result | {"elapsed_s": self.state.elapsed_s})
        self._write("validation", result)
        return result

    def save(self) -> None:
        """Write the checkpoint."""
        if not self.group.leads:
            return
        state = self.state
        state.model = {name: value.cpu() for name, value in self.network.state_dict().items()}
        state.average = {name: value.cpu() for name, value in self.average.items()}
        state.optimizer = self.optimizer.state_dict()
        save_checkpoint(self.folder / CHECKPOINT, state)

    def _log(self, terms: LossTerms) -> None:
        state, cm = self.state, 100 * self.network.scale
        samples, seconds = (
            now - then for now, then in zip((state.samples, state.elapsed_s), self._logged, strict=True)
        )
        self._logged = state.samples, state.elapsed_s
        total = self.settings.steps or self.settings.budget_s
        left_s = (total - self._spent) * (state.elapsed_s / self._spent if self.settings.steps else 1.0)
        self._write(
            "train",
            {
                "progress": self.progress,
                "coarse_cm": terms.coarse.item() * cm,
                "fine_cm": terms.fine.item() * cm,
                "cross_entropy": terms.label.item(),
                "extra": terms.extra.item(),
                "rate": self.optimizer.param_groups[0]["lr"],
                "samples": state.samples,
                "samples_per_s": samples / max(seconds, 1e-9),
                "left_s": left_s,
            },
        )

    def _write(self, kind: str, values: dict[str, float]) -> None:
        if not self.group.leads:
            return
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
