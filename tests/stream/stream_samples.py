# SPDX-License-Identifier: Apache-2.0
"""Small made-up data of every kind, and the stamp of the document's test vectors."""

from __future__ import annotations

import numpy as np

from edge.frames import Detections, FusedCloud, Heatmap, ObjectCloud, PointCloud, Pose, RadarId, Shape
from edge.stream.messages import PoseStatus, RadarStatus, Reason, Status
from edge.stream.wire import Stamp

BOOT = bytes(range(16))
STAMP = Stamp(BOOT, 7, 1_000_500_000, 1_800_000_000_000_000_000, True, "sim", b"configur", b"calibrat")


def pose(t_ns: int = 1_000_000_000) -> Pose:
    return Pose(t_ns, np.array([1.0, 2.5, 0.0]), np.array([0.0, 0.0, 0.6, 0.8]))


def object_cloud(points: int = 1) -> ObjectCloud:
    xyz = np.arange(3 * points, dtype=np.float32).reshape(points, 3) / 4
    power = np.zeros(points, np.float32)
    return ObjectCloud(5, xyz, power, pose(), 400_000_000, 1_000_000_000, 3.0, 36, True, np.array([-6.0, 0.5, 0.75]))


def shape(points: int = 2, class_name: str = "car") -> Shape:
    fine = np.array([[0.5, -1.0, 0.25], [2.0, 1.0, 1.75]], np.float32)
    if points != 2:
        fine = np.random.default_rng(0).normal(0, 1, (points, 3)).astype(np.float32)
    return Shape(
        identity=5,
        class_name=class_name,
        class_probability={"car": 0.75, "bicycle": 0.25, "unknown": 0.0},
        confidence=0.5,
        fine_m=fine,
        coarse_m=fine[:1],
        input=object_cloud(),
        model="0123456789abcdef",
        latency_us={"nn": 7000},
    )


def fused_cloud(points: int = 50) -> FusedCloud:
    rng = np.random.default_rng(1)
    xyz = rng.normal(0, 3, (points, 3)).astype(np.float32)
    numbers = np.arange(points, dtype=np.int64)
    power = rng.normal(0, 9, points).astype(np.float32)
    return FusedCloud(xyz, power, numbers, pose(), 4, 9, 2.5, 61, False, np.array([1.25, 0.0, 0.125]))


def heatmap(radar: RadarId = "horizontal", t_ns: int = 5) -> Heatmap:
    power = np.random.default_rng(2).exponential(1e6, (8, 12)).astype(np.float32)
    cosine = (np.arange(8, dtype=np.float32) - 4) / np.float32(4.1)
    return Heatmap(radar, 3, t_ns, power, cosine, np.arange(12, dtype=np.float32) * np.float32(0.15))


def detections(radar: RadarId, count: int = 3) -> Detections:
    columns = np.random.default_rng(len(radar)).normal(0, 1, (5, count)).astype(np.float32)
    columns[3] = np.nan
    return Detections(radar, 3, 77, *columns)


def point_cloud(points: int = 4) -> PointCloud:
    rng = np.random.default_rng(3)
    xyz = rng.normal(0, 3, (points, 3)).astype(np.float32)
    return PointCloud(3, 77, xyz, *rng.normal(0, 3, (3, points)).astype(np.float32))


def status() -> Status:
    return Status(
        state="DEGRADED",
        level=1,
        reasons=(Reason("POSE_GAP", 2, 10, 20, "no pose for 120 ms"),),
        radars={"horizontal": RadarStatus(60, 58, {"saturated": 1, "no_pose": 1}, 59.9)},
        latency_us={"heatmap": (4000.0, 5000.0, 9000.0)},
        pose=PoseStatus(12.0, 30.0, 1, "recorded"),
        system={"rss_mb": 210.0},
        versions={"rfconstruct": "0.1.0"},
        uptime_s=12.5,
    )
