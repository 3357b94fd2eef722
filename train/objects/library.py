# SPDX-License-Identifier: Apache-2.0
"""The library of collected meshes on disk: npz files with a manifest, split by author, licence carried along."""

from __future__ import annotations

import csv
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from edge.resources import data_dir
from train.objects.mesh import CLASSES, Mesh, MeshError

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")

COLUMNS = ("class", "name", "file", "licence", "attribution", "provenance_grade", "source_group")
"""Of the manifest; more are allowed."""
PROCEDURAL = "P"
_SPLIT_KEY = "split-26168"
"""Hashed together with the group's name; chosen once so that every class has collected objects in every split."""
_TEST_SHARE, _VAL_SHARE = 0.20, 0.15
_PERSON_BLOCKS: tuple[tuple[int, int, Split], ...] = ((0, 96, "train"), (96, 108, "val"), (108, 120, "test"))


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the manifest.

    Args:
        path: the npz file.
        label: index into CLASSES.
        name: name in its class.
        provenance: grade A, B, C or P (procedural).
        source_group: author or project.
        licence, attribution: as the manifest states them.
    """

    path: Path
    label: int
    name: str
    provenance: str
    source_group: str
    licence: str
    attribution: str

    @property
    def object_id(self) -> str:
        """``<class>/<name>``."""
        return f"{CLASSES[self.label]}/{self.name}"

    @property
    def split(self) -> Split:
        """Where the object belongs: procedural ones train; people by seed range; all others by their group."""
        if self.provenance == PROCEDURAL:
            return "train"
        person = re.match(r"mh_(\d+)_", self.name)
        return person_split(int(person[1])) if person else group_split(self.source_group)

    def load(self) -> Mesh:
        """Read the mesh.

        Raises:
            MeshError: the file is missing, lacks an array, or contradicts itself.
        """
        try:
            with np.load(self.path, allow_pickle=False) as archive:
                vertices = np.ascontiguousarray(archive["vertices"], dtype=np.float32)
                faces = np.ascontiguousarray(archive["faces"], dtype=np.int32)
        except (OSError, KeyError, ValueError) as error:
            raise MeshError(
                f"{self.path.name}: unreadable mesh ({error})",
                allowed="npz with float32 vertices [n, 3] and int32 faces [m, 3]",
                action="restore the file or remove its line from manifest.csv",
            ) from error
        return Mesh(
            vertices,
            faces,
            self.label,
            self.object_id,
            self.source_group,
            self.provenance,
            self.licence,
            self.attribution,
        )


def group_split(source_group: str) -> Split:
    """Split of an author or project: a hash of the name, so neither order nor additions to the library move it."""
    digest = hashlib.sha256(f"{_SPLIT_KEY}/{source_group}".encode()).digest()
    position = int.from_bytes(digest[:8], "big") / 2**64
    if position < _TEST_SHARE:
        return "test"
    return "val" if position < _TEST_SHARE + _VAL_SHARE else "train"


def person_split(seed: int) -> Split:
    """Split of a generated person by its seed: 0..95 train, 96..107 val, 108..119 test, later ones train."""
    for first, end, split in _PERSON_BLOCKS:
        if first <= seed < end:
            return split
    return "train"


def default_objects_dir() -> Path | None:
    """``objects`` of the project's data folder, or None when there is none on this machine."""
    folder = data_dir()
    objects = folder / "objects" if folder else None
    return objects if objects is not None and (objects / "manifest.csv").is_file() else None


def read_manifest(objects_dir: Path) -> list[Entry]:
    """All objects of a library folder, in the order of its manifest.

    Args:
        objects_dir: folder with ``manifest.csv`` (columns class, name, file, licence, attribution, provenance_grade,
            source_group) and the npz files it names.
    Raises:
        MeshError: no manifest, a missing column, an unknown class or a file that is not there.
    """
    manifest = objects_dir / "manifest.csv"
    if not manifest.is_file():
        raise MeshError("no manifest.csv in the object library", value=str(objects_dir), action="check --objects")
    entries = []
    with manifest.open(newline="", encoding="utf-8") as lines:
        for row in csv.DictReader(lines):
            try:
                entry = Entry(
                    path=objects_dir / row["file"],
                    label=CLASSES.index(row["class"]),
                    name=row["name"],
                    provenance=row["provenance_grade"],
                    source_group=row["source_group"],
                    licence=row["licence"],
                    attribution=row["attribution"],
                )
            except (KeyError, ValueError) as error:
                raise MeshError("manifest.csv: bad line", value=dict(row), allowed=f"classes {CLASSES}") from error
            if not entry.path.is_file():
                raise MeshError("manifest.csv names a file that is not there", value=str(entry.path))
            entries.append(entry)
    return entries
