# SPDX-License-Identifier: Apache-2.0
"""Point clouds with any columns as PLY, PCD and NPZ files, binary, little endian, each written in one move.

PLY 1.0 (Turk, Stanford), PCD 0.7 (Point Cloud Library, ``DATA binary``), NPZ (NumPy). CloudCompare, MeshLab, PCL and
Open3D read them; ``intensity`` is the name that they colour by.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.errors import RecordingError

Columns = Mapping[str, NDArray[Any]]
"""Name -> [n]: float32, float64, or integers of 1, 2 or 4 bytes."""
SUFFIXES = (".ply", ".pcd", ".npz")
_PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "u4": "uint",
              "i4": "int"}  # fmt: skip


def write_points(path: Path, columns: Columns, facts: Mapping[str, object], tables: Columns | None = None) -> None:
    """Write a file in the format that its suffix names.

    Args:
        path: ``.ply``, ``.pcd`` or ``.npz``; replaced when it is there.
        columns: of equal length, x, y, z first.
        facts: about the file: comments in PLY and PCD, text arrays in NPZ.
        tables: more arrays, only for NPZ.
    Raises:
        RecordingError: another suffix, or the file cannot be written.
    """
    makers = {".ply": ply_bytes, ".pcd": pcd_bytes}
    if path.suffix not in SUFFIXES:
        raise RecordingError(f"{path}: unknown format", value=path.suffix, allowed=", ".join(SUFFIXES))
    if path.suffix == ".npz":
        content = _npz_bytes(columns, facts, tables or {})
    else:
        content = makers[path.suffix](columns, facts)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise RecordingError(
            f"{path}: cannot be written ({error.strerror})", action="check folder and space"
        ) from error


def ply_bytes(columns: Columns, facts: Mapping[str, object]) -> bytes:
    """A PLY file with one element, ``vertex``."""
    records = _records(columns)
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {key} {_one_line(value)}" for key, value in facts.items()]
    lines.append(f"element vertex {len(records)}")
    lines += [f"property {_PLY_TYPES[records.dtype[name].str[1:]]} {name}" for name in columns]
    return "\n".join([*lines, "end_header", ""]).encode("ascii", "replace") + records.tobytes()


def pcd_bytes(columns: Columns, facts: Mapping[str, object]) -> bytes:
    """A PCD file; an unordered cloud has height 1."""
    records = _records(columns)
    kinds = [records.dtype[name].str[1:].upper() for name in columns]
    lines = [f"# {key} {_one_line(value)}" for key, value in facts.items()]
    lines += [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(kind[1:] for kind in kinds)}",
        f"TYPE {' '.join(kind[0] for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(records)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(records)}",
        "DATA binary",
        "",
    ]
    return "\n".join(lines).encode("ascii", "replace") + records.tobytes()


def _npz_bytes(columns: Columns, facts: Mapping[str, object], tables: Columns) -> bytes:
    """``xyz_m`` [n, 3], the other columns, tables, and facts as texts; nothing is pickled."""
    arrays: dict[str, Any] = {"xyz_m": np.stack([columns[axis] for axis in "xyz"], axis=1)}
    arrays |= {name: np.asarray(column) for name, column in columns.items() if name not in "xyz"}
    arrays |= {name: np.asarray(table) for name, table in tables.items()}
    arrays |= {f"about_{key}": np.array(str(value)) for key, value in facts.items()}
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _records(columns: Columns) -> NDArray[Any]:
    """Columns side by side without padding."""
    layout = np.dtype([(name, np.asarray(column).dtype.newbyteorder("<")) for name, column in columns.items()])
    records = np.empty(len(next(iter(columns.values()))), layout)
    for name, column in columns.items():
        records[name] = column
    return records


def _one_line(value: object) -> str:
    return " ".join(str(value).split())
