# SPDX-License-Identifier: Apache-2.0
"""The shipped model: unaltered, and with the answers its manifest promises."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest

from edge.resources import shipped_dir
from train.dataset import CLASSES
from train.evaluate import OnnxModel
from train.nearest import nearest_distance

FOLDER = shipped_dir("models") / "default"
MANIFEST = json.loads((FOLDER / "manifest.json").read_text())


@pytest.mark.parametrize("entry", MANIFEST["files"], ids=lambda entry: entry["precision"])
def test_file_is_unaltered_and_gives_the_golden_answer(entry: dict[str, object]) -> None:
    path = FOLDER / str(entry["file"])
    assert hashlib.sha256(path.read_bytes()).hexdigest() == entry["sha256"]
    tolerance_m = MANIFEST["golden"]["tolerance_m"][path.name]
    with np.load(FOLDER / MANIFEST["golden"]["file"]) as golden:
        fine, coarse, probability = OnnxModel(path)(golden["points"])
        np.testing.assert_allclose(fine[golden["fine_rows"]], golden[f"{path.name}:fine"], atol=tolerance_m)
        np.testing.assert_allclose(coarse, golden[f"{path.name}:coarse"], atol=tolerance_m)
        np.testing.assert_allclose(probability, golden[f"{path.name}:class_probability"], atol=0.02)


def test_manifest_is_complete() -> None:
    assert MANIFEST["schema"] == 2
    assert MANIFEST["classes"] == list(CLASSES)
    assert MANIFEST["default_file"] in {entry["file"] for entry in MANIFEST["files"]}
    assert MANIFEST["input"]["min_points"] == 64
    assert MANIFEST["output"] == {"coarse": 256, "fine": 16384}
    assert (FOLDER / MANIFEST["golden"]["file"]).stat().st_size < 100_000
    assert (FOLDER / "model.onnx").stat().st_size <= 10_000_000


def test_card_names_the_samples_and_the_limits() -> None:
    card = (FOLDER / "card.md").read_text()
    assert f"{MANIFEST['training']['samples']} samples" in card
    assert "no radar" in card


def test_a_shift_of_the_input_shifts_the_answer() -> None:
    model = OnnxModel(FOLDER / "model.onnx")
    with np.load(FOLDER / "golden.npz") as golden:
        points = golden["points"]
    shift = np.float32([2.0, -4.0, 0.0])
    np.testing.assert_allclose(model(points + shift)[1] - shift, model(points)[1], atol=1e-3)


def test_order_of_the_input_hardly_matters() -> None:
    """It decides which of close points stand for their neighbourhood: the surface moves by no more than a range bin."""
    model = OnnxModel(FOLDER / "model.onnx")
    with np.load(FOLDER / "golden.npz") as golden:
        points = golden["points"]
    reference, again = model(points)[0], model(points[::-1])[0]
    both = (nearest_distance(*pair).mean() for pair in ((reference, again), (again, reference)))
    assert max(both) < 0.05
