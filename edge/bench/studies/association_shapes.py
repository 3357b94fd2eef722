# SPDX-License-Identifier: Apache-2.0
"""What the association does to the completed shape: a drive's points fused, completed and held against the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from edge.bench.studies.association_scenes import Drive, Scene
from edge.completion.manifest import find_model
from edge.completion.model import CompletionModel
from edge.frames import Float64, FusedCloud, PointCloud, Pose, Shape
from edge.fusion.objects import ObjectTracker
from edge.fusion.temporal import TemporalFusion
from edge.odometry.transforms import transform_points
from edge.reference.chamfer import chamfer_l1_m
from edge.rig import Rig


def completed(drive: Drive, rule: Callable[[Scene], Float64], rig: Rig) -> Shape | None:
    """The most trusted shape of a drive, if there is one.

    Args:
        drive: frame pairs, track.
        rule: scene -> points [n, 3] in the rig frame.
        rig: settings of fusion, objects and completion, with its model.
    """
    settings = replace(rig.settings.fusion, max_pose_gap_s=1.0)
    fusion, tracker = TemporalFusion(settings), ObjectTracker(rig.settings.objects, rig.geometry)
    model = CompletionModel.load(find_model(rig.settings.completion.model), rig.settings.completion)
    windows: list[FusedCloud | None] = []
    half = np.radians(rig.geometry.yaw_deg) / 2.0
    quaternion = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
    for number, (scene, shift) in enumerate(zip(drive.scenes, drive.shift_m, strict=True)):
        xyz = rule(scene).astype(np.float32)
        t_ns = round(number * drive.period_s * 1e9)
        column = np.zeros(len(xyz), dtype=np.float32)
        cloud = PointCloud(number, t_ns, xyz, column, column, column)
        windows.append(fusion.add(cloud, Pose(t_ns, shift.copy(), quaternion)))
    windows.append(fusion.flush())
    objects = [thing for window in windows if window is not None for thing in tracker.process(window)]
    shapes = [shape for shape in map(model.complete, objects) if shape is not None]
    return max(shapes, key=lambda shape: shape.confidence, default=None)


def distance_cm(shape: Shape, drive: Drive) -> float:
    """Chamfer distance between the completed shape and the true surface, cm."""
    placed = transform_points(shape.input.pose, shape.fine_m.astype(np.float64))
    return 100.0 * chamfer_l1_m(placed, drive.surface_m)
