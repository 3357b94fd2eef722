# SPDX-License-Identifier: Apache-2.0
"""A made-up drive as messages of the stream: the rig drives along x and looks left, objects stand beside it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.frames import Detections, Float32, FusedCloud, Heatmap, ObjectCloud, PointCloud, Pose, RadarId, Shape
from edge.stream import convert
from edge.stream.decode import decode
from edge.stream.messages import Message, RadarStatus, Reason, State, Status
from edge.stream.wire import Draft, Stamp, join, pack

S = 1_000_000_000
BOOT = bytes(16)
SPEED_M_S = 5.0
LEFT = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
COSINES = np.linspace(-0.9, 0.9, 91).astype(np.float32)
RANGES_M = (0.1 * np.arange(151)).astype(np.float32)


def message(draft: Draft, boot: bytes = BOOT, sequence: int = 0) -> Message:
    """As a subscriber gets it."""
    found = decode(pack(draft, Stamp(boot, sequence, draft.t_ns, 0, True, "sim", bytes(8), bytes(8))))
    assert found is not None
    return found


def block(draft: Draft) -> bytes:
    """As a recording keeps it."""
    return join(pack(draft, Stamp(BOOT, 0, draft.t_ns, 0, True, "sim", bytes(8), bytes(8))))


def pose_at(t_s: float, origin_m: float = 0.0) -> Pose:
    """The rig 0.8 m above the ground."""
    return Pose(round(t_s * S), np.array([origin_m + SPEED_M_S * t_s, 0.0, 0.8]), LEFT)


def pose_draft(t_s: float, origin_m: float = 0.0) -> Draft:
    return convert.encode_pose(pose_at(t_s, origin_m))


def brick(size_m: tuple[float, float, float], yaw_rad: float = 0.0, count: int = 3000) -> Float32:
    """Points inside an upright brick on the ground around the origin, float32 [n, 3]."""
    points = (np.random.default_rng(0).random((count, 3)) - [0.5, 0.5, 0.0]) * size_m
    turn = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]])
    points[:, :2] = points[:, :2] @ turn.T
    return points.astype(np.float32)


def thing(
    identity: int,
    t_s: float,
    at_m: tuple[float, float] = (5.0, 4.0),
    class_name: str = "car",
    points_m: Float32 | None = None,
) -> Shape:
    """A shape on the ground at ``at_m`` whose window ended at ``t_s``."""
    points_m = brick((4.2, 1.8, 1.5)) if points_m is None else points_m
    where = Pose(round(t_s * S), np.array([*at_m, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    seen = points_m[:50]
    cloud = ObjectCloud(
        *(identity, seen, np.zeros(len(seen), np.float32), where),
        *(round((t_s - 0.6) * S), round(t_s * S), 3.0, 36, True, np.array([0.0, -4.0, 0.8])),
    )
    return Shape(identity, class_name, {class_name: 0.9, "unknown": 0.1}, 0.9, points_m, points_m[:1], cloud, "0" * 16)


def shape_draft(identity: int, t_s: float, at_m: tuple[float, float] = (5.0, 4.0), class_name: str = "car") -> Draft:
    return convert.encode_shape(thing(identity, t_s, at_m, class_name))


def cloud_draft(t_s: float, points: int = 400) -> Draft:
    """Points 3 to 6 m in front of the rig, of power 20 to 60 dB."""
    rng = np.random.default_rng(1)
    xyz = (rng.random((points, 3)) * [3.0, 4.0, 1.6] + [3.0, -2.0, -0.7]).astype(np.float32)
    power = np.linspace(20, 60, points).astype(np.float32)
    reference = pose_at(t_s - 0.6)
    ends = (reference.t_ns, round(t_s * S))
    return convert.encode_cloud(
        FusedCloud(xyz, power, np.arange(points), reference, *ends, 3.0, 36, True, np.array([1.5, 0.0, 0.0]))
    )


def found(radar: RadarId, number: int, t_s: float) -> Detections:
    """Two detections: 6 m ahead, and 8 m away at direction cosine 0.5."""
    columns = np.array([[6.0, 8.0], [0.0, 0.5], [50.0, 40.0], [0.0, 0.0], [20.0, 15.0]], np.float32)
    return Detections(radar, number, round(t_s * S), *columns)


def detections_draft(t_s: float, number: int = 0) -> Draft:
    xyz = np.array([[5.0, 0.0, 0.0], [6.9, 4.0, 0.2]], np.float32)
    columns = np.full((3, 2), 5.0, np.float32)
    points = PointCloud(number, round(t_s * S), xyz, *columns)
    return convert.encode_detections(found("horizontal", number, t_s), found("vertical", number, t_s), points)


def heatmap_draft(radar: RadarId, t_s: float, number: int = 0) -> Draft:
    """Noise around 1, a peak of 10000 (40 dB) where the first detection is."""
    power = np.random.default_rng(2).exponential(1.0, (len(COSINES), len(RANGES_M))).astype(np.float32)
    power[45, 59:62] = 1e4
    power[69:71, 79:82] = 3e3
    return convert.encode_heatmap(Heatmap(radar, number, round(t_s * S), power, COSINES, RANGES_M))


def status_draft(t_s: float, state: State = "RUN", lost: int = 0, detail: str = "") -> Draft:
    reasons = (Reason("NO_POSE", lost, 1, 2, detail),) if lost or detail else ()
    count = round(60 * t_s)
    status = Status(
        state=state,
        level=1 if reasons else 0,
        reasons=reasons,
        radars={
            r: RadarStatus(count, count - lost, {"no_pose": lost} if lost else {}, 59.9)
            for r in ("horizontal", "vertical")
        },
        latency_us={"heatmap": (900.0, 1500.0, 3e3), "detect": (3e2, 5e2, 9e2), "complete": (5e3, 12e3, 2e4)},
        uptime_s=t_s,
    )
    return convert.encode_status(status, round(t_s * S))


def drive(length_s: float) -> list[Draft]:
    """Everything of a short drive past a car, a bicycle and a pedestrian, in time order."""
    drafts: list[Draft] = []
    steps = round(20 * length_s)
    for number in range(steps + 1):
        t_s = number / 20
        drafts += [pose_draft(t_s), detections_draft(t_s, number)]
        if number % 2 == 0:
            drafts += [heatmap_draft("horizontal", t_s, number), heatmap_draft("vertical", t_s, number)]
        if number % 10 == 9:
            drafts += [cloud_draft(t_s), status_draft(t_s), shape_draft(1, t_s, (10.5, 4.6))]
            drafts.append(convert.encode_shape(thing(2, t_s, (7.5, 3.4), "bicycle", brick((1.8, 0.5, 1.6), 0.4))))
            drafts.append(convert.encode_shape(thing(3, t_s, (12.0, 3.0), "pedestrian", brick((0.5, 0.5, 1.7)))))
    return drafts


def final(shape: Shape) -> Draft:
    """The last shape of an object."""
    draft = convert.encode_shape(shape)
    return replace(draft, flags=draft.flags | 4)
