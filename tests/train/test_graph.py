# SPDX-License-Identifier: Apache-2.0
"""The graph builder: the nearest-neighbour search against brute force, the loop over objects against single ones."""

from __future__ import annotations

import numpy as np
import onnx
import onnxruntime
import pytest

from train.graph import BLOCK, IR_VERSION, OPSET, Graph, per_object


def session(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])


def search(queries: int) -> onnx.ModelProto:
    """Points -> the nearest of them to each of their own first rows, turned about."""
    graph = Graph()
    graph.prepare_rows("points")
    fixed = graph.constant("fixed", np.random.default_rng(3).normal(size=(queries, 3)).astype(np.float32))
    graph.add("Cast", [graph.nearest_rows(fixed, queries, "nearest")], "row", to=onnx.TensorProto.FLOAT)
    return graph.model({"row": (queries,)})


@pytest.mark.parametrize("points", [1, BLOCK - 1, BLOCK, BLOCK + 1, 500])
def test_nearest_row_is_that_of_brute_force(points: int) -> None:
    cloud = np.random.default_rng(points).normal(size=(points, 3)).astype(np.float32)
    queries = np.random.default_rng(3).normal(size=(40, 3))
    expected = ((queries[:, None] - cloud[None].astype(np.float64)) ** 2).sum(-1).argmin(1)
    np.testing.assert_array_equal(session(search(40)).run(None, {"points": cloud})[0], expected)


def test_of_equal_points_the_first_is_nearest() -> None:
    cloud = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    run = session(search(40)).run
    once, twice = (run(None, {"points": np.tile(cloud, (n, 1))})[0] for n in (1, 3))
    np.testing.assert_array_equal(once, twice)


def test_every_object_of_a_batch_gets_what_it_gets_alone() -> None:
    single = search(40)
    clouds = [np.random.default_rng(n).normal(size=(n, 3)).astype(np.float32) for n in (1, 70, 33)]
    feed = {"points": np.concatenate(clouds), "counts": np.array([1, 70, 33])}
    found = session(per_object(single)).run(None, feed)[0]
    for row, cloud in zip(found, clouds, strict=True):
        np.testing.assert_array_equal(row, session(single).run(None, {"points": cloud})[0])


def test_only_standard_operators_are_declared_when_no_others_occur() -> None:
    model = per_object(search(4))
    assert model.ir_version == IR_VERSION
    assert [(one.domain, one.version) for one in model.opset_import] == [("", OPSET)]
