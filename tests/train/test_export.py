# SPDX-License-Identifier: Apache-2.0
"""Export: the ONNX graph answers as torch does; quantization changes little; the command writes a whole folder."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from edge.frames import Float32
from train.batches import Batch
from train.checkpoint import Checkpoint, save_checkpoint
from train.cli import main
from train.dataset import CLASSES
from train.evaluate import OnnxModel
from train.export import IR_VERSION, OPSET, export
from train.fit import FitSettings
from train.manifest import FULL, SMALL, write_golden
from train.network import WIDTHS, CompletionNetwork
from train.quantize import quantize


def cloud(points: int) -> Float32:
    rng = np.random.default_rng(points)
    return (rng.normal(size=(points, 3)) * (1.5, 0.6, 0.5) + (8, -3, 0.8)).astype(np.float32)


@pytest.fixture(scope="module")
def network() -> CompletionNetwork:
    torch.manual_seed(0)
    network = CompletionNetwork(WIDTHS["edge"], len(CLASSES)).eval()
    network.start_from(np.random.default_rng(0).uniform(-1, 1, (1024, 3)).astype(np.float32))
    return network


@pytest.fixture(scope="module")
def folder(network: CompletionNetwork, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model")
    export(network.state_dict(), folder / FULL)
    quantize(folder / FULL, folder / SMALL)
    return folder


@pytest.mark.parametrize("points", [1, 64, 777, 2048])
def test_graph_answers_as_torch_does(network: CompletionNetwork, folder: Path, points: int) -> None:
    fine, coarse, probability = OnnxModel(folder / FULL)(cloud(points))
    with torch.no_grad():
        expected = network(torch.from_numpy(cloud(points)), [points])
    assert fine.shape == (16384, 3)
    np.testing.assert_allclose(fine, expected.fine[0], atol=1e-4)
    np.testing.assert_allclose(coarse, expected.coarse[0], atol=1e-4)
    np.testing.assert_allclose(probability, expected.logits.softmax(1)[0], atol=1e-5)


def test_file_is_portable_and_small(folder: Path) -> None:
    model = onnx.load(folder / FULL)
    assert model.ir_version == IR_VERSION
    assert [(o.domain, o.version) for o in model.opset_import] == [("", OPSET)]
    assert (folder / FULL).stat().st_size <= 10_000_000
    assert (folder / SMALL).stat().st_size <= 2_700_000


def test_quantized_graph_differs_little(folder: Path) -> None:
    full, small = OnnxModel(folder / FULL), OnnxModel(folder / SMALL)
    for points in (64, 1000):
        shift = np.linalg.norm(small(cloud(points))[0] - full(cloud(points))[0], axis=1)
        assert 0 < np.sqrt(np.square(shift).mean()) < 0.02


def test_quantized_products_are_unsigned_on_both_sides(folder: Path) -> None:
    model = onnx.load(folder / SMALL)
    kinds = {c.name: c.data_type for c in model.graph.initializer}
    products = [node for node in model.graph.node if node.op_type == "MatMulInteger"]
    assert len(products) >= 8
    assert all(kinds[node.input[1]] == onnx.TensorProto.UINT8 for node in products)


def test_golden_answers_are_repeated(folder: Path, tmp_path: Path) -> None:
    models = {name: OnnxModel(folder / name) for name in (FULL, SMALL)}
    tolerance_m = write_golden(tmp_path / "golden.npz", models, [cloud(100), cloud(300)])
    with np.load(tmp_path / "golden.npz") as golden:
        for name, model in models.items():
            fine, coarse, probability = model(golden["points"])
            assert np.abs(fine[golden["fine_rows"]] - golden[f"{name}:fine"]).max() <= tolerance_m[name]
            assert np.abs(coarse - golden[f"{name}:coarse"]).max() <= tolerance_m[name]
            np.testing.assert_allclose(probability, golden[f"{name}:class_probability"], atol=1e-3)


@pytest.fixture
def checkpoint(network: CompletionNetwork, tmp_path: Path) -> Path:
    state = network.state_dict()
    path = tmp_path / "runs" / "short" / "checkpoint.pt"
    save_checkpoint(path, Checkpoint(state, state, {}, 5, 80, 12.0, asdict(FitSettings()), []))
    return path


def test_export_command_writes_a_whole_folder(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RFCONSTRUCT_DATA", str(tmp_path))
    target = tmp_path / "default"
    arguments = ["export", str(checkpoint), str(target), "--samples", "4", "--emd-samples", "1", "--bank", "0"]
    assert main(arguments) == 0
    manifest = json.loads((target / "manifest.json").read_text())
    for entry in manifest["files"]:
        content = (target / entry["file"]).read_bytes()
        assert entry["sha256"] == hashlib.sha256(content).hexdigest()
        assert entry["bytes"] == len(content)
    assert manifest["classes"] == list(CLASSES)
    assert set(manifest["golden"]["tolerance_m"]) == {FULL, SMALL}
    card = (target / "card.md").read_text()
    assert "no radar" in card
    assert "80 samples" in card
    assert main(["evaluate", str(target), "--samples", "4", "--emd-samples", "0", "--bank", "0"]) == 0
    assert "mean Chamfer distance" in capsys.readouterr().out


def test_commands_name_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path / "none.pt"), str(tmp_path)]) == 6
    assert main(["evaluate", str(tmp_path), "--bank", "0"]) == 6
    assert "none.pt" in capsys.readouterr().err


def test_batch_moves_between_devices() -> None:
    batch = Batch(torch.zeros(3, 3), [1, 2], torch.zeros(2, 4, 3), torch.zeros(2, dtype=torch.int64))
    moved = batch.to(torch.device("cpu"))
    assert moved.counts == [1, 2]
    assert moved.points_m.shape == (3, 3)
