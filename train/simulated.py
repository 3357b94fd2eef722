# SPDX-License-Identifier: Apache-2.0
"""Simulated radar clouds as training data: truth sampled from the object at load, mixed with perturbed geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.completion.sight import bearing_rad, turned
from edge.config import require
from edge.errors import RecordingError
from edge.frames import Float32
from train.dataset import CompletionDataset, DatasetSettings, Sample, spread
from train.objects.library import SPLITS, Split
from train.objects.mesh import CLASSES, Mesh, MeshError
from train.objects.reference import HUMAN_FILE, ObjectRef
from train.objects.sampling import sample_surface
from train.simulate.shards import Cloud, read_clouds
from train.vary_cloud import borrowed, hidden, strays, stretch, window, with_strays

USABLE = ("whole", "split")
"""Clouds that are the object's: not merged with something else, not missing."""
THIN_SHARE, MIRROR_SHARE = 0.5, 0.5
WINDOW_SHARE, HIDDEN_SHARE, STRETCH_SHARE, STRAY_SHARE = 0.3, 0.3, 0.5, 0.2
BORROWED_SHARE = 0.3
"""Chance of the strays of another drive-by, for scans too."""
_SURFACE_POINTS = 2048
_VARIATION = 3
"""Of the ways in which clouds are varied: a run is continued with those that it began with."""
_SIZE_TOLERANCE_M = 2e-3
_OWN = 1
"""Sets the generator of a simulated sample apart from that of the perturbed one with the same index."""


class SimulatedDataset(CompletionDataset):
    """In train, ``CompletionDataset`` with a share of simulated clouds; in val and test, simulated clouds only.

    Item ``index`` is a pure function of (split, seed, epoch, index, settings, share, set of clouds). The frame and its
    errors are those of ``CompletionDataset``. In train a cloud is varied (``vary_cloud``: shorter window, hidden part,
    stretched with its truth, stray points), thinned half of the time (log-uniform, down to ``min_points``) and mirrored
    half of the time; val and test take every cloud once, as it is. Samples that are not simulated are the very ones
    that ``CompletionDataset`` gives for this index. Without box, samples of both kinds are given the strays of another
    drive-by at times, where these lay about the object that the other one saw.

    Args:
        source: folder of a data set, or file of clouds; or several, whose clouds are taken together.
        split, settings, seed: as in ``CompletionDataset``.
        share: chance of a simulated cloud in train, where its class has any.
    Raises:
        ConfigError: a share outside 0..1.
        RecordingError: no readable set, or none of its clouds can be used here.
    """

    def __init__(
        self,
        source: Path | Sequence[Path],
        split: Split,
        settings: DatasetSettings,
        seed: int,
        share: float = 0.5,
    ) -> None:
        require(0 <= share <= 1, "dataset.simulated_share", share, "0..1")
        super().__init__(split, settings, seed)
        self.share = share
        sets = [read_clouds(one) for one in ([source] if isinstance(source, Path) else source)]
        shards = [shard for one in sets for shard in one]
        self.identity = "+".join(one[0].identity for one in sets)
        self._sizes_m = {name: info.size_m for shard in shards for name, info in shard.objects.items()}
        mine = [c for shard in shards for c in shard.clouds if shard.objects[c.object].split == split and _usable(c)]
        here = {name: _is_here(name, settings.objects_dir) for name in {cloud.object for cloud in mine}}
        self.absent = sorted(name for name, present in here.items() if not present)
        """Objects whose mesh this machine does not have; their clouds are left out."""
        self._strays: dict[int, Float32] = {}
        enough = [cloud for cloud in mine if here[cloud.object] and len(cloud) >= settings.min_points]
        self.clouds = enough
        self._of_label = [[c for c in enough if c.object.startswith(f"{name}/")] for name in CLASSES]
        if not enough:
            raise RecordingError(
                f"{_names(source)}: no cloud can be used for {split}",
                value=f"{len(mine)} clouds of {len(here)} objects, {len(self.absent)} of these not on this machine",
                action="set RFCONSTRUCT_DATA to the folder that holds objects/, or make a larger set",
            )

    def __len__(self) -> int:
        return super().__len__() if self.split == "train" else len(self.clouds)

    @property
    def description(self) -> dict[str, object]:
        """What decides the samples beside seed and settings."""
        data = {"simulated_set": self.identity, "simulated_share": self.share, "simulated_clouds": len(self.clouds)}
        return super().description | data | {"simulated_variation": _VARIATION * self.settings.vary_clouds}

    @property
    def summary(self) -> str:
        """One line for the user."""
        left_out = f"; {len(self.absent)} objects are not on this machine" if self.absent else ""
        objects = len({cloud.object for cloud in self.clouds})
        return f"{len(self.clouds)} simulated clouds of {objects} objects for {self.split}{left_out}"

    def __getitem__(self, index: int) -> Sample:
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        epoch = int(self._epoch[0]) if self.split == "train" else 0
        rng = np.random.default_rng([self.seed, SPLITS.index(self.split), epoch, index, _OWN])
        if self.split != "train":
            return self._seen(self.clouds[index], rng)
        clouds = self._of_label[index % len(CLASSES)]
        simulated = clouds and rng.random() < self.share
        sample = self._seen(clouds[rng.integers(len(clouds))], rng) if simulated else super().__getitem__(index)
        vary = self.settings.vary_clouds and not self.settings.box_frame
        return self._soiled(sample, rng) if vary and rng.random() < BORROWED_SHARE else sample

    def _soiled(self, sample: Sample, rng: np.random.Generator) -> Sample:
        """A sample with the strays of another drive-by about the middle of its object."""
        other, points = int(rng.integers(len(self.clouds))), len(sample.partial)
        if other not in self._strays:
            self._strays[other] = self._strays_of(self.clouds[other])
        most = self.settings.max_points - points
        added = borrowed(points, self._strays[other], len(self.clouds[other]), most, rng) + _foot(sample.truth)
        power_db = None if sample.power_db is None else np.pad(sample.power_db, (0, len(added)))
        return replace(sample, partial=np.concatenate([sample.partial, added]), power_db=power_db)

    def _strays_of(self, cloud: Cloud) -> Float32:
        """Strays [k, 3] along the line of sight, from the spot on the ground under the middle of the object."""
        mesh = self._checked_mesh(cloud.object)
        rng = np.random.default_rng(len(cloud))
        surface = sample_surface(mesh.vertices, mesh.faces, _SURFACE_POINTS, rng)
        surface = np.asarray(surface @ cloud.rotation.T + cloud.translation_m, np.float32)
        bearing = bearing_rad(cloud.object, cloud.sensor_m, cloud.xyz_m)
        return turned(strays(cloud.xyz_m, surface) - _foot(surface), -bearing)

    def _seen(self, cloud: Cloud, rng: np.random.Generator) -> Sample:
        """A cloud and its truth."""
        settings = self.settings
        mesh = self._checked_mesh(cloud.object)
        vary = self.split == "train" and settings.vary_clouds
        chosen = self._chosen(cloud, float(np.linalg.norm(mesh.size_m)), rng)
        partial, power_db = cloud.xyz_m[chosen], cloud.power_db[chosen] - np.median(cloud.power_db)
        truth = sample_surface(mesh.vertices, mesh.faces, settings.truth_points, rng)
        rotation, translation = cloud.rotation.astype(np.float32), cloud.translation_m.astype(np.float32)
        scale = np.ones(3, np.float32)
        if vary and rng.random() < STRETCH_SHARE:
            scale = stretch(rng)
            own = (partial - translation) @ rotation
            partial, truth = np.asarray((own * scale) @ rotation.T + translation, np.float32), truth * scale
        if vary and rng.random() < STRAY_SHARE:
            partial = with_strays(partial, settings.max_points, rng)
        if settings.box_frame:
            partial = np.asarray((partial - translation) @ rotation, np.float32)
        else:
            truth = truth @ rotation.T + translation
            partial, truth = self._as_seen(partial, truth, bearing_rad(cloud.object, cloud.sensor_m, partial), rng)
        power_db = np.pad(power_db, (0, len(partial) - len(power_db)))  # that of neighbours and strays is not known
        if self.split == "train" and rng.random() < MIRROR_SHARE:
            mirror = np.array([1, -1, 1], np.float32)
            partial, truth = partial * mirror, truth * mirror
        partial, truth = np.ascontiguousarray(partial), np.ascontiguousarray(truth)
        x_m, y_m, z_m = (float(v) for v in mesh.size_m * scale)
        return Sample(partial, truth, mesh.label, cloud.object, (x_m, y_m, z_m), power_db.astype(np.float32))

    def _chosen(self, cloud: Cloud, diagonal_m: float, rng: np.random.Generator) -> NDArray[np.int64]:
        """Indices of the cloud's points that are taken, in random order: all of them, in train often fewer."""
        settings, kept = self.settings, np.arange(len(cloud))
        if self.split == "train" and settings.vary_clouds:
            if rng.random() < WINDOW_SHARE:
                kept = self._if_enough(cloud, kept, kept[window(cloud.frame_number, cloud.frames, rng)], diagonal_m)
            if rng.random() < HIDDEN_SHARE:
                kept = self._if_enough(cloud, kept, kept[~hidden(cloud.xyz_m[kept], rng)], diagonal_m)
        count = most = min(len(kept), settings.max_points)
        if self.split == "train" and rng.random() < THIN_SHARE:
            count = round(np.exp(rng.uniform(np.log(min(settings.min_points, most)), np.log(most))))
        return rng.permutation(kept)[:count]

    def _if_enough(
        self, cloud: Cloud, before: NDArray[np.int64], after: NDArray[np.int64], diagonal_m: float
    ) -> NDArray[np.int64]:
        """``after`` where it has points enough and they are spread as the settings ask, else ``before``."""
        enough = len(after) >= self.settings.min_points
        return after if enough and spread(cloud.xyz_m[after]) >= self.settings.min_spread * diagonal_m else before

    def _checked_mesh(self, name: str) -> Mesh:
        mesh = _mesh(name, self.settings.objects_dir)
        if np.abs(mesh.size_m - np.array(self._sizes_m[name])).max() > _SIZE_TOLERANCE_M:
            raise MeshError(
                f"{name}: not the object that the radar saw",
                value=f"{np.round(mesh.size_m, 3).tolist()} m",
                allowed=f"{list(self._sizes_m[name])} m",
                action="use the object library that the set was made with",
            )
        return mesh


def _names(source: Path | Sequence[Path]) -> str:
    return str(source) if isinstance(source, Path) else ", ".join(map(str, source))


def _foot(truth: Float32) -> Float32:
    """Spot [3] on the ground, z = 0, under the middle of an object [n, 3]."""
    foot: Float32 = (truth.max(axis=0) + truth.min(axis=0)) / 2
    foot[2] = 0
    return foot


def _usable(cloud: Cloud) -> bool:
    return cloud.kind == "simulated" and not cloud.error and cloud.status in USABLE


def _is_here(name: str, objects_dir: Path | None) -> bool:
    """Whether the object can be loaded, without loading it."""
    ref = ObjectRef.from_text(name)
    person = (ref.generated and ref.generated[0] == "human") or (ref.rider or "").startswith("human")
    if person and not (objects_dir and (objects_dir / HUMAN_FILE).is_file()):
        return False
    try:
        return ref.generated is not None or (objects_dir is not None and ref.entry(objects_dir).path.is_file())
    except MeshError:
        return False


@lru_cache(maxsize=2048)
def _mesh(name: str, objects_dir: Path | None) -> Mesh:
    """An object, kept in memory (some 200 kB each)."""
    return ObjectRef.from_text(name).mesh(objects_dir)
