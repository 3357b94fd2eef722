# SPDX-License-Identifier: Apache-2.0
"""Records of 128 bytes from the process that holds the camera to the one that uses its poses.

Little endian: magic ``RFPO``, u16 version, u16 kind, u32 sequence, u32 flags, body of 108 bytes, u32 CRC-32 of all
before it. A record is shorter than ``PIPE_BUF``, so a pipe takes it whole or not at all. Body of a pose: i64 time, i64
arrival (CLOCK_MONOTONIC, ns), 7 f64 position and quaternion (x, y, z, w), 3 f32 velocity (m/s), f32 turn rate (rad/s,
NaN: no gyroscope). Body of a text: u16 code, UTF-8, padded with zeros.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum, IntFlag

MAGIC = b"RFPO"
VERSION = 1
RECORD_BYTES = 128
_HEAD = struct.Struct("<4sHHII")
_POSE = struct.Struct("<qq7d4f")
_CODE = struct.Struct("<H")
_CRC = struct.Struct("<I")
_BODY_BYTES = RECORD_BYTES - _HEAD.size - _CRC.size
TEXT_BYTES = _BODY_BYTES - _CODE.size


class Kind(IntEnum):
    """What a record tells."""

    HELLO = 1
    """The process runs; text: versions and device."""
    POSE = 2
    ALIVE = 3
    """Nothing to say; text: what it waits for."""
    ERROR = 4
    """Why the process ends; text: reason, code: its exit code."""


class PoseFlag(IntFlag):
    """What is known of a pose besides its numbers."""

    TIME_APPROXIMATE = 1
    """Time of the newest image, which may be one or two frames after the one the pose was made of."""
    TIME_GUESSED = 2
    """The pose came without any time: it carries its arrival."""


@dataclass(frozen=True, slots=True)
class PoseRecord:
    """A pose as the camera gave it.

    Args:
        sequence: number of the record.
        flags: what is known of its time.
        t_ns, arrival_ns: CLOCK_MONOTONIC; instant of the pose, and when it came out of the camera's library.
        position_m, quaternion_xyzw: of the sensor in its odometry frame.
        velocity_m_s: in that frame.
        turn_rate_rad_s: of the gyroscope; NaN: unknown.
    """

    sequence: int
    flags: PoseFlag
    t_ns: int
    arrival_ns: int
    position_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]
    velocity_m_s: tuple[float, float, float]
    turn_rate_rad_s: float

    def pack(self) -> bytes:
        """The 128 bytes."""
        numbers = (*self.position_m, *self.quaternion_xyzw, *self.velocity_m_s, self.turn_rate_rad_s)
        return _pack(Kind.POSE, self.sequence, self.flags, _POSE.pack(self.t_ns, self.arrival_ns, *numbers))


@dataclass(frozen=True, slots=True)
class TextRecord:
    """A word from the process.

    Args:
        kind: any but POSE.
        sequence: number of the record.
        code: of an ERROR.
        text: at most 106 bytes of UTF-8; the rest is cut off.
    """

    kind: Kind
    sequence: int
    code: int
    text: str

    def pack(self) -> bytes:
        """The 128 bytes."""
        text = self.text.encode("utf-8", "replace")[:TEXT_BYTES]
        return _pack(self.kind, self.sequence, PoseFlag(0), _CODE.pack(self.code) + text)


Record = PoseRecord | TextRecord


def _pack(kind: Kind, sequence: int, flags: PoseFlag, body: bytes) -> bytes:
    head = _HEAD.pack(MAGIC, VERSION, kind, sequence & 0xFFFFFFFF, flags)
    record = head + body.ljust(_BODY_BYTES, b"\0")
    return record + _CRC.pack(zlib.crc32(record))


def unpack(block: bytes) -> Record | None:
    """One record of exactly 128 bytes; None when they are none."""
    if len(block) != RECORD_BYTES or zlib.crc32(block[: -_CRC.size]) != _CRC.unpack_from(block, -_CRC.size)[0]:
        return None
    magic, version, kind, sequence, flags = _HEAD.unpack_from(block)
    if magic != MAGIC or version != VERSION or kind not in set(Kind):
        return None
    if kind == Kind.POSE:
        t_ns, arrival_ns, *v = _POSE.unpack_from(block, _HEAD.size)
        known = PoseFlag(flags & (PoseFlag.TIME_APPROXIMATE | PoseFlag.TIME_GUESSED))
        place = (v[0], v[1], v[2]), (v[3], v[4], v[5], v[6]), (v[7], v[8], v[9])
        return PoseRecord(sequence, known, t_ns, arrival_ns, *place, v[10])
    (code,) = _CODE.unpack_from(block, _HEAD.size)
    text = block[_HEAD.size + _CODE.size : -_CRC.size].rstrip(b"\0").decode("utf-8", "replace")
    return TextRecord(Kind(kind), sequence, code, text)


class RecordReader:
    """Records out of a stream of bytes; garbage is passed over and counted, and nothing but a part of a record is kept.

    Attributes:
        garbage_bytes: that belonged to no record.
    """

    def __init__(self) -> None:
        self.garbage_bytes = 0
        self._rest = b""

    def feed(self, chunk: bytes) -> list[Record]:
        """Records that are complete with ``chunk``, in order."""
        data, start = self._rest + chunk, 0
        found: list[Record] = []
        while (at := data.find(MAGIC, start)) >= 0 and at + RECORD_BYTES <= len(data):
            record = unpack(data[at : at + RECORD_BYTES])
            self.garbage_bytes += at - start + (record is None)
            start = at + (RECORD_BYTES if record is not None else 1)
            if record is not None:
                found.append(record)
        if at < 0:  # only the last three bytes can still begin a record
            at = max(start, len(data) - len(MAGIC) + 1)
        self.garbage_bytes += at - start
        self._rest = data[at:]
        return found
