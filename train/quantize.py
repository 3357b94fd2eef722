# SPDX-License-Identifier: Apache-2.0
"""Eight-bit weights and activations for an exported network: own calibration, QGemm and QLinearAdd in one u8 chain.

Activations are unsigned, weights signed with a scale for every output channel. QGemm knows one scale for a whole
tensor; channels get ranges of their own because what widens them is multiplied into the weights that read them. A ReLU
is absorbed by a range that begins at zero.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import onnx
import onnxruntime
from onnx import numpy_helper

from edge.completion.golden import PROBE, PROBE_DEPTH
from edge.config import require
from edge.frames import Float32
from train.graph import Graph, make_model

MARGIN = 0.15
"""Room beyond the calibrated range, in shares of it."""
BALANCE = 0.5
"""Share of the channels' unequal widths, in logarithms, that goes into the weights: both sides get the same error."""
_LEAST_SCALE = 1e-6
"""Of a channel's weights, against the widest one: without weights the code of any bias would be too long."""
_LEAST_GAIN = 0.02
"""Of a channel, against the widest one."""
HALF_ELEMENTS = 100_000
"""Float weights with more elements are stored in half precision and widened when the model is loaded."""
PROBE_ROWS = 16
_MICROSOFT = "com.microsoft"
_PASSIVE = ("Reshape", "Gather", "Relu")
"""Operators that give on codes what they give on numbers."""


@dataclass(frozen=True)
class Range:
    """Of one tensor over the calibration inputs.

    Args:
        low, high: float32 [channels], the last axis; 0 in between is not implied.
    """

    low: Float32
    high: Float32


def calibrate(
    model: onnx.ModelProto, tensors: Sequence[str], inputs: Sequence[Float32], share: float = 1.0
) -> dict[str, Range]:
    """Ranges of tensors of a float model.

    Args:
        model: of one object.
        tensors: names of float tensors inside the model.
        inputs: clouds float32 [n, 3]: seeded validation samples of every kind of data.
        share: of an input's values that lie within the range, per channel and input; 1: minimum and maximum.
    """
    require(len(inputs) > 0, "calibration inputs", len(inputs), ">= 1")
    require(0.5 < share <= 1, "calibration share", share, "0.5..1")
    low: dict[str, Float32] = {}
    high: dict[str, Float32] = {}
    for values in _probe(model, tensors, inputs):
        for name, value in zip(tensors, values, strict=True):
            rows = value.reshape(-1, value.shape[-1])
            least, most = (rows.min(0), rows.max(0)) if share == 1 else np.quantile(rows, (1 - share, share), axis=0)
            low[name] = np.minimum(low.get(name, least), least).astype(np.float32)
            high[name] = np.maximum(high.get(name, most), most).astype(np.float32)
    return {name: Range(low[name], high[name]) for name in tensors}


def _probe(model: onnx.ModelProto, tensors: Sequence[str], inputs: Sequence[Float32]) -> Iterator[list[Float32]]:
    """Values of float tensors inside a model, input by input."""
    probe = onnx.ModelProto()
    probe.CopyFrom(model)
    known = {one.name for one in probe.graph.output}
    probe.graph.output.extend(onnx.ValueInfoProto(name=name) for name in tensors if name not in known)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    session = onnxruntime.InferenceSession(probe.SerializeToString(), options, providers=["CPUExecutionProvider"])
    for points in inputs:
        yield session.run(list(tensors), {"points": points})


def quantize(
    model: onnx.ModelProto, nodes: Collection[str], inputs: Sequence[Float32], weight_bits: int = 8
) -> onnx.ModelProto:
    """Quantize named nodes of a float model.

    Args:
        model: of one object, fp32 (``export.build``).
        nodes: names of Gemm nodes with a constant weight and of Add nodes with a constant second term.
        inputs: calibration clouds, float32 [n, 3].
        weight_bits: 8, or 7: then no processor can saturate, because the 16-bit sum of two products fits.
    Returns:
        A model with the same inputs and outputs; its QGemm and QLinearAdd are operators of ONNX Runtime.
    Raises:
        ConfigError: no inputs, or another number of bits.
    """
    require(weight_bits in (7, 8), "weight bits", weight_bits, "7 or 8")
    tensors = [name for node in model.graph.node if node.name in nodes for name in (node.input[0], node.output[0])]
    ranges = calibrate(model, list(dict.fromkeys(tensors)), inputs)
    limit = 2 ** (weight_bits - 1) - 1
    first = _Rewriter(model, set(nodes), ranges, limit, {}).run()
    return _Rewriter(model, set(nodes), ranges, limit, _bias_of_maxima(model, first, nodes, inputs)).run()


def _bias_of_maxima(
    model: onnx.ModelProto, coded: onnx.ModelProto, nodes: Collection[str], inputs: Sequence[Float32]
) -> dict[str, Float32]:
    """Mean error of what a quantized product gives to a maximum over rows, which rounding errors can only raise."""
    products = {node.output[0]: node.name for node in model.graph.node if node.name in nodes}
    for node in model.graph.node:
        if node.op_type == "Reshape" and node.input[0] in products:
            products[node.output[0]] = products[node.input[0]]
    pairs = [
        (products[node.input[0]], node.output[0])
        for node in model.graph.node
        if node.op_type == "ReduceMax" and node.input[0] in products
    ]
    if not pairs:
        return {}
    tensors = [maximum for _, maximum in pairs]
    sums = {product: np.zeros(1, np.float32) for product, _ in pairs}
    for right, wrong in zip(_probe(model, tensors, inputs), _probe(coded, tensors, inputs), strict=True):
        for (product, _), a, b in zip(pairs, right, wrong, strict=True):
            sums[product] = sums[product] + (b - a).reshape(-1, a.shape[-1]).mean(axis=0)
    return {product: total / np.float32(len(inputs)) for product, total in sums.items()}


def with_saturation_probe(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with one more output, ``eight_bit_sum``: a product of the largest codes, computed when it is loaded.

    ``edge.completion.golden`` compares it with the exact number: a processor that adds two products in 16 bits cannot
    give it, whatever the weights of the network are.
    """
    graph = Graph()
    codes = graph.constant("probe.codes", np.full((PROBE_ROWS, PROBE_DEPTH), 255, np.uint8))
    weight = graph.constant("probe.weight", np.full((PROBE_DEPTH, PROBE_ROWS), 127, np.int8))
    one = graph.constant("probe.one", np.array(1, np.float32))
    zeros = [graph.constant(f"probe.zero{n}", np.array(0, kind)) for n, kind in enumerate((np.uint8, np.int8))]
    graph.add("QGemm", [codes, one, zeros[0], weight, one, zeros[1]], PROBE, domain=_MICROSOFT)
    shape = [PROBE_ROWS, PROBE_ROWS]
    output = onnx.helper.make_tensor_value_info(PROBE, onnx.TensorProto.FLOAT, shape)
    whole = model.graph
    return make_model(
        [*whole.node, *graph.nodes], whole.input, [*whole.output, output], [*whole.initializer, *graph.constants]
    )


@dataclass(frozen=True)
class _Codes:
    """A tensor in eight bits: ``real = gain * step * (code - zero)``, gain per channel of the last axis."""

    name: str
    step: float
    zero: int
    gain: Float32


class _Rewriter:
    """Walks the float nodes in order and writes the quantized graph; tensors are widened only where floats are read."""

    def __init__(
        self,
        model: onnx.ModelProto,
        nodes: set[str],
        ranges: dict[str, Range],
        limit: int,
        errors: dict[str, Float32],
    ) -> None:
        self.model, self.nodes, self.ranges, self.limit, self.errors = model, nodes, ranges, limit, errors
        self.graph, self.codes, self.floats = Graph(), dict[str, _Codes](), set[str]()
        self.weights = {one.name: numpy_helper.to_array(one) for one in model.graph.initializer}
        self.readers: dict[str, list[onnx.NodeProto]] = {}
        for node in model.graph.node:
            for name in node.input:
                self.readers.setdefault(name, []).append(node)

    def run(self) -> onnx.ModelProto:
        """The quantized model."""
        for node in self.model.graph.node:
            if node.name in self.nodes:
                (self._gemm if node.op_type == "Gemm" else self._sum)(node)
            elif node.input[0] in self.codes and node.op_type in _PASSIVE:
                self._pass(node)
            else:
                self._copy(node)
        for one in self.model.graph.output:
            self._float(one.name)
        graph = self.model.graph
        return make_model(self.graph.nodes, graph.input, graph.output, self.graph.constants)

    def _gemm(self, node: onnx.NodeProto) -> None:
        """QGemm; its result stays in codes when quantized nodes read it."""
        source, target = self._code(node.input[0]), node.output[0]
        made = self._range(target) if self._coded(target) else None
        gain = 1.0 if made is None else made.gain.astype(np.float64)
        weight = self.weights[node.input[1]].astype(np.float64) * source.gain[:, None] / gain
        add, name = self.graph.constant, node.name
        scale = np.maximum(np.abs(weight).max(axis=0), 1e-12) / self.limit
        scale = np.maximum(scale, _LEAST_SCALE * scale.max())
        bias = self.weights.get(node.input[2])
        if bias is not None:  # its code has 32 bits; of a channel nearly without weights it would need more
            right = (bias - self.errors.get(name, 0.0)) / gain
            scale = np.maximum(scale, np.abs(right) / (source.step * 2.0**30))
        codes = np.clip(np.rint(weight / scale), -self.limit, self.limit).astype(np.int8)
        inputs = [*self._with_scale(source), add(f"{name}.w_code", codes)]
        inputs += [add(f"{name}.w_scale", scale.astype(np.float32)), self._zeros(len(scale))]
        steps = source.step * scale
        if bias is None:
            step = add(f"{name}.step", (steps * gain).astype(np.float32))
            divided = self.graph.add("Div", [node.input[2], step], f"{name}.b")
            rounded = self.graph.add("Round", [divided], f"{name}.b_round")
            inputs.append(self.graph.add("Cast", [rounded], f"{name}.b_code", to=onnx.TensorProto.INT32))
        else:
            inputs.append(add(f"{name}.b_code", np.rint(right / steps).astype(np.int32)))
        if made is None:
            self.graph.add("QGemm", inputs, target, domain=_MICROSOFT)
            self.floats.add(target)
            return
        self.graph.add("QGemm", [*inputs, *self._with_scale(made)[1:]], made.name, domain=_MICROSOFT)
        self.codes[target] = made

    def _sum(self, node: onnx.NodeProto) -> None:
        """QLinearAdd of a tensor and a constant; of the tensor, what the constant cannot lift above zero is cut."""
        target, term = node.output[0], self.weights[node.input[1]]
        made = self._range(target, np.abs(term).reshape(-1, term.shape[-1]).max(axis=0))
        term = term / made.gain
        found = self.ranges[node.input[0]]
        least = float(-term.max() if self._is_relu(target) else (found.low / made.gain).min())
        high = float((found.high / made.gain).max())
        first = self._code(node.input[0], self._steps(f"{target}.first", least, high, made.gain))
        second = self._steps(f"{target}.term", float(term.min()), float(term.max()), made.gain)
        codes = np.clip(np.rint(term / second.step) + second.zero, 0, 255).astype(np.uint8)
        self.graph.constant(second.name, codes)
        inputs = [*self._with_scale(first), *self._with_scale(second), *self._with_scale(made)[1:]]
        self.graph.add("QLinearAdd", inputs, made.name, domain=_MICROSOFT)
        self.codes[target] = made

    def _pass(self, node: onnx.NodeProto) -> None:
        """An operator that does not compute, on codes; a ReLU was absorbed."""
        source = self.codes[node.input[0]]
        name = source.name
        if node.op_type != "Relu":
            copy = onnx.NodeProto()
            copy.CopyFrom(node)
            copy.input[0], name = source.name, f"{node.output[0]}_code"
            copy.output[0] = copy.name = name
            self._constants_of(node)
            self.graph.nodes.append(copy)
        self.codes[node.output[0]] = replace(source, name=name)

    def _copy(self, node: onnx.NodeProto) -> None:
        """A float node."""
        for name in node.input:
            self._float(name)
        self._constants_of(node)
        self.graph.nodes.append(node)
        self.floats.update(node.output)

    def _constants_of(self, node: onnx.NodeProto) -> None:
        """Initializers that a copied node reads; large ones in half precision."""
        for name in node.input:
            value = self.weights.get(name)
            if value is None or name in self.floats:
                continue
            self.floats.add(name)
            if value.dtype == np.float32 and value.size > HALF_ELEMENTS:
                half = self.graph.constant(f"{name}.half", value.astype(np.float16))
                self.graph.add("Cast", [half], name, to=onnx.TensorProto.FLOAT)
            else:
                self.graph.constant(name, value)

    def _float(self, name: str) -> None:
        """Make the float version of a tensor of codes exist."""
        codes = self.codes.get(name)
        if codes is not None and name not in self.floats:
            self.floats.add(name)
            self.graph.add("DequantizeLinear", self._with_scale(codes), f"{name}_even")
            self.graph.add("Mul", [f"{name}_even", self.graph.constant(f"{codes.name}.gain", codes.gain)], name)

    def _code(self, name: str, wanted: _Codes | None = None) -> _Codes:
        """Codes of a tensor, quantized here if it is float."""
        if name not in self.codes:
            made = self._range(name) if wanted is None else wanted
            inverse = self.graph.constant(f"{made.name}.inverse", (1 / made.gain).astype(np.float32))
            even = self.graph.add("Mul", [name, inverse], f"{made.name}_even")
            self.graph.add("QuantizeLinear", [even, *self._with_scale(made)[1:]], made.name)
            self.codes[name] = made
            self.floats.add(name)
        return self.codes[name]

    def _range(self, name: str, least: Float32 | None = None) -> _Codes:
        """Codes for what calibration found; the gain makes all channels equally wide, none narrower than ``least``."""
        found = self.ranges[name]
        low = np.zeros_like(found.low) if self._is_relu(name) else np.minimum(found.low, 0)
        high = np.maximum(found.high, 0)
        width = np.maximum(-low, high) * (1 + MARGIN)
        gain = np.maximum(width if least is None else np.maximum(width, least), _LEAST_GAIN * width.max())
        gain = np.maximum(gain, np.float32(1e-12))
        gain = gain.max() * (gain / gain.max()) ** np.float32(BALANCE)
        return self._steps(f"{name}_code", float((low / gain).min()), float((width / gain).max()), gain)

    def _steps(self, name: str, low: float, high: float, gain: Float32) -> _Codes:
        """Codes for a range, widened to hold 0."""
        low, high = min(low, 0.0), max(high, 0.0)
        step = float(np.float32(max(high - low, 1e-12) / 255))
        return _Codes(name, step, int(np.clip(np.rint(-low / step), 0, 255)), gain)

    def _with_scale(self, codes: _Codes) -> list[str]:
        """Names of codes, step and zero point, as the quantized operators take them."""
        add = self.graph.constant
        step = add(f"{codes.name}.step", np.array(codes.step, np.float32))
        return [codes.name, step, add(f"{codes.name}.zero", np.array(codes.zero, np.uint8))]

    def _zeros(self, count: int) -> str:
        return self.graph.constant(f"zeros_{count}", np.zeros(count, np.int8))

    def _is_relu(self, name: str) -> bool:
        readers = self.readers.get(name, [])
        return len(readers) == 1 and readers[0].op_type == "Relu"

    def _coded(self, name: str) -> bool:
        """Whether a quantized node reads the tensor, directly or behind operators that do not compute."""
        return any(
            reader.name in self.nodes or (reader.op_type in _PASSIVE and self._coded(reader.output[0]))
            for reader in self.readers.get(name, [])
        )
