# SPDX-License-Identifier: Apache-2.0
"""Small readers of PLY, PCD and Foxglove's messages that share nothing with what writes them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

_PLY = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
_PCD = {"F4": "f", "F8": "d", "U1": "B", "U2": "H", "U4": "I", "I1": "b", "I2": "h", "I4": "i"}

Rows = list[tuple[float, ...]]


def read_ply_rows(path: Path) -> tuple[list[str], Rows, list[str]]:
    """Names of the properties, vertices, comments."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    words = [line.split() for line in lines[2:]]
    assert [w[:2] for w in words if w[0] == "element"] == [["element", "vertex"]]
    count = int(next(w[2] for w in words if w[0] == "element"))
    properties = [w for w in words if w[0] == "property"]
    rows = list(struct.iter_unpack("<" + "".join(_PLY[w[1]] for w in properties), body))
    assert len(rows) == count
    return [w[2] for w in properties], rows, [line for line in lines if line.startswith("comment")]


def read_pcd_rows(path: Path) -> tuple[list[str], Rows]:
    """Names of the fields, points."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    lines = [line for line in head.decode("ascii").splitlines() if not line.startswith("#")]
    facts = {line.split()[0]: line.split()[1:] for line in lines}
    assert list(facts) == ["VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS"]
    assert facts["VERSION"] == ["0.7"]
    assert set(facts["COUNT"]) == {"1"}
    kinds = [kind + size for kind, size in zip(facts["TYPE"], facts["SIZE"], strict=True)]
    rows = list(struct.iter_unpack("<" + "".join(_PCD[kind] for kind in kinds), body))
    assert int(facts["POINTS"][0]) == int(facts["WIDTH"][0]) * int(facts["HEIGHT"][0]) == len(rows)
    return facts["FIELDS"], rows


def read_foxglove(path: Path) -> list[tuple[str, int, Any]]:
    """Topic, log time and message, decoded by Google's library with the schemas that the file holds."""
    factories: dict[int, Any] = {}
    found = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            assert schema is not None
            assert channel.message_encoding == schema.encoding == "protobuf"
            if schema.id not in factories:
                pool = descriptor_pool.DescriptorPool()
                for description in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(description)
                factories[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            found.append((channel.topic, message.log_time, factories[schema.id].FromString(message.data)))
    return found


def cloud_rows(cloud: Any) -> tuple[list[str], Rows]:
    """Names of the fields and points of a ``foxglove.PointCloud``, by its own description."""
    codes = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i", 7: "f", 8: "d"}
    rows = []
    for start in range(0, len(cloud.data), cloud.point_stride):
        rows.append(
            tuple(struct.unpack_from("<" + codes[f.type], cloud.data, start + f.offset)[0] for f in cloud.fields)
        )
    return [field.name for field in cloud.fields], rows
