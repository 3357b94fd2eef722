# SPDX-License-Identifier: Apache-2.0
"""Quantization: close to the float network, in one chain of eight bits, and what saturation would do to it."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxruntime import InferenceSession

from edge.completion.network import Network
from edge.errors import ConfigError
from edge.frames import Float32
from train.export import INT8_NODES, build
from train.graph import Graph, per_object
from train.network import WIDTHS, CompletionNetwork
from train.quantize import MARGIN, calibrate, quantize


def cloud(seed: int, points: int = 300) -> Float32:
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(points, 3)) * (1.5, 0.6, 0.5) + (8, -3, 0.8)).astype(np.float32)


CALIBRATION = [cloud(seed) for seed in range(100, 108)]


@pytest.fixture(scope="module")
def model() -> onnx.ModelProto:
    torch.manual_seed(0)
    network = CompletionNetwork(WIDTHS["tiny"], 4).eval()
    network.start_from(np.random.default_rng(0).uniform(-1, 1, (1024, 3)).astype(np.float32))
    return build(network)


@pytest.mark.parametrize("bits", [8, 7])
def test_quantized_answers_are_near_and_classes_stay(model: onnx.ModelProto, bits: int) -> None:
    small = Network(per_object(quantize(model, INT8_NODES, CALIBRATION, bits)).SerializeToString(), "int8")
    full = Network(per_object(model).SerializeToString(), "fp32")
    for seed, points in ((0, 64), (1, 1000)):
        right, found = full.run(cloud(seed, points)), small.run(cloud(seed, points))
        shift_m = np.sqrt(np.square(found.fine_m - right.fine_m).sum(axis=1).mean())
        assert 0 < shift_m < 0.01
        np.testing.assert_allclose(found.probability, right.probability, atol=0.02)


def test_a_channel_without_weights_keeps_its_bias() -> None:
    """Its code is bias / step, and a step made from no weights would be nothing."""
    torch.manual_seed(1)
    network = CompletionNetwork(WIDTHS["tiny"], 4).eval()
    with torch.no_grad():
        network.fold2.weight[:4] = 0
        network.fold2.bias[:4] = 2
        network.local1.weight[3] = 0
    float_model = build(network)
    small = Network(per_object(quantize(float_model, INT8_NODES, CALIBRATION)).SerializeToString(), "int8")
    right, found = Network(per_object(float_model).SerializeToString(), "fp32").run(cloud(0)), small.run(cloud(0))
    assert np.sqrt(np.square(found.fine_m - right.fine_m).sum(axis=1).mean()) < 0.02


def test_coordinates_never_pass_eight_bits(model: onnx.ModelProto) -> None:
    """Their steps would be centimetres: only the named nodes are quantized, and what they read are features."""
    coded = quantize(model, INT8_NODES, CALIBRATION)
    kinds = [node.op_type for node in coded.graph.node]
    assert kinds.count("QGemm") == 4
    assert kinds.count("QLinearAdd") == 1
    assert kinds.count("QuantizeLinear") == 2
    floats = {node.name for node in coded.graph.node if node.op_type == "Gemm"}
    assert {"point1", "point2", "coarse3", "fold_coarse", "nearest_score"} <= floats


def test_range_is_that_of_the_tensor(model: onnx.ModelProto) -> None:
    found = calibrate(model, ["centered"], CALIBRATION)["centered"]
    middles = [(c.min(0) + c.max(0)) / 2 * (1, 1, 0) for c in CALIBRATION]
    low = np.min([(c - m).min(0) for c, m in zip(CALIBRATION, middles, strict=True)], axis=0)
    np.testing.assert_allclose(found.low, low, atol=1e-5)


def test_error_of_a_product_is_that_of_half_steps() -> None:
    """Half a step of every input and of every weight, added up, is the most that one layer can be off."""
    graph, rng = Graph(), np.random.default_rng(0)
    weight = rng.uniform(-1, 1, (5, 3)).astype(np.float32)
    graph.linear("points", weight, rng.normal(size=5).astype(np.float32), "layer")
    model = graph.model({"layer": (200, 5)})
    inputs = rng.uniform(0, 1, (200, 3)).astype(np.float32)
    right, found = (
        InferenceSession(one.SerializeToString(), providers=["CPUExecutionProvider"]).run(None, {"points": inputs})[0]
        for one in (model, quantize(model, ["layer"], [inputs]))
    )
    of_inputs = (1 + MARGIN) * inputs.max() / 255 / 2 * np.abs(weight).sum(1).max()
    of_weights = np.abs(weight).max() / 127 / 2 * inputs.sum(1).max()
    assert 0 < np.abs(found - right).max() <= 1.05 * (of_inputs + of_weights)


@pytest.mark.parametrize("bits", [6, 9])
def test_other_numbers_of_bits_are_refused(model: onnx.ModelProto, bits: int) -> None:
    with pytest.raises(ConfigError, match="weight bits"):
        quantize(model, INT8_NODES, CALIBRATION, bits)


def test_without_inputs_there_is_no_calibration(model: onnx.ModelProto) -> None:
    with pytest.raises(ConfigError, match="calibration inputs"):
        quantize(model, INT8_NODES, [])


def pairwise(codes: NDArray[np.uint8], weight: NDArray[np.int8], saturate: bool) -> NDArray[np.int64]:
    """The product as AVX2 forms it: sums of two products in 16 bits, then the sum of those."""
    products = codes.astype(np.int64)[:, :, None] * weight.astype(np.int64)[None]
    pairs = products[:, 0::2] + products[:, 1::2]
    return (np.clip(pairs, -(2**15), 2**15 - 1) if saturate else pairs).sum(axis=1)


def test_seven_bit_weights_cannot_saturate(model: onnx.ModelProto) -> None:
    coded = quantize(model, INT8_NODES, CALIBRATION, 7)
    weights = [numpy_helper.to_array(one) for one in coded.graph.initializer if one.name.endswith(".w_code")]
    assert len(weights) == 4
    assert max(np.abs(weight.astype(int)).max() for weight in weights) == 63
    worst = np.full((1, 2), 255, np.uint8), np.full((2, 1), 63, np.int8)
    assert pairwise(*worst, saturate=True) == pairwise(*worst, saturate=False)
    eight = np.full((1, 2), 255, np.uint8), np.full((2, 1), 127, np.int8)
    assert pairwise(*eight, saturate=True) != pairwise(*eight, saturate=False)


def test_weights_of_quantized_layers_are_bytes(model: onnx.ModelProto) -> None:
    kinds = {one.name: one.data_type for one in quantize(model, INT8_NODES, CALIBRATION).graph.initializer}
    assert kinds["fold2.w_code"] == kinds["local2.w_code"] == onnx.TensorProto.INT8
    assert "fold2.weight" not in kinds
