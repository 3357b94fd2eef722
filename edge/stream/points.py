# SPDX-License-Identifier: Apache-2.0
"""Point payloads: columns interleaved as the header describes them, as in PointCloud2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.errors import WireError
from edge.stream.fields import Fields

POINT_LIMIT = 2**20
TYPE_CODES: dict[int, str] = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8", 9: "<f2"}
"""Element types of point fields: 1 to 8 as in sensor_msgs/PointField, 9 is float16."""
_CODES = {np.dtype(text): code for code, text in TYPE_CODES.items()}


def pack_points(columns: Mapping[str, NDArray[Any]], encoding: str = "f4") -> tuple[dict[str, Any], bytes]:
    """Interleave columns into a payload.

    Args:
        columns: field name -> [n]; of a type in ``TYPE_CODES``.
        encoding: number format of the coordinates x, y, z: "f4", "f2", or "i2" in millimetres.
    Returns:
        Description for the header, and the payload.
    Raises:
        WireError: a coordinate does not fit the encoding.
    """
    scale = 1e-3 if encoding == "i2" else 1.0
    values = {
        name: _encoded(column, encoding, scale) if name in ("x", "y", "z") else np.asarray(column)
        for name, column in columns.items()
    }
    layout = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in values.items()])
    records = np.empty(len(next(iter(values.values()))), layout)
    for name, column in values.items():
        records[name] = column
    fields = [[name, layout.fields[name][1], _CODES[layout[name]], 1] for name in values]  # type: ignore[index]
    block = {"n": len(records), "step": layout.itemsize, "fields": fields, "enc": encoding, "scale": scale, "unit": "m"}
    return block, records.tobytes()


def read_points(block: Fields, payload: bytes, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of a payload; coordinates come as float32 metres, other fields in their own type.

    Args:
        block: description of the payload.
        payload: its bytes.
        names: fields that are needed; others are ignored.
    Returns:
        Field name -> [n], copies in native byte order.
    Raises:
        WireError: a field is missing, or description and payload contradict each other.
    """
    count, step, scale = block.integer("n", POINT_LIMIT), block.integer("step", 4096, 1), block.number("scale")
    if count * step != len(payload):
        raise WireError(f"{block.where}: payload is not n * step", value=len(payload), allowed=str(count * step))
    found: dict[str, tuple[str, int]] = {}
    for entry in block.array("fields"):
        if isinstance(entry, list) and len(entry) >= 4 and isinstance(entry[0], str) and entry[0] in names:
            description = Fields(dict(zip(("offset", "type", "count"), entry[1:4], strict=True)), entry[0])
            kind = TYPE_CODES.get(description.integer("type", 255, 1), "")
            description.integer("count", 1, 1)
            if not kind or description.integer("offset", step) + np.dtype(kind).itemsize > step:
                raise WireError(f"{block.where}: field {entry[0]} does not fit", value=repr(entry)[:80])
            found[entry[0]] = (kind, entry[1])
    if missing := [name for name in names if name not in found]:
        raise WireError(f"{block.where}: no field {', '.join(missing)}")
    formats, offsets = zip(*(found[name] for name in names), strict=True)
    layout = np.dtype({"names": list(names), "formats": formats, "offsets": offsets, "itemsize": step})
    records = np.frombuffer(payload, layout)
    with np.errstate(all="ignore"):
        return {
            name: (records[name] * scale).astype(np.float32) if name in ("x", "y", "z") else _native(records[name])
            for name in names
        }


def _native(column: NDArray[Any]) -> NDArray[Any]:
    return column.astype(column.dtype.newbyteorder("="))


def _encoded(column: NDArray[Any], encoding: str, scale: float) -> NDArray[Any]:
    """Coordinates in metres as the encoding has them."""
    limit = 32767 * scale if encoding == "i2" else float(np.finfo(encoding).max)
    largest = float(np.abs(column).max()) if len(column) else 0.0
    if not largest <= limit:
        raise WireError("coordinate does not fit", value=largest, allowed=f"{encoding}: {limit:g} m")
    if encoding == "i2":
        return np.rint(column / np.float32(scale)).astype(np.int16)
    return np.asarray(column, np.dtype(encoding))
