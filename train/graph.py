# SPDX-License-Identifier: Apache-2.0
"""A small builder of ONNX graphs: Gemm layers, views, an exact nearest-neighbour search, a loop over objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

OPSET, IR_VERSION = 21, 10
BLOCK = 32
"""Columns of one block of the nearest-neighbour search."""
FAR_M = 1e4
"""Coordinate of the rows that fill the last block."""
POINTS, COUNTS = "points", "counts"
Shape = Sequence[int | str]


class Graph:
    """Nodes and constants of a graph under construction; a node is named after its output."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._names: set[str] = set()

    def constant(self, name: str, value: NDArray[Any]) -> str:
        """An initializer; a name that exists already is taken for the same value."""
        if name not in self._names:
            self._names.add(name)
            self.constants.append(numpy_helper.from_array(np.asarray(value, order="C"), name))
        return name

    def integers(self, *values: int) -> str:
        """Constant int64 [len(values)]."""
        return self.constant("int_" + "_".join(map(str, values)), np.array(values, np.int64))

    def add(self, kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        """A node of the given operator with one output; returns the output's name."""
        self.nodes.append(helper.make_node(kind, list(inputs), [output], name=output, **attributes))
        return output

    def linear(
        self, source: str, weight: NDArray[np.float32], bias: NDArray[np.float32] | str | None, output: str
    ) -> str:
        """``source @ weight.T + bias``; a bias that is a name is the output of a node that broadcasts."""
        inputs = [source, self.constant(f"{output}.weight", weight.T)]
        if bias is not None:
            inputs.append(bias if isinstance(bias, str) else self.constant(f"{output}.bias", bias))
        return self.add("Gemm", inputs, output)

    def relu(self, source: str) -> str:
        """``max(source, 0)``; ONNX Runtime fuses it into the Gemm before it."""
        return self.add("Relu", [source], f"{source}_relu")

    def view(self, source: str, shape: Sequence[int], output: str) -> str:
        """The same numbers in another shape."""
        return self.add("Reshape", [source, self.integers(*shape)], output)

    def prepare_rows(self, points: str) -> None:
        """Points [n, 3] as ``nearest_rows`` reads them: in whole blocks, with their squared norms."""
        self.add("Shape", [points], "rows", start=0, end=1)
        self.add("Mul", ["rows", self.integers(BLOCK - 1)], "rows_negative")  # -n modulo the block
        self.add("Mod", ["rows_negative", self.integers(BLOCK)], "rows_missing")
        self.add("Concat", [self.integers(0, 0), "rows_missing", self.integers(0)], "pads", axis=0)
        self.add("Pad", [points, "pads", self.constant("far", np.array(FAR_M, np.float32))], "filled")
        self.add("Mul", ["filled", "filled"], "squared")
        self.add("ReduceSum", ["squared", self.integers(1)], "norm", keepdims=1)
        self.add("Concat", ["filled", "norm"], "rows4", axis=1)

    def nearest_rows(self, queries: str, count: int, output: str) -> str:
        """Row of the prepared points nearest to each of ``queries`` [count, 3]: int64 [count].

        The score ``|p|^2 - 2 p q`` is one product of depth 4. ONNX Runtime's ArgMin is scalar, its ReduceMin is not, so
        the minimum of every block of 32 is found first, then the best block, then the place in it: the first of equal
        scores wins, as in one ArgMin over all.
        """
        turned = self.constant("minus_two", np.array(-2.0, np.float32))
        ones = self.constant(f"ones_{count}", np.ones((count, 1), np.float32))
        steps = self.constant(f"steps_{count}", np.arange(count, dtype=np.int64))
        minus = self.add("Mul", [queries, turned], f"{output}_minus")
        four = self.add("Concat", [minus, ones], f"{output}_queries", axis=1)
        score = self.add("Gemm", [four, "rows4"], f"{output}_score", transB=1)
        blocks = self.view(score, (count, -1, BLOCK), f"{output}_blocks")
        low = self.add("ReduceMin", [blocks, self.integers(2)], f"{output}_low", keepdims=0)
        best = self.add("ArgMin", [low], f"{output}_best", axis=1, keepdims=0)
        width = self.add("Shape", [low], f"{output}_width", start=1, end=2)
        start = self.add("Mul", [steps, width], f"{output}_start")
        place = self.add("Add", [start, best], f"{output}_place")
        found = self.add("Gather", [self.view(score, (-1, BLOCK), f"{output}_flat"), place], f"{output}_block", axis=0)
        within = self.add("ArgMin", [found], f"{output}_within", axis=1, keepdims=0)
        first = self.add("Mul", [best, self.integers(BLOCK)], f"{output}_first")
        return self.add("Add", [first, within], output)

    def model(self, outputs: Mapping[str, Shape], columns: int = 3) -> onnx.ModelProto:
        """Checked model of one object: input ``points`` float32 [n, columns] and these outputs, float32."""
        inputs = [_float_value(POINTS, ["points", columns])]
        return make_model(self.nodes, inputs, [_float_value(*one) for one in outputs.items()], self.constants)


def _float_value(name: str, shape: Shape) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape))


def make_model(
    nodes: Sequence[onnx.NodeProto],
    inputs: Sequence[onnx.ValueInfoProto],
    outputs: Sequence[onnx.ValueInfoProto],
    constants: Sequence[onnx.TensorProto],
) -> onnx.ModelProto:
    """A checked model; ONNX Runtime's own operators are declared when they occur."""
    graph = helper.make_graph(list(nodes), "completion", list(inputs), list(outputs), list(constants))
    domains = [helper.make_opsetid("", OPSET)]
    if any(node.domain for node in _all_nodes(nodes)):
        domains.append(helper.make_opsetid("com.microsoft", 1))
    model = helper.make_model(graph, opset_imports=domains, ir_version=IR_VERSION, producer_name="rfconstruct")
    onnx.checker.check_model(model, full_check=len(domains) == 1)
    return model


def _all_nodes(nodes: Sequence[onnx.NodeProto]) -> list[onnx.NodeProto]:
    inner = [node for one in nodes for a in one.attribute if a.HasField("g") for node in _all_nodes(list(a.g.node))]
    return [*nodes, *inner]


def per_object(single: onnx.ModelProto) -> onnx.ModelProto:
    """A model of many objects from a model of one.

    A Loop passes over the objects: nothing is padded, clouds of different sizes share no arithmetic, so an object's
    answer is bit for bit the same in any batch, and memory does not grow with it. One object already fills one core;
    a segmented graph would save only the reading of the one-row layers' weights.

    Args:
        single: of ``Graph.model`` or its quantized like.
    Returns:
        Model with inputs ``points`` float32 [sum(counts), 3], the clouds one after the other, and ``counts`` int64
        [objects], each >= 1, and the outputs of ``single`` with a leading axis for the objects.
    """
    body, int64 = Graph(), TensorProto.INT64
    body.add("Gather", [COUNTS, "object"], "count", axis=0)
    body.view("count", (1,), "count_row")
    body.add("Add", ["first", "count_row"], "next")
    body.add("Slice", [POINTS, "first", "next", body.integers(0)], "cloud")
    body.add("Identity", ["go_on"], "go_on_after")
    results = [one.name for one in single.graph.output]
    inner = {POINTS: "cloud", **{name: f"{name}_of_one" for name in results}}
    value = helper.make_tensor_value_info
    loop = helper.make_graph(
        [*body.nodes, *(_renamed(node, inner) for node in single.graph.node)],
        "object",
        [value("object", int64, []), value("go_on", TensorProto.BOOL, []), value("first", int64, [1])],
        [value("go_on_after", TensorProto.BOOL, []), value("next", int64, [1])]
        + [_float_value(inner[one.name], _shape(one)) for one in single.graph.output],
    )
    whole = Graph()
    whole.add("Shape", [COUNTS], "objects")
    whole.view("objects", (), "trips")
    state = whole.constant("first_row", np.zeros(1, np.int64))
    carried = ["points_used", *results]
    whole.nodes.append(helper.make_node("Loop", ["trips", "", state], carried, name="loop", body=loop))
    columns = single.graph.input[0].type.tensor_type.shape.dim[1].dim_value
    known = {one.name for one in single.graph.initializer}
    constants = [*single.graph.initializer, *(c for c in (*body.constants, *whole.constants) if c.name not in known)]
    return make_model(
        whole.nodes,
        [_float_value(POINTS, ["points", columns]), value(COUNTS, int64, ["objects"])],
        [_float_value(one.name, ["objects", *_shape(one)]) for one in single.graph.output],
        list({constant.name: constant for constant in constants}.values()),
    )


def _shape(value: onnx.ValueInfoProto) -> list[int]:
    return [dimension.dim_value for dimension in value.type.tensor_type.shape.dim]


def _renamed(node: onnx.NodeProto, names: dict[str, str]) -> onnx.NodeProto:
    """A copy with other names of tensors."""
    copy = onnx.NodeProto()
    copy.CopyFrom(node)
    for tensors in (copy.input, copy.output):
        tensors[:] = [names.get(name, name) for name in tensors]
    return copy
