# SPDX-License-Identifier: Apache-2.0
"""Names of objects as text: collected or parametric, as it is or deformed; the same text is always the same object.

``car/akdan_audi_sedan``      an object of the library
``car/parametric_00012``      parametric object number 12 of its class, needs no files
``pedestrian/human_00012``    person number 12 of the human model in the library's ``human_model/mh_model.npz``
``bicycle/dcl_city@rider3``   a two-wheeler with rider number 3, the project's own body
``bicycle/dcl_city@human3``   the same with a rider of the human model
``car/akdan_audi_sedan+7``    any of them, varied by ``train.objects.deform`` from seed 7, rider and machine as one
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from train.objects.contacts import find_contacts
from train.objects.deform import DeformSettings, vary
from train.objects.human import HUMAN_ORIGIN, HumanModel
from train.objects.human_rider import human_rider
from train.objects.library import SPLITS, Entry, Split, default_objects_dir, read_manifest
from train.objects.mesh import CLASSES, ClassName, Mesh, MeshError, stand
from train.objects.parametric import generate, two_wheeler
from train.objects.primitives import join
from train.objects.rider import own_rider

_NAME = re.compile(r"[^/+@\s]+")
_RIDER = re.compile(r"(rider|human)(\d+)")
_TEXT = re.compile(rf"(?P<class>[a-z]+)/(?P<name>{_NAME.pattern})(?:@(?P<rider>\w+))?(?:\+(?P<deform>\d+))?")
_GENERATED = re.compile(r"(parametric|human)_(\d+)")
_FORM = "<class>/<name>[@<rider>][+<seed>]"
RIDDEN = ("bicycle", "motorcycle")
HUMAN_FILE = Path("human_model") / "mh_model.npz"


@dataclass(frozen=True, slots=True)
class ObjectRef:
    """One object by name; hashable, small to send, and readable in an index.

    Args:
        class_name: one of CLASSES.
        name: of a library object, ``parametric_<number>`` or ``human_<number>``.
        deform_seed: seed of the variation, None = the object as it is.
        rider: ``rider<number>`` or ``human<number>``, put on a two-wheeler; None = the object as it is (a parametric
            two-wheeler then has a rider or not, as its own number says).
    Raises:
        MeshError: no such class, a name with / + @ or white space, a negative seed, or a rider on what is not ridden.
    """

    class_name: ClassName
    name: str
    deform_seed: int | None = None
    rider: str | None = None

    def __post_init__(self) -> None:
        if self.class_name not in CLASSES or not _NAME.fullmatch(self.name) or (self.deform_seed or 0) < 0:
            raise MeshError(
                "not the name of an object",
                value=self.to_text(),
                allowed=f"{_FORM}, class one of {', '.join(CLASSES)}",
            )
        if self.rider is not None and (self.class_name not in RIDDEN or not _RIDER.fullmatch(self.rider)):
            raise MeshError("no such rider", value=self.to_text(), allowed="@rider<n> or @human<n> on a two-wheeler")

    @classmethod
    def from_text(cls, text: str) -> ObjectRef:
        """Read the text form.

        Raises:
            MeshError: not of the form ``<class>/<name>[@<rider>][+<seed>]``.
        """
        match = _TEXT.fullmatch(text)
        if match is None:
            raise MeshError("not the name of an object", value=text, allowed=_FORM)
        deform = None if match["deform"] is None else int(match["deform"])
        return cls(match["class"], match["name"], deform, match["rider"])  # type: ignore[arg-type]

    def to_text(self) -> str:
        """``<class>/<name>[@<rider>][+<seed>]``."""
        rider = "" if self.rider is None else f"@{self.rider}"
        deform = "" if self.deform_seed is None else f"+{self.deform_seed}"
        return f"{self.class_name}/{self.name}{rider}{deform}"

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
        base = self._bare(objects_dir) if self.rider is None else self._ridden(objects_dir)
        if self.deform_seed is not None:
            seeds = [self.deform_seed, zlib.crc32(self.undeformed.to_text().encode())]
            base = vary(base, settings or DeformSettings(), np.random.default_rng(seeds))
        return replace(base, object_id=self.to_text())

    def _bare(self, objects_dir: Path | None) -> Mesh:
        if self.generated is None:
            return self.entry(objects_dir).load()
        if self.generated[0] == "parametric":
            return generate(self.class_name, self.generated[1])
        if self.class_name == "pedestrian":
            return _human(objects_dir).person(self.generated[1])
        raise MeshError("people of the human model are pedestrians", value=self.to_text())

    def _ridden(self, objects_dir: Path | None) -> Mesh:
        """The machine with its rider, not yet deformed."""
        if self.generated and self.generated[0] == "parametric":
            base = generate(self.class_name, self.generated[1], rider=False)
            parts, contacts = two_wheeler(self.class_name, self.generated[1])
        else:
            base = self._bare(objects_dir)
            parts, contacts = [(base.vertices.astype(np.float64), base.faces.astype(np.int64))], find_contacts(base)
        kind, number = _RIDER.fullmatch(self.rider or "").groups()  # type: ignore[union-attr]
        rng = np.random.default_rng([int(number), zlib.crc32(f"{self.class_name}/{self.name}".encode())])
        body = human_rider(_human(objects_dir), contacts, rng) if kind == "human" else own_rider(contacts, rng)
        vertices, faces = join([*parts, *body])
        return replace(base, vertices=stand(vertices), faces=faces)


def library_refs(objects_dir: Path | None = None) -> list[ObjectRef]:
    """Every object of the library in the order of its manifest; empty when there is no library here."""
    folder = objects_dir or default_objects_dir()
    return [ObjectRef(CLASSES[e.label], e.name) for e in _entries(folder).values()] if folder else []


def _human(objects_dir: Path | None) -> HumanModel:
    return HumanModel.load((objects_dir or _library()) / HUMAN_FILE)


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
