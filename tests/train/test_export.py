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

from edge.completion.manifest import read_manifest
from edge.completion.model import CompletionModel
from edge.completion.network import Network
from edge.config import CompletionSettings
from edge.errors import ModelError
from edge.frames import Float32
from train.batches import Batch
from train.checkpoint import Checkpoint, save_checkpoint
from train.cli import main
from train.dataset import CLASSES
from train.evaluate import OnnxModel
from train.export import INT8_NODES, build, example_input, export
from train.fit_settings import FitSettings
from train.graph import IR_VERSION, OPSET, per_object
from train.manifest import FULL, SMALL, write_golden
from train.network import WIDTHS, CompletionNetwork, Frame
from train.networks import registry
from train.networks.registry import Option
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
    model = build(network)
    export(model, folder / FULL)
    export(quantize(model, INT8_NODES, [cloud(n) for n in (70, 300, 900)]), folder / SMALL)
    return folder


@pytest.mark.parametrize("points", [1, 64, 777, 2048])
def test_graph_answers_as_torch_does(network: CompletionNetwork, folder: Path, points: int) -> None:
    fine, coarse, probability = OnnxModel(folder / FULL)(cloud(points))
    with torch.no_grad():
        expected = network(torch.from_numpy(cloud(points)), [points])
    assert fine.shape == (16384, 3)
    np.testing.assert_allclose(fine, expected.fine[0], atol=1e-5)
    np.testing.assert_allclose(coarse, expected.coarse[0], atol=1e-5)
    np.testing.assert_allclose(probability, expected.logits.softmax(1)[0], atol=1e-5)


EVERYTHING = {"mirror": "cue", "attention": "both", "uncertainty": True, "coarse": 512, "power": True, "ground": True}
NETWORKS: list[tuple[str, Frame, dict[str, Option]]] = [
    ("paper", "sight", {}),
    ("paper", "box", {}),
    ("pcn", "box", {}),
    ("narrow", "sight", {"mirror": "cue"}),
    ("narrow", "sight", {"attention": "tokens"}),
    ("narrow", "sight", {"attention": "coarse", "uncertainty": True}),
    ("narrow", "sight", EVERYTHING),
    ("narrow", "sight", {"mirror": "cue", "trim": 5}),
    ("narrow", "sight", EVERYTHING | {"trim": 20}),
    ("queries", "sight", {"trim": 5}),
    ("queries", "box", {"mirror": False}),
]


@pytest.mark.parametrize(("name", "frame", "options"), NETWORKS, ids=lambda value: str(value))
def test_every_network_and_option_answers_as_torch_does(name: str, frame: Frame, options: dict[str, Option]) -> None:
    torch.manual_seed(1)
    network = registry.build(name, "tiny", frame, options).eval()
    with torch.no_grad():
        for key, value in network.named_parameters():
            if not key.startswith("sigma"):
                value.add_(0.05 * torch.randn_like(value))
    graph = Network(per_object(build(network)).SerializeToString(), name)
    clouds = [example_input(network, points) for points in (1, 90, 333)]
    batch = graph.run_all(np.concatenate(clouds), [len(points) for points in clouds])
    for number, points in enumerate(clouds):
        found = graph.run(points)
        with torch.no_grad():
            right = network(torch.from_numpy(points), [len(points)])
        np.testing.assert_allclose(found.fine_m, right.fine[0], atol=1e-5)
        np.testing.assert_allclose(found.coarse_m, right.coarse[0], atol=1e-5)
        np.testing.assert_allclose(found.probability, right.logits.softmax(1)[0], atol=1e-5)
        if right.log_sigma is not None:
            assert found.sigma_m is not None
            np.testing.assert_allclose(found.sigma_m, right.log_sigma[0].exp() * network.scale, rtol=1e-4)
        np.testing.assert_array_equal(batch.fine_m[number], found.fine_m)
        np.testing.assert_array_equal(batch.probability[number], found.probability)


@pytest.mark.parametrize("file", [FULL, SMALL])
def test_order_and_repetition_of_the_points_do_not_matter(folder: Path, file: str) -> None:
    model, points = OnnxModel(folder / file), cloud(200)
    reference = model(points)[0]
    np.testing.assert_allclose(model(points[::-1])[0], reference, atol=1e-5)
    np.testing.assert_allclose(model(np.concatenate([points, points[50:120]]))[0], reference, atol=1e-5)


def test_graph_without_the_training_classifier_gives_no_classes(network: CompletionNetwork) -> None:
    graph = Network(per_object(build(network, classifier=False)).SerializeToString(), "paper")
    assert "class_probability" not in graph.signature
    assert graph.run(cloud(80)).probability.shape == (0,)


def test_a_transformer_has_no_edge_graph() -> None:
    with pytest.raises(ModelError, match="no edge graph"):
        build(registry.build("adapointr", "tiny"))


def test_file_is_portable_and_small(folder: Path) -> None:
    model = onnx.load(folder / FULL)
    assert model.ir_version == IR_VERSION
    assert [(o.domain, o.version) for o in model.opset_import] == [("", OPSET)]
    assert (folder / FULL).stat().st_size <= 10_000_000
    assert (folder / SMALL).stat().st_size <= 6_000_000


def test_golden_answers_are_repeated(folder: Path, tmp_path: Path) -> None:
    models = {name: OnnxModel(folder / name) for name in (FULL, SMALL)}
    tolerance_m = write_golden(tmp_path / "golden.npz", models, [cloud(100), cloud(300)])
    with np.load(tmp_path / "golden.npz") as golden:
        for name, model in models.items():
            fine, coarse, probability = model(golden["points"])
            assert np.abs(fine[golden["fine_rows"]] - golden[f"{name}:fine"]).max() <= tolerance_m[name]
            assert np.abs(coarse - golden[f"{name}:coarse"]).max() <= tolerance_m[name]
            np.testing.assert_allclose(probability, golden[f"{name}:class_probability"], atol=1e-3)


@pytest.fixture(params=["narrow", "queries"])
def checkpoint(request: pytest.FixtureRequest, network: CompletionNetwork, tmp_path: Path) -> Path:
    name = request.param
    state = (network if name == "narrow" else registry.build(name)).state_dict()
    path = tmp_path / "runs" / "short" / "checkpoint.pt"
    save_checkpoint(path, Checkpoint(state, state, {}, 5, 80, 12.0, asdict(FitSettings(network=name)), []))
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
    assert read_manifest(target).classes == CLASSES
    assert CompletionModel.load(target, CompletionSettings(), file=SMALL).file == SMALL
    assert main(["evaluate", str(target), "--samples", "4", "--emd-samples", "0", "--bank", "0"]) == 0
    assert "mean Chamfer distance" in capsys.readouterr().out


def test_commands_name_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path / "none.pt"), str(tmp_path)]) == 6
    assert main(["evaluate", str(tmp_path), "--bank", "0"]) == 6
    assert "none.pt" in capsys.readouterr().err


def test_a_missing_confidence_is_refused_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = tmp_path / "no.json"
    assert main(["export", str(tmp_path / "none.pt"), str(tmp_path), "--confidence", str(missing)]) == 6
    assert "no.json: no such file" in capsys.readouterr().err


def test_batch_moves_between_devices() -> None:
    batch = Batch(torch.zeros(3, 3), [1, 2], torch.zeros(2, 4, 3), torch.zeros(2, dtype=torch.int64))
    moved = batch.to(torch.device("cpu"))
    assert moved.counts == [1, 2]
    assert moved.points_m.shape == (3, 3)
