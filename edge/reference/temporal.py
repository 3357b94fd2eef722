# SPDX-License-Identifier: Apache-2.0
"""Temporal fusion from its definition in float64: all frames at hand, windows by index, points moved by matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.config import FusionSettings
from edge.frames import Float64, PointCloud, Pose

STEP_M = 0.02
TOLERANCE_M = 1e-6


@dataclass(frozen=True, slots=True)
class Window:
    """Frames ``first`` to ``last``, both included; points [n, 3] and mean rig position [3] seen from the first."""

    first: int
    last: int
    travel_m: float
    complete: bool
    xyz_m: Float64
    sensor_m: Float64


def matrix(pose: Pose) -> Float64:
    """Homogeneous [4, 4] of a pose, rig to odometry, from v' = v + 2 q x (q x v + w v)."""
    q = pose.quaternion_xyzw / np.linalg.norm(pose.quaternion_xyzw)
    columns = [v + 2.0 * np.cross(q[:3], np.cross(q[:3], v) + q[3] * v) for v in np.eye(3)]
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = np.stack(columns, axis=1), pose.position_m
    return result


def interrupted(a: Pose, b: Pose, settings: FusionSettings) -> bool:
    """Whether a gap or a jump lies between two poses."""
    step_s = (b.t_ns - a.t_ns) / 1e9
    turn = matrix(a)[:3, :3].T @ matrix(b)[:3, :3]
    turn_deg = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
    travel_m = np.linalg.norm(b.position_m - a.position_m)
    too_fast = travel_m > settings.max_speed_m_s * step_s or turn_deg > settings.max_turn_deg_s * step_s
    return bool(step_s > settings.max_pose_gap_s or too_fast)


def paths(poses: Sequence[Pose], settings: FusionSettings) -> tuple[list[float], list[bool]]:
    """Path up to every pose, and whether an interruption lies before it."""
    path_m, broken = [], []
    anchor, before_m = poses[0].position_m, 0.0
    for k, pose in enumerate(poses):
        broken.append(k > 0 and interrupted(poses[k - 1], pose, settings))
        if broken[k]:
            anchor = pose.position_m
        chord_m = float(np.linalg.norm(pose.position_m - anchor))
        path_m.append(before_m + chord_m)
        if chord_m >= STEP_M:
            anchor, before_m = pose.position_m, before_m + chord_m
    return path_m, broken


def fuse(clouds: Sequence[PointCloud], poses: Sequence[Pose], settings: FusionSettings) -> list[Window]:
    """All windows of a drive, the last one by flush; nothing is ever overwritten.

    Args:
        clouds, poses: of every frame, in order of time.
        settings: travel, hop, time, gaps.
    """
    path_m, broken = paths(poses, settings)
    hop_m = settings.hop_m or 0.5 * settings.travel_m
    seconds = [(pose.t_ns - poses[0].t_ns) / 1e9 for pose in poses]
    to_odom = [matrix(pose) for pose in poses]

    def window(first: int, last: int, covered: bool) -> Window:
        back = np.linalg.inv(to_odom[first])
        moved = [np.zeros((0, 3))]
        for k in range(first, last + 1):
            points = np.column_stack([clouds[k].xyz_m.astype(np.float64), np.ones(len(clouds[k]))])
            moved.append((points @ (back @ to_odom[k]).T)[:, :3])
        complete = covered and last - first + 1 >= settings.min_frames
        sensor_m = np.mean([(back @ to_odom[k])[:3, 3] for k in range(first, last + 1)], axis=0)
        return Window(first, last, max(path_m[last] - path_m[first], 0.0), complete, np.concatenate(moved), sensor_m)

    def after(first: int, now: int, stored: int) -> int:
        for k in range(first + 1, stored):
            if path_m[k] >= path_m[first] + hop_m - TOLERANCE_M and seconds[now] - seconds[k] <= settings.max_time_s:
                return k
        return stored

    found, first = [], 0
    for k in range(len(poses)):
        closed = False
        if broken[k]:
            if first < k:
                found.append(window(first, k - 1, False))
            closed, first = first < k, k
        elif first < k and seconds[k] - seconds[first] > settings.max_time_s:
            found.append(window(first, k - 1, False))
            closed, first = True, after(first, k, k)
        if not closed and path_m[k] - path_m[first] >= settings.travel_m - TOLERANCE_M:
            found.append(window(first, k, True))
            first = after(first, k, k + 1)
    if first < len(poses):
        found.append(window(first, len(poses) - 1, False))
    return found
