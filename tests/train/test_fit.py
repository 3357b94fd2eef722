# SPDX-License-Identifier: Apache-2.0
"""Training: it learns, it continues exactly, its schedule ends annealed, and it refuses what cannot be continued."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from edge.errors import ConfigError, ModelError
from train.batches import Order, collate, endless, in_frame
from train.checkpoint import load_checkpoint
from train.cli import _parser
from train.dataset import CompletionDataset, DatasetSettings
from train.distill import DistillSettings
from train.fit import CHECKPOINT, FitSettings, Trainer, learning_rate
from train.fit_command import _class_weights
from train.fit_text import fit_command, starting_point
from train.losses import LossSettings
from train.nearest import nearest_distance
from train.networks.registry import of_checkpoint, parse_options
from train.perturb_settings import PerturbSettings

DATA = DatasetSettings(truth_points=512, max_points=200, epoch_samples=24, parametric_objects=1, evaluation_views=1)
SETTINGS = FitSettings(
    network="narrow",
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
    options = {"mirror": "cue", "uncertainty": True, "trim": 5}
    fourth = Trainer(replace(SETTINGS, options=options, steps=1, start=str(path)), *data, tmp_path / "fourth")
    assert all(torch.equal(fourth.network.state_dict()[name], value) for name, value in first.average.items())
    fourth.run()
    back = str(tmp_path / "fourth" / CHECKPOINT)
    with pytest.raises(ModelError, match="at least its options"):
        Trainer(replace(SETTINGS, start=back), *data, tmp_path / "fifth")
    with pytest.raises(ModelError, match="at least its options"):  # the weights would fit, the centre does not
        Trainer(replace(SETTINGS, options=options | {"trim": 0}, start=back), *data, tmp_path / "sixth")


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


def test_a_larger_budget_stretches_the_schedule_and_never_turns_it_back(
    data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path
) -> None:
    trainer = Trainer(replace(SETTINGS, steps=0, budget_s=100), *data, tmp_path)
    trainer.state.elapsed_s = 40
    trainer.save()
    longer = Trainer(replace(SETTINGS, steps=0, budget_s=400), *data, tmp_path, resume=True)
    assert longer.progress == pytest.approx(0.4)
    longer.state.elapsed_s = 220
    assert longer.progress == pytest.approx(0.7)
    longer.save()
    shorter = Trainer(replace(SETTINGS, steps=0, budget_s=250), *data, tmp_path, resume=True)
    assert shorter.progress == pytest.approx(0.7)
    shorter.state.elapsed_s = 250
    assert shorter.progress == 1
    shorter.save()
    again = Trainer(replace(SETTINGS, steps=0, budget_s=500), *data, tmp_path, resume=True)
    assert again.progress == pytest.approx(0.5)  # over, and taken up again
    again.save()
    assert Trainer(replace(SETTINGS, steps=0, budget_s=500), *data, tmp_path, resume=True).progress == again.progress


def test_a_stopped_run_goes_on_as_if_it_had_not_stopped(
    data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path
) -> None:
    settings = replace(SETTINGS, steps=4)
    whole = Trainer(settings, *data, tmp_path / "whole")
    whole.run()
    for count in range(1, 5):
        leg = Trainer(replace(settings, stop_after_s=1e-6), *data, tmp_path / "legs", resume=count > 1)
        leg.run()
        assert leg.state.step == count
    for name, value in whole.average.items():
        assert torch.equal(value, leg.average[name]), name


@pytest.mark.parametrize(
    ("network", "precision"),
    [
        ("pcn", "fp32"),
        ("adapointr", "fp32"),
        ("narrow", "bf16"),
        ("queries", "fp32"),
        ("queries", "bf16"),
    ],
)
def test_every_network_trains_and_continues_exactly(
    network: str, precision: str, data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path
) -> None:
    settings = replace(SETTINGS, network=network, precision=precision)
    whole = Trainer(settings, *data, tmp_path / "whole")
    before = whole.validate()["cd_macro_cm"]
    steps(whole, 4)
    broken = Trainer(settings, *data, tmp_path / "broken")
    steps(broken, 2)
    broken.save()
    continued = Trainer(settings, *data, tmp_path / "broken", resume=True)
    steps(continued, 2)
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, continued.network.state_dict()[name]), name
    assert whole.validate()["cd_macro_cm"] < 1.5 * before
    continued.save()
    loaded = of_checkpoint(load_checkpoint(tmp_path / "broken" / CHECKPOINT))
    assert loaded.parameter_count == whole.network.parameter_count


def test_other_options_are_another_run(data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path) -> None:
    Trainer(SETTINGS, *data, tmp_path).save()
    with pytest.raises(ConfigError, match=r"fit\.options"):
        Trainer(replace(SETTINGS, options={"mirror": "plane"}), *data, tmp_path, resume=True)
    with pytest.raises(ConfigError, match="different frames"):
        Trainer(replace(SETTINGS, frame="box"), *data, tmp_path / "box")


def test_box_frame_puts_every_object_into_the_unit_sphere() -> None:
    dataset = CompletionDataset("train", replace(DATA, box_frame=True, truth_points=4000), 0)
    for index in range(4):
        sample = in_frame(dataset[index], "box")
        radius = np.linalg.norm(sample.truth, axis=1).max()
        size = sample.truth.max(0) - sample.truth.min(0)
        assert 0.25 < radius <= 0.5001
        assert 0.9 < np.linalg.norm(size) <= 1.0001
        np.testing.assert_allclose((sample.truth.max(0) + sample.truth.min(0)) / 2, 0, atol=0.03)


def test_powers_are_a_column_and_points_without_are_average() -> None:
    sample = CompletionDataset("train", DATA, 0)[0]
    power = np.linspace(-9, 9, len(sample.partial), dtype=np.float32)
    batch = collate([sample, replace(sample, power_db=power)], columns=4)
    assert batch.points_m.shape == (2 * len(power), 4)
    assert not batch.points_m[: len(power), 3].any()
    np.testing.assert_array_equal(batch.points_m[len(power) :, 3], power)


def test_scans_of_pcn_lie_on_the_visible_surface_and_ours_do_not() -> None:
    clean = replace(
        DATA, perturbation=PerturbSettings.clean(), truth_points=30_000, sight_sigma_deg=0, ground_sigma_m=0
    )
    for index in range(4):
        sample = CompletionDataset("train", clean, 0)[index]
        assert nearest_distance(sample.partial, sample.truth).max() < 0.08
    noisy = CompletionDataset("train", replace(DATA, truth_points=30_000), 0)[0]
    assert nearest_distance(noisy.partial, noisy.truth).max() > 0.08
    assert "perturbation" in CompletionDataset("train", clean, 0).description


def test_a_teacher_pulls_the_student(data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path) -> None:
    wide = Trainer(replace(SETTINGS, network="paper", steps=2), *data, tmp_path / "wide")
    wide.run()
    path = str(tmp_path / "wide" / CHECKPOINT)
    only = replace(SETTINGS, teacher=path, distill=DistillSettings(fine=1.0))
    student = Trainer(only, *data, tmp_path / "student")
    assert student.teacher is not None
    batch = next(student.batches(0))
    with torch.no_grad():
        taught = student.teacher.network(batch.points_m, batch.counts)
        same = student.teacher.loss(batch, taught, 16, student.matcher, torch.Generator())
        own = student.network(batch.points_m, batch.counts)
        away = student.teacher.loss(batch, own, 16, student.matcher, torch.Generator())
    assert float(same) == pytest.approx(0, abs=1e-5)
    assert float(away) > 1e-3
    steps(student, 2)
    student.save()
    wide.state.samples += 1
    wide.save()
    with pytest.raises(ConfigError, match="teacher_sha256"):
        Trainer(only, *data, tmp_path / "student", resume=True)


WORKER = """
import json, sys, torch
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_fit import DATA, SETTINGS, CompletionDataset, Trainer, replace
if __name__ == "__main__":
    settings = replace(SETTINGS, batch=2, steps=3, **json.loads(sys.argv[3]))
    data = CompletionDataset("train", DATA, 0), CompletionDataset("val", DATA, 0)
    trainer = Trainer(settings, *data, Path(sys.argv[1]))
    trainer.run()
    weights = torch.cat([value.flatten() for value in trainer.network.state_dict().values()])
    both = [torch.empty_like(weights) for _ in range(2)]
    torch.distributed.all_gather(both, weights)
    assert torch.equal(*both)
    trainer.group.close()
"""


@pytest.mark.parametrize("chosen", [{}, {"network": "queries", "options": {"denoise": False}}])
def test_two_processes_take_the_steps_of_one_with_the_double_batch(
    data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path, chosen: dict[str, Any]
) -> None:
    (tmp_path / "worker.py").write_text(WORKER)
    run = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    arguments = [str(tmp_path / "worker.py"), str(tmp_path / "two"), str(Path(__file__).parent), json.dumps(chosen)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        [*run, *arguments], env=environment, capture_output=True, text=True, timeout=250, check=False
    )
    assert result.returncode == 0, result.stderr[-3000:]
    settings = replace(SETTINGS, batch=4, **chosen)
    one = Trainer(replace(settings, steps=3), *data, tmp_path / "one")
    one.run()
    two = load_checkpoint(tmp_path / "two" / CHECKPOINT)
    assert (two.step, two.samples, two.settings["batch"]) == (3, 12, 4)
    for name, value in one.network.state_dict().items():
        torch.testing.assert_close(two.model[name], value, atol=2e-4, rtol=0)
    assert two.history[-1]["cd_macro_cm"] == pytest.approx(one.state.history[-1]["cd_macro_cm"], rel=0.01)
    assert len((tmp_path / "two" / "log.jsonl").read_text().splitlines()) == 1
    continued = Trainer(replace(settings, steps=5), *data, tmp_path / "two", resume=True)
    assert continued.run()[-1]["samples"] == 20


def test_a_useless_weight_is_refused(data: tuple[CompletionDataset, CompletionDataset], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"coarse_emd.*of narrow is EMD"):
        Trainer(replace(SETTINGS, loss=LossSettings(emd_points=128, coarse_emd=0.1)), *data, tmp_path)


def test_shares_of_the_processes_are_the_large_batch() -> None:
    whole, parts = list(Order(23, 6, 1)), [list(Order(23, 3, 1, rank, 2)) for rank in (0, 1)]
    assert [a + b for a, b in zip(*parts, strict=True)] == whole


def test_the_command_of_the_card_gives_the_settings_back() -> None:
    """What the parser makes of it is what the run had; what is usual is not named."""
    loss = LossSettings(
        fine_emd=0.25, coarse_emd=0.125, beta=0.05, emd_points=256, joint=True, class_weights=(1.0, 2.0, 1.0, 1.0)
    )
    chosen = FitSettings(
        network="queries", width="edge", options={"trim": 5, "mirror": False}, frame="box", seed=3, steps=70, batch=8,
        rate=5e-4, cells=8, precision="bf16", start="/elsewhere/models/default", loss=loss,
    )  # fmt: skip
    data = {"max_points": 2048, "truth_points": 4096, "simulated_share": 0.6, "simulated_set": "a+b"}
    command = fit_command("own", asdict(chosen) | {"data": data})
    options = _parser().parse_args(command.split()[1:])
    for name in ("network", "width", "frame", "seed", "steps", "batch", "rate", "cells", "precision"):
        assert getattr(options, name) == getattr(chosen, name), name
    assert parse_options("queries", options.option) == chosen.options
    assert (options.fine_emd, options.coarse_emd, options.beta, options.emd_points) == (0.25, 0.125, 0.05, 256)
    assert options.joint_uncertainty
    assert not options.squared
    assert (options.start, options.points, options.simulated_share) == ("models/default", 2048, 0.6)
    assert _class_weights(options.class_weight) == loss.class_weights
    assert ("truth-points" in command, len(options.simulated)) == (False, 2)
    assert starting_point("/somewhere/runs/first/checkpoint.pt") == "runs/first/checkpoint.pt"
