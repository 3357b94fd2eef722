# SPDX-License-Identifier: Apache-2.0
"""The look-up oracle: zero but for the sampling floor when the unseen object is among the training objects."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from train.objects.library import COLUMNS, group_split
from train.objects.oracle import oracle
from train.objects.parametric import generate


def test_an_unseen_object_that_was_trained_on_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from train.cli import main

    train = next(f"author{k}" for k in range(100) if group_split(f"author{k}") == "train")
    test = next(f"author{k}" for k in range(100) if group_split(f"author{k}") == "test")
    with (tmp_path / "manifest.csv").open("w", newline="") as lines:
        writer = csv.writer(lines)
        writer.writerow(COLUMNS)
        for name, seed, group in (("a", 1, train), ("b", 5, train), ("same", 5, test)):
            mesh = generate("car", seed)
            np.savez(tmp_path / f"{name}.npz", vertices=mesh.vertices, faces=mesh.faces)
            writer.writerow(("car", name, f"{name}.npz", "CC0-1.0", "", "A", group))
    rows = list(oracle("car", 1, 600, tmp_path))
    assert [count for _, count, _, _ in rows] == [2, 4, 4, 4]
    floor = rows[0][2]
    assert 0.04 < floor < 0.15  # 600 points on some 30 m^2: 1 / (2 sqrt(n / A)) is 0.11 m
    assert all(median <= floor for _, _, median, _ in rows)  # more objects never make it worse
    assert main(["objects", "oracle", "--objects", str(tmp_path), "--variants", "1", "--points", "100"]) == 0
    assert "+ parametric" in capsys.readouterr().out
