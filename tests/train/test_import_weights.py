# SPDX-License-Identifier: Apache-2.0
"""Weights out of an edge graph: the network answers as the exported one did; what is not that network is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from edge.errors import ModelError
from train.dataset import CLASSES
from train.export import INT8_NODES, build, example_input, export
from train.fit import Trainer
from train.import_weights import read_weights
from train.manifest import FULL
from train.network import Frame
from train.networks import registry
from train.networks.registry import Option
from train.quantize import quantize


def made(kind: str, frame: Frame, options: dict[str, Option], seed: int = 0) -> torch.nn.Module:
    torch.manual_seed(seed)
    network = registry.build(kind, "edge", frame, options).eval()
    shape = np.random.default_rng(seed).uniform(-1, 1, (network.coarse_points, 3)).astype(np.float32)
    network.start_from(shape)
    return network


@pytest.mark.parametrize(
    ("kind", "frame", "options"),
    [
        ("narrow", "sight", {}),
        ("narrow", "sight", {"mirror": "cue", "uncertainty": True}),
        ("narrow", "sight", {"mirror": "cue", "trim": 5}),
        ("narrow", "box", {"mirror": "cue", "coarse": 512}),
        ("queries", "sight", {"trim": 5}),
        ("queries", "box", {"mirror": False}),
        ("pcn", "sight", {}),
        ("paper", "box", {}),
    ],
)
def test_a_network_comes_back(kind: str, frame: Frame, options: dict[str, Option], tmp_path: Path) -> None:
    network, other = made(kind, frame, options), made(kind, frame, options, seed=1)
    export(build(network), tmp_path / FULL)
    weights, samples = read_weights(tmp_path, other)
    assert samples == 0, "there is no manifest"
    missing = other.load_state_dict(weights, strict=False).missing_keys
    assert all(name.startswith("class") for name in missing) or not missing
    cloud = torch.from_numpy(example_input(network, 300))
    with torch.no_grad():
        before, after = network(cloud, [300]), other(cloud, [300])
    torch.testing.assert_close(after.fine, before.fine, atol=1e-4, rtol=0)
    torch.testing.assert_close(after.coarse, before.coarse, atol=1e-4, rtol=0)
    if not missing:
        torch.testing.assert_close(after.logits, before.logits, atol=1e-4, rtol=1e-4)
    if options.get("uncertainty"):
        torch.testing.assert_close(after.log_sigma, before.log_sigma, atol=1e-4, rtol=1e-4)


def test_options_may_be_added_and_samples_are_counted(tmp_path: Path) -> None:
    network, other = made("narrow", "sight", {}), made("narrow", "sight", {"mirror": "cue"}, seed=1)
    export(build(network), tmp_path / FULL)
    (tmp_path / "manifest.json").write_text('{"training": {"samples": 3, "samples_before": 4}}')
    assert Trainer._load_start(other, tmp_path) == 7
    cloud = torch.from_numpy(example_input(network, 100))
    with torch.no_grad():
        torch.testing.assert_close(other(cloud, [100]).fine, network(cloud, [100]).fine, atol=1e-4, rtol=0)


def test_a_plane_of_symmetry_is_neither_dropped_nor_made_up(tmp_path: Path) -> None:
    with_plane, without = made("queries", "sight", {}), made("queries", "sight", {"mirror": False})
    for network, other in ((with_plane, without), (without, with_plane)):
        export(build(network), tmp_path / FULL)
        with pytest.raises(ModelError, match=r"mirror|plane"):
            read_weights(tmp_path, other)


def test_another_centre_is_refused_unless_there_was_none(tmp_path: Path) -> None:
    plain, trimmed = made("narrow", "sight", {}), made("narrow", "sight", {"trim": 5})
    export(build(trimmed), tmp_path / FULL)
    assert read_weights(tmp_path, trimmed)[1] == 0
    for other in (plain, made("narrow", "sight", {"trim": 4})):
        with pytest.raises(ModelError, match="trim=5"):
            read_weights(tmp_path, other)
    export(build(plain), tmp_path / FULL)
    read_weights(tmp_path, trimmed)


def test_what_is_no_such_graph_is_refused(tmp_path: Path) -> None:
    network = made("narrow", "sight", {})
    with pytest.raises(ModelError, match="no fp32 graph"):
        read_weights(tmp_path, network)
    (tmp_path / FULL).write_bytes(b"\x08\x07nothing")
    with pytest.raises(ModelError, match="no fp32 graph"):
        read_weights(tmp_path, network)
    export(quantize(build(network), INT8_NODES, [example_input(network, 90)]), tmp_path / "model.int8.onnx")
    with pytest.raises(ModelError, match="no fp32 graph"):
        read_weights(tmp_path / "model.int8.onnx", network)
    export(build(network), tmp_path / FULL)
    torch.manual_seed(0)
    with pytest.raises(ModelError, match="same network and width"):
        read_weights(tmp_path, registry.build("narrow", "tiny", "sight", {}))
    with pytest.raises(ModelError, match="attention"):
        read_weights(tmp_path, registry.build("narrow", "edge", "sight", {"attention": "tokens"}))


def test_every_class_of_the_project_has_a_row(tmp_path: Path) -> None:
    network = made("narrow", "sight", {})
    export(build(network), tmp_path / FULL)
    assert read_weights(tmp_path, network)[0]["class2.bias"].shape == (len(CLASSES),)
