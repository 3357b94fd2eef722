# SPDX-License-Identifier: Apache-2.0
"""The recipe of a data set: how many objects of which class and origin, and how their clouds are made."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from edge.config import require
from edge.errors import ConfigError
from edge.rig_toml import Place, fill, merged, read_toml, require_known, subtable
from train.objects.mesh import CLASSES, ClassName
from train.perturb_settings import PerturbSettings
from train.simulate.randomise import Ranges

RECIPES = Path(__file__).parent / "recipes"


@dataclass(frozen=True, slots=True)
class ClassSettings:
    """One class of a data set.

    Args:
        weight: objects of this class, relative to the other classes' weights.
        collected, procedural, generated: shares of the training objects that are collected meshes of the library,
            procedural ones of the library, and made by this project's generators; the share of an origin that has no
            object here goes to the others.
        ridden: chance of a rider on a library object; two-wheelers only (generated ones have their own riders).
    Raises:
        ConfigError: a negative number, or nothing but zeros.
    """

    weight: float
    collected: float
    procedural: float
    generated: float
    ridden: float = 0.0

    def __post_init__(self) -> None:
        for one in fields(self):
            require(getattr(self, one.name) >= 0, f"class.{one.name}", getattr(self, one.name), ">= 0")
        total = self.collected + self.procedural + self.generated
        require(total > 0, "class.collected, procedural, generated", total, "a sum > 0")
        require(self.ridden <= 1, "class.ridden", self.ridden, "0..1")


@dataclass(frozen=True, slots=True)
class ClassMix:
    """Weights and origins of the classes; default weights are the paper's 1697 cars, 396 two-wheelers, 480 people."""

    car: ClassSettings = ClassSettings(1697, 0.75, 0.0, 0.25)
    bicycle: ClassSettings = ClassSettings(198, 0.45, 0.35, 0.2, ridden=0.3)
    motorcycle: ClassSettings = ClassSettings(198, 0.45, 0.35, 0.2, ridden=0.3)
    pedestrian: ClassSettings = ClassSettings(480, 0.75, 0.0, 0.25)

    def __post_init__(self) -> None:
        total = sum(self.of(name).weight for name in CLASSES)
        require(total > 0, "classes: weight", total, "at least one class with a weight > 0")
        for name in ("car", "pedestrian"):
            require(self.of(name).ridden == 0, f"classes.{name}.ridden", self.of(name).ridden, "0")

    def of(self, name: ClassName) -> ClassSettings:
        """Settings of a class."""
        settings: ClassSettings = getattr(self, name)
        return settings

    def counts(self, objects: int) -> dict[ClassName, int]:
        """``objects`` shared out by weight (largest remainders, earlier classes first)."""
        weights = {name: self.of(name).weight for name in CLASSES}
        exact = {name: objects * weight / sum(weights.values()) for name, weight in weights.items()}
        counts = {name: int(share) for name, share in exact.items()}
        order = sorted(CLASSES, key=lambda name: counts[name] - exact[name])
        for name in order[: objects - sum(counts.values())]:
            counts[name] += 1
        return counts


@dataclass(frozen=True, slots=True)
class SetSettings:
    """Size of a data set.

    Args:
        objects: distinct objects (variations of a mesh count as objects).
        drive_bys, perturbed: clouds of every object, simulated by the radar and perturbed geometry.
        val_share, test_share: of every class's objects; they come from source groups that no other split uses.
        min_points: a perturbed scan with fewer is drawn again, 16 times at most.
    Raises:
        ConfigError: a number outside its range.
    """

    objects: int = 2573
    drive_bys: int = 8
    perturbed: int = 8
    val_share: float = 0.1
    test_share: float = 0.1
    min_points: int = 64

    def __post_init__(self) -> None:
        require(self.objects >= 1, "set.objects", self.objects, ">= 1")
        enough = self.drive_bys >= 0 and self.perturbed >= 0 and self.drive_bys + self.perturbed >= 1
        require(enough, "set.drive_bys, set.perturbed", (self.drive_bys, self.perturbed), ">= 0, one of them >= 1")
        held = self.val_share >= 0 and self.test_share >= 0 and self.val_share + self.test_share <= 1
        require(held, "set.val_share, set.test_share", (self.val_share, self.test_share), ">= 0, together <= 1")


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """How the simulated clouds are made, see ``cloud.DriveSpec``.

    Args:
        rig: name or folder of the rig.
        every: only each n-th frame is made.
        ranges: from which the settings of every drive-by are drawn.
    Raises:
        ConfigError: a number outside its range.
    """

    rig: str = "cascade_demo"
    every: int = 3
    ranges: Ranges = field(default_factory=Ranges)

    def __post_init__(self) -> None:
        require(self.every >= 1, "drive.every", self.every, ">= 1")


@dataclass(frozen=True, slots=True)
class Recipe:
    """Everything but the seed and the library that decides what a data set holds.

    Args:
        set: size.
        classes: mix and origins.
        drive: of the simulated drive-bys.
        perturb: of the perturbed scans.
        text: the file it was read from.
    """

    set: SetSettings = field(default_factory=SetSettings)
    classes: ClassMix = field(default_factory=ClassMix)
    drive: DriveSettings = field(default_factory=DriveSettings)
    perturb: PerturbSettings = field(default_factory=PerturbSettings)
    text: str = field(default="", compare=False)

    @property
    def sha256(self) -> str:
        """Of all values, those left at their default included; the text of the file does not count."""
        return digest(self.settings)

    @property
    def settings(self) -> dict[str, Any]:
        """All values as JSON has them."""
        settings: dict[str, Any] = _plain({name: value for name, value in asdict(self).items() if name != "text"})
        return settings

    def resized(self, **sizes: int | None) -> Recipe:
        """Another size: fields of ``SetSettings``; None leaves a value as it is."""
        given = {name: value for name, value in sizes.items() if value is not None}
        return replace(self, set=replace(self.set, **given))


def differences(here: dict[str, Any], there: dict[str, Any]) -> list[str]:
    """``key = value here (value there)`` for every value of two recipes' settings that differs."""
    one, other = dict(_flat("", here)), dict(_flat("", there))
    keys = [key for key in sorted(one | other) if one.get(key) != other.get(key)]
    return [f"{key} = {one.get(key)} ({other.get(key)})" for key in keys]


def digest(value: object) -> str:
    """SHA-256, as hex, of a value's canonical JSON, in which 1 and 1.0 are the same."""
    return hashlib.sha256(json.dumps(_plain(value), sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _flat(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _flat(f"{key}.{name}" if key else name, inner)
    else:
        yield key, value


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def known_recipes() -> list[str]:
    """Names of the recipes that come with the software."""
    return sorted(path.stem for path in RECIPES.glob("*.toml"))


def load_recipe(name_or_path: str) -> Recipe:
    """A recipe that came with the software, or a file.

    Raises:
        ConfigError: no such recipe, or a key or value that cannot work; file and key are named.
    """
    path = Path(name_or_path)
    if name_or_path in known_recipes():
        path = RECIPES / f"{name_or_path}.toml"
    elif path.suffix != ".toml":
        raise ConfigError("no such recipe", value=name_or_path, allowed=f"{', '.join(known_recipes())} or a .toml file")
    place = Place(path)
    table = read_toml(path)
    require_known(table, [one.name for one in fields(Recipe) if one.name != "text"], place)
    defaults: dict[str, Any] = {name: asdict(ClassMix().of(name)) for name in CLASSES}
    classes = merged(defaults, subtable(table, "classes", place))
    return Recipe(
        fill(SetSettings, subtable(table, "set", place), place.at("set")),
        fill(ClassMix, classes, place.at("classes")),
        fill(DriveSettings, subtable(table, "drive", place), place.at("drive")),
        fill(PerturbSettings, subtable(table, "perturb", place), place.at("perturb")),
        path.read_text(encoding="utf-8"),
    )
