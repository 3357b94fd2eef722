# SPDX-License-Identifier: Apache-2.0
"""Training: it learns, it continues exactly, its schedule ends annealed, and it refuses what cannot be continued."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from edge.errors import ConfigError, ModelError
from train.batches import Order, endless
from train.checkpoint import load_checkpoint
from train.dataset import CompletionDataset, DatasetSettings
from train.fit import CHECKPOINT, FitSettings, Trainer, learning_rate
from train.losses import LossSettings

DATA = DatasetSettings(truth_points=512, max_points=200, epoch_samples=24, parametric_objects=1, evaluation_views=1)
SETTINGS = FitSettings(
    width="tiny",
    steps=6,
    batch=4,
    cells=2,
    workers=0,
    threads=1,
    validation_samples=4,
    loss=LossSettings(emd_points=128),
)


@pytest.fixture(scope="module")
def data() -> tuple[CompletionDataset, CompletionDataset]:
    return CompletionDataset("train", DATA, 0), CompletionDataset("val", DATA, 0)


def steps(trainer: Trainer, count: int) -> None:
    settings = trainer.settings
    batches = endless(trainer.train, settings.batch, settings.seed, trainer.state.step, 0)
    for _ in range(count):
        trainer.step(next(batches))


def test_continued_run_equals_an_unbroken_one(
    data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path
) -> None:
    whole = Trainer(SETTINGS, *data, tmp_path / "whole")
    steps(whole, 6)
    broken = Trainer(SETTINGS, *data, tmp_path / "broken")
    steps(broken, 3)
    broken.save()
    continued = Trainer(SETTINGS, *data, tmp_path / "broken", resume=True)
    assert continued.state.step == 3
    steps(continued, 3)
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, continued.network.state_dict()[name]), name
        assert torch.equal(whole.average[name], continued.average[name]), name
    assert whole.state.samples == continued.state.samples == 24


def test_training_reduces_the_distance(data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path) -> None:
    settings = replace(SETTINGS, steps=40, batch=8, rate=3e-3, log_s=0.0, average=0.9)
    trainer = Trainer(settings, *data, tmp_path)
    before = trainer.validate()
    history = trainer.run()
    assert history[-1]["cd_macro_cm"] < 0.8 * before["cd_macro_cm"]
    records = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [r["step"] for r in records if r["kind"] == "train"] == list(range(1, 41))
    assert records[-1]["kind"] == "validation"
    assert load_checkpoint(tmp_path / CHECKPOINT).samples == 320
    assert not list(tmp_path.glob("*.tmp"))


def test_termination_leaves_a_checkpoint(
    data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = Trainer(replace(SETTINGS, steps=50), *data, tmp_path)
    step = trainer.step

    def interrupted(batch: object) -> object:
        if trainer.state.step == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(batch)  # type: ignore[arg-type]

    monkeypatch.setattr(trainer, "step", interrupted)
    trainer.run()
    assert load_checkpoint(tmp_path / CHECKPOINT).step == 3
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_fine_tuning_begins_with_the_averaged_weights_of_another_run(
    data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path
) -> None:
    first = Trainer(replace(SETTINGS, steps=2), *data, tmp_path / "first")
    first.run()
    path = tmp_path / "first" / CHECKPOINT
    second = Trainer(replace(SETTINGS, steps=2, start=str(path)), *data, tmp_path / "second")
    for name, value in second.network.state_dict().items():
        assert torch.equal(value, first.average[name])
    assert second.state.step == 0
    second.run()
    assert load_checkpoint(tmp_path / "second" / CHECKPOINT).settings["samples_before"] == first.state.samples
    with pytest.raises(ModelError, match="another network"):
        Trainer(replace(SETTINGS, network="pcn", width="tiny", start=str(path)), *data, tmp_path / "third")


def test_schedule_rises_then_falls_to_the_final_rate() -> None:
    rates = [learning_rate(p / 1000, SETTINGS) for p in range(1001)]
    peak = round(1000 * SETTINGS.warmup_share)
    assert rates[peak] == pytest.approx(SETTINGS.rate)
    assert rates[:peak] == sorted(rates[:peak])
    assert rates[peak:] == sorted(rates[peak:], reverse=True)
    assert rates[-1] == pytest.approx(SETTINGS.final_rate)


def test_progress_follows_time_when_no_steps_are_set(
    data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path
) -> None:
    trainer = Trainer(replace(SETTINGS, steps=0, budget_s=100), *data, tmp_path)
    trainer.state.elapsed_s = 25
    assert trainer.progress == 0.25
    trainer.state.elapsed_s = 300
    assert trainer.progress == 1
    assert trainer.run() != []


def test_what_cannot_be_continued_is_refused(data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path) -> None:
    trainer = Trainer(SETTINGS, *data, tmp_path)
    trainer.save()
    with pytest.raises(ConfigError, match="holds a run"):
        Trainer(SETTINGS, *data, tmp_path)
    with pytest.raises(ConfigError, match=r"another fit\.batch"):
        Trainer(replace(SETTINGS, batch=5), *data, tmp_path, resume=True)
    with pytest.raises(ConfigError, match=r"another fit\.data"):
        Trainer(SETTINGS, CompletionDataset("train", DATA, 1), data[1], tmp_path, resume=True)
    assert Trainer(replace(SETTINGS, steps=60), *data, tmp_path, resume=True).settings.steps == 60
    with pytest.raises(ModelError, match="not a checkpoint"):
        Trainer(SETTINGS, *data, tmp_path / "none", resume=True)
    content = (tmp_path / CHECKPOINT).read_bytes()
    (tmp_path / CHECKPOINT).write_bytes(content[: len(content) // 2])
    with pytest.raises(ModelError, match="not a checkpoint"):
        Trainer(SETTINGS, *data, tmp_path, resume=True)


def test_divergence_is_named(data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path) -> None:
    trainer = Trainer(SETTINGS, *data, tmp_path)
    batch = next(endless(trainer.train, 4, 0, 0, 0))
    with torch.no_grad():
        trainer.network.coarse3.bias[0] = float("nan")
    with pytest.raises(ModelError, match="diverged at step 0"):
        trainer.step(batch)


def test_order_of_an_epoch_is_a_permutation_that_can_start_anywhere() -> None:
    order = Order(10, 3, seed=5)
    every = list(order)
    assert len(every) == len(order) == 3
    assert len({index for batch in every for index in batch}) == 9
    order.first = 1
    assert list(order) == every[1:]
    order.epoch, order.first = 1, 0
    assert list(order) != every


@pytest.mark.parametrize(
    "change", [{"width": "huge"}, {"cells": 17}, {"final_rate": 1.0}, {"batch": 0}, {"average": 1.0}]
)
def test_settings_that_cannot_work_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        replace(SETTINGS, **change)  # type: ignore[arg-type]
