# SPDX-License-Identifier: Apache-2.0
"""Typed messages: what a subscriber gets, with numpy arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from edge.frames import Detections, Float32, Float64, FusedCloud, PointCloud, Pose, RadarId
from edge.stream.wire import Source

State = Literal["INIT", "WAIT", "RUN", "DEGRADED", "FAULT", "STOP"]
STATES: tuple[State, ...] = ("INIT", "WAIT", "RUN", "DEGRADED", "FAULT", "STOP")
LEVELS = {"OK": 0, "WARN": 1, "ERROR": 2, "STALE": 3}
"""Levels of diagnostic_msgs/DiagnosticStatus."""


@dataclass(frozen=True, slots=True)
class Header:
    """Common part of every message.

    Args:
        topic: as sent, for example ``1/shape/car/``.
        minor: minor version of the sender.
        boot: 16 bytes, another with every start of the publisher.
        sequence: number within the topic.
        t_ns: instant of the measurement, CLOCK_MONOTONIC of the publisher's machine.
        t_pub_ns: instant of publication, same clock.
        utc_ns, utc_ok: that instant in UTC, and whether that clock is synchronised.
        frame: frame of reference of the coordinates, or "".
        source: "live", "replay" or "sim".
        config_hash, calibration_hash: 8 bytes each.
        flags: FLAG_* bits of edge/stream/wire.py.
    """

    topic: str
    minor: int
    boot: bytes
    sequence: int
    t_ns: int
    t_pub_ns: int
    utc_ns: int
    utc_ok: bool
    frame: str
    source: Source
    config_hash: bytes
    calibration_hash: bytes
    flags: int


@dataclass(frozen=True, slots=True)
class ShapeMessage:
    """A completed object.

    Args:
        header: common part; ``t_ns`` is the end of the window.
        identity: of the object, lasts from window to window.
        class_name: most probable class or "unknown".
        class_probability: class name -> probability.
        confidence: 0..1.
        pose: object frame in the odometry frame.
        size_m: float64 [3], extent along x, y, z of the object frame, from the 1 % to the 99 % quantile of the points.
        input_points: points that the network saw; ``input_m`` may hold more.
        frames: frames of the window.
        t_start_ns, t_end_ns: first and last frame of the window.
        travel_m: travel inside the window.
        latency_us: stage -> microseconds.
        model: first 16 hex digits of the model file's SHA-256.
        fine_m: float32 [n, 3], object frame.
        input_m: float32 [m, 3], the partial input in the object frame, or None when it was not sent.
        pose_vehicle: object frame in the vehicle frame (base_link), or None when it was not sent.
        age_s: since the object was first seen; 0 from a publisher of version 1.0.
        final: the object has left the window; no more of it will come.
    """

    header: Header
    identity: int
    class_name: str
    class_probability: dict[str, float]
    confidence: float
    pose: Pose
    size_m: Float64
    input_points: int
    frames: int
    t_start_ns: int
    t_end_ns: int
    travel_m: float
    latency_us: dict[str, int]
    model: str
    fine_m: Float32
    input_m: Float32 | None
    pose_vehicle: Pose | None = None
    age_s: float = 0.0
    final: bool = False


@dataclass(frozen=True, slots=True)
class CloudMessage:
    """The fused cloud of a window, in the window frame."""

    header: Header
    cloud: FusedCloud


@dataclass(frozen=True, slots=True)
class HeatmapMessage:
    """Range-angle power of one radar, in steps of half a decibel.

    Args:
        header: common part; ``t_ns`` is the first chirp.
        radar: which radar.
        number: frame number.
        power_db: float32 [angle, range]; the lowest value means "this or less".
        direction_cosine: float32 [angle].
        range_m: float32 [range].
    """

    header: Header
    radar: RadarId
    number: int
    power_db: Float32
    direction_cosine: Float32
    range_m: Float32


@dataclass(frozen=True, slots=True)
class DetectionsMessage:
    """Detections of one frame of each radar, and the 3-D points made of them.

    Args:
        header: common part; ``t_ns`` is the first chirp of the first radar's burst.
        number: frame number.
        horizontal, vertical: of each radar, or None when the rig does not have it.
        points: associated points in the rig frame, or None in a rig of one radar.
    """

    header: Header
    number: int
    horizontal: Detections | None
    vertical: Detections | None
    points: PointCloud | None


@dataclass(frozen=True, slots=True)
class PoseMessage:
    """Pose of the rig in the odometry frame."""

    header: Header
    pose: Pose


@dataclass(frozen=True, slots=True)
class Reason:
    """Why the state is not RUN: an upper-case code, how often, first and last instant, and words."""

    code: str
    count: int
    first_ns: int
    last_ns: int
    detail: str = ""


@dataclass(frozen=True, slots=True)
class RadarStatus:
    """The account of one radar's frames: ``frames_in = frames_ok + sum(lost.values())``."""

    frames_in: int
    frames_ok: int
    lost: dict[str, int] = field(default_factory=dict)
    fps: float = 0.0


@dataclass(frozen=True, slots=True)
class PoseStatus:
    """The pose source: age of the newest pose, its rate, gaps so far, and where poses come from."""

    age_ms: float
    rate_hz: float
    gaps: int
    source: str


@dataclass(frozen=True, slots=True)
class Status:
    """How the appliance does.

    Args:
        state: INIT, WAIT, RUN, DEGRADED, FAULT or STOP.
        level: of ``LEVELS``.
        reasons: what keeps it from RUN.
        radars: radar id -> account of its frames.
        latency_us: stage -> (p50, p99, max).
        pose: the pose source, None without one.
        system: figures of the machine, for example cpu, temp_c, rss_mb.
        versions: component -> version.
        uptime_s: since the start.
    """

    state: State
    level: int = 0
    reasons: tuple[Reason, ...] = ()
    radars: dict[str, RadarStatus] = field(default_factory=dict)
    latency_us: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    pose: PoseStatus | None = None
    system: dict[str, float] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    uptime_s: float = 0.0


@dataclass(frozen=True, slots=True)
class StatusMessage:
    """State of the appliance, once a second and on change."""

    header: Header
    status: Status


@dataclass(frozen=True, slots=True)
class HeartbeatMessage:
    """Sign of life, ten times a second."""

    header: Header
    state: State


Message = (
    ShapeMessage | CloudMessage | HeatmapMessage | DetectionsMessage | PoseMessage | StatusMessage | HeartbeatMessage
)
