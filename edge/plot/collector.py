# SPDX-License-Identifier: Apache-2.0
"""A sink that remembers what the pictures need and writes them when the run is over."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edge.best_shapes import keep_best
from edge.config import AssociationSettings
from edge.frames import RADARS, Detections, Float32, FusedCloud, Heatmap, Pose, RadarId, Shape
from edge.odometry.transforms import rotation_matrix
from edge.pipeline import FrameResult, WindowResult
from edge.plot.clouds import cloud_picture
from edge.plot.figure import prepare_folder
from edge.plot.heatmaps import heatmap_picture
from edge.plot.shapes import shape_picture

MAX_KEPT_FRAMES = 4096
FOV_DEG = AssociationSettings().fov_deg


class PictureCollector:
    """Keeps the frame with the most detections, the detections of the current window, and the largest window.

    Args:
        folder: where ``write`` puts the PNGs.
        subtitle: one line under every title, such as the recording's name.
        truth_odom_m: float32 [n, 3], surface of the true object in the odometry frame, for simulated scenes.
        fov_deg: field of view of the association (``association.fov_deg``).
    Raises:
        DependencyError: matplotlib is not installed.
        RfconstructError: the folder cannot be written.
    """

    def __init__(
        self, folder: Path, subtitle: str, truth_odom_m: Float32 | None = None, fov_deg: float = FOV_DEG
    ) -> None:
        prepare_folder(folder)
        self.folder, self.subtitle, self._truth_odom_m, self._fov_deg = folder, subtitle, truth_odom_m, fov_deg
        self._best: tuple[int, dict[RadarId, Heatmap], dict[RadarId, Detections]] | None = None
        self._frames: list[tuple[Pose, dict[RadarId, Detections]]] = []
        self._window: tuple[FusedCloud, list[tuple[Pose, dict[RadarId, Detections]]]] | None = None
        self._shapes: dict[int, Shape] = {}

    def frame(self, result: FrameResult) -> None:
        """Keep a copy of the heatmaps when no earlier frame had more detections."""
        count = sum(map(len, result.detections.values()))
        if len(result.heatmaps) == len(result.detections) and (self._best is None or count > self._best[0]):
            copies = {radar: copy_heatmap(heatmap) for radar, heatmap in result.heatmaps.items()}
            self._best = (count, copies, dict(result.detections))
        if result.pose is not None and len(self._frames) < MAX_KEPT_FRAMES:
            self._frames.append((result.pose, dict(result.detections)))

    def window(self, result: WindowResult) -> None:
        """Keep the window with the most points, and the most trusted shape of every object."""
        inside = [entry for entry in self._frames if entry[0].t_ns >= result.cloud.t_start_ns]
        if self._window is None or len(result.cloud) > len(self._window[0]):
            self._window = (result.cloud, [entry for entry in inside if entry[0].t_ns <= result.cloud.t_end_ns])
        self._frames = inside
        for shape in result.shapes:
            self.shape(shape)

    def shape(self, shape: Shape) -> None:
        """Keep the most trusted shape of every object."""
        keep_best(self._shapes, shape)

    def write(self) -> list[Path]:
        """Write all pictures that there is something for; returns their paths."""
        paths = []
        if self._best is not None:
            paths.append(heatmap_picture(self.folder / "heatmaps.png", *self._best[1:], self.subtitle, self._fov_deg))
        if self._window is not None and len(self._window[0]):
            cloud, frames = self._window
            alone = [single_radar_points(radar, frames, cloud.reference, self._fov_deg) for radar in RADARS]
            span = f"{self.subtitle}; {cloud.frames} frames, {cloud.travel_m:.2f} m of travel"
            paths.append(cloud_picture(self.folder / "fused_cloud.png", cloud, alone[0], alone[1], span))
        for identity, shape in sorted(self._shapes.items()):
            truth_m = None if self._truth_odom_m is None else to_object_frame(self._truth_odom_m, shape.input.pose)
            path = self.folder / f"shape_{identity}.png"
            paths.append(shape_picture(path, shape, self.subtitle, truth_m))
        return paths


def single_radar_points(
    radar: RadarId,
    frames: list[tuple[Pose, dict[RadarId, Detections]]],
    reference: Pose,
    fov_deg: float = FOV_DEG,
) -> Float32:
    """One radar's detections inside its field of view, placed by the poses; the unknown direction is set to zero.

    Args:
        radar: which.
        frames: pose of the rig and detections of every frame.
        reference: pose of the frame of reference of the result.
        fov_deg: largest angle off boresight along the radar's array.
    Returns:
        float32 [n, 4]: x, y, z in metres in the frame of ``reference``, power in dB.
    """
    along = 1 if radar == "horizontal" else 2
    home = rotation_matrix(reference.quaternion_xyzw)
    parts = [np.zeros((0, 4))]
    for pose, detections in frames:
        found = detections[radar]
        inside = np.abs(found.direction_cosine) <= np.sin(np.radians(fov_deg))
        r, u = found.range_m[inside].astype(np.float64), found.direction_cosine[inside].astype(np.float64)
        rig_m = np.zeros((len(r), 3))
        rig_m[:, 0], rig_m[:, along] = r * np.sqrt(1.0 - u**2), r * u
        odom_m = rig_m @ rotation_matrix(pose.quaternion_xyzw).T + (pose.position_m - reference.position_m)
        parts.append(np.column_stack((odom_m @ home, found.power_db[inside])))
    return np.concatenate(parts).astype(np.float32)


def to_object_frame(points_odom_m: Float32, pose: Pose) -> Float32:
    """Points [n, 3] of the odometry frame in the frame whose pose in it is ``pose``."""
    return np.asarray((points_odom_m - pose.position_m) @ rotation_matrix(pose.quaternion_xyzw), dtype=np.float32)


def copy_heatmap(heatmap: Heatmap) -> Heatmap:
    """The power of a heatmap for keeping, without its Doppler maps."""
    return Heatmap(
        *(heatmap.radar, heatmap.number, heatmap.t_first_chirp_ns, heatmap.power.copy()),
        *(heatmap.direction_cosine, heatmap.range_m, heatmap.response),
    )
