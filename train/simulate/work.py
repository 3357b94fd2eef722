# SPDX-License-Identifier: Apache-2.0
"""The work list of a data set: objects, splits and seeds, all from the recipe, the seed and the library's names."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.rig_toml import Place, fill
from train.objects.human import HUMAN_ORIGIN
from train.objects.library import PROCEDURAL, SPLITS, Split, default_objects_dir
from train.objects.mesh import CLASSES, ClassName
from train.objects.reference import HUMAN_FILE, ObjectRef, library_refs
from train.simulate.recipe import Recipe, digest
from train.simulate.shards import KINDS, Kind

OBJECTS_PER_SHARD = 2
"""A shard is what a kill can cost: about half a minute of all cores, 16 drive-bys; its file has some 60 kB."""
_DEFORM_SEEDS = 1_000_000
_NUMBERS = 100_000
_PARAMETRIC_PEOPLE = 5
"""Every fifth generated person is parametric even where the human model is at hand."""


@dataclass(frozen=True, slots=True)
class Item:
    """One cloud to be made.

    Args:
        object: text form of an ObjectRef.
        kind: simulated drive-by or perturbed scan.
        variation: number of this cloud among those of its object and kind.
        seed: of every chance decision of this cloud; depends on the set's seed and the fields above only.
    """

    object: str
    kind: Kind
    variation: int
    seed: int


@dataclass(frozen=True, slots=True)
class Plan:
    """What a data set is to hold.

    Args:
        settings: of the recipe, as JSON has them; a set can be checked even when this software has others by now.
        text: of the recipe's file.
        seed: of the set.
        objects: text forms of the ObjectRefs, in the order of the work.
    """

    settings: dict[str, Any]
    text: str
    seed: int
    objects: tuple[str, ...]

    @classmethod
    def make(cls, recipe: Recipe, seed: int) -> Plan:
        """Choose the objects; with the same library the same recipe and seed give the same list everywhere."""
        return cls(recipe.settings, recipe.text, seed, tuple(ref.to_text() for ref in choose_objects(recipe, seed)))

    @property
    def identity(self) -> str:
        """Hash of recipe, seed and objects: shards of another identity do not belong to the set."""
        return digest([digest(self.settings), self.seed, self.objects])

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-len(self.objects) // OBJECTS_PER_SHARD)

    @property
    def per_object(self) -> int:
        """Clouds of one object."""
        return sum(self.counts.values())

    @property
    def counts(self) -> dict[Kind, int]:
        """Clouds of one object by kind."""
        size = self.settings["set"]
        return {"simulated": int(size["drive_bys"]), "perturbed": int(size["perturbed"])}

    @property
    def recipe(self) -> Recipe:
        """The recipe itself.

        Raises:
            ConfigError: this software does not know all of its settings any more.
        """
        return fill(Recipe, self.settings | {"text": self.text}, Place(Path("recipe")))

    def shard_objects(self, number: int) -> tuple[str, ...]:
        """Objects of a shard."""
        return self.objects[number * OBJECTS_PER_SHARD : (number + 1) * OBJECTS_PER_SHARD]

    def items(self, number: int) -> Iterator[Item]:
        """Clouds of a shard, in the order in which they are stored."""
        for name in self.shard_objects(number):
            for kind in KINDS:
                for variation in range(self.counts[kind]):
                    yield Item(name, kind, variation, item_seed(self.seed, name, kind, variation))


def item_seed(seed: int, name: str, kind: Kind, variation: int) -> int:
    """Seed of a cloud, 0..2^63-1: a hash, so that it does not move when a set grows."""
    text = f"{seed}/{name}/{kind}/{variation}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def group_key(ref: ObjectRef) -> str:
    """What must not fall into two splits: the author or project; of generated objects, each its own group."""
    group = ref.source_group
    return ref.undeformed.to_text() if ref.generated or group == HUMAN_ORIGIN[0] else group


def choose_objects(recipe: Recipe, seed: int) -> list[ObjectRef]:
    """The distinct objects of a set, classes and splits mixed.

    Library objects come as they are first; when a class needs more than its source groups hold, variations of them
    (``train.objects.deform``) follow, in every split from that split's own groups.
    """
    rng = np.random.default_rng([seed, 0x0B1EC7])
    library: dict[tuple[ClassName, Split, bool], list[ObjectRef]] = {}
    for ref in library_refs():
        library.setdefault((ref.class_name, ref.split, ref.entry().provenance == PROCEDURAL), []).append(ref)
    chosen: list[ObjectRef] = []
    for name, count in recipe.classes.counts(recipe.set.objects).items():
        held = {"val": round(count * recipe.set.val_share), "test": round(count * recipe.set.test_share)}
        for split in SPLITS:
            wanted = held.get(split, count - sum(held.values()))
            settings = recipe.classes.of(name)
            shares = (settings.collected, settings.procedural, settings.generated) if split == "train" else (1, 0, 0)
            collected, procedural = library.get((name, split, False), []), library.get((name, split, True), [])
            parts = _shared(wanted, shares, (bool(collected), bool(procedural), True))
            for refs, part in ((collected, parts[0]), (procedural, parts[1])):
                chosen += _varied(refs, part, settings.ridden, rng)
            chosen += _generated(name, split, parts[2], rng)
    return [chosen[k] for k in rng.permutation(len(chosen))]


def _shared(count: int, shares: Sequence[float], present: Sequence[bool]) -> list[int]:
    """``count`` by shares, those of absent origins given to the others; the last origin always exists."""
    weights = np.array(shares, dtype=float) * np.array(present)
    if weights.sum() == 0:
        weights[-1] = 1
    ends = np.rint(np.cumsum(weights) / weights.sum() * count).astype(int)
    return [int(n) for n in np.diff(ends, prepend=0)]


def _varied(refs: Sequence[ObjectRef], count: int, ridden: float, rng: np.random.Generator) -> list[ObjectRef]:
    """``count`` distinct objects: all as they are in random order, then variations of all, again and again."""
    chosen: dict[ObjectRef, None] = {}
    while len(chosen) < count:
        plain = len(chosen) < len(refs)
        for k in rng.permutation(len(refs))[: count - len(chosen)]:
            deform = None if plain else int(rng.integers(_DEFORM_SEEDS))
            rider = f"{_rider_kind()}{_number(refs[k].split, rng)}" if rng.random() < ridden else None
            chosen[ObjectRef(refs[k].class_name, refs[k].name, deform, rider)] = None
    return list(chosen)


def _generated(name: ClassName, split: Split, count: int, rng: np.random.Generator) -> list[ObjectRef]:
    """``count`` distinct objects of this project's generators, numbered so that they belong to the split."""
    model = name == "pedestrian" and _has_people()
    first = _number(split, rng)
    kinds = ["human" if model and k % _PARAMETRIC_PEOPLE else "parametric" for k in range(count)]
    return [ObjectRef(name, f"{kind}_{first + len(SPLITS) * k:05d}") for k, kind in enumerate(kinds)]


def _number(split: Split, rng: np.random.Generator) -> int:
    """A random number of a generated object or person of this split."""
    return len(SPLITS) * int(rng.integers(_NUMBERS)) + SPLITS.index(split)


def _has_people() -> bool:
    folder = default_objects_dir()
    return folder is not None and (folder / HUMAN_FILE).is_file()


def _rider_kind() -> str:
    return "human" if _has_people() else "rider"


def class_counts(plan: Plan) -> dict[str, int]:
    """Objects by class."""
    return {name: sum(text.startswith(f"{name}/") for text in plan.objects) for name in CLASSES}
