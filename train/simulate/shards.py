# SPDX-License-Identifier: Apache-2.0
"""The files of a data set: shards of clouds that prove themselves intact, written whole or not at all.

A shard is ``b"RFCLOUD1"``, the SHA-256 (32 bytes) of what follows, and zlib-compressed MessagePack: a map of ``set``
(identity of the work list), ``number``, ``objects`` (group, split, licence, attribution by name), ``samples`` (one map
a cloud) and the points of all samples one after the other: ``x``, ``y``, ``z`` int16 in millimetres, ``power`` int8 in
dB about the sample's ``power_db``, ``step`` uint16 frames since the point before (since 0 at a sample's first). Arrays
are little-endian byte strings, 16-bit ones as all low bytes before all high bytes, which packs better.
"""

from __future__ import annotations

import hashlib
import math
import os
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.errors import RecordingError
from edge.frames import Float32, Float64

Kind = Literal["simulated", "perturbed"]
KINDS: tuple[Kind, Kind] = ("simulated", "perturbed")
MAGIC = b"RFCLOUD1"
SUFFIX = ".clouds"
POINT_M = 1e-3
_LIMIT = 32767
_MAX_BYTES = 1 << 30
"""Largest decompressed shard that a reader accepts."""


class ShardError(RecordingError):
    """A shard that is damaged, foreign or from another version."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """One cloud of an object with its truth by reference.

    Args:
        object: text form of the ObjectRef; its mesh is the truth.
        kind: simulated drive-by or perturbed scan.
        variation, seed: see ``work.Item``.
        xyz_m: float32 [n, 3], the frame of ``edge.frames.ObjectCloud`` (z up, ground 0); n may be 0: nothing was seen.
        power_db: float32 [n]. frame_number: int64 [n], ascending from 0.
        sensor_m: float64 [3], mean position of the rig, same frame.
        rotation: float64 [3, 3], translation_m: float64 [3]: mesh frame to the cloud's, p = R v + t.
        frames: radar frames of the window. travel_m: path of the rig in it.
        statistics: name -> number.
        status: of a simulated cloud, see ``cloud.Target``: "whole", "split", "merged" or "missing".
        error: why there is no cloud; the other fields then hold nothing.
    """

    object: str
    kind: Kind
    variation: int
    seed: int
    xyz_m: Float32
    power_db: Float32
    frame_number: NDArray[np.int64]
    sensor_m: Float64
    rotation: Float64
    translation_m: Float64
    frames: int
    travel_m: float
    statistics: dict[str, float] = field(default_factory=dict)
    status: str = "whole"
    error: str = ""

    def __len__(self) -> int:
        return len(self.xyz_m)

    @classmethod
    def failed(cls, name: str, kind: Kind, variation: int, seed: int, error: str) -> Cloud:
        """The record of a cloud that could not be made."""
        none = np.empty(0)
        empty = none.astype(np.float32).reshape(0, 3), none.astype(np.float32), none.astype(np.int64)
        return cls(
            name, kind, variation, seed, *empty, np.zeros(3), np.eye(3), np.zeros(3), 0, 0.0, {}, "missing", error
        )

    def record(self) -> dict[str, Any]:
        """All but the points, as plain values: what index.json says of a sample."""
        return {
            "object": self.object,
            "class": self.object.split("/")[0],
            "kind": self.kind,
            "variation": self.variation,
            "seed": self.seed,
            "points": len(self),
            "frames": self.frames,
            "travel_m": round(self.travel_m, 4),
            "sensor_m": [round(float(v), 4) for v in self.sensor_m],
            "rotation": [round(float(v), 9) for v in self.rotation.ravel()],
            "translation_m": [round(float(v), 6) for v in self.translation_m],
            "status": self.status,
            "statistics": {name: round(float(v), 6) for name, v in sorted(self.statistics.items())},
            "error": self.error,
        }


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """What has to be known of an object without its mesh.

    Args:
        split, group: of ``ObjectRef.split`` and ``work.group_key``.
        licence, attribution: of the mesh.
        size_m: extent along x, y, z, to the millimetre: a reader's mesh of another size is not the one that was seen.
    """

    split: str
    group: str
    licence: str
    attribution: str
    size_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Shard:
    """Some clouds of a set.

    Args:
        identity: of the set's work list.
        number: of the shard.
        objects: by text form.
        clouds: in the order of the work list.
    """

    identity: str
    number: int
    objects: dict[str, ObjectInfo]
    clouds: tuple[Cloud, ...]


def encode(shard: Shard) -> bytes:
    """The bytes of a shard file; the same shard gives the same bytes.

    Raises:
        ConfigError: a cloud that the format cannot hold (further than 32.767 m, powers 127 dB beside their median,
            frame numbers that do not ascend), or numbers that are not finite.
    """
    points = [_points(cloud) for cloud in shard.clouds]
    x, y, z, power, step = (np.concatenate([one[k] for one in points]) for k in range(5))
    content = {
        "set": shard.identity,
        "number": shard.number,
        "objects": {name: asdict(info) for name, info in sorted(shard.objects.items())},
        "samples": [cloud.record() | {"power_db": _median_db(cloud)} for cloud in shard.clouds],
        "x": _split_bytes(x),
        "y": _split_bytes(y),
        "z": _split_bytes(z),
        "power": power.astype(np.int8).tobytes(),
        "step": _split_bytes(step),
    }
    body = zlib.compress(msgpack.packb(content), 9)
    return MAGIC + hashlib.sha256(body).digest() + body


def decode(data: bytes, name: str) -> Shard:
    """Inverse of ``encode`` (points to 1 mm, powers to 1 dB).

    Args:
        data: of the file.
        name: for the error.
    Raises:
        ShardError: any byte differs from what was written, or the content contradicts itself.
    """
    body = data[len(MAGIC) + 32 :]
    if data[: len(MAGIC)] != MAGIC:
        raise ShardError(f"{name}: not a shard of this version", value=data[:8], allowed=repr(MAGIC))
    if hashlib.sha256(body).digest() != data[len(MAGIC) : len(MAGIC) + 32]:
        raise ShardError(f"{name}: damaged, its hash does not fit", action="build again; only this shard is remade")
    try:
        unpacker = zlib.decompressobj()
        content = msgpack.unpackb(unpacker.decompress(body, _MAX_BYTES))
        return _shard(content)
    except (zlib.error, ValueError, KeyError, TypeError, IndexError, msgpack.UnpackException) as error:
        raise ShardError(f"{name}: its content contradicts itself ({error!r})") from error


def read_shard(path: Path) -> Shard:
    """Read a file.

    Raises:
        ShardError: unreadable, damaged or foreign.
    """
    try:
        return decode(path.read_bytes(), path.name)
    except OSError as error:
        raise ShardError(f"{path.name}: cannot be read", value=error.strerror) from error


def read_clouds(path: Path) -> list[Shard]:
    """Every intact shard of a data set's folder, finished or not, or the one shard of a file of clouds.

    Raises:
        ShardError: no shard there, a damaged one, or shards of different sets.
    """
    paths = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
    shards = [read_shard(one) for one in paths]
    if len({shard.identity for shard in shards}) != 1:
        raise ShardError(
            f"{path}: not one data set of simulated clouds",
            value=f"{len(shards)} shards",
            action="give a folder that rfconstruct-train simulate has made, or a file of clouds",
        )
    return shards


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that after a kill or a power cut there is the whole file or none (or the one before)."""
    temporary = path.with_name(f".{path.name}.tmp")
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def check_cloud(cloud: Cloud) -> None:
    """Refuse what the format cannot hold, see ``encode``.

    Raises:
        ConfigError: naming the cloud and the column.
    """
    _points(cloud)


def _median_db(cloud: Cloud) -> int:
    median_db = float(np.median(cloud.power_db)) if len(cloud) else 0.0
    return round(median_db) if math.isfinite(median_db) else 0


def _points(cloud: Cloud) -> tuple[NDArray[Any], ...]:
    """x, y, z, power and frame step of a cloud as whole numbers, in the order of the frames."""
    name = f"{cloud.object} {cloud.kind} {cloud.variation}"
    order = np.argsort(cloud.frame_number, kind="stable")
    grid = np.rint(cloud.xyz_m[order].astype(np.float64) / POINT_M)
    largest = float(np.abs(grid).max(initial=0))
    require(largest <= _LIMIT, f"{name}: xyz_m", largest * POINT_M, f"|x| <= {_LIMIT * POINT_M} m and finite")
    power = np.rint(cloud.power_db[order].astype(np.float64) - _median_db(cloud))
    outside = cloud.power_db[order][~(np.abs(power) <= 127)]
    require(not len(outside), f"{name}: power_db", outside[:3].tolist(), "finite, within 127 dB of the median")
    step = np.diff(cloud.frame_number[order], prepend=0)
    require(bool((step >= 0).all() and (step <= 65535).all()), f"{name}: frame_number", step, "0..65535 from point on")
    truth = *cloud.rotation.ravel(), *cloud.translation_m
    numbers = [cloud.travel_m, *cloud.sensor_m, *truth, *cloud.statistics.values()]
    require(bool(np.isfinite(numbers).all()), f"{name}: truth and statistics", "NaN or infinity", "finite numbers")
    x, y, z = grid.T.astype(np.int16)
    return x, y, z, power, step.astype(np.uint16)


def _split_bytes(values: NDArray[Any]) -> bytes:
    """16-bit values as low bytes, then high bytes."""
    raw = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<")))
    return raw.view(np.uint8).reshape(-1, 2).T.tobytes()


def _joined_bytes(raw: bytes, kind: str) -> NDArray[Any]:
    pairs = np.frombuffer(raw, np.uint8).reshape(2, -1).T
    return np.ascontiguousarray(pairs).view(kind).ravel()


def _shard(content: dict[str, Any]) -> Shard:
    counts = [int(record["points"]) for record in content["samples"]]
    columns = [_joined_bytes(content[key], "<i2") for key in "xyz"]
    power = np.frombuffer(content["power"], np.int8)
    step = _joined_bytes(content["step"], "<u2")
    if any(len(column) != sum(counts) for column in (*columns, power, step)) or min(counts, default=0) < 0:
        raise ValueError("the points do not fit the counts")
    xyz_m = (np.stack(columns, axis=1) * POINT_M).astype(np.float32)
    ends = np.cumsum(counts)
    clouds = [
        _cloud(record, xyz_m[start:end], power[start:end], step[start:end])
        for record, start, end in zip(content["samples"], ends - counts, ends, strict=True)
    ]
    objects = {
        name: ObjectInfo(**info | {"size_m": tuple(map(float, info["size_m"]))})
        for name, info in content["objects"].items()
    }
    return Shard(content["set"], int(content["number"]), objects, tuple(clouds))


def _cloud(record: dict[str, Any], xyz_m: Float32, power: NDArray[np.int8], step: NDArray[np.uint16]) -> Cloud:
    return Cloud(
        record["object"],
        record["kind"],
        int(record["variation"]),
        int(record["seed"]),
        xyz_m,
        power.astype(np.float32) + np.float32(record["power_db"]),
        np.cumsum(step, dtype=np.int64),
        np.array(record["sensor_m"], dtype=np.float64),
        np.array(record["rotation"], dtype=np.float64).reshape(3, 3),
        np.array(record["translation_m"], dtype=np.float64),
        int(record["frames"]),
        float(record["travel_m"]),
        dict(record["statistics"]),
        record["status"],
        record["error"],
    )
