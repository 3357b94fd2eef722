# SPDX-License-Identifier: Apache-2.0
"""The completion model at run time: known answers, refusals, limits and what the confidence means."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from edge.completion import network
from edge.completion.confidence import ConfidenceModel
from edge.completion.golden import PROBE, PROBE_DEPTH, PROBE_SUM
from edge.completion.manifest import read_manifest
from edge.completion.model import CompletionModel, confidence
from edge.completion.sight import turned
from edge.config import CompletionSettings
from edge.errors import ConfigError, ModelError
from edge.frames import Float32, Float64, ObjectCloud, Pose
from edge.resources import shipped_dir

SHIPPED = shipped_dir("models") / "default"
SETTINGS = CompletionSettings()
SENSOR_M = np.array([-8.0, 0.0, 0.8])


def cloud(points: Float32, frames: int = 60, complete: bool = True, sensor_m: Float64 = SENSOR_M) -> ObjectCloud:
    """An object cloud of these points, seen along x."""
    pose = Pose(9, np.array([1.0, 2.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    return ObjectCloud(7, points, np.zeros(len(points), np.float32), pose, 5, 9, 3.0, frames, complete, sensor_m)


@pytest.fixture(scope="module")
def golden() -> Float32:
    with np.load(SHIPPED / "golden.npz") as stored:
        points: Float32 = stored["points"]
    return points


@pytest.fixture(scope="module")
def model() -> CompletionModel:
    return CompletionModel.load(SHIPPED, SETTINGS)


def framed(folder: Path, frame: str, confidence: ConfidenceModel | None = None) -> CompletionModel:
    """The shipped network, with a manifest that promises this input frame and this confidence."""
    shutil.copytree(SHIPPED, folder, dirs_exist_ok=True)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["input"]["frame"] = frame
    manifest["confidence"] = None if confidence is None else confidence.to_dict()
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return CompletionModel.load(folder, SETTINGS, file="model.onnx")


def resigned(folder: Path, file: str, content: bytes) -> Path:
    """The shipped folder with another content of a file, now the default, and a manifest that vouches for it."""
    shutil.copytree(SHIPPED, folder, dirs_exist_ok=True)
    (folder / file).write_bytes(content)
    manifest = json.loads((folder / "manifest.json").read_text())
    for entry in manifest["files"]:
        if entry["file"] == file:
            entry |= {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    manifest["default_file"] = file
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def test_shape_of_the_known_input(model: CompletionModel, golden: Float32) -> None:
    shape = model.complete(cloud(golden))
    assert shape is not None
    assert shape.fine_m.shape == (16384, 3)
    assert shape.coarse_m.shape == (256, 3)
    assert shape.fine_m.dtype == np.float32
    with np.load(SHIPPED / "golden.npz") as stored:
        probability = stored[f"{model.file}:class_probability"]
    assert shape.class_name == model.manifest.classes[int(probability.argmax())]
    assert set(shape.class_probability) == {"car", "bicycle", "motorcycle", "pedestrian", "unknown"}
    assert math.isclose(sum(shape.class_probability.values()), 1.0, abs_tol=1e-5)
    assert shape.identity == 7
    assert shape.model == hashlib.sha256((SHIPPED / model.file).read_bytes()).hexdigest()[:16]
    assert shape.latency_us["nn"] > 0


def test_the_shape_moves_with_its_input(model: CompletionModel, golden: Float32) -> None:
    shift = np.array([100.0, -40.0, 0.0], np.float32)
    here, there = model.complete(cloud(golden)), model.complete(cloud(golden + shift, sensor_m=SENSOR_M + shift))
    assert here is not None
    assert there is not None
    assert np.median(np.abs(there.coarse_m - shift - here.coarse_m)) < 0.01


def test_the_network_sees_the_cloud_along_the_line_of_sight(tmp_path: Path, golden: Float32) -> None:
    """Turning the scene, sensor and all, turns the shape; a network of the object frame gets the points as they are."""
    model, plain = framed(tmp_path / "sight", "line_of_sight"), framed(tmp_path / "object", "object")
    ahead = golden.mean(axis=0, dtype=np.float64) - [8.0, 0.0, 0.0]
    reference = model.run(golden)[0]
    for angle_rad in (0.0, 0.7, -2.5, np.pi):
        sensor_m = turned(ahead[None], angle_rad)[0].astype(np.float64)
        seen = model.complete(cloud(turned(golden, angle_rad), sensor_m=sensor_m))
        assert seen is not None
        np.testing.assert_allclose(seen.fine_m, turned(reference, angle_rad), atol=0.02)
    unseen = plain.complete(cloud(golden, sensor_m=np.full(3, np.nan)))
    assert unseen is not None
    np.testing.assert_array_equal(unseen.fine_m, reference)


def test_without_a_line_of_sight_the_shape_is_withheld(tmp_path: Path, golden: Float32) -> None:
    model = framed(tmp_path, "line_of_sight")
    above = golden.mean(axis=0, dtype=np.float64) + np.array([0.0, 0.0, 5.0])
    for sensor_m, reason in ((np.array([np.nan, 0, 0]), "not known"), (above, "stands above")):
        with pytest.raises(ModelError, match=f"object 7.*{reason}"):
            model.complete(cloud(golden, sensor_m=sensor_m))


def test_too_few_points_give_no_shape(model: CompletionModel, golden: Float32) -> None:
    assert model.complete(cloud(golden[:63])) is None
    assert model.complete(cloud(golden[:64])) is not None


def test_too_many_points_are_thinned_and_never_repeated(model: CompletionModel, golden: Float32) -> None:
    many = np.random.default_rng(1).uniform(-1, 1, (5000, 3)).astype(np.float32)
    seen: list[Float32] = []
    run = model.run
    model.run = lambda points_m: seen.append(points_m) or run(points_m)  # type: ignore[method-assign,func-returns-value]
    try:
        for points in (many, many, many[:2048], golden):
            done = model.complete(cloud(points, sensor_m=points.mean(axis=0, dtype=np.float64) - [8.0, 0.0, 0.0]))
            assert done is not None
            assert done.input_points == min(len(points), 2048)
            assert len(done.input) == len(points)
    finally:
        del model.run
    assert len(seen[0]) == len(np.unique(seen[0], axis=0)) == 2048
    np.testing.assert_array_equal(seen[0], seen[1])
    assert set(map(bytes, seen[0])) <= set(map(bytes, many))
    np.testing.assert_array_equal(seen[2], many[:2048])
    np.testing.assert_array_equal(seen[3], golden)


def test_confidence_follows_its_definition(golden: Float32) -> None:
    full = cloud(golden)
    assert confidence(0.9, 256, full) == pytest.approx(0.9)
    assert confidence(0.9, 64, full) == pytest.approx(0.45)
    assert confidence(0.9, 2048, cloud(golden, frames=15)) == pytest.approx(0.45)
    assert confidence(0.9, 2048, cloud(golden, frames=600)) == pytest.approx(0.9)
    assert confidence(0.9, 2048, cloud(golden, complete=False)) == pytest.approx(0.72)
    assert confidence(1.0001, 2048, full) == 1.0


def test_class_is_unknown_below_the_least_confidence(tmp_path: Path, golden: Float32) -> None:
    """Of a manifest without a calibrated confidence: points and frames set it."""
    known = framed(tmp_path, "line_of_sight").complete(cloud(golden))
    assert known is not None
    strict = CompletionModel.load(tmp_path, replace(SETTINGS, min_confidence=0.99 * known.confidence))
    sure, unsure = strict.complete(cloud(golden)), strict.complete(cloud(golden, frames=30))
    assert sure is not None
    assert unsure is not None
    assert (sure.class_name, unsure.class_name) == (known.class_name, "unknown")
    assert unsure.class_probability == sure.class_probability


def test_not_finite_clouds_and_answers_are_withheld(model: CompletionModel, golden: Float32) -> None:
    broken = golden.copy()
    broken[3, 1] = np.nan
    with pytest.raises(ModelError, match="object 7: its points are not finite"):
        model.complete(cloud(broken))
    with pytest.raises(ModelError, match="object 7: its points are not finite and within 1000 m"):
        model.complete(cloud(golden * np.float32(1e38)))
    run = model.run
    model.run = lambda points: run(points)._replace(coarse_m=np.full((1024, 3), np.inf, np.float32))  # type: ignore[method-assign]
    try:
        with pytest.raises(ModelError, match="answer is not finite"):
            model.complete(cloud(golden))
    finally:
        del model.run


def test_the_rig_must_be_one_of_the_manifest(model: CompletionModel) -> None:
    assert model.valid_for("cascade_demo")
    assert not model.valid_for("awr1843_pair")
    with pytest.raises(ModelError, match="awr1843_pair") as caught:
        CompletionModel.load(SHIPPED, SETTINGS, rig_name="awr1843_pair")
    assert "cascade_pair" in caught.value.allowed


@pytest.mark.parametrize(("low", "high"), [(32, 2048), (64, 4096)])
def test_settings_may_not_widen_what_was_trained(low: int, high: int) -> None:
    with pytest.raises(ConfigError, match=r"64\.\.2048"):
        CompletionModel.load(SHIPPED, replace(SETTINGS, min_points=low, max_points=high))


@pytest.mark.parametrize(
    "values", [{"min_points": 0}, {"max_points": 8}, {"intra_op_threads": 0}, {"min_confidence": 2}]
)
def test_settings_are_checked(values: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(values))):
        replace(SETTINGS, **values)  # type: ignore[arg-type]


@pytest.mark.parametrize("file", ["model.onnx", "model.int8.onnx"])
def test_wrong_weights_with_a_right_hash_are_refused(tmp_path: Path, file: str) -> None:
    content = bytearray((SHIPPED / file).read_bytes())
    middle = len(content) // 2
    content[middle : middle + 200_000] = content[middle : middle + 200_000][::-1]
    with pytest.raises(ModelError, match=r"known input|known answer|cannot load|failed|another graph") as caught:
        CompletionModel.load(resigned(tmp_path, file, bytes(content)), SETTINGS, file=file)
    assert caught.value.exit_code == 6


def test_measured_and_allowed_difference_are_named(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    with np.load(SHIPPED / "golden.npz") as stored:
        answers = dict(stored)
    answers["model.onnx:coarse"][5, 2] += np.float32(0.25)
    np.savez(tmp_path / "golden.npz", **answers)
    assert CompletionModel.load(tmp_path, SETTINGS, file="model.int8.onnx").file == "model.int8.onnx"
    with pytest.raises(ModelError, match="coarse of the known input") as caught:
        CompletionModel.load(tmp_path, SETTINGS, file="model.onnx")
    assert caught.value.value == "0.25 m"
    assert caught.value.allowed == f"at most {read_manifest(SHIPPED).tolerance_m['model.onnx']:.3g} m"


@pytest.mark.parametrize("content", [b"", b"PK\x05\x06" + bytes(18), b"\x93NUMPY\x01\x00"])
def test_no_known_answer_is_a_refusal(tmp_path: Path, content: bytes) -> None:
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    (tmp_path / "golden.npz").write_bytes(content)
    with pytest.raises(ModelError, match=r"golden\.npz"):
        CompletionModel.load(tmp_path, SETTINGS)


def test_no_onnx_file_is_a_refusal(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="cannot load"):
        CompletionModel.load(resigned(tmp_path, "model.int8.onnx", b"no protobuf"), SETTINGS, file="model.int8.onnx")
    with pytest.raises(ModelError, match="no such model file"):
        CompletionModel.load(SHIPPED, SETTINGS, file="other.onnx")


def test_nothing_is_written_beside_the_model(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    before = sorted(path.name for path in tmp_path.iterdir())
    CompletionModel.load(tmp_path, SETTINGS)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_an_int8_file_that_fails_is_replaced_by_the_fp32_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As after weights were altered in place."""
    content = bytearray((SHIPPED / "model.int8.onnx").read_bytes())
    at = content.index(numpy_helper.to_array(weight("rebuild2.w_code")).tobytes())
    content[at : at + 4000] = content[at : at + 4000][::-1]
    folder = resigned(tmp_path, "model.int8.onnx", bytes(content))
    fallen = CompletionModel.load(folder, SETTINGS)
    assert fallen.file == "model.onnx"
    assert "known input differs" in fallen.fallback
    assert "model.onnx runs instead" in caplog.text
    with pytest.raises(ModelError, match="known input differs"):
        CompletionModel.load(folder, SETTINGS, file="model.int8.onnx")
    assert CompletionModel.load(SHIPPED, SETTINGS).fallback == ""


def weight(name: str) -> onnx.TensorProto:
    """A constant of the shipped int8 file."""
    return next(one for one in onnx.load(SHIPPED / "model.int8.onnx").graph.initializer if one.name == name)


def test_when_no_file_gives_its_known_answer_nothing_runs(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    with np.load(SHIPPED / "golden.npz") as stored:
        answers = dict(stored)
    for name in ("model.onnx:fine", "model.int8.onnx:fine"):
        answers[name] = answers[name] + np.float32(0.1)
    np.savez(tmp_path / "golden.npz", **answers)
    with pytest.raises(ModelError, match=r"model\.onnx: fine of the known input"):
        CompletionModel.load(tmp_path, SETTINGS)


def test_the_self_test_notices_a_processor_on_which_eight_bits_saturate(tmp_path: Path) -> None:
    """The file's product of the largest codes, given the number that sums of two products in 16 bits would make."""
    whole = onnx.load(SHIPPED / "model.int8.onnx")
    right = network.Network((SHIPPED / "model.int8.onnx").read_bytes(), "int8").constant(PROBE)
    assert (right == PROBE_SUM).all()
    cut = np.clip(2 * 255 * 127, -(2**15), 2**15 - 1) * PROBE_DEPTH // 2
    assert cut < PROBE_SUM
    probe = next(node for node in whole.graph.node if node.output[0] == PROBE)
    whole.graph.initializer.append(numpy_helper.from_array(np.full_like(right, cut), "saturated"))
    probe.CopyFrom(onnx.helper.make_node("Identity", ["saturated"], [PROBE]))
    folder = resigned(tmp_path, "model.int8.onnx", whole.SerializeToString())
    model = CompletionModel.load(folder, SETTINGS)
    assert model.file == "model.onnx"
    assert "eight-bit products saturate" in model.fallback


def test_a_calibrated_confidence_is_taken_from_the_manifest(tmp_path: Path, golden: Float32) -> None:
    """A constant logistic model: ln 4 is a chance of 0.8, of a road user in all cases."""
    heads = {"shape": (math.log(4), 0.0), "class": (math.log(9), 0.0), "known": (30.0,)}
    for below, expected in ((0.85, False), (0.95, True)):
        trust = ConfidenceModel(("points",), (0.0,), (1.0,), heads, below, 0.15)
        shape = framed(tmp_path / str(below), "line_of_sight", trust).complete(cloud(golden, frames=20))
        assert shape is not None
        assert shape.confidence == pytest.approx(0.8)
        assert (shape.class_name == "unknown") is expected


def test_a_model_of_the_box_frame_completes_only_where_the_box_is_known(tmp_path: Path, golden: Float32) -> None:
    model = framed(tmp_path, "box")
    with pytest.raises(ModelError, match="no box is known"):
        model.complete(cloud(golden))
    assert model.run(golden).fine_m.shape == (16384, 3)


def test_a_network_without_a_classifier_publishes_unknown(tmp_path: Path, golden: Float32) -> None:
    whole = onnx.load(SHIPPED / "model.onnx")
    loop = next(node for node in whole.graph.node if node.op_type == "Loop")
    body, name = loop.attribute[0].g, "class_probability"
    at = [one.name for one in body.output].index(f"{name}_of_one")
    del body.output[at], loop.output[at - 1], whole.graph.output[[o.name for o in whole.graph.output].index(name)]
    folder = resigned(tmp_path, "model.onnx", whole.SerializeToString())
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest |= {"classes": [], "default_file": "model.onnx", "confidence": None}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with np.load(SHIPPED / "golden.npz") as stored:
        answers = dict(stored)
    answers[f"model.onnx:{name}"] = np.empty(0, np.float32)
    np.savez(folder / "golden.npz", **answers)
    shape = CompletionModel.load(folder, SETTINGS).complete(cloud(golden))
    assert shape is not None
    assert shape.class_name == "unknown"
    assert shape.class_probability == {"unknown": 1.0}
    assert shape.confidence == 1.0


def test_counts_that_do_not_fit_the_points_are_refused(model: CompletionModel, golden: Float32) -> None:
    for counts in ([], [0, len(golden)], [len(golden) - 1]):
        with pytest.raises(ModelError, match="counts do not fit"):
            model.run_all(golden, counts)
    both = model.run_all(np.concatenate([golden, golden[:100]]), [len(golden), 100])
    np.testing.assert_array_equal(both.fine_m[0], model.run(golden).fine_m)
    np.testing.assert_array_equal(both.fine_m[1], model.run(golden[:100]).fine_m)
