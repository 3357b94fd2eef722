# SPDX-License-Identifier: Apache-2.0
"""The library reader and its splits."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from train.objects.library import COLUMNS, SPLITS, group_split, person_split, read_manifest
from train.objects.mesh import CLASSES, MeshError


def write_library(folder: Path, rows: list[tuple[str, str, str, str]]) -> None:
    """A library of tetrahedra; rows of (class, name, grade, group)."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]], np.int32)
    with (folder / "manifest.csv").open("w", newline="") as lines:
        writer = csv.writer(lines)
        writer.writerow(COLUMNS)
        for class_name, name, grade, group in rows:
            np.savez(folder / f"{name}.npz", vertices=vertices, faces=faces)
            writer.writerow((class_name, name, f"{name}.npz", "CC0-1.0", "nobody", grade, group))


def test_splits_are_disjoint_by_group_and_complete(object_data: Path) -> None:
    entries = read_manifest(object_data)
    groups: dict[str, set[str]] = {}
    for entry in entries:
        if entry.provenance != "P" and not entry.name.startswith("mh_"):
            groups.setdefault(entry.source_group, set()).add(entry.split)
    assert all(len(splits) == 1 for splits in groups.values())
    names = {split: {e.object_id for e in entries if e.split == split} for split in SPLITS}
    assert sum(len(n) for n in names.values()) == len(entries) == len(set().union(*names.values()))
    for split in SPLITS:
        for label in range(len(CLASSES)):
            real = [e for e in entries if e.split == split and e.label == label and e.provenance != "P"]
            assert len(real) >= 2, (split, CLASSES[label])
    assert all(e.split == "train" for e in entries if e.provenance == "P")


def test_every_object_is_true_to_scale_and_carries_its_licence(object_data: Path) -> None:
    lengths = {"car": (2.5, 6.2), "bicycle": (1.1, 2.4), "motorcycle": (1.6, 2.5), "pedestrian": (0.2, 1.6)}
    for entry in read_manifest(object_data)[::5]:
        mesh = entry.load()
        low, high = lengths[CLASSES[mesh.label]]
        assert low < mesh.size_m[0] < high, mesh.object_id
        assert mesh.vertices[:, 2].min() == pytest.approx(0, abs=0.01)
        assert mesh.licence


def test_split_of_a_group_does_not_depend_on_the_rest(tmp_path: Path) -> None:
    write_library(tmp_path, [("car", f"c{i}", "A", f"author{i % 20}") for i in range(40)])
    splits = {e.name: e.split for e in read_manifest(tmp_path)}
    write_library(tmp_path, [("car", f"c{i}", "A", f"author{i % 20}") for i in reversed(range(0, 40, 3))])
    again = {e.name: e.split for e in read_manifest(tmp_path)}
    assert all(splits[name] == split for name, split in again.items())
    assert {group_split(f"author{i}") for i in range(40)} == set(SPLITS)


def test_people_are_split_by_seed() -> None:
    assert [person_split(s) for s in (0, 95, 96, 107, 108, 119, 500)] == [
        "train", "train", "val", "val", "test", "test", "train",
    ]  # fmt: skip


def test_a_library_that_contradicts_itself_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="no manifest"):
        read_manifest(tmp_path)
    write_library(tmp_path, [("tram", "t", "A", "x")])
    with pytest.raises(MeshError, match="bad line"):
        read_manifest(tmp_path)
    write_library(tmp_path, [("car", "t", "A", "x")])
    (tmp_path / "t.npz").unlink()
    with pytest.raises(MeshError, match="not there"):
        read_manifest(tmp_path)
    write_library(tmp_path, [("car", "t", "A", "x")])
    np.savez(tmp_path / "t.npz", vertices=np.zeros((3, 3)))
    with pytest.raises(MeshError, match="unreadable"):
        read_manifest(tmp_path)[0].load()
