# SPDX-License-Identifier: Apache-2.0
"""Which files of a folder are meshes of which class: class folders, ShapeNet-like and CAESAR-like, or a class map."""

from __future__ import annotations

import csv
import re
import tomllib
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

from train.objects.mesh import CLASSES, ClassName, MeshError
from train.objects.readers import SUFFIXES

Layout = Literal["folders", "shapenet", "caesar"]
LAYOUTS: tuple[Layout, ...] = ("folders", "shapenet", "caesar")
SYNSETS: dict[str, ClassName] = {"02958343": "car", "02834778": "bicycle", "03790512": "motorcycle"}
"""WordNet offsets that name the folders of ShapeNetCore."""
TYPICAL_LENGTH_M: dict[ClassName, float] = {"car": 4.5, "bicycle": 1.75, "motorcycle": 2.1}
"""Where a unit-normalised object comes without its size."""
_GENERIC = re.compile(r"model(_normalized)?|models|mesh|scene|untitled", re.IGNORECASE)
_GENERATED = re.compile(r"(parametric|human)_\d")
"""Names that objects made from a number have."""


@dataclass(frozen=True, slots=True)
class Found:
    """A mesh file of a class.

    Args:
        path: the file. class_name: its class. name: unique in its class, fit for a file name and an ObjectRef.
        group: the folder it lies in, below that of its class; its own name when it lies directly there.
        key: what sizes are looked up by: the ShapeNet identifier, else the name.
    """

    path: Path
    class_name: ClassName
    name: str
    group: str
    key: str


@dataclass(frozen=True)
class ClassMap:
    """A class map file and what else it fixes.

    Args:
        classes: folder name or glob of the path below the folder -> class; the first that fits wins.
        lengths_m: class -> length (height of a pedestrian) that its objects are scaled to.
        up, forward, unit: as on the command line; None = not fixed.
    """

    classes: dict[str, ClassName]
    lengths_m: dict[ClassName, float] = field(default_factory=dict)
    up: str | None = None
    forward: str | None = None
    unit: str | None = None


def read_class_map(path: Path) -> ClassMap:
    """Read a TOML file: ``[classes]`` pattern = class, and optionally ``[lengths_m]``, ``up``, ``forward``, ``unit``.

    Raises:
        MeshError: not TOML, an unknown key or class, a length that is not positive.
    """
    try:
        content: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise MeshError(f"{path.name}: not a class map ({error})", allowed="TOML with a table [classes]") from error
    unknown = set(content) - {"classes", "lengths_m", "up", "forward", "unit"}
    if unknown or not isinstance(content.get("classes"), dict):
        raise MeshError(f"{path.name}: not a class map", value=sorted(content), allowed="[classes], [lengths_m], ...")
    lengths = content.get("lengths_m", {})
    for name in [*content["classes"].values(), *lengths]:
        if name not in CLASSES:
            raise MeshError(f"{path.name}: unknown class", value=name, allowed=", ".join(CLASSES))
    for name, value in lengths.items():
        if not isinstance(value, int | float) or not value > 0:
            raise MeshError(f"{path.name}: lengths_m.{name}", value=value, allowed="> 0 m")
    return ClassMap(content["classes"], lengths, content.get("up"), content.get("forward"), content.get("unit"))


def find_meshes(root: Path, layout: Layout, classes: ClassMap | None = None) -> list[Found]:
    """Mesh files of a folder with their classes, sorted by path.

    Args:
        root: the folder.
        layout: "folders" and "shapenet" take the class from a folder's name (a class or a synset) or from the map;
            "caesar" takes every file for a person.
    Raises:
        MeshError: not a folder, no mesh in it, or two with one name.
    """
    if not root.is_dir():
        raise MeshError("no such folder", value=str(root))
    patterns: dict[str, ClassName] = {name: name for name in CLASSES} | SYNSETS
    patterns = (classes.classes | patterns) if classes else patterns
    found = []
    for path in sorted(p for p in root.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()):
        parts = path.relative_to(root).parts
        depth, class_name = (0, "pedestrian") if layout == "caesar" else _class_of(parts, patterns)
        if class_name is None or _is_spare(path, layout):
            continue
        inner = [*parts[depth:-1], path.stem]
        words = [word for word in inner if not _GENERIC.fullmatch(word)] or [inner[-1]]
        name = re.sub(r"[^\w.-]+", "_", "_".join(words))
        name = f"file_{name}" if _GENERATED.match(name) else name
        folders = [word for word in inner[:-1] if not _GENERIC.fullmatch(word)]
        key = words[0] if layout == "shapenet" else name
        found.append(Found(path, class_name, name, "/".join(folders) or name, key))
    if not found:
        raise MeshError(
            "no meshes found",
            value=str(root),
            allowed=f"files {' '.join(SUFFIXES)} below folders named {', '.join(CLASSES)} or a ShapeNet synset",
            action="give --layout caesar for a folder of people, or a class map with --map",
        )
    _unique(found)
    return found


def read_sizes(path: Path) -> dict[str, float]:
    """True length (height of a person) in metres by name from a CSV file.

    Columns ``name`` and ``length_m``, or ShapeNetSem's ``fullId`` and ``aligned.dims`` (centimetres ``x\\,y\\,z``, of
    which the largest is taken).

    Raises:
        MeshError: other columns or not a number.
    """
    sizes: dict[str, float] = {}
    with path.open(newline="", encoding="utf-8") as lines:
        for row in csv.DictReader(lines):
            try:
                if "length_m" in row:
                    sizes[row["name"]] = float(row["length_m"])
                elif row["aligned.dims"]:
                    numbers = [float(word) for word in re.split(r"[\\,\s]+", row["aligned.dims"]) if word]
                    sizes[row["fullId"].split(".")[-1]] = max(numbers) / 100
            except (KeyError, ValueError, TypeError) as error:
                raise MeshError(
                    f"{path.name}: bad line", value=dict(row), allowed="name,length_m or fullId,aligned.dims"
                ) from error
    return sizes


def _class_of(parts: tuple[str, ...], patterns: dict[str, ClassName]) -> tuple[int, ClassName | None]:
    """Class of a path and how many of its parts belong to the class's folder."""
    for pattern, class_name in patterns.items():
        for depth, part in enumerate(parts[:-1]):
            if part == pattern:
                return depth + 1, class_name
        if fnmatchcase("/".join(parts), pattern):
            fixed = pattern.split("/")
            depth = next((k for k, word in enumerate(fixed) if any(c in word for c in "*?[")), len(fixed))
            return min(depth, len(parts) - 1), class_name
    return 0, None


def _is_spare(path: Path, layout: Layout) -> bool:
    """ShapeNet stores voxelised variants beside the normalised model; only the latter is read."""
    return layout == "shapenet" and path.stem != "model_normalized" and path.with_name("model_normalized.obj").is_file()


def _unique(found: list[Found]) -> None:
    names: dict[tuple[str, str], Path] = {}
    for one in found:
        first = names.setdefault((one.class_name, one.name.lower()), one.path)
        if first != one.path:
            raise MeshError(f"two meshes would be {one.class_name}/{one.name}", value=f"{first}, {one.path}")
