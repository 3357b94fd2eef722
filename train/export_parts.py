# SPDX-License-Identifier: Apache-2.0
"""Pieces of edge graphs that several networks share: centring, plane of symmetry, attention, normalisation."""

from __future__ import annotations

import numpy as np
from onnx import helper

from train.graph import Graph
from train.network import CompletionModel


class Parts:
    """A graph under construction, and the weights of the network that it becomes.

    Args:
        network: any that starts with ``CompletionModel.to_units``.
    """

    def __init__(self, network: CompletionModel) -> None:
        self.network, self.graph, self.scale = network, Graph(), np.float32(network.scale)
        self.weights = {name: value.detach().cpu().float().numpy() for name, value in network.state_dict().items()}

    def _layer(self, name: str, source: str) -> str:
        return self.graph.linear(source, self.weights[f"{name}.weight"], self.weights.get(f"{name}.bias"), name)

    def _center(self) -> None:
        """Points about their centre, "centered" [n, 3]; the centre is 0 in the box, in sight the middle in x and y.

        "low" and "high" are the ends of the bounding box.
        """
        graph, sight = self.graph, self.network.frame == "sight"
        places = "points"
        if self.network.columns > 3:
            places = graph.add("Slice", ["points", *(graph.integers(n) for n in (0, 3, 1))], "places")
        graph.add("ReduceMax", [places, graph.integers(0)], "high", keepdims=1)
        graph.add("ReduceMin", [places, graph.integers(0)], "low", keepdims=1)
        low, high = self._trimmed(places) if self.network.trim_percent else ("low", "high")
        graph.add("Add", [high, low], "both_ends")
        half = np.array([[0.5, 0.5, 0.0]], np.float32) * sight
        graph.add("Mul", ["both_ends", graph.constant("half", half)], "center")
        graph.add("Sub", [places, "center"], "centered")

    def _trimmed(self, places: str) -> tuple[str, str]:
        """Ends [1, 3] of what ``train.network.middle`` leaves of every axis."""
        graph = self.graph
        count = graph.add("Shape", [places], "places_count", start=0, end=1)
        last = graph.add("Sub", [count, graph.integers(1)], "places_last")
        percent = graph.add("Mul", [last, graph.integers(self.network.trim_percent)], "left_out_percent")
        low = graph.add("Div", [percent, graph.integers(100)], "left_out")
        high = graph.add("Sub", [last, low], "left_in")
        graph.nodes.append(
            helper.make_node("TopK", [places, count], ["ordered", "order"], name="ordered", axis=0, largest=0)
        )
        ends = (graph.add("Gather", ["ordered", row], f"{row}_end", axis=0) for row in (low, high))
        return next(ends), next(ends)

    def _plane(self, feature: str) -> None:
        """Vertical plane of symmetry in the input's unit: "plane_normal" [1, 3] and "plane_offset" [1, 1]."""
        graph, weights = self.graph, self.weights
        weight, bias = weights["plane.weight"].copy(), weights["plane.bias"].copy()
        weight[2], bias[2] = weight[2] * self.scale, bias[2] * self.scale
        graph.linear(feature, weight, bias, "plane")
        raw = graph.add("Slice", ["plane", *(graph.integers(n) for n in (0, 2, 1))], "plane_raw")
        length = graph.add("ReduceL2", [raw, graph.integers(1)], "plane_length", keepdims=1)
        graph.add("Max", [length, graph.constant("least", np.full(1, 1e-12, np.float32))], "plane_divisor")
        graph.add("Div", [raw, "plane_divisor"], "plane_unit")
        zero = graph.constant("zero_column", np.zeros((1, 1), np.float32))
        graph.add("Concat", ["plane_unit", zero], "plane_normal", axis=1)
        graph.add("Slice", ["plane", *(graph.integers(n) for n in (2, 3, 1))], "plane_offset")

    def _mirrored(self, points: str, output: str) -> str:
        """Mirror image about the plane; [n, 3]."""
        graph = self.graph
        graph.add("Gemm", [points, "plane_normal"], f"{output}_along", transB=1)
        graph.add("Sub", [f"{output}_along", "plane_offset"], f"{output}_distance")
        two = graph.constant("two", np.array(2, np.float32))
        twice = graph.add("Mul", [f"{output}_distance", two], f"{output}_two")
        return graph.add("Sub", [points, graph.add("Mul", [twice, "plane_normal"], f"{output}_step")], output)

    def _norm(self, layer: str, source: str, output: str) -> str:
        names = [self.graph.constant(f"{layer}.{part}", self.weights[f"{layer}.{part}"]) for part in ("weight", "bias")]
        return self.graph.add("LayerNormalization", [source, *names], output, axis=-1, epsilon=1e-5)

    def _attend(self, name: str, queries: str, memory: str, heads: int) -> str:
        """``networks.attention.Attention``: [q, channels], [m, channels] -> [q, channels]."""
        graph = self.graph
        key_value = self.weights[f"{name}.key_value.weight"]
        width = key_value.shape[1]
        depth = width // heads
        query = self.weights[f"{name}.query.weight"] / np.sqrt(np.float32(depth))
        parts = {}
        for part, source, weight, order in (
            ("query", queries, query, [1, 0, 2]),
            ("key", memory, key_value[:width], [1, 2, 0]),
            ("value", memory, key_value[width:], [1, 0, 2]),
        ):
            flat = graph.linear(source, weight, None, f"{name}.{part}")
            split = graph.view(flat, [-1, heads, depth], f"{name}.{part}_heads")
            parts[part] = graph.add("Transpose", [split], f"{name}.{part}_turned", perm=order)
        score = graph.add("MatMul", [parts["query"], parts["key"]], f"{name}.score")
        share = graph.add("Softmax", [score], f"{name}.share", axis=-1)
        mixed = graph.add("MatMul", [share, parts["value"]], f"{name}.mixed")
        turned = graph.add("Transpose", [mixed], f"{name}.mixed_turned", perm=[1, 0, 2])
        return self._layer(f"{name}.output", graph.view(turned, [-1, width], f"{name}.mixed_flat"))
