# SPDX-License-Identifier: Apache-2.0
"""The messages of Foxglove's and Lichtblick's 3-D panel that an export needs, with the field numbers of their schemas.

Names, numbers and types: https://github.com/foxglove/foxglove-sdk, schemas/proto/foxglove. Fields that an export does
not fill are left out of the descriptors, as Protocol Buffers allow.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from edge.frames import Pose
from edge.recording.point_files import Columns
from edge.recording.protobuf import Schema, fields, numbered

POINT_CLOUD, TRANSFORM, SCENE = "foxglove.PointCloud", "foxglove.FrameTransform", "foxglove.SceneUpdate"
_TIME, _SPAN = "google.protobuf.Timestamp", "google.protobuf.Duration"
_NUMERIC = "foxglove.PackedElementField.NumericType"
_DELETION = "foxglove.SceneEntityDeletion.Type"
SCHEMA = Schema(
    messages={
        _TIME: fields(seconds=(1, "int64"), nanos=(2, "int32")),
        _SPAN: fields(seconds=(1, "int64"), nanos=(2, "int32")),
        "foxglove.Vector3": fields(x=(1, "double"), y=(2, "double"), z=(3, "double")),
        "foxglove.Quaternion": fields(x=(1, "double"), y=(2, "double"), z=(3, "double"), w=(4, "double")),
        "foxglove.Pose": fields(position=(1, "foxglove.Vector3"), orientation=(2, "foxglove.Quaternion")),
        "foxglove.PackedElementField": fields(name=(1, "string"), offset=(2, "fixed32"), type=(3, _NUMERIC)),
        POINT_CLOUD: fields(
            timestamp=(1, _TIME),
            frame_id=(2, "string"),
            pose=(3, "foxglove.Pose"),
            point_stride=(4, "fixed32"),
            fields=(5, "foxglove.PackedElementField", True),
            data=(6, "bytes"),
        ),
        TRANSFORM: fields(
            timestamp=(1, _TIME),
            parent_frame_id=(2, "string"),
            child_frame_id=(3, "string"),
            translation=(4, "foxglove.Vector3"),
            rotation=(5, "foxglove.Quaternion"),
        ),
        "foxglove.Color": fields(r=(1, "double"), g=(2, "double"), b=(3, "double"), a=(4, "double")),
        "foxglove.KeyValuePair": fields(key=(1, "string"), value=(2, "string")),
        "foxglove.CubePrimitive": fields(
            pose=(1, "foxglove.Pose"), size=(2, "foxglove.Vector3"), color=(3, "foxglove.Color")
        ),
        "foxglove.TextPrimitive": fields(
            pose=(1, "foxglove.Pose"),
            billboard=(2, "bool"),
            font_size=(3, "double"),
            scale_invariant=(4, "bool"),
            color=(5, "foxglove.Color"),
            text=(6, "string"),
        ),
        "foxglove.SceneEntity": fields(
            timestamp=(1, _TIME),
            frame_id=(2, "string"),
            id=(3, "string"),
            lifetime=(4, _SPAN),
            frame_locked=(5, "bool"),
            metadata=(6, "foxglove.KeyValuePair", True),
            cubes=(8, "foxglove.CubePrimitive", True),
            texts=(13, "foxglove.TextPrimitive", True),
        ),
        "foxglove.SceneEntityDeletion": fields(timestamp=(1, _TIME), type=(2, _DELETION), id=(3, "string")),
        SCENE: fields(deletions=(1, "foxglove.SceneEntityDeletion", True), entities=(2, "foxglove.SceneEntity", True)),
    },
    enums={
        _DELETION: numbered(("MATCHING_ID", "ALL")),
        _NUMERIC: numbered(("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64")),
    },
)
_NUMERIC_OF = {"u1": "UINT8", "i1": "INT8", "u2": "UINT16", "i2": "INT16", "u4": "UINT32", "i4": "INT32",
               "f4": "FLOAT32", "f8": "FLOAT64"}  # fmt: skip


def descriptors(name: str) -> bytes:
    """What the schema record of MCAP holds for encoding ``protobuf``."""
    return SCHEMA.descriptors(name)


def point_cloud(t_ns: int, frame_id: str, pose: Pose | None, columns: Columns) -> bytes:
    """A ``foxglove.PointCloud``.

    Args:
        t_ns: instant.
        frame_id: frame of reference.
        pose: of the points' own frame in it; None: they are the same.
        columns: name -> [n]; ``red``, ``green``, ``blue``, ``alpha`` (uint8) colour the points.
    """
    layout = np.dtype([(name, np.asarray(column).dtype.newbyteorder("<")) for name, column in columns.items()])
    records = np.empty(len(columns["x"]), layout)
    packed: list[dict[str, Any]] = []
    for name, column in columns.items():
        records[name] = column
        kind, offset = layout.fields[name][:2]  # type: ignore[index]
        packed.append({"name": name, "offset": offset, "type": _NUMERIC_OF[kind.str[1:]]})
    values = {
        "timestamp": _time(t_ns),
        "frame_id": frame_id,
        "pose": _pose([0.0] * 3, [0.0, 0.0, 0.0, 1.0]) if pose is None else _pose_of(pose),
        "point_stride": layout.itemsize,
        "fields": packed,
        "data": records.tobytes(),
    }
    return SCHEMA.encode(POINT_CLOUD, values)


def transform(t_ns: int, parent: str, child: str, pose: Pose) -> bytes:
    """A ``foxglove.FrameTransform``: where the child frame is in its parent."""
    values = {"timestamp": _time(t_ns), "parent_frame_id": parent, "child_frame_id": child}
    placed = {"translation": _xyz(pose.position_m.tolist()), "rotation": _xyzw(pose.quaternion_xyzw.tolist())}
    return SCHEMA.encode(TRANSFORM, values | placed)


def box(
    t_ns: int,
    frame_id: str,
    identity: str,
    pose: Pose,
    size_m: list[float],
    text: str,
    color: tuple[float, float, float],
    facts: dict[str, str],
    lifetime_s: float,
) -> bytes:
    """A ``foxglove.SceneUpdate`` of one box with a label; a newer one with the same identity replaces it.

    Args:
        t_ns: instant.
        frame_id: frame of reference.
        identity: of the object.
        pose: of the box's centre.
        size_m: along its axes.
        text: the label.
        color: red, green, blue, 0..1.
        facts: shown when it is selected.
        lifetime_s: it vanishes so long after its instant.
    """
    above = [*pose.position_m[:2].tolist(), float(pose.position_m[2]) + size_m[2] / 2 + 0.3]
    solid = dict(zip("rgba", (*color, 0.25), strict=True))
    label = {"pose": _pose(above, [0.0, 0.0, 0.0, 1.0]), "billboard": True, "font_size": 14.0, "scale_invariant": True,
             "color": dict.fromkeys("rgba", 1.0), "text": text}  # fmt: skip
    entity = {
        "timestamp": _time(t_ns),
        "frame_id": frame_id,
        "id": identity,
        "lifetime": {"seconds": int(lifetime_s), "nanos": round(lifetime_s % 1 * 1e9)},
        "metadata": [{"key": key, "value": value} for key, value in facts.items()],
        "cubes": [{"pose": _pose_of(pose), "size": _xyz(size_m), "color": solid}],
        "texts": [label],
    }
    return SCHEMA.encode(SCENE, {"entities": [entity]})


def _time(t_ns: int) -> dict[str, int]:
    return {"seconds": t_ns // 10**9, "nanos": t_ns % 10**9}


def _pose_of(pose: Pose) -> dict[str, Any]:
    return _pose(pose.position_m.tolist(), pose.quaternion_xyzw.tolist())


def _pose(position: list[float], orientation: list[float]) -> dict[str, Any]:
    return {"position": _xyz(position), "orientation": _xyzw(orientation)}


def _xyz(values: list[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def _xyzw(values: list[float]) -> dict[str, float]:
    return dict(zip("xyzw", values, strict=True))
