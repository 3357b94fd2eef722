# SPDX-License-Identifier: Apache-2.0
"""One picture of a simulated drive-by: object, heatmaps, each radar alone, both together, perturbed geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from edge.errors import RfconstructError
from edge.frames import RADARS, Detections, Float32, FusedCloud, Heatmap, ObjectCloud, Pose, RadarId
from edge.odometry.transforms import rotation_matrix
from edge.pipeline import FrameResult, WindowResult
from edge.plot.collector import FOV_DEG, copy_heatmap, single_radar_points
from edge.plot.figure import BOTH, COARSE, HORIZONTAL, VERTICAL, dress, new_figure, prepare_folder, write
from edge.plot.heatmaps import heatmap_panel
from edge.rig import Radar
from train.objects.mesh import CLASSES, Mesh
from train.objects.reference import ObjectRef
from train.objects.sampling import sample_surface
from train.perturb import perturb
from train.perturb_settings import PerturbSettings
from train.simulate.cloud import DriveSpec, SimulatedCloud, find_target, make_drive, observe, run
from train.simulate.settings import SimulationSettings

MARGIN_M = 0.6
TRUTH_POINTS = 4000
TRUTH = "#c3c8cf"
DPI = 85
SPAN_DB = 25.0
AROUND_M = 3.0
"""Heatmaps are drawn this far beyond the object."""


@dataclass(slots=True)
class Kept:
    """A sink that keeps what the picture shows.

    Args:
        boards: of the rig.
        middle: number of the frame whose heatmaps are shown.
    """

    boards: Mapping[RadarId, Radar]
    middle: int
    heatmaps: dict[RadarId, Heatmap] = field(default_factory=dict)
    detections: dict[RadarId, Detections] = field(default_factory=dict)
    frames: list[tuple[Pose, dict[RadarId, Detections]]] = field(default_factory=list)
    windows: list[WindowResult] = field(default_factory=list)

    def frame(self, result: FrameResult) -> None:
        """Poses and detections of every frame, heatmaps of the middle one."""
        if result.pose is not None:
            self.frames.append((result.pose, dict(result.detections)))
        if result.number == self.middle:
            self.heatmaps = {radar: copy_heatmap(heatmap) for radar, heatmap in result.heatmaps.items()}
            self.detections = dict(result.detections)

    def window(self, result: WindowResult) -> None:
        """All of them."""
        self.windows.append(result)


def write_montages(
    folder: Path,
    objects: Sequence[str],
    seed: int,
    rig: str,
    every: int,
    settings: SimulationSettings | None = None,
) -> list[SimulatedCloud]:
    """A picture of a drive-by for every object, ``simulated_<class>.png``, numbered when there are several of a class.

    Args:
        folder: is made when it is not there.
        objects: text forms of ObjectRefs; empty: a parametric object of every class.
        seed: of the drive-bys.
        rig, every, settings: as in ``DriveSpec``.
    Raises:
        DependencyError: matplotlib is not installed.
        RfconstructError: the folder cannot be written, no such object or rig, or nothing was seen of an object.
    """
    prepare_folder(folder)
    made: list[SimulatedCloud] = []
    for text in objects or [f"{name}/parametric_00000" for name in CLASSES]:
        ref = ObjectRef.from_text(text)
        number = sum(one.spec.object.class_name == ref.class_name for one in made)
        name = f"simulated_{ref.class_name}" + (f"_{number + 1}" if number else "")
        made.append(montage(DriveSpec(ref, seed, rig=rig, every=every, settings=settings), folder / f"{name}.png"))
    return made


def montage(spec: DriveSpec, path: Path) -> SimulatedCloud:
    """Simulate a drive-by and write its picture.

    Raises:
        RfconstructError: the pipeline found no cluster of the object.
        DependencyError: matplotlib is not installed.
    """
    mesh = spec.object.mesh()
    drive = make_drive(spec, mesh)
    kept = Kept(drive.rig.radars, drive.frames // 2)
    run(drive, [kept])
    made, target = observe(spec, mesh, drive, kept.windows), find_target(mesh, drive, kept.windows)
    if target.window is None or target.cloud is None:
        raise RfconstructError(f"{spec.object}, seed {spec.seed}: no cluster of the object", action="take another seed")
    figure = new_figure(12.0, 9.4, f"Simulated drive-by past {spec.object}", _caption(made))
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.0, 1.25))
    _top_row(top, mesh, made, kept)
    _clouds(bottom, mesh, made, kept, target.window, target.cloud)
    write(figure, path, dpi=DPI)
    return made


def _caption(made: SimulatedCloud) -> str:
    figures, scene = made.statistics, made.settings.scene
    return (
        f"{scene.side_m:.1f} m aside, neighbours: {scene.neighbours}; {made.frames} frames over {made.travel_m:.1f} m; "
        f"{100 * figures.within_10cm:.0f} % of the points within 10 cm of the true surface (grey), "
        f"{100 * figures.within_20cm:.0f} % within 20 cm; the cluster is {made.status}"
    )


def _top_row(row: Any, mesh: Mesh, made: SimulatedCloud, kept: Kept) -> None:
    from train.contact_sheet import shade

    axes = row.subplots(1, 3, width_ratios=(1.0, 1.5, 1.15))
    sensor_m = made.truth_rotation.T @ (made.sensor_m - made.truth_translation_m)
    towards = sensor_m / np.linalg.norm(sensor_m[:2]) * 4.0
    axes[0].imshow(shade(mesh, (towards[0], towards[1], 1.2), 480, 300), cmap="gray", vmin=0, vmax=1)
    axes[0].set_axis_off()
    axes[0].set_title("The object, from the radar's side", fontsize=10, loc="left")
    limit_m = float(np.linalg.norm(made.sensor_m)) + AROUND_M
    for axis, radar in zip(axes[1:], RADARS, strict=True):
        shown = kept.heatmaps[radar], kept.detections[radar]
        heatmap_panel(row, axis, *shown, limit_m, np.radians(FOV_DEG), SPAN_DB)


def _clouds(row: Any, mesh: Mesh, made: SimulatedCloud, kept: Kept, window: FusedCloud, cloud: ObjectCloud) -> None:
    """Four clouds in the object frame, from above and from the side of the radar, the truth in grey below them."""
    inside = [entry for entry in kept.frames if window.t_start_ns <= entry[0].t_ns <= window.t_end_ns]
    alone = {radar: _alone(kept.boards[radar], inside, window, cloud) for radar in RADARS}
    rng = np.random.default_rng(made.spec.seed)
    rotation, shift_m = made.truth_rotation.astype(np.float32), made.truth_translation_m.astype(np.float32)
    truth = sample_surface(mesh.vertices, mesh.faces, TRUTH_POINTS, rng) @ rotation.T + shift_m
    scan, _ = perturb(mesh, PerturbSettings(), rng, _sector(made))
    layers = (
        ("Horizontal alone", HORIZONTAL, alone["horizontal"]),
        ("Vertical alone", VERTICAL, alone["vertical"]),
        ("Both", BOTH, cloud.xyz_m),
        ("Perturbed", COARSE, scan @ rotation.T + shift_m),
    )
    low, high = truth.min(axis=0) - MARGIN_M, truth.max(axis=0) + MARGIN_M
    views = (("from above", 0, 1), ("from the radar", 0, 2))
    spans = [high[up] - low[up] for _, _, up in views]
    grid = row.subplots(2, len(layers), sharex="col", height_ratios=[max(span, 1.0) for span in spans])
    for line, (view, across, up) in zip(grid, views, strict=True):
        for axis, (title, colour, points) in zip(line, layers, strict=True):
            axis.scatter(truth[:, across], truth[:, up], s=1.0, c=TRUTH, linewidths=0, rasterized=True)
            axis.scatter(points[:, across], points[:, up], s=5.0, c=colour, linewidths=0, alpha=0.6, rasterized=True)
            name = f"{title}, {len(points)} points" if up == 1 else view
            dress(axis, name, "along the track  x (m)" if up == 2 else "", "y (m)" if up == 1 else "up  z (m)")
            axis.set_xlim(low[across], high[across])
            axis.set_ylim(low[up], high[up])
            axis.set_aspect("equal")


def _alone(
    board: Radar, frames: list[tuple[Pose, dict[RadarId, Detections]]], window: FusedCloud, cloud: ObjectCloud
) -> Float32:
    """One radar's detections in the object frame; what it cannot know is as at its own height, or straight ahead."""
    points = single_radar_points(board.radar, frames, window.reference)[:, :3] + np.array(board.mounting.position_m)
    axes = rotation_matrix(window.reference.quaternion_xyzw)
    moved = points @ axes.T + (window.reference.position_m - cloud.pose.position_m)
    return np.asarray(moved, dtype=np.float32)


def _sector(made: SimulatedCloud) -> int:
    """Eighth of the circle about the object in which the radar was."""
    x, y, _ = made.truth_rotation.T @ (made.sensor_m - made.truth_translation_m)
    return int(np.floor(np.arctan2(y, x) / (np.pi / 4))) % 8
