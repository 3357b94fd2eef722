# SPDX-License-Identifier: Apache-2.0
"""Weights of a network from its edge graph: the inverse of ``export``, so that a shipped model can be trained further.

The graph holds the product of the folding's local weight and the encoder's last weight, not the former itself: the one
of least norm that gives this product stands in for it, and the network computes the same.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper

from edge.errors import ModelError
from train.network import CompletionModel, CompletionNetwork
from train.networks.narrow import NarrowNetwork
from train.networks.queries import QueryNetwork

PLAIN = ("point2", "coarse1", "coarse2", "fold2", "class1", "class2")
"""Layers that stand in the graph as they are."""
Arrays = dict[str, NDArray[np.float32]]


def read_weights(path: Path, network: CompletionModel) -> tuple[dict[str, torch.Tensor], int]:
    """Parameters of a network that was exported.

    Args:
        path: model folder, or its fp32 ``.onnx`` file.
        network: of the same kind and width, without attention, power and ground, with the graph's ``trim``. What the
            graph does not have (options that the exported network was trained without) is left out of the result.
    Returns:
        Parameter name -> tensor, and the samples that the model had seen (0: its manifest does not say).
    Raises:
        ModelError: no such file, no graph of this project, another network, or an int8 graph.
    """
    file = path / "model.onnx" if path.is_dir() else path
    try:
        graph = onnx.load(file).graph
        arrays = {one.name: numpy_helper.to_array(one) for one in graph.initializer}
        if (trim := _trim_percent(graph, arrays)) not in (0, network.trim_percent):
            raise KeyError(f"trim={trim}")
        reader = _QueryReader if isinstance(network, QueryNetwork) else _Reader
        weights = reader(arrays, network).read()
        expected = network.state_dict()
        result = {name: torch.from_numpy(np.array(value, np.float32)) for name, value in weights.items()}
        wrong = [name for name, value in result.items() if name not in expected or expected[name].shape != value.shape]
        if wrong:
            raise KeyError(wrong[0])
    except Exception as error:  # the disk, protobuf, numpy and a missing layer have no common root
        raise ModelError(
            f"{path}: no fp32 graph of this network",
            value=f"{type(error).__name__}: {error}",
            allowed="a model folder that 'rfconstruct-train export' wrote, not of adapointr, same network and width",
            action="name the network, width and options of that model (its card names them)",
        ) from error
    return result, _samples(file.with_name("manifest.json"))


def _trim_percent(graph: onnx.GraphProto, arrays: Arrays) -> int:
    """What the graph's centre leaves out at each end (``export``), which no weight tells; 0: nothing."""
    bodies = [a.g for node in graph.node for a in node.attribute if a.HasField("g")]
    found = [node.input[1] for part in (graph, *bodies) for node in part.node if node.name == "left_out_percent"]
    return int(arrays[found[0]].item()) if found else 0


def _samples(manifest: Path) -> int:
    try:
        training: dict[str, Any] = json.loads(manifest.read_text())["training"]
        return int(training["samples"]) + int(training.get("samples_before", 0))
    except (OSError, ValueError, KeyError, TypeError):
        return 0


class _Reader:
    """Layer by layer what ``export._Builder`` writes, back in network units."""

    def __init__(self, arrays: Arrays, network: CompletionModel) -> None:
        if not isinstance(network, CompletionNetwork):
            raise KeyError(type(network).__name__)
        self.arrays, self.network, self.scale = arrays, network, np.float32(network.scale)
        if isinstance(network, NarrowNetwork):
            options = network.options
            if options.attention != "none" or options.power or options.ground:
                raise KeyError("attention, power, ground")

    def read(self) -> Arrays:
        """Everything that is there."""
        result: Arrays = {}
        for name in PLAIN:
            if f"{name}.weight" in self.arrays:
                result |= self._layer(name, name)
        result |= self._layer("point1", "point1", self.scale, 1)
        result |= self._layer("local2", "local2")
        result["local1.weight"] = np.concatenate([self._weight("local1"), self._weight("local1_global")], axis=1)
        result["local1.bias"] = self.arrays["local1_global.bias"]
        for name in ("coarse3", "fold3"):
            result |= self._layer(name, name, 1 / self.scale, 1 / self.scale)
        result |= self._fold1(result)
        return result | self._added()

    def _weight(self, name: str) -> NDArray[np.float32]:
        return np.asarray(self.arrays[f"{name}.weight"].T)

    def _layer(self, graph: str, name: str, weight: Any = 1, bias: Any = 1) -> Arrays:
        return {f"{name}.weight": self._weight(graph) * weight, f"{name}.bias": self.arrays[f"{graph}.bias"] * bias}

    def _fold1(self, found: Arrays) -> Arrays:
        """[patch 2 | coarse 3 | local | global], put together again."""
        patch = self.network.patch.numpy()
        of_patch = np.linalg.lstsq(patch, self.arrays["fold_patch"][0], rcond=None)[0].T
        parts, bias = [of_patch, self._weight("fold_coarse") * self.scale], self.arrays["fold_global.bias"]
        if self.network.local:
            product = self._weight("fold_local").astype(np.float64)
            of_local = (product @ np.linalg.pinv(found["local2.weight"].astype(np.float64))).astype(np.float32)
            bias = bias - of_local @ found["local2.bias"]
            parts.append(of_local)
        parts.append(self._weight("fold_global"))
        return {"fold1.weight": np.concatenate(parts, axis=1).astype(np.float32), "fold1.bias": bias}

    def _added(self) -> Arrays:
        """Of the options of ``narrow``, where both the graph and the network have them."""
        result: Arrays = {}
        if "plane.weight" in self.arrays and hasattr(self.network, "plane"):
            unit = np.array([1, 1, 1 / self.scale], np.float32)
            result |= self._layer("plane", "plane", unit[:, None], unit)
            result["of_mirror.weight"] = self._weight("of_mirror")
            result["of_evidence.weight"] = self._weight("of_evidence") * self.scale
        if "sigma_log.weight" in self.arrays and hasattr(self.network, "sigma"):
            result |= self._layer("sigma_log", "sigma")
            result["sigma.bias"] = result["sigma.bias"] - np.log(self.scale)
        return result


class _QueryReader:
    """What ``export_queries`` writes: nearly every layer as it is, in network units."""

    def __init__(self, arrays: Arrays, network: CompletionModel) -> None:
        self.arrays, self.network, self.scale = arrays, network, np.float32(network.scale)
        if "plane.weight" in arrays and not hasattr(network, "plane"):
            raise KeyError("mirror")

    def read(self) -> Arrays:
        """Everything; KeyError names a parameter that the graph lacks."""
        parameters = self.network.state_dict()
        return {name: self._one(name).astype(np.float32).reshape(parameters[name].shape) for name in parameters}

    def _one(self, name: str) -> NDArray[np.float32]:
        layer, _, kind = name.rpartition(".")
        if layer.endswith("attention.query"):
            heads = int(self.network.get_submodule(layer.removesuffix(".query")).heads)  # type: ignore[arg-type]
            weight = self.arrays[name].T
            return np.asarray(weight * np.sqrt(np.float32(weight.shape[0] // heads)))
        if layer.endswith("attention.key_value"):
            attention = layer.removesuffix("_value").removesuffix("key")
            return np.concatenate([self.arrays[f"{attention}{part}.weight"].T for part in ("key", "value")])
        if layer == "sigma":
            value = self.arrays[f"sigma_log.{kind}"]
            return np.asarray(value.T if kind == "weight" else value - np.log(self.scale))
        moved = {"reduce.bias": "reduce_feature.bias", "rebuild1.bias": "top.bias"}
        value = self.arrays[moved.get(name, name)]
        return np.asarray(value.T if value.ndim == 2 else value)
