# SPDX-License-Identifier: Apache-2.0
"""A training cloud: what the pipeline itself makes of a simulated drive-by's raw frames, and where the truth is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.frames import RADARS, Float32, Float64, FusedCloud, ObjectCloud, Pose
from edge.odometry.transforms import rotation_matrix
from edge.pipeline import FrameResult, Pipeline, Sink, WindowResult
from edge.rig import Rig, load_rig
from train.nearest import nearest_index
from train.objects.mesh import Mesh
from train.objects.reference import ObjectRef
from train.simulate.cloud_statistics import CloudStatistics, measure
from train.simulate.drive_by import DriveBy
from train.simulate.randomise import Ranges, draw
from train.simulate.scene import make_scene
from train.simulate.settings import SimulationSettings
from train.simulate.stages import SharedStages

Status = Literal["whole", "split", "merged", "missing"]
LEAST_POINTS = 8
"""A cluster with fewer points in the true box is not the target's."""
BOX_MARGIN_M = 0.3
SPLIT_SHARE, MERGED_SHARE = 0.15, 0.3
VIEWS = 3


@dataclass(frozen=True, slots=True)
class DriveSpec:
    """One training cloud by name.

    Args:
        object: the target.
        seed: of everything that is drawn.
        ranges: from which the settings are drawn.
        rig: name or folder of the rig.
        every: only each n-th frame is made.
        settings: of the drive-by, its ``track.every`` instead of ``every``; None: drawn from ``ranges``.
    """

    object: ObjectRef
    seed: int
    ranges: Ranges = field(default_factory=Ranges)
    rig: str = "cascade_demo"
    every: int = 3
    settings: SimulationSettings | None = None

    def __post_init__(self) -> None:
        require(self.every >= 1, "drive.every", self.every, ">= 1")
        require(self.seed >= 0, "drive.seed", self.seed, ">= 0")


@dataclass(frozen=True, slots=True)
class Target:
    """The target's cluster of a window.

    Args:
        status: "whole"; "split": other clusters hold more than 15 % of the points in the target's box; "merged": more
            than 30 % of its points lie outside that box; "missing": no cluster has 8 points in it.
        window: the window with the most points of the target.
        cloud: its cluster; None when missing.
        frame_number: int64 [n], frame of each of its points.
        truth_rotation: float64 [3, 3]; truth_rotation @ v + truth_translation_m carries the mesh into the frame of the
            cloud, by the pose in the middle of the window.
        truth_translation_m: float64 [3].
    """

    status: Status
    window: FusedCloud | None
    cloud: ObjectCloud | None
    frame_number: NDArray[np.int64]
    truth_rotation: Float64
    truth_translation_m: Float64


@dataclass(frozen=True, slots=True)
class SimulatedCloud:
    """The cloud of one object as the pipeline segments it, in the object frame of ``ObjectCloud``, and the truth in it.

    Args:
        spec: what it was made from.
        status: see ``Target``; a missing target has an empty cloud.
        xyz_m: float32 [n, 3].
        power_db: float32 [n].
        frame_number: int64 [n].
        sensor_m: float64 [3], mean position of the rig over the window.
        truth_rotation: float64 [3, 3]; truth_rotation @ v + truth_translation_m carries the mesh into this frame.
        truth_translation_m: float64 [3].
        frames: of the window.
        travel_m: in the window.
        complete: the window covers the travel that the rig asks for.
        statistics: points, distances, coverage.
        settings: that were drawn.
    """

    spec: DriveSpec
    status: Status
    xyz_m: Float32
    power_db: Float32
    frame_number: NDArray[np.int64]
    sensor_m: Float64
    truth_rotation: Float64
    truth_translation_m: Float64
    frames: int
    travel_m: float
    complete: bool
    statistics: CloudStatistics
    settings: SimulationSettings


class Windows:
    """A sink that keeps every window."""

    def __init__(self) -> None:
        self.results: list[WindowResult] = []

    def frame(self, result: FrameResult) -> None:
        """Nothing is kept of single frames."""

    def window(self, result: WindowResult) -> None:
        """Keep it."""
        self.results.append(result)


def simulate_cloud(spec: DriveSpec) -> SimulatedCloud:
    """Drive past the object and return its cloud; the same spec gives the same cloud.

    Raises:
        ConfigError: no such rig, one that ``run`` refuses, or ranges that cannot work.
        MeshError: no such object.
    """
    mesh = spec.object.mesh()
    drive = make_drive(spec, mesh)
    windows = Windows()
    run(drive, [windows])
    return observe(spec, mesh, drive, windows.results)


def make_drive(spec: DriveSpec, mesh: Mesh) -> DriveBy:
    """The drive-by of a spec; ``mesh`` is that of its object. The target is the first of its objects."""
    base = _rig(spec.rig)
    schedule = next(iter(base.radars.values())).schedule
    settings = spec.settings
    if settings is None:
        settings = draw(spec.ranges, spec.seed, schedule.frame_period_s)
        settings = replace(settings, track=replace(settings.track, every=min(spec.every, settings.track.frames)))
    rig = settings.processing.applied(base)
    duration_s = settings.track.frames * (settings.track.frame_period_s or schedule.frame_period_s)
    placed = make_scene(
        *(mesh, settings.scene, settings.surface, settings.track.speed_m_s * duration_s, duration_s),
        *(float(schedule.profile.wavelength_m), spec.seed),
    )
    return DriveBy(rig, placed, settings, spec.seed, shared_stages().synthesizers(rig))


def run(drive: DriveBy, sinks: Sequence[Sink]) -> Pipeline:
    """Everything that a drive-by gives through the whole pipeline; its stages are shared with the next drive-by.

    Raises:
        ConfigError: a rig of one radar, which sees no height, or one that does not look to the left of the vehicle.
    """
    name, radars, yaw_deg = drive.rig.name, drive.rig.radars, drive.rig.geometry.yaw_deg
    require(len(radars) == len(RADARS), f"radars of rig {name}", ", ".join(radars), " and ".join(RADARS))
    require(30 <= yaw_deg % 360 <= 150, f"geometry.yaw_deg of rig {name}", yaw_deg, "30..150, the scenes stand left")
    pipeline = Pipeline(drive.rig, None, sinks, shared_stages().imaging(drive.rig))
    for item in drive:
        pipeline.feed(item)
    pipeline.finish()
    return pipeline


@lru_cache(maxsize=1)
def shared_stages() -> SharedStages:
    """Those of this process."""
    return SharedStages()


@lru_cache(maxsize=8)
def _rig(name: str) -> Rig:
    return load_rig(name)


def observe(spec: DriveSpec, mesh: Mesh, drive: DriveBy, windows: Sequence[WindowResult]) -> SimulatedCloud:
    """The target's cloud among the windows of a drive-by, with the truth beside it and their statistics."""
    target = find_target(mesh, drive, windows)
    cloud, window = target.cloud, target.window
    empty = np.zeros((0, 3), np.float32)
    xyz_m, power_db = (cloud.xyz_m, cloud.power_db) if cloud else (empty, empty[:, 0])
    frames, travel_m = (window.frames, window.travel_m) if window else (0, 0.0)
    eyes_m = _eyes_m(drive, window)
    in_mesh = ((xyz_m - target.truth_translation_m) @ target.truth_rotation).astype(np.float32)
    statistics = measure(mesh, in_mesh, target.frame_number, frames, eyes_m, np.random.default_rng((spec.seed, 4)))
    return SimulatedCloud(
        *(spec, target.status, xyz_m, power_db, target.frame_number, cloud.sensor_m if cloud else np.full(3, np.nan)),
        *(target.truth_rotation, target.truth_translation_m, frames, travel_m, window is not None and window.complete),
        *(statistics, drive.settings),
    )


def find_target(mesh: Mesh, drive: DriveBy, windows: Sequence[WindowResult]) -> Target:
    """The cluster with the most points in the box of the true target, over all windows, and the truth in its frame."""
    best: tuple[int, WindowResult, ObjectCloud, NDArray[np.bool_]] | None = None
    for window in windows:
        for cloud in window.objects:
            inside = in_box(mesh, cloud.xyz_m, *truth_in_frame(drive, window.cloud, cloud.pose))
            if best is None or inside.sum() > best[0]:
                best = (int(inside.sum()), window, cloud, inside)
    none = np.zeros(0, np.int64)
    if best is None or best[0] < LEAST_POINTS:
        longest = max((w.cloud for w in windows), key=lambda cloud: cloud.frames, default=None)
        truth = truth_in_frame(drive, longest, None)
        return Target("missing", longest, None, none, *truth)
    count, window, cloud, inside = best
    truth = truth_in_frame(drive, window.cloud, cloud.pose)
    others = sum(
        int(in_box(mesh, one.xyz_m, *truth_in_frame(drive, window.cloud, one.pose)).sum())
        for one in window.objects
        if one is not cloud
    )
    status: Status = "whole"
    if 1.0 - inside.mean() > MERGED_SHARE:
        status = "merged"
    elif others > SPLIT_SHARE * (count + others):
        status = "split"
    return Target(status, window.cloud, cloud, frame_numbers(window.cloud, cloud), *truth)


def in_box(mesh: Mesh, xyz_m: Float32, rotation: Float64, translation_m: Float64) -> NDArray[np.bool_]:
    """Which points lie in the mesh's bounding box, 0.3 m wider on all sides; bool [n]."""
    local = (xyz_m - translation_m) @ rotation
    low, high = mesh.vertices.min(axis=0) - BOX_MARGIN_M, mesh.vertices.max(axis=0) + BOX_MARGIN_M
    inside: NDArray[np.bool_] = ((local >= low) & (local <= high)).all(axis=1)
    return inside


def truth_in_frame(
    drive: DriveBy, window: FusedCloud | ObjectCloud | None, pose: Pose | None, number: int = 0
) -> tuple[Float64, Float64]:
    """Rotation [3, 3] and translation [3] from the mesh's frame into an upright frame of the reported odometry.

    In the middle of the window the radar saw the target at its true place; where the reported pose of that instant puts
    that place is where the truth belongs.

    Args:
        drive: its objects; the first is the target.
        window: None: the middle of the whole drive.
        pose: of the frame, upright; None: on the ground below the target's reported place.
        number: of the object among the drive's.
    """
    span = (window.t_start_ns, window.t_end_ns) if window else drive.span_ns
    middle_ns = sum(span) // 2
    true, reported = drive.true_pose(middle_ns), drive.reported_pose(middle_ns)
    change = rotation_matrix(reported.quaternion_xyzw) @ rotation_matrix(true.quaternion_xyzw).T
    target = drive.placed[number].at(drive.seconds(middle_ns))
    rotation: Float64 = change @ target.rotation
    place_m: Float64 = change @ (target.position_m - true.position_m) + reported.position_m
    origin_m = np.append(place_m[:2], 0.0) if pose is None else pose.position_m
    return rotation, place_m - origin_m


def frame_numbers(window: FusedCloud, cloud: ObjectCloud) -> NDArray[np.int64]:
    """Frame of every point of an object, which is a part of the window's cloud."""
    axes = rotation_matrix(window.reference.quaternion_xyzw)
    whole = window.xyz_m.astype(np.float64) @ axes.T + (window.reference.position_m - cloud.pose.position_m)
    return window.frame_number[nearest_index(cloud.xyz_m, np.ascontiguousarray(whole, dtype=np.float32))]


def _eyes_m(drive: DriveBy, window: FusedCloud | None) -> list[Float64]:
    """Positions of the rig in the frame of the target's mesh: begin, middle and end of the window."""
    span = (window.t_start_ns, window.t_end_ns) if window else drive.span_ns
    eyes = []
    for t_ns in np.linspace(*span, VIEWS).astype(np.int64).tolist():
        target = drive.placed[0].at(drive.seconds(t_ns))
        eyes.append((drive.true_pose(t_ns).position_m - target.position_m) @ target.rotation)
    return eyes
