# SPDX-License-Identifier: Apache-2.0
"""Received frames to typed messages; whatever the bytes are, the only error is ``WireError``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from edge.errors import PoseError, WireError
from edge.frames import RADARS, Detections, Float32, FusedCloud, PointCloud, Pose, RadarId
from edge.stream.fields import U32, Fields
from edge.stream.messages import (
    LEVELS,
    STATES,
    CloudMessage,
    DetectionsMessage,
    Header,
    HeartbeatMessage,
    HeatmapMessage,
    Message,
    PoseMessage,
    PoseStatus,
    RadarStatus,
    Reason,
    ShapeMessage,
    State,
    Status,
    StatusMessage,
)
from edge.stream.points import read_points
from edge.stream.wire import BOOT_BYTES, FLAG_CUT_WINDOW, FLAG_FINAL, HASH_BYTES, SOURCES, Received, Source, unpack

AXIS_LIMIT = 4096


def decode(frames: Sequence[bytes]) -> Message | None:
    """One message from its frames.

    Args:
        frames: topic, header and payloads as received.
    Returns:
        The message, or None for a type that this version does not know.
    Raises:
        WireError: anything that is not the format.
    """
    received = unpack(frames)
    reader = _READERS.get(received.fields.text("type"))
    if reader is None:
        return None
    with np.errstate(all="ignore"):  # numbers beyond float32 become infinite and are refused where they matter
        return reader(read_header(received), received)


def read_header(received: Received) -> Header:
    """The common part of a message."""
    fields = received.fields
    return Header(
        topic=received.topic,
        minor=Fields({"minor": fields.array("v")[1]}, "header.v").integer("minor"),
        boot=fields.binary("boot", BOOT_BYTES),
        sequence=fields.integer("seq"),
        t_ns=fields.instant("t_ns"),
        t_pub_ns=fields.instant("t_pub_ns"),
        utc_ns=fields.instant("utc_ns"),
        utc_ok=fields.flag("utc_ok"),
        frame=fields.text("frame"),
        source=cast(Source, fields.text("src", SOURCES)),
        config_hash=fields.binary("cfg", HASH_BYTES),
        calibration_hash=fields.binary("cal", HASH_BYTES),
        flags=fields.integer("flags", U32),
    )


def _payload(received: Received, number: int) -> bytes:
    if number >= len(received.payloads):
        raise WireError(f"payload {number} is missing", value=len(received.payloads))
    return received.payloads[number]


def _xyz(received: Received, key: str, number: int) -> Float32:
    columns = read_points(received.fields.section(key), _payload(received, number), ("x", "y", "z"))
    return _stacked(columns)


def _stacked(columns: dict[str, NDArray[Any]]) -> Float32:
    """Coordinates float32 [n, 3]; all of them numbers."""
    points = np.stack([columns[name] for name in ("x", "y", "z")], axis=1)
    if not np.isfinite(points).all():
        raise WireError("coordinates are not finite")
    return points


def _columns(received: Received, key: str, number: int, names: Sequence[str]) -> list[Float32]:
    columns = read_points(received.fields.section(key), _payload(received, number), names)
    return [columns[name].astype(np.float32, copy=False) for name in names]


def _pose(fields: Fields) -> Pose:
    position, quaternion = fields.numbers("p", 3), fields.numbers("q", 4)
    try:
        return Pose(fields.instant("t_ns"), np.array(position), np.array(quaternion))
    except PoseError as error:
        raise WireError(f"{fields.where}: {error.what}", value=error.value, allowed=error.allowed) from error


def _shape(header: Header, received: Received) -> ShapeMessage:
    fields = received.fields
    names = [str(name) for name in fields.array("cls_n")]
    return ShapeMessage(
        header=header,
        identity=fields.integer("id", U32),
        class_name=fields.text("cls"),
        class_probability=dict(zip(names, fields.numbers("cls_p", len(names)), strict=True)),
        confidence=fields.number("conf"),
        pose=_pose(fields.section("pose")),
        size_m=np.array(fields.numbers("size", 3)),
        input_points=fields.integer("n_in"),
        frames=fields.integer("n_frames"),
        t_start_ns=fields.instant("t0_ns"),
        t_end_ns=fields.instant("t1_ns"),
        travel_m=fields.number("travel_m"),
        latency_us={key: fields.section("lat_us").integer(key) for key in fields.section("lat_us")},
        model=fields.binary("model", HASH_BYTES).hex(),
        fine_m=_xyz(received, "pts", 0),
        input_m=_xyz(received, "in", 1) if "in" in fields else None,
        pose_vehicle=_pose(fields.section("pose_v")) if "pose_v" in fields else None,
        age_s=fields.number("age_s") if "age_s" in fields else 0.0,
        final=bool(header.flags & FLAG_FINAL),
    )


def _cloud(header: Header, received: Received) -> CloudMessage:
    fields = received.fields
    columns = read_points(fields.section("pts"), _payload(received, 0), ("x", "y", "z", "power", "frame"))
    cloud = FusedCloud(
        xyz_m=_stacked(columns),
        power_db=columns["power"].astype(np.float32, copy=False),
        frame_number=columns["frame"].astype(np.int64),
        reference=_pose(fields.section("pose")),
        t_start_ns=fields.instant("t0_ns"),
        t_end_ns=fields.instant("t1_ns"),
        travel_m=fields.number("travel_m"),
        frames=fields.integer("n_frames"),
        complete=not header.flags & FLAG_CUT_WINDOW,
        sensor_m=np.array(fields.numbers("sensor", 3) if "sensor" in fields else [np.nan] * 3),
    )
    return CloudMessage(header, cloud)


def _heatmap(header: Header, received: Received) -> HeatmapMessage:
    fields, payload = received.fields, _payload(received, 0)
    axes = []
    for axis in fields.sections("axes"):
        count = axis.integer("n", AXIS_LIMIT, 1)
        axes.append((axis.number("first") + axis.number("step") * np.arange(count)).astype(np.float32))
    if len(axes) != 2 or len(axes[0]) * len(axes[1]) != len(payload):
        raise WireError("heat: axes contradict the payload", value=([len(a) for a in axes], len(payload)))
    if not all(np.isfinite(axis).all() for axis in axes):
        raise WireError("heat: axes are not finite")
    levels = np.frombuffer(payload, np.uint8).reshape(len(axes[0]), len(axes[1]))
    power_db = np.float32(fields.number("offset")) + np.float32(fields.number("scale")) * levels.astype(np.float32)
    radar = cast(RadarId, fields.text("radar", RADARS))
    return HeatmapMessage(header, radar, fields.integer("number"), power_db, axes[0], axes[1])


def _detections(header: Header, received: Received) -> DetectionsMessage:
    fields = received.fields
    number = fields.integer("number")
    found: dict[RadarId, Detections | None] = dict.fromkeys(RADARS)
    for part, radar in enumerate(RADARS, 1):
        if radar in fields:
            columns = _columns(received, radar, part, ("r", "u", "power", "doppler", "snr"))
            found[radar] = Detections(radar, number, fields.section(radar).instant("t_ns"), *columns)
    points = None
    if "pts" in fields:
        power_db, horizontal_m, vertical_m = _columns(received, "pts", 0, ("power", "r_h", "r_v"))
        points = PointCloud(number, header.t_ns, _xyz(received, "pts", 0), power_db, horizontal_m, vertical_m)
    return DetectionsMessage(header, number, found["horizontal"], found["vertical"], points)


def _status(header: Header, received: Received) -> StatusMessage:
    fields = received.fields
    radars, stages = fields.section("radars"), fields.section("lat_us")
    machine, versions = fields.section("sys"), fields.section("ver")
    status = Status(
        state=cast(State, fields.text("state", STATES)),
        level=fields.integer("level", max(LEVELS.values())),
        reasons=tuple(_reason(reason) for reason in fields.sections("reasons")),
        radars={radar: _radar_status(radars.section(radar)) for radar in radars},
        latency_us={stage: cast(tuple[float, float, float], tuple(stages.numbers(stage, 3))) for stage in stages},
        pose=_pose_status(fields.section("pose")) if "pose" in fields else None,
        system={key: machine.number(key) for key in machine},
        versions={key: versions.text(key) for key in versions},
        uptime_s=fields.number("up_s"),
    )
    return StatusMessage(header, status)


def _reason(fields: Fields) -> Reason:
    code, detail = fields.text("code"), fields.text("detail")
    return Reason(code, fields.integer("count"), fields.instant("first_ns"), fields.instant("last_ns"), detail)


def _radar_status(fields: Fields) -> RadarStatus:
    lost = fields.section("lost")
    return RadarStatus(
        fields.integer("frames_in"),
        fields.integer("frames_ok"),
        {cause: lost.integer(cause) for cause in lost},
        fields.number("fps"),
    )


def _pose_status(fields: Fields) -> PoseStatus:
    return PoseStatus(fields.number("age_ms"), fields.number("rate_hz"), fields.integer("gaps"), fields.text("source"))


_READERS: dict[str, Callable[[Header, Received], Message]] = {
    "shape": _shape,
    "cloud": _cloud,
    "heat": _heatmap,
    "det": _detections,
    "pose": lambda header, received: PoseMessage(header, _pose(received.fields.section("pose"))),
    "status": _status,
    "hb": lambda header, received: HeartbeatMessage(header, cast(State, received.fields.text("state", STATES))),
}
