# SPDX-License-Identifier: Apache-2.0
"""Held-out samples with all that an evaluation needs: where the object stands, its mesh, when each point was seen."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edge.frames import FULL_WINDOW_FRAMES, Float32, Float64
from train.dataset import CompletionDataset, DatasetSettings, Sample
from train.nearest import nearest_index
from train.objects.library import Split
from train.objects.mesh import Mesh
from train.objects.reference import ObjectRef
from train.objects.sampling import sample_surface
from train.simulated import SimulatedDataset

Source = Literal["scans", "drive-bys"]


@dataclass(frozen=True, slots=True)
class Case:
    """One held-out sample.

    Args:
        sample: input and truth, metres.
        number: of the case in its source; seed of what is drawn for it.
        source: perturbed scans, or drive-bys simulated down to the samples of the ADC and seen by the edge pipeline.
        mesh: the object.
        rotation, translation_m: float64 [3, 3], [3]: p = R v + t from the frame of the mesh to that of the sample.
        frames: radar frames of the window; a scan counts as a full window.
        frame_number: int64 [n] of each point of ``sample.partial``, ascending numbers in time; None: a scan.
        box_frame: the setting with box priors.
    """

    sample: Sample
    number: int
    source: Source
    mesh: Mesh
    rotation: Float64
    translation_m: Float64
    frames: int = FULL_WINDOW_FRAMES
    frame_number: NDArray[np.int64] | None = None
    box_frame: bool = False

    @property
    def diagonal_m(self) -> float:
        """Of the object's own bounding box."""
        return float(np.linalg.norm(self.mesh.size_m))

    def posed(self, points_m: Float32) -> Float32:
        """Points [n, 3] of the mesh's frame in the sample's."""
        return np.ascontiguousarray(points_m @ self.rotation.T + self.translation_m, np.float32)

    def unposed(self, points_m: Float32) -> Float32:
        """Points [n, 3] of the sample's frame in the mesh's."""
        return np.ascontiguousarray((points_m - self.translation_m) @ self.rotation, np.float32)

    def resampled(self) -> Float32:
        """The surface sampled once more, as many points as the truth has."""
        rng = np.random.default_rng([self.number, len(self.sample.truth)])
        return self.posed(sample_surface(self.mesh.vertices, self.mesh.faces, len(self.sample.truth), rng))

    def seen_as(self, partial: Float32, frames: int | None = None) -> Case:
        """The same object with another input."""
        return replace(
            self,
            sample=replace(self.sample, partial=np.ascontiguousarray(partial, np.float32), power_db=None),
            frames=self.frames if frames is None else frames,
            frame_number=None,
        )


class HeldOut(Sequence[Case]):
    """The cases of a data set, made when they are asked for; never the same work twice where it can be avoided.

    Args:
        dataset: any split and frame; a split other than "train" gives the same cases always.
        indices: of the dataset, all by default.
    """

    def __init__(self, dataset: CompletionDataset, indices: Sequence[int] | None = None) -> None:
        self.dataset = dataset
        self.indices = list(range(len(dataset)) if indices is None else indices)
        self._twin = in_box_frame(dataset)

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[Case]:
        return (self[position] for position in range(len(self)))

    def __getitem__(self, position: int) -> Case:  # type: ignore[override]
        index = self.indices[position]
        sample, own = self.dataset[index], self._twin[index]
        rotation, translation_m = motion(own.truth, sample.truth)
        box = self.dataset.settings.box_frame
        if not isinstance(self.dataset, SimulatedDataset) or self.dataset.split == "train":
            return Case(sample, index, "scans", self.dataset.mesh(index), rotation, translation_m, box_frame=box)
        cloud = self.dataset.clouds[index]
        mesh = _mesh(cloud.object, self.dataset.settings.objects_dir)
        in_mesh = (cloud.xyz_m - cloud.translation_m.astype(np.float32)) @ cloud.rotation.astype(np.float32)
        times = cloud.frame_number[nearest_index(own.partial, np.ascontiguousarray(in_mesh, np.float32))]
        return Case(sample, index, "drive-bys", mesh, rotation, translation_m, cloud.frames, times, box)

    def spread(self, count: int) -> HeldOut:
        """At most ``count`` cases, evenly over all."""
        return HeldOut(self.dataset, [self.indices[position] for position in spread(len(self), count)])


class Joined(Sequence[Case]):
    """Several sources one after the other."""

    def __init__(self, parts: Sequence[Sequence[Case]]) -> None:
        self._places = [(part, position) for part in parts for position in range(len(part))]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, position: int) -> Case:  # type: ignore[override]
        part, inner = self._places[position]
        return part[inner]


def held_out(
    source: Source,
    split: Split,
    box_frame: bool = False,
    simulated: Path | Sequence[Path] | None = None,
    seed: int = 0,
) -> HeldOut:
    """Cases of a source with the project's object library.

    Args:
        source: scans need no file; drive-bys need ``simulated``, a data set or a file of clouds.
        split: "val" or "test".
        box_frame: the setting with box priors.
        simulated: where the drive-bys are; several sets are taken together.
        seed: of the scans and of the errors of the line of sight.
    Raises:
        RecordingError: no such set, or no cloud of this split in it.
        MeshError: an object library that cannot be read.
    """
    settings = DatasetSettings.default(box_frame=box_frame)
    if source == "scans" or simulated is None:
        return HeldOut(CompletionDataset(split, settings, seed))
    return HeldOut(SimulatedDataset(simulated, split, settings, seed))


def in_box_frame(dataset: CompletionDataset) -> CompletionDataset:
    """The same samples in the frame of their meshes; they share the epoch."""
    twin = copy.copy(dataset)
    twin.settings = replace(dataset.settings, box_frame=True)
    return twin


def motion(before: Float32, after: Float32) -> tuple[Float64, Float64]:
    """Rotation and translation between the same points in two frames, p' = R p + t (Kabsch 1976).

    Args:
        before, after: [n >= 3, 3], corresponding rows, not on one line; the first 256 are used.
    """
    first, second = before[:256].astype(np.float64), after[:256].astype(np.float64)
    u, _, vt = np.linalg.svd((first - first.mean(axis=0)).T @ (second - second.mean(axis=0)))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation: Float64 = (u @ flip @ vt).T
    return rotation, second.mean(axis=0) - rotation @ first.mean(axis=0)


def spread(length: int, count: int) -> list[int]:
    """At most ``count`` indices, evenly over 0..length - 1, each once."""
    return sorted(set(np.linspace(0, length - 1, min(count, length)).astype(int).tolist()))


@lru_cache(maxsize=256)
def _mesh(name: str, objects_dir: Path | None) -> Mesh:
    return ObjectRef.from_text(name).mesh(objects_dir)
