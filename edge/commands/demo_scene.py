# SPDX-License-Identifier: Apache-2.0
"""The demo's recording: a simulated drive past one car, made once and cached."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import edge
from edge.errors import CaptureError
from edge.frames import RADARS, Float64, RadarFrame
from edge.recording.writer import RecordingWriter
from edge.reference.drive_by import DriveBy, DriveByScene, place, poses, sample_surface
from edge.resources import data_dir
from edge.rig import Rig

SCENE = DriveBy()
KEPT_RECORDINGS = 3
"""Newest ones of one object that stay in the cache; other objects' are not touched."""
TRUTH_POINTS = 16384
COLLECTED_CAR = Path("objects") / "car" / "c1280_sedan.npz"
COLLECTED_CREDIT = '"Generic passenger car pack" by Comrade1280, CC-BY-4.0; the model was not trained on this author'
SHIPPED_CAR = Path(edge.__file__).parent / "reference" / "demo_car.npz"
SHIPPED_CREDIT = "the project's own parametric sedan"


@dataclass(frozen=True, slots=True)
class DemoObject:
    """The object beside the road.

    Args:
        credit: whose it is.
        vertices_odom_m: float64 [v, 3] in the odometry frame.
        faces: int32 [f, 3].
    """

    credit: str
    vertices_odom_m: Float64
    faces: NDArray[np.int32]

    def truth_odom_m(self) -> NDArray[np.float32]:
        """Points spread evenly over the true surface, float32 [16384, 3], odometry frame."""
        surface = sample_surface(self.vertices_odom_m, self.faces, TRUTH_POINTS, np.random.default_rng(0))
        return surface.points_m.astype(np.float32)


def demo_object() -> DemoObject:
    """A real car's mesh when the optional data are on this machine, else the shipped one."""
    folder = data_dir()
    collected = folder / COLLECTED_CAR if folder is not None else None
    path, credit = (SHIPPED_CAR, SHIPPED_CREDIT)
    if collected is not None and collected.is_file():
        path, credit = collected, COLLECTED_CREDIT
    with np.load(path, allow_pickle=False) as mesh:
        vertices, faces = mesh["vertices"].astype(np.float64), mesh["faces"].astype(np.int32)
    return DemoObject(credit, place(vertices, SCENE), faces)


def cache_dir() -> Path:
    """XDG_CACHE_HOME/rfconstruct, by default ~/.cache/rfconstruct; CaptureError when there is no home."""
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "rfconstruct"
    except RuntimeError as error:
        raise CaptureError(f"no place for the demo's recording: {error}", action="set XDG_CACHE_HOME") from error


def demo_recording(rig: Rig, thing: DemoObject, scene: DriveBy) -> Path:
    """Path of the demo's recording, made when it is not in the cache.

    Args:
        rig: two radars.
        thing: what stands beside the road.
        scene: track, timing and levels.
    Raises:
        CaptureError: the cache cannot be written.
    """
    owner = hashlib.sha256(thing.credit.encode()).hexdigest()[:8]
    key = hashlib.sha256(repr(scene).encode() + rig.config_hash + thing.vertices_odom_m.tobytes()).hexdigest()[:16]
    path = cache_dir() / f"demo-{owner}-{key}.mcap"
    if path.is_file():
        return path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            _record(Path(folder) / path.name, rig, thing, scene)
            (Path(folder) / path.name).replace(path)
        ages = {file: file.stat().st_mtime_ns for file in path.parent.glob(f"demo-{owner}-*.mcap")}
        for stale in sorted(ages, key=lambda file: ages[file])[:-KEPT_RECORDINGS]:
            stale.unlink(missing_ok=True)
    except OSError as error:
        raise CaptureError(
            f"the demo's recording cannot be written ({error.strerror})",
            value=str(path.parent),
            allowed="a writable folder with 50 MB free",
            action="set XDG_CACHE_HOME to another folder",
        ) from error
    return path


def _record(path: Path, rig: Rig, thing: DemoObject, scene: DriveBy) -> None:
    waiting = poses(scene, rig.geometry)
    with RecordingWriter(path, rig) as writer:
        for frame in _frames(rig, thing, scene):
            while waiting and waiting[0].t_ns <= frame.t_first_chirp_ns:
                writer.pose(waiting.pop(0))
            writer.frame(frame)
        for pose in waiting:
            writer.pose(pose)


def _frames(rig: Rig, thing: DemoObject, settings: DriveBy) -> Iterator[RadarFrame]:
    """Frames in time order, computed on two threads."""
    scene = DriveByScene(
        *(rig.radars, rig.geometry, rig.settings.antenna, thing.vertices_odom_m, thing.faces, settings)
    )
    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(lambda key: scene.frame(*key), [(r, n) for n in range(settings.frames) for r in RADARS])
