# SPDX-License-Identifier: Apache-2.0
"""Names of objects as text: collected or parametric, as it is or deformed; the same text is always the same object.

``car/akdan_audi_sedan``      an object of the library
``car/parametric_00012``      parametric object number 12 of its class, needs no files
``pedestrian/human_00012``    person number 12 of the human model in the library's ``human_model/mh_model.npz``
``car/akdan_audi_sedan+7``    any of them, varied by ``train.objects.deform`` from seed 7
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from train.objects.deform import DeformSettings, vary
from train.objects.human import HUMAN_ORIGIN, HumanModel
from train.objects.library import SPLITS, Entry, Split, default_objects_dir, read_manifest
from train.objects.mesh import CLASSES, ClassName, Mesh, MeshError
from train.objects.parametric import generate

_NAME = re.compile(r"[^/+@\s]+")
_TEXT = re.compile(rf"(?P<class>[a-z]+)/(?P<name>{_NAME.pattern})(?:\+(?P<deform>\d+))?")
_GENERATED = re.compile(r"(parametric|human)_(\d+)")
HUMAN_FILE = Path("human_model") / "mh_model.npz"


@dataclass(frozen=True, slots=True)
class ObjectRef:
    """One object by name; hashable, small to send, and readable in an index.

    Args:
        class_name: one of CLASSES.
        name: of a library object, ``parametric_<number>`` or ``human_<number>``.
        deform_seed: seed of the variation, None = the object as it is.
    Raises:
        MeshError: no such class, a name with / + @ or white space, or a negative seed.
    """

    class_name: ClassName
    name: str
    deform_seed: int | None = None

    def __post_init__(self) -> None:
        if self.class_name not in CLASSES or not _NAME.fullmatch(self.name) or (self.deform_seed or 0) < 0:
            raise MeshError(
                "not the name of an object",
                value=self.to_text(),
                allowed=f"<class>/<name>[+<seed>], class one of {', '.join(CLASSES)}",
            )

    @classmethod
    def from_text(cls, text: str) -> ObjectRef:
        """Read the text form.

        Raises:
            MeshError: not of the form ``<class>/<name>[+<seed>]``.
        """
        match = _TEXT.fullmatch(text)
        if match is None:
            raise MeshError("not the name of an object", value=text, allowed="<class>/<name>[+<seed>]")
        deform = match["deform"]
        return cls(match["class"], match["name"], None if deform is None else int(deform))  # type: ignore[arg-type]

    def to_text(self) -> str:
        """``<class>/<name>[+<seed>]``."""
        return f"{self.class_name}/{self.name}" + ("" if self.deform_seed is None else f"+{self.deform_seed}")

    __str__ = to_text

    @property
    def label(self) -> int:
        """Index into CLASSES."""
        return CLASSES.index(self.class_name)

    @property
    def undeformed(self) -> ObjectRef:
        """The object that is varied."""
        return replace(self, deform_seed=None)

    @property
    def generated(self) -> tuple[str, int] | None:
        """("parametric" or "human", number), or None for an object of the library."""
        match = _GENERATED.fullmatch(self.name)
        return (match[1], int(match[2])) if match else None

    @property
    def split(self) -> Split:
        """Split of the object that is varied: of its source group; generated ones by number modulo 3 (see SPLITS)."""
        return SPLITS[self.generated[1] % len(SPLITS)] if self.generated else self.entry().split

    @property
    def source_group(self) -> str:
        """Author or project; "own" for parametric objects."""
        return self.mesh_origin()[0]

    @property
    def licence(self) -> str:
        """Licence of the mesh and of what is made from it."""
        return self.mesh_origin()[1]

    @property
    def attribution(self) -> str:
        """What redistribution of a derived work owes."""
        return self.mesh_origin()[2]

    def mesh_origin(self, objects_dir: Path | None = None) -> tuple[str, str, str]:
        """Source group, licence and attribution, without reading the mesh."""
        if self.generated:
            return HUMAN_ORIGIN if self.generated[0] == "human" else ("own", "Apache-2.0", "")
        entry = self.entry(objects_dir)
        return entry.source_group, entry.licence, entry.attribution

    def entry(self, objects_dir: Path | None = None) -> Entry:
        """The object's line in the manifest.

        Args:
            objects_dir: library folder; None = the project's.
        Raises:
            MeshError: no library here, or no such object in it.
        """
        folder = objects_dir or _library()
        try:
            return _entries(folder)[f"{self.class_name}/{self.name}"]
        except KeyError:
            raise MeshError("no such object in the library", value=self.to_text(), allowed="see its manifest") from None

    def mesh(self, objects_dir: Path | None = None, settings: DeformSettings | None = None) -> Mesh:
        """The object, on the ground, centred; its ``object_id`` is the text form.

        Args:
            objects_dir: library folder; None = the project's.
            settings: how far a variation goes.
        Raises:
            MeshError: an object of the library that is not there or cannot be read.
        """
        if self.generated is None:
            base = self.entry(objects_dir).load()
        elif self.generated[0] == "parametric":
            base = generate(self.class_name, self.generated[1])
        elif self.class_name == "pedestrian":
            base = HumanModel.load((objects_dir or _library()) / HUMAN_FILE).person(self.generated[1])
        else:
            raise MeshError("people of the human model are pedestrians", value=self.to_text())
        if self.deform_seed is not None:
            seeds = [self.deform_seed, zlib.crc32(self.undeformed.to_text().encode())]
            base = vary(base, settings or DeformSettings(), np.random.default_rng(seeds))
        return replace(base, object_id=self.to_text())


def library_refs(objects_dir: Path | None = None) -> list[ObjectRef]:
    """Every object of the library in the order of its manifest; empty when there is no library here."""
    folder = objects_dir or default_objects_dir()
    return [ObjectRef(CLASSES[e.label], e.name) for e in _entries(folder).values()] if folder else []


def _library() -> Path:
    folder = default_objects_dir()
    if folder is None:
        raise MeshError(
            "no object library on this machine",
            action="set RFCONSTRUCT_DATA to the folder that holds objects/, or use parametric objects",
        )
    return folder


@lru_cache(maxsize=8)
def _entries(folder: Path) -> dict[str, Entry]:
    return {entry.object_id: entry for entry in read_manifest(folder)}
