# SPDX-License-Identifier: Apache-2.0
"""The pipeline's data as messages, and shapes as PLY files."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from edge.errors import RecordingError, WireError
from edge.frames import (
    FULL_WINDOW_FRAMES,
    Detections,
    Float32,
    Float64,
    FusedCloud,
    Heatmap,
    PointCloud,
    Pose,
    Shape,
)
from edge.stream.fields import U32
from edge.stream.messages import ShapeMessage, State, Status
from edge.stream.points import pack_points
from edge.stream.wire import FLAG_CUT_WINDOW, FLAG_FEW_FRAMES, FLAG_FINAL, MAJOR, Draft

HEATMAP_STEP_DB = 0.5
EXTENT_QUANTILES = (0.01, 0.99)
_PLY_FORMATS = ("i1", "u1", "<i2", "<u2", "<i4", "<u4", "<f4", "<f8")
_PLY_OLD = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_PLY_NEW = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
_PLY_TYPES = dict(zip(_PLY_OLD + _PLY_NEW, _PLY_FORMATS * 2, strict=True))
_PLY_HEADER_LIMIT = 64 * 2**10


def shape_size_m(shape: Shape) -> Float64:
    """Extent of the fine points along x, y, z of the object frame, float64 [3].

    From the 1 % to the 99 % quantile (nearest rank): a few stray points out of 16,384 would double a plain extent.
    """
    low, high = np.quantile(shape.fine_m, EXTENT_QUANTILES, axis=0, method="nearest")
    return np.asarray(high - low, dtype=np.float64)


def encode_shape(shape: Shape, encoding: str = "f4", send_input: bool = True) -> Draft:
    """A completed object on ``1/shape/<class>/``.

    Args:
        shape: the object.
        encoding: number format of the points: "f4", "f2" or "i2".
        send_input: add the partial cloud as the second payload.
    Returns:
        The message without its stamp.
    Raises:
        WireError: a point that the encoding cannot hold or that is not finite.
    """
    cloud = shape.input
    block, payload = pack_points(_xyz(shape.fine_m), encoding)
    fields: dict[str, Any] = {
        "id": shape.identity,
        "cls": shape.class_name,
        "cls_n": list(shape.class_probability),
        "cls_p": list(shape.class_probability.values()),
        "conf": shape.confidence,
        "pose": _pose(cloud.pose),
        "size": shape_size_m(shape).tolist(),
        "n_in": shape.input_points,
        "n_frames": cloud.frames,
        "t0_ns": cloud.t_start_ns,
        "t1_ns": cloud.t_end_ns,
        "travel_m": float(cloud.travel_m),
        "lat_us": dict(shape.latency_us),
        "model": bytes.fromhex(shape.model),
        "age_s": float(cloud.age_s),
        "pts": block,
    }
    if shape.pose_vehicle is not None:
        fields["pose_v"] = _pose(shape.pose_vehicle)
    payloads = [payload]
    if send_input:
        fields["in"], partial = pack_points(_xyz(cloud.xyz_m), encoding)
        payloads.append(partial)
    flags = _window_flags(cloud.frames, cloud.complete) | (FLAG_FINAL if cloud.final else 0)
    return Draft(f"{MAJOR}/shape/{shape.class_name}/", "shape", cloud.t_end_ns, "object", flags, fields, payloads)


def encode_cloud(cloud: FusedCloud) -> Draft:
    """A fused window on ``1/cloud/``; WireError: a frame number beyond unsigned 32 bit."""
    numbers = cloud.frame_number
    if len(numbers) and not 0 <= numbers.min() <= numbers.max() <= U32:
        raise WireError("frame number does not fit", value=int(numbers.max()), allowed=f"0..{U32}")
    columns = _xyz(cloud.xyz_m) | {
        "power": np.asarray(cloud.power_db, np.float32),
        "frame": np.asarray(numbers, np.uint32),
    }
    block, payload = pack_points(columns)
    fields = {
        "pose": _pose(cloud.reference),
        "t0_ns": cloud.t_start_ns,
        "t1_ns": cloud.t_end_ns,
        "travel_m": float(cloud.travel_m),
        "n_frames": cloud.frames,
        "pts": block,
    }
    if np.isfinite(cloud.sensor_m).all():
        fields["sensor"] = cloud.sensor_m.tolist()
    flags = _window_flags(cloud.frames, cloud.complete)
    return Draft(f"{MAJOR}/cloud/", "cloud", cloud.t_end_ns, "window", flags, fields, [payload])


def encode_heatmap(heatmap: Heatmap) -> Draft:
    """A heatmap on ``1/heat/<radar>/``: decibels in 255 steps of 0.5 dB below the peak.

    Raises:
        WireError: the power is not finite or negative.
    """
    peak = float(heatmap.power.max())
    if not (np.isfinite(peak) and float(heatmap.power.min()) >= 0.0):
        raise WireError(
            f"{heatmap.radar} frame {heatmap.number}: heatmap is no power", value=peak, allowed="finite, >= 0"
        )
    tiny = np.finfo(np.float32).tiny
    offset_db = 10.0 * float(np.log10(max(peak, float(tiny)))) - 255 * HEATMAP_STEP_DB
    power_db = 10.0 * np.log10(np.maximum(heatmap.power, tiny))
    levels = np.clip(np.rint((power_db - offset_db) / HEATMAP_STEP_DB), 0, 255).astype(np.uint8)
    fields = {
        "radar": heatmap.radar,
        "number": heatmap.number,
        "scale": HEATMAP_STEP_DB,
        "offset": offset_db,
        "axes": [_axis("direction_cosine", heatmap.direction_cosine), _axis("range_m", heatmap.range_m)],
    }
    topic = f"{MAJOR}/heat/{heatmap.radar}/"
    return Draft(topic, "heat", heatmap.t_first_chirp_ns, "radar", 0, fields, [levels.tobytes()])


def encode_detections(
    horizontal: Detections | None, vertical: Detections | None, points: PointCloud | None = None
) -> Draft:
    """Detections of one frame on ``1/det/``; payload 0 the points, 1 the horizontal, 2 the vertical radar's detections.

    Args:
        horizontal, vertical: of each radar; None when the rig does not have it.
        points: the points made of both; None in a rig of one radar.
    Returns:
        The message without its stamp.
    Raises:
        WireError: neither radar is there.
    """
    present = [detections for detections in (horizontal, vertical) if detections is not None]
    if not present:
        raise WireError("detections of no radar", action="give those of at least one")
    fields: dict[str, Any] = {"number": present[0].number}
    payloads = [b"", b"", b""]
    if points is not None:
        fields |= {"n_pair": len(points)}
        fields["pts"], payloads[0] = pack_points(_point_columns(points))
    for part, key, detections in ((1, "n_h", horizontal), (2, "n_v", vertical)):
        fields[key] = 0 if detections is None else len(detections)
        if detections is not None:
            block, payloads[part] = pack_points(_detection_columns(detections))
            fields[detections.radar] = block | {"t_ns": detections.t_first_chirp_ns}
    t_ns = present[0].t_first_chirp_ns if points is None else points.t_ns
    return Draft(f"{MAJOR}/det/", "det", t_ns, "rig", 0, fields, payloads)


def encode_pose(pose: Pose) -> Draft:
    """A pose of the rig on ``1/pose/``."""
    return Draft(f"{MAJOR}/pose/", "pose", pose.t_ns, "odom", 0, {"pose": _pose(pose)})


def encode_status(status: Status, t_ns: int) -> Draft:
    """The state of the appliance at ``t_ns`` on ``1/status/``."""
    fields: dict[str, Any] = {
        "state": status.state,
        "level": status.level,
        "reasons": [asdict(reason) for reason in status.reasons],
        "radars": {name: asdict(radar) for name, radar in status.radars.items()},
        "lat_us": {stage: list(values) for stage, values in status.latency_us.items()},
        "sys": dict(status.system),
        "ver": dict(status.versions),
        "up_s": float(status.uptime_s),
    }
    if status.pose is not None:
        fields["pose"] = asdict(status.pose)
    return Draft(f"{MAJOR}/status/", "status", t_ns, "", 0, fields)


def encode_heartbeat(state: State, t_ns: int) -> Draft:
    """A sign of life at ``t_ns`` on ``1/hb/``."""
    return Draft(f"{MAJOR}/hb/", "hb", t_ns, "", 0, {"state": state})


def write_ply(path: Path, points_m: Float32, comments: Mapping[str, object] | None = None) -> None:
    """Write points as a binary little-endian PLY file (vertices x, y, z as float), in one move.

    Args:
        path: the file.
        points_m: [n, 3], metres.
        comments: written as ``comment key value`` lines.
    Raises:
        RecordingError: the file cannot be written.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [
        f"comment {key} {str(value).splitlines()[0] if str(value) else ''}" for key, value in (comments or {}).items()
    ]
    lines += [
        f"element vertex {len(points_m)}",
        "property float x",
        "property float y",
        "property float z",
        "end_header",
    ]
    content = "\n".join(lines).encode("ascii", "replace") + b"\n" + np.ascontiguousarray(points_m, "<f4").tobytes()
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written ({error.strerror})") from error


def save_shape(path: Path, shape: Shape | ShapeMessage) -> None:
    """Write a shape's fine points (object frame) as PLY; identity, class, confidence and pose become comments."""
    pose = shape.pose if isinstance(shape, ShapeMessage) else shape.input.pose
    comments = {
        "frame": "object, metres, z up",
        "identity": shape.identity,
        "class": shape.class_name,
        "confidence": f"{shape.confidence:.4f}",
        "model": shape.model,
        "t_ns": pose.t_ns,
        "position_m": " ".join(f"{value:.6f}" for value in pose.position_m),
        "quaternion_xyzw": " ".join(f"{value:.9f}" for value in pose.quaternion_xyzw),
    }
    write_ply(path, shape.fine_m, comments)


def read_ply(path: Path) -> tuple[Float32, dict[str, str]]:
    """Read the vertices of a binary little-endian PLY file.

    Args:
        path: file whose first element is ``vertex`` with scalar properties, x, y and z among them.
    Returns:
        Points float32 [n, 3], and comments: first word -> rest of the line.
    Raises:
        RecordingError: unreadable, another format, or fewer bytes than the header promises.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    head, found, body = content[:_PLY_HEADER_LIMIT].partition(b"end_header\n")
    lines = head.decode("ascii", "replace").split("\n")
    if not found or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise RecordingError(f"{path}: no binary PLY file", allowed="PLY 1.0, binary_little_endian")
    body = content[len(head) + len(found) :]
    comments = {match[1]: match[2] for line in lines if (match := re.fullmatch(r"comment (\S+) ?(.*)", line))}
    declarations = [line.split() for line in lines[2:] if line and not line.startswith(("comment", "obj_info"))]
    count, names, formats = _vertex(path, declarations)
    layout = np.dtype(list(zip(names, formats, strict=True)))
    if count * layout.itemsize > len(body):
        raise RecordingError(
            f"{path}: vertices are missing", value=len(body), allowed=f"{count * layout.itemsize} bytes"
        )
    records = np.frombuffer(body, layout, count)
    return np.stack([records[name].astype(np.float32) for name in ("x", "y", "z")], axis=1), comments


def _vertex(path: Path, declarations: list[list[str]]) -> tuple[int, list[str], list[str]]:
    """Number of vertices, names and formats of their properties."""
    first = declarations[0] if declarations else []
    if len(first) != 3 or first[:2] != ["element", "vertex"] or not re.fullmatch(r"\d{1,9}", first[2]):
        raise RecordingError(f"{path}: first element is no vertex", value=" ".join(first))
    names, formats = [], []
    for words in declarations[1:]:
        if words[:1] == ["element"]:
            break
        if len(words) != 3 or words[0] != "property" or words[1] not in _PLY_TYPES or words[2] in names:
            raise RecordingError(f"{path}: property cannot be read", value=" ".join(words), allowed="scalar properties")
        names.append(words[2])
        formats.append(_PLY_TYPES[words[1]])
    if not {"x", "y", "z"} <= set(names):
        raise RecordingError(f"{path}: vertices have no x, y, z", value=" ".join(names))
    return int(first[2]), names, formats


def _xyz(points_m: Float32) -> dict[str, Float32]:
    """Columns, each contiguous."""
    return dict(zip("xyz", np.ascontiguousarray(points_m.T, np.float32), strict=True))


def _pose(pose: Pose) -> dict[str, Any]:
    return {"t_ns": pose.t_ns, "p": pose.position_m.tolist(), "q": pose.quaternion_xyzw.tolist()}


def _axis(name: str, values: Float32) -> dict[str, Any]:
    """A uniform axis by its ends, so that rounding of single values does not accumulate."""
    first, last, count = float(values[0]), float(values[-1]), len(values)
    return {"name": name, "n": count, "first": first, "step": (last - first) / max(count - 1, 1)}


def _point_columns(points: PointCloud) -> dict[str, Float32]:
    x, y, z = (np.asarray(points.xyz_m[:, axis], np.float32) for axis in range(3))
    ground = np.hypot(x, y)
    return {
        "x": x,
        "y": y,
        "z": z,
        "r": np.hypot(ground, z),
        "az": np.arctan2(y, x),
        "el": np.arctan2(z, ground),
        "power": np.asarray(points.power_db, np.float32),
        "r_h": np.asarray(points.range_horizontal_m, np.float32),
        "r_v": np.asarray(points.range_vertical_m, np.float32),
    }


def _detection_columns(detections: Detections) -> dict[str, Float32]:
    columns = {
        "r": detections.range_m,
        "u": detections.direction_cosine,
        "power": detections.power_db,
        "doppler": detections.doppler_m_s,
        "snr": detections.snr_db,
    }
    return {name: np.asarray(column, np.float32) for name, column in columns.items()}


def _window_flags(frames: int, complete: bool) -> int:
    return (0 if complete else FLAG_CUT_WINDOW) | (FLAG_FEW_FRAMES if frames < FULL_WINDOW_FRAMES else 0)
