# SPDX-License-Identifier: Apache-2.0
"""Names of objects: text and back, the same object every time, splits and credits of what is varied."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_object_library import write_library

from train.objects.library import SPLITS, read_manifest
from train.objects.mesh import CLASSES, ClassName, MeshError
from train.objects.parametric import generate
from train.objects.reference import ObjectRef, library_refs


@given(
    st.sampled_from(CLASSES),
    st.text("abcXYZ0189_-.", min_size=1, max_size=20),
    st.none() | st.integers(0, 10**12),
)
def test_text_and_back(class_name: ClassName, name: str, seed: int | None) -> None:
    ref = ObjectRef(class_name, name, seed)
    assert ObjectRef.from_text(ref.to_text()) == ref
    assert pickle.loads(pickle.dumps(ref)) == ref
    assert str(ref) == ref.to_text()
    assert ref.label == CLASSES.index(class_name)


@pytest.mark.parametrize("text", ["car", "tram/x", "car/", "car/a b", "car/a+b", "car/a+-1", "car/a/b", "/x", "car/x+"])
def test_other_text_is_refused(text: str) -> None:
    with pytest.raises(MeshError):
        ObjectRef.from_text(text)


def test_a_name_that_would_not_survive_the_text_is_refused() -> None:
    for name, seed in (("a+1", None), ("a/b", None), ("", None), ("a", -1)):
        with pytest.raises(MeshError):
            ObjectRef("car", name, seed)


def test_parametric_objects_need_no_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RFCONSTRUCT_DATA", str(tmp_path))
    for number, class_name in enumerate(CLASSES):
        ref = ObjectRef.from_text(f"{class_name}/parametric_0001{number}")
        mesh = ref.mesh()
        np.testing.assert_array_equal(mesh.vertices, generate(class_name, 10 + number).vertices)
        assert mesh.object_id == ref.to_text()
        assert mesh.label == ref.label
        assert ref.split == SPLITS[(10 + number) % 3]
        assert (ref.source_group, ref.licence) == ("own", "Apache-2.0")
    assert library_refs() == []
    for text in ("car/somebody", "pedestrian/human_00001"):
        with pytest.raises(MeshError, match="no object library"):
            ObjectRef.from_text(text).mesh()


def test_a_seed_varies_the_object_the_same_way_each_time() -> None:
    base = ObjectRef("car", "parametric_00003")
    varied = [ObjectRef("car", "parametric_00003", seed).mesh() for seed in (1, 1, 2)]
    np.testing.assert_array_equal(varied[0].vertices, varied[1].vertices)
    assert not np.allclose(varied[0].vertices, varied[2].vertices)
    assert not np.allclose(varied[0].vertices, base.mesh().vertices)
    np.testing.assert_array_equal(varied[0].faces, base.mesh().faces)
    assert varied[0].object_id == "car/parametric_00003+1"
    assert varied[0].vertices[:, 2].min() == 0
    assert ObjectRef("car", "parametric_00003", 1).split == base.split


def test_library_objects_carry_split_group_and_credits(tmp_path: Path) -> None:
    write_library(tmp_path, [("car", "a", "A", "someone"), ("bicycle", "b", "P", "generator")])
    refs = library_refs(tmp_path)
    assert [r.to_text() for r in refs] == ["car/a", "bicycle/b"]
    assert refs[0].mesh(tmp_path).source_group == "someone"
    assert refs[0].mesh_origin(tmp_path) == ("someone", "CC0-1.0", "nobody")
    assert refs[1].entry(tmp_path).split == "train"
    with pytest.raises(MeshError, match="no such object"):
        ObjectRef("car", "b").mesh(tmp_path)


def test_the_projects_library_is_found(object_data: Path) -> None:
    entries = {e.object_id: e for e in read_manifest(object_data)}
    refs = library_refs()
    assert [r.to_text() for r in refs] == list(entries)
    for ref in refs[::40]:
        entry = entries[ref.to_text()]
        assert (ref.split, ref.source_group, ref.licence, ref.attribution) == (
            entry.split, entry.source_group, entry.licence, entry.attribution,
        )  # fmt: skip
        np.testing.assert_array_equal(ref.mesh().faces, entry.load().faces)
    if (object_data / "human_model" / "mh_model.npz").is_file():
        person = ObjectRef("pedestrian", "human_00004")
        assert person.mesh().licence == person.licence == "CC0-1.0"
        with pytest.raises(MeshError, match="pedestrians"):
            ObjectRef("car", "human_00004").mesh()
