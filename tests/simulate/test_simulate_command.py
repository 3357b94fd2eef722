# SPDX-License-Identifier: Apache-2.0
"""The verb ``simulate``: build, go on, check, pack, stop; and training on what it made."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from fake_clouds import Here, fake_cloud, small_plan

from edge.errors import ConfigError, ExitCode
from train.cli import main
from train.dataset import CompletionDataset, DatasetSettings
from train.fit import FitSettings, Trainer
from train.losses import LossSettings
from train.simulate.build import INDEX, build, shard_name
from train.simulated import SimulatedDataset

SCANS = ["--objects", "3", "--drive-bys", "0", "--perturbed", "2", "--workers", "1"]


def simulate(folder: Path, *arguments: str) -> int:
    return main(["simulate", "--out", str(folder), *arguments])


def test_a_set_is_built_checked_and_finished_from_its_folder_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "set"
    assert simulate(folder, *SCANS) == ExitCode.OK
    assert "6 clouds, 0 failed" in capsys.readouterr().out
    assert simulate(folder, "--check") == ExitCode.OK
    assert "6 clouds of 3 objects: good" in capsys.readouterr().out
    before = (folder / INDEX).read_bytes()
    (folder / shard_name(1)).unlink()
    assert simulate(folder, "--check") == ExitCode.FAILURE
    assert simulate(folder, "--workers", "1") == ExitCode.OK
    assert "1 shards were there" in capsys.readouterr().out
    assert (folder / INDEX).read_bytes() == before


def test_refusals_have_their_exit_codes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "set"
    build(small_plan(), folder, Here(), fake_cloud)
    assert simulate(folder, "--seed", "4") == ExitCode.BAD_CONFIG
    assert "holds another data set" in capsys.readouterr().err
    assert simulate(folder, "--recipe", "no_such") == ExitCode.BAD_CONFIG
    assert simulate(tmp_path / "none", "--check") == ExitCode.FAILURE
    assert "no index" in capsys.readouterr().err
    assert simulate(tmp_path / "none", "--clouds-only", str(tmp_path / "x")) == ExitCode.FAILURE


def test_the_radar_clouds_go_into_one_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    build(small_plan(), tmp_path / "set", Here(), fake_cloud)
    assert simulate(tmp_path / "set", "--clouds-only", str(tmp_path / "one.clouds")) == ExitCode.OK
    assert "12 clouds" in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_workers_and_keeps_what_is_finished(tmp_path: Path, number: signal.Signals) -> None:
    folder = tmp_path / "set"
    command = [sys.executable, "-m", "train.cli", "simulate", "--out", str(folder), "--objects", "400"]
    command += ["--drive-bys", "0", "--perturbed", "1", "--workers", "1"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as run:
        while not (folder / shard_name(0)).exists():
            assert run.poll() is None
            time.sleep(0.02)
        os.killpg(run.pid, number) if number == signal.SIGINT else run.send_signal(number)
        _, said = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "to go on: rfconstruct-train simulate --out" in said
    assert "Traceback" not in said
    index = json.loads((folder / INDEX).read_text())
    assert index["complete"] is False
    assert len(index["samples"]) >= 2
    for _ in range(100):
        if not alive(run.pid):
            return
        time.sleep(0.1)
    pytest.fail(f"processes are left: {alive(run.pid)}")


def alive(group: int) -> list[str]:
    """Processes of a group that are not just waiting to be reaped."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            name, _, rest = path.read_text().rpartition(")")
            state, _, of_group = rest.split()[:3]
            if int(of_group) == group and state != "Z":
                found.append(f"{name}) {state}")
    return found


DATA = DatasetSettings(truth_points=512, max_points=200, epoch_samples=24, parametric_objects=1, evaluation_views=1)
FIT = FitSettings(
    width="tiny", steps=2, batch=2, cells=2, workers=0, threads=1, validation_samples=4,
    loss=LossSettings(emd_points=128),
)  # fmt: skip


def test_a_run_on_simulated_clouds_continues_exactly_and_only_with_the_same(tmp_path: Path) -> None:
    from train.batches import endless

    build(small_plan(objects=12, drive_bys=2), tmp_path / "set", Here(), fake_cloud)
    validation = CompletionDataset("val", DATA, 0)

    def trainer(name: str, share: float = 0.5, resume: bool = False) -> Trainer:
        data = SimulatedDataset(tmp_path / "set", "train", DATA, 0, share)
        return Trainer(FIT, data, validation, tmp_path / name, resume)

    def steps(one: Trainer, count: int) -> None:
        batches = endless(one.train, FIT.batch, FIT.seed, one.state.step, 0)
        for _ in range(count):
            one.step(next(batches))

    whole, broken = trainer("whole"), trainer("broken")
    steps(whole, 2)
    steps(broken, 1)
    broken.save()
    continued = trainer("broken", resume=True)
    steps(continued, 1)
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, continued.network.state_dict()[name]), name
    with pytest.raises(ConfigError, match="another"):
        trainer("broken", share=0.4, resume=True)


@pytest.mark.slow
def test_real_drive_bys(tmp_path: Path) -> None:
    """Two objects past the simulated radars, through the whole pipeline, checked, and read as training data."""
    folder = tmp_path / "set"
    assert simulate(folder, "--objects", "2", "--drive-bys", "2", "--perturbed", "1") == ExitCode.OK
    assert simulate(folder, "--check") == ExitCode.OK
    sample = SimulatedDataset(folder, "train", DatasetSettings.default(min_points=8, truth_points=4096), 0, 1.0)[0]
    assert len(sample.partial) >= 8
