# SPDX-License-Identifier: Apache-2.0
"""The data set: partial clouds made on the fly from collected and parametric meshes, the complete surface as truth."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from edge.completion.sight import bearing_rad, turned
from edge.config import require
from edge.frames import Float32
from train.objects.deform import DeformSettings, vary
from train.objects.human import HumanModel
from train.objects.library import PROCEDURAL, SPLITS, Entry, Split, default_objects_dir, read_manifest
from train.objects.mesh import CLASSES, ClassName, Mesh, MeshError
from train.objects.parametric import generate
from train.objects.reference import RIDDEN, ObjectRef
from train.objects.sampling import sample_surface
from train.perturb import AZIMUTH_SECTORS, PerturbSettings, perturb, with_neighbour

__all__ = ["CLASSES", "CompletionDataset", "DatasetSettings", "Sample", "mean_shape"]

Origin = Literal["collected", "procedural", "parametric"]
_ORIGINS: tuple[Origin, ...] = ("collected", "procedural", "parametric")
_EVALUATION_PARAMETRIC = 12
"""Parametric objects of a class in val and test when the library holds no collected one."""
_ATTEMPTS = 16
_RIDERS = 4
"""Different riders of a library two-wheeler."""


@dataclass(frozen=True)
class Sample:
    """One pair of input and truth.

    Args:
        partial: float32 [n, 3], metres, n real points (never padded), in the line-of-sight frame of
            ``edge.completion.sight``: x away from the radar, ground z = 0, x and y from the middle of the partial
            cloud's bounding box; in the box frame x along the object, x and y from the centre of the truth.
        truth: float32 [truth_points, 3], same frame, uniform by area, random order.
        label: index into CLASSES.
        object_id: "<class>/<name>".
        size_m: extent of the complete object along its own axes.
        power_db: float32 [n], relative to the cloud's median; None where the source has no powers.
    """

    partial: Float32
    truth: Float32
    label: int
    object_id: str
    size_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    power_db: Float32 | None = None


@dataclass(frozen=True)
class DatasetSettings:
    """What is drawn.

    Args:
        objects_dir: library folder (with the human model in ``human_model/mh_model.npz`` if it has one); None =
            parametric objects only. ``DatasetSettings.default()`` finds the folder.
        max_points, min_points: points of a partial cloud; a draw with fewer is repeated with a new view point.
        min_spread: so is one whose standard deviation in space is less than this share of the object's diagonal: a
            single clump says nothing about a shape.
        truth_points: points of the truth.
        perturbation, deformation: see there; deformation is applied in train only.
        box_frame: the variant with box priors: x along the object, origin at the centre of the complete shape on the
            ground; the trainer scales to the unit sphere. Otherwise the line-of-sight frame, the object at any heading.
        sight_sigma_deg, ground_sigma_m: standard deviations of the errors of the line of sight and of the height of the
            ground, as a calibration, a pose and a road that is not level bring them.
        neighbour_probability: chance, in train without box, of points of something else that stands beside the object
            and was not segmented from it (``perturb.with_neighbour``).
        vary_clouds: simulated radar clouds are varied in train (``vary_cloud``).
        epoch_samples: samples of one training epoch, classes in turn.
        evaluation_views: samples of every val and test object, azimuth sectors in turn.
        origin_share: chance of a collected, a procedural (library) and an own parametric object in train, by class;
            shares of an origin that has no object go to the others.
        parametric_objects: how many different parametric objects of a class there are in train.
        rider_share: chance of a rider on a two-wheeler of the library in train (parametric ones have their own draw).
    Raises:
        ConfigError: a number outside its range.
    """

    objects_dir: Path | None = None
    max_points: int = 2048
    min_points: int = 64
    min_spread: float = 0.1
    truth_points: int = 16384
    perturbation: PerturbSettings = field(default_factory=PerturbSettings)
    deformation: DeformSettings = field(default_factory=DeformSettings)
    box_frame: bool = False
    sight_sigma_deg: float = 3.0
    ground_sigma_m: float = 0.02
    neighbour_probability: float = 0.15
    vary_clouds: bool = True
    epoch_samples: int = 20_000
    evaluation_views: int = 8
    origin_share: dict[ClassName, tuple[float, float, float]] = field(
        default_factory=lambda: {
            "car": (0.75, 0.0, 0.25),
            "bicycle": (0.45, 0.35, 0.2),
            "motorcycle": (0.45, 0.35, 0.2),
            "pedestrian": (0.75, 0.0, 0.25),
        }
    )
    parametric_objects: int = 256
    rider_share: float = 0.5

    def __post_init__(self) -> None:
        require(1 <= self.min_points <= self.max_points, "dataset.min_points", self.min_points, "1..max_points")
        require(0 <= self.min_spread < 0.3, "dataset.min_spread", self.min_spread, "0..0.3")
        chance = self.neighbour_probability
        require(0 <= chance <= 1, "dataset.neighbour_probability", chance, "0..1")
        require(self.sight_sigma_deg >= 0, "dataset.sight_sigma_deg", self.sight_sigma_deg, ">= 0 deg")
        require(self.ground_sigma_m >= 0, "dataset.ground_sigma_m", self.ground_sigma_m, ">= 0 m")
        require(self.truth_points >= 1, "dataset.truth_points", self.truth_points, ">= 1")
        require(self.epoch_samples >= 1, "dataset.epoch_samples", self.epoch_samples, ">= 1")
        require(self.evaluation_views >= 1, "dataset.evaluation_views", self.evaluation_views, ">= 1")
        require(self.parametric_objects >= 1, "dataset.parametric_objects", self.parametric_objects, ">= 1")
        require(0 <= self.rider_share <= 1, "dataset.rider_share", self.rider_share, "0..1")
        require(set(self.origin_share) == set(CLASSES), "dataset.origin_share", set(self.origin_share), str(CLASSES))

    @classmethod
    def default(cls, **changes: object) -> DatasetSettings:
        """Settings with the project's object library when this machine has one."""
        return replace(cls(objects_dir=default_objects_dir()), **changes)  # type: ignore[arg-type]

    @classmethod
    def pcn(cls, **changes: object) -> DatasetSettings:
        """The same objects, their partial clouds made PCN's way: clean depth scans, no errors of the frame."""
        plain = cls.default(
            perturbation=PerturbSettings.clean(), sight_sigma_deg=0.0, ground_sigma_m=0.0, neighbour_probability=0.0
        )
        return replace(plain, **changes)  # type: ignore[arg-type]


class CompletionDataset(torch.utils.data.Dataset[Sample]):
    """Map-style data set; item ``index`` is a pure function of (split, seed, epoch, index, settings).

    Args:
        split: "train" (varied objects, new draws every epoch), "val" or "test" (objects as they are, the same draws
            always, whatever the epoch).
        settings: what is drawn.
        seed: of every chance decision.
    Raises:
        MeshError: the library is there but cannot be read.
    """

    def __init__(self, split: Split, settings: DatasetSettings, seed: int) -> None:
        require(split in SPLITS, "dataset.split", split, ", ".join(SPLITS))
        self.split: Split = split
        self.settings = settings
        self.seed = seed
        self._perturbation = replace(settings.perturbation, max_points=settings.max_points)
        self._epoch = torch.zeros(1, dtype=torch.int64)
        self._epoch.share_memory_()  # type: ignore[no-untyped-call]  # loader workers that persist see it change
        self._library: dict[tuple[int, Origin], list[Entry]] = {}
        for entry in read_manifest(settings.objects_dir) if settings.objects_dir else []:
            origin: Origin = "procedural" if entry.provenance == PROCEDURAL else "collected"
            if entry.split == split:
                self._library.setdefault((entry.label, origin), []).append(entry)
        model = settings.objects_dir / "human_model" / "mh_model.npz" if settings.objects_dir else None
        self._human = model if model and model.is_file() else None
        self._evaluation = [] if split == "train" else self._evaluation_objects()

    def _evaluation_objects(self) -> list[Entry | tuple[int, int]]:
        """Collected objects of the split, or (class, seed) of parametric ones where a class has none."""
        objects: list[Entry | tuple[int, int]] = []
        for label in range(len(CLASSES)):
            collected = self._library.get((label, "collected"), [])
            objects += collected or [(label, number) for number in range(_EVALUATION_PARAMETRIC)]
        return objects

    def __len__(self) -> int:
        if self.split == "train":
            return self.settings.epoch_samples
        return len(self._evaluation) * self.settings.evaluation_views

    def set_epoch(self, epoch: int) -> None:
        """New draws for the next pass (train only); also seen by running loader workers."""
        self._epoch[0] = epoch

    @property
    def object_ids(self) -> list[str]:
        """Names of the library's objects that this split draws from."""
        return [entry.object_id for entries in self._library.values() for entry in entries]

    @property
    def description(self) -> dict[str, object]:
        """What decides the samples: a run can only be continued where all of this is the same."""
        names = "\n".join(sorted(self.object_ids))
        return {
            "library_objects": len(self.object_ids),
            "library_sha256": hashlib.sha256(names.encode()).hexdigest(),
            "seed": self.seed,
            "truth_points": self.settings.truth_points,
            "max_points": self.settings.max_points,
            "box_frame": self.settings.box_frame,
            "sight_sigma_deg": self.settings.sight_sigma_deg,
            "ground_sigma_m": self.settings.ground_sigma_m,
            "neighbour_probability": self.settings.neighbour_probability,
        } | ({"perturbation": repr(changed)} if (changed := self.settings.perturbation) != PerturbSettings() else {})

    def mesh(self, index: int) -> Mesh:
        """The complete object of a sample, before yaw and shift."""
        return self._mesh(index, self._generator(index))

    def __getitem__(self, index: int) -> Sample:
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        rng = self._generator(index)
        mesh = self._mesh(index, rng)
        settings = self.settings
        sector = index // len(CLASSES) if self.split == "train" else index % settings.evaluation_views
        diagonal = float(np.linalg.norm(mesh.size_m))
        for _ in range(_ATTEMPTS):
            partial, radar_m = perturb(mesh, self._perturbation, rng, sector % AZIMUTH_SECTORS)
            if len(partial) >= settings.min_points and spread(partial) >= settings.min_spread * diagonal:
                break
        else:
            raise MeshError(
                f"{mesh.object_id}: no view gives enough points that are spread over the object",
                value=f"{len(partial)} points",
                allowed=f">= {settings.min_points} points, spread >= {settings.min_spread} of the diagonal",
                action="lower dataset.min_points, dataset.min_spread or the perturbation",
            )
        truth = sample_surface(mesh.vertices, mesh.faces, settings.truth_points, rng)
        if not settings.box_frame:
            partial, truth = self._as_seen(partial, truth, bearing_rad(mesh.object_id, radar_m, partial), rng)
        return Sample(
            np.ascontiguousarray(partial), np.ascontiguousarray(truth), mesh.label, mesh.object_id, size_of(mesh)
        )

    def _as_seen(
        self, partial: Float32, truth: Float32, bearing: float, rng: np.random.Generator
    ) -> tuple[Float32, Float32]:
        """Both clouds in the line-of-sight frame, with errors of its axis and of the ground, perhaps a neighbour."""
        error_rad = np.radians(rng.normal(0, self.settings.sight_sigma_deg))
        angle_rad = error_rad - bearing
        partial, truth = turned(partial, angle_rad), turned(truth, angle_rad)
        if self.split == "train" and rng.random() < self.settings.neighbour_probability:
            partial = with_neighbour(partial, self.settings.max_points, rng)
        origin_m = (partial.max(axis=0) + partial.min(axis=0)) / 2
        origin_m[2] = rng.normal(0, self.settings.ground_sigma_m)
        return partial - origin_m, truth - origin_m

    def _generator(self, index: int) -> np.random.Generator:
        epoch = int(self._epoch[0]) if self.split == "train" else 0
        return np.random.default_rng([self.seed, SPLITS.index(self.split), epoch, index])

    def _mesh(self, index: int, rng: np.random.Generator) -> Mesh:
        if self.split != "train":
            item = self._evaluation[index // self.settings.evaluation_views]
            return _load(item) if isinstance(item, Entry) else _parametric(*item, self.split)
        label = index % len(CLASSES)
        share = np.array(self.settings.origin_share[CLASSES[label]], dtype=float)
        for number, origin in enumerate(_ORIGINS[:2]):
            share[number] *= bool(self._library.get((label, origin)))
        if share.sum() == 0:
            share[2] = 1
        origin = _ORIGINS[rng.choice(3, p=share / share.sum())]
        if origin == "parametric":
            number = int(rng.integers(self.settings.parametric_objects))
            human = self._human if CLASSES[label] == "pedestrian" and number % 5 else None
            mesh = _person(human, len(SPLITS) * number) if human else _parametric(label, number, self.split)
        else:
            entries = self._library[label, origin]
            entry = entries[rng.integers(len(entries))]
            ridden = CLASSES[label] in RIDDEN and rng.random() < self.settings.rider_share
            number = int(rng.integers(_RIDERS)) if ridden else 0
            mesh = _ridden(entry, self.settings.objects_dir, bool(self._human), number) if ridden else _load(entry)
        return vary(mesh, self.settings.deformation, rng)


def size_of(mesh: Mesh) -> tuple[float, float, float]:
    """Extent along x, y and z, metres."""
    x_m, y_m, z_m = (float(v) for v in mesh.size_m)
    return x_m, y_m, z_m


def spread(points: Float32) -> float:
    """Standard deviation of points [n, 3] about their mean, all axes together, metres."""
    return float(np.sqrt(points.var(axis=0).sum()))


@cache
def _load(entry: Entry) -> Mesh:
    """A library mesh, kept in memory (the whole library is about 50 MB)."""
    return entry.load()


@lru_cache(maxsize=1024)
def _ridden(entry: Entry, objects_dir: Path | None, human: bool, number: int) -> Mesh:
    """A library two-wheeler with a rider, without where nothing on it looks like a saddle and a bar (0.4 MB each)."""
    ref = ObjectRef(CLASSES[entry.label], entry.name, rider=f"{'human' if human else 'rider'}{number}")
    try:
        return ref.mesh(objects_dir)
    except MeshError:
        return _load(entry)


@lru_cache(maxsize=2048)
def _parametric(label: int, number: int, split: Split) -> Mesh:
    """A parametric mesh, kept in memory; the splits have seeds of their own."""
    return generate(CLASSES[label], 3 * number + SPLITS.index(split))


@lru_cache(maxsize=2048)
def _person(model: Path, number: int) -> Mesh:
    """A person of the human model, kept in memory (160 kB each)."""
    return HumanModel.load(model).person(number)


def mean_shape(dataset: CompletionDataset, points: int, see: Callable[[Sample], Sample] = lambda one: one) -> Float32:
    """A cloud drawn from the mean distribution of the data: every point from the truth of another random sample.

    Args:
        dataset: where the samples come from.
        points: size of the result.
        see: puts a sample into the frame of the network.
    Returns:
        float32 [points, 3], in the samples' frame.
    """
    draws = min(256, len(dataset), points)
    rng = np.random.default_rng([dataset.seed, points])
    chosen = rng.choice(len(dataset), draws, replace=False)
    counts = np.full(draws, points // draws)
    counts[: points % draws] += 1
    parts = [see(dataset[int(i)]).truth[:n] for i, n in zip(chosen, counts, strict=True)]
    shape = np.concatenate(parts)
    return shape[rng.permutation(len(shape))]
