# SPDX-License-Identifier: Apache-2.0
"""Checkpoint to ONNX: the graph is built by hand, in metres, for any number of input points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from train.network import COARSE_POINTS, FINE_POINTS, PATCH_CELLS, SCALE_M, patch_grid

OPSET, IR_VERSION = 21, 10
COORDINATE_NODES = ("point1", "distance", "fold_coarse", "fold3")
"""Nodes that work on coordinates; they stay in float when the rest is quantized."""

_Weights = dict[str, NDArray[np.float32]]


class _Graph:
    """Nodes and constants of a graph under construction; a node is named after its output."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: NDArray[Any]) -> str:
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def add(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    def linear(self, source: str, weight: NDArray[np.float32], bias: NDArray[np.float32] | str, output: str) -> str:
        """``source @ weight.T + bias``; a bias that is a name is the output of a node [1, channels]."""
        offset = bias if isinstance(bias, str) else self.constant(f"{output}.bias", bias)
        return self.add("Gemm", [source, self.constant(f"{output}.weight", weight.T), offset], output)

    def relu(self, source: str) -> str:
        return self.add("Relu", [source], f"{source}_relu")

    def view(self, source: str, shape: list[int], output: str) -> str:
        return self.add("Reshape", [source, self.constant(f"{output}.shape", np.array(shape, np.int64))], output)


def build(weights: _Weights) -> onnx.ModelProto:
    """The network of ``network.CompletionNetwork`` as an ONNX graph (opset 21).

    Args:
        weights: the network's state, float32.
    Returns:
        Model with input ``points`` float32 [n, 3] metres, n >= 1 free, and outputs ``fine`` float32 [16384, 3] and
        ``coarse`` float32 [1024, 3], metres, in the frame of the input, and ``class_probability`` float32 [classes].
        What does not differ per fine point is computed once per coarse point or once per cloud, and the product of the
        folding's local weight and the encoder's last weight is a constant.
    """
    graph = _Graph()
    classes = len(weights["class2.bias"])
    center = _center(graph)
    hidden, feature = _encoder(graph, weights)
    coarse = _coarse(graph, weights, feature)
    _folding(graph, weights, hidden, feature, coarse)
    for name, rows in (("coarse", COARSE_POINTS), ("fine", FINE_POINTS)):
        graph.add("Mul", [graph.view(f"{name}_unit", [rows, 3], f"{name}_rows"), "scale"], f"{name}_scaled")
        graph.add("Add", [f"{name}_scaled", center], name)
    graph.linear(feature, weights["class1.weight"], weights["class1.bias"], "class1")
    logits = graph.linear(graph.relu("class1"), weights["class2.weight"], weights["class2.bias"], "class2")
    graph.view(graph.add("Softmax", [logits], "softmax", axis=1), [classes], "class_probability")
    value = helper.make_tensor_value_info
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "completion",
            [value("points", TensorProto.FLOAT, ["points", 3])],
            [
                value("fine", TensorProto.FLOAT, [FINE_POINTS, 3]),
                value("coarse", TensorProto.FLOAT, [COARSE_POINTS, 3]),
                value("class_probability", TensorProto.FLOAT, [classes]),
            ],
            graph.constants,
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="rfconstruct",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def _center(graph: _Graph) -> str:
    """Points in network units, x and y about the middle of their bounding box; returns that middle [1, 3], z 0."""
    graph.constant("scale", np.array(SCALE_M, np.float32))
    axis = graph.constant("rows", np.array([0], np.int64))
    graph.add("ReduceMax", ["points", axis], "high", keepdims=1)
    graph.add("ReduceMin", ["points", axis], "low", keepdims=1)
    graph.add("Add", ["high", "low"], "both_ends")
    graph.add("Mul", ["both_ends", graph.constant("half", np.array([[0.5, 0.5, 0.0]], np.float32))], "center")
    graph.add("Sub", ["points", "center"], "centered")
    graph.add("Div", ["centered", "scale"], "unit")
    return "center"


def _encoder(graph: _Graph, weights: _Weights) -> tuple[str, str]:
    """Hidden rows of the second PointNet layer [n, channels] and the global feature [1, channels]."""
    graph.linear("unit", weights["point1.weight"], weights["point1.bias"], "point1")
    first = graph.linear(graph.relu("point1"), weights["point2.weight"], weights["point2.bias"], "point2")
    graph.add("ReduceMax", [first, "rows"], "global1", keepdims=1)
    weight = weights["local1.weight"]
    split = weight.shape[1] // 2
    shared = graph.linear("global1", weight[:, split:], weights["local1.bias"], "local1_global")
    graph.linear(first, weight[:, :split], shared, "local1")
    hidden = graph.relu("local1")
    graph.linear(hidden, weights["local2.weight"], weights["local2.bias"], "local2")
    return hidden, graph.add("ReduceMax", ["local2", "rows"], "feature", keepdims=1)


def _coarse(graph: _Graph, weights: _Weights, feature: str) -> str:
    """Coarse points [1024, 3] in network units."""
    source = feature
    for name in ("coarse1", "coarse2"):
        graph.linear(source, weights[f"{name}.weight"], weights[f"{name}.bias"], name)
        source = graph.relu(name)
    graph.linear(source, weights["coarse3.weight"], weights["coarse3.bias"], "coarse3")
    return graph.view("coarse3", [COARSE_POINTS, 3], "coarse_unit")


def _folding(graph: _Graph, weights: _Weights, hidden: str, feature: str, coarse: str) -> str:
    """Fine points [1024, 16, 3] in network units: nearest input point's local feature, then the folding."""
    weight, channels = weights["fold1.weight"], weights["local2.weight"].shape[0]
    of_local, of_global = weight[:, 5 : 5 + channels], weight[:, 5 + channels :]
    graph.add("Mul", ["unit", "unit"], "unit_squared")
    graph.add("ReduceSum", ["unit_squared", graph.constant("columns", np.array([1], np.int64))], "norm", keepdims=0)
    graph.add("Gemm", [coarse, "unit", "norm"], "distance", transB=1, alpha=-2.0)
    graph.add("ArgMin", ["distance"], "nearest", axis=1, keepdims=0)
    local = graph.add("Gather", [hidden, "nearest"], "local", axis=0)
    bias = weights["fold1.bias"] + of_local @ weights["local2.bias"]
    shared = graph.linear(feature, of_global, bias, "fold_global")
    base = graph.linear(coarse, weight[:, 2:5], shared, "fold_coarse")
    width = weights["fold2.weight"].shape[0]
    graph.linear(local, of_local @ weights["local2.weight"], base, "fold_local")
    graph.view("fold_local", [COARSE_POINTS, 1, width], "fold_base")
    patch = patch_grid().numpy() @ weight[:, :2].T
    graph.add("Add", ["fold_base", graph.constant("fold_patch", patch[None])], "fold1_cells")
    graph.view(graph.relu("fold1_cells"), [FINE_POINTS, width], "fold1")
    graph.linear("fold1", weights["fold2.weight"], weights["fold2.bias"], "fold2")
    graph.linear(graph.relu("fold2"), weights["fold3.weight"], weights["fold3.bias"], "fold3")
    graph.view("fold3", [COARSE_POINTS, PATCH_CELLS, 3], "offset")
    graph.view(coarse, [COARSE_POINTS, 1, 3], "coarse_cells")
    return graph.add("Add", ["offset", "coarse_cells"], "fine_unit")


def export(state: dict[str, torch.Tensor], path: Path) -> None:
    """Write a network state as a fp32 ONNX file.

    Args:
        state: ``Checkpoint.average`` or a state dict.
        path: the file.
    """
    weights = {name: value.detach().cpu().float().numpy() for name, value in state.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(build(weights), path)
