# SPDX-License-Identifier: Apache-2.0
"""Montage and figures by their commands: a picture of bounded size, a row for every class, refusals."""

from __future__ import annotations

from pathlib import Path

import pytest

from train.cli import main
from train.objects.mesh import CLASSES


def test_a_picture_is_written_and_its_figures_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    text = "pedestrian/parametric_00000"
    assert main(["montage", "--out", str(tmp_path), "--object", text, "--every", "6", "--seed", "2"]) == 0
    (picture,) = tmp_path.iterdir()
    assert picture.name == "simulated_pedestrian.png"
    content = picture.read_bytes()
    assert content.startswith(b"\x89PNG")
    assert 30_000 < len(content) < 400_000
    assert capsys.readouterr().out.startswith(f"{text}: ")


def test_an_unknown_object_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["montage", "--out", str(tmp_path), "--object", "lorry/x"]) != 0
    assert "car" in capsys.readouterr().err


def test_figures_of_every_class(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["clouds", "--objects", "1", "--every", "20", "--without-ground"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:6]] == list(CLASSES)
    stages = [line.split("|")[1].strip() for line in lines[9:]]
    assert {"optics", "synthesis", "heatmap", "detect", "associate", "fuse"} <= set(stages)
