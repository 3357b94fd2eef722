# SPDX-License-Identifier: Apache-2.0
"""The manifest reader: every key strict, every refusal named, every altered file refused."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.completion.confidence import ConfidenceModel
from edge.completion.manifest import find_model, read_files, read_manifest
from edge.errors import ExitCode, ModelError
from edge.resources import shipped_dir

HEADS = {"shape": (0.5, 1.0), "class": (0.5, 1.0), "known": (0.5,)}
SHIPPED = shipped_dir("models") / "default"
CONTENT: dict[str, Any] = json.loads((SHIPPED / "manifest.json").read_text())


def write(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A folder whose manifest is the shipped one after ``change``."""
    content = copy.deepcopy(CONTENT)
    change(content)
    (folder / "manifest.json").write_text(json.dumps(content))
    return folder


def test_a_manifest_without_classes_or_with_a_confidence_is_read(tmp_path: Path) -> None:
    trust = ConfidenceModel(("points",), (0.0,), (1.0,), HEADS, 0.6, 0.15)
    manifest = read_manifest(write(tmp_path, lambda c: c.update(classes=[], confidence=trust.to_dict())))
    assert manifest.classes == ()
    assert manifest.confidence == trust
    with pytest.raises(ModelError, match="confidence"):
        read_manifest(write(tmp_path, lambda c: c.update(confidence={"names": []})))


def test_shipped_manifest_is_read() -> None:
    manifest = read_manifest(SHIPPED)
    assert manifest.classes == ("car", "bicycle", "motorcycle", "pedestrian")
    assert (manifest.min_points, manifest.max_points) == (64, 2048)
    assert (manifest.coarse_points, manifest.fine_points) == (256, 16384)
    assert {"cascade_pair", "cascade_pair_fine", "cascade_demo"} <= set(manifest.rigs)
    assert manifest.tolerance_m == CONTENT["golden"]["tolerance_m"]
    assert manifest.input_frame == CONTENT["input"]["frame"]
    assert set(read_files(SHIPPED, manifest)) == {"model.onnx", "model.int8.onnx"}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda c: c.update(extra=1), "unknown key extra"),
        (lambda c: c.pop("rigs"), "missing key rigs"),
        (lambda c: c["input"].update(points=1), "unknown key input.points"),
        (lambda c: c["golden"].pop("tolerance_m"), "missing key golden.tolerance_m"),
        (lambda c: c["files"][0].pop("sha256"), "missing key files.sha256"),
        (lambda c: c.update(schema=1), "schema"),
        (lambda c: c.update(classes="car"), "key classes"),
        (lambda c: c.update(classes=["car", "car"]), "classes"),
        (lambda c: c.update(classes=["Car/1"]), "classes"),
        (lambda c: c["files"].append(c["files"][0]), "files.file"),
        (lambda c: c.update(rigs=[{}]), "classes and rigs"),
        (lambda c: c["input"].update(min_points=True), "key input.min_points"),
        (lambda c: c["input"].update(min_points=4096), "input and output"),
        (lambda c: c.update(default_file="other.onnx"), "default_file"),
        (lambda c: c["files"][0].update(file="../model.onnx"), "file name"),
        (lambda c: c["files"][0].update(sha256="0" * 63), "files.sha256"),
        (lambda c: c["files"][0].update(bytes=2**40), "files.bytes"),
        (lambda c: c["input"].update(frame="odom"), "input.frame"),
        (lambda c: c["input"].update(columns=5), "input.columns"),
        (lambda c: c.update(confidence=0.5), "key confidence"),
        (lambda c: c["golden"]["tolerance_m"].pop("model.onnx"), "golden.tolerance_m"),
        (lambda c: c["golden"]["tolerance_m"].update({"model.onnx": float("nan")}), "golden.tolerance_m"),
    ],
)
def test_contradiction_is_named(tmp_path: Path, change: Callable[[dict[str, Any]], object], named: str) -> None:
    with pytest.raises(ModelError, match=r"manifest\.json") as caught:
        read_manifest(write(tmp_path, change))
    assert named in caught.value.what
    assert caught.value.exit_code == ExitCode.BAD_MODEL == 6


@pytest.mark.parametrize("text", ["", "[]", "null", "{", '{"schema": 2}', "[" * 100_000, "\udcff"])
def test_no_manifest_at_all(tmp_path: Path, text: str) -> None:
    (tmp_path / "manifest.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ModelError):
        read_manifest(tmp_path)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None)
@given(key=st.sampled_from(sorted(CONTENT)), value=VALUES)
def test_any_value_of_any_key_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, key: str, value: object
) -> None:
    folder = write(tmp_path_factory.getbasetemp(), lambda content: content.update({key: value}))
    try:
        manifest = read_manifest(folder)
    except ModelError:
        return
    assert manifest.min_points <= manifest.max_points


def test_every_altered_bit_and_length_is_refused(tmp_path: Path) -> None:
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    manifest, rng = read_manifest(tmp_path), np.random.default_rng(0)
    for _ in range(25):
        for name in manifest.files:
            path = tmp_path / name
            original = path.read_bytes()
            altered = bytearray(original)
            altered[int(rng.integers(len(altered)))] ^= 1 << int(rng.integers(8))
            path.write_bytes(altered)
            with pytest.raises(ModelError, match="SHA-256"):
                read_files(tmp_path, manifest)
            path.write_bytes(original)
    (tmp_path / "model.onnx").write_bytes(b"")
    with pytest.raises(ModelError, match="wrong size"):
        read_files(tmp_path, manifest)
    (tmp_path / "model.onnx").unlink()
    with pytest.raises(ModelError, match=r"model\.onnx: unreadable"):
        read_files(tmp_path, manifest)


def test_a_model_is_found_by_name_or_path() -> None:
    assert find_model("default") == find_model(str(SHIPPED)) == SHIPPED
    with pytest.raises(ModelError, match="default"):
        find_model("none_of_this_name")
