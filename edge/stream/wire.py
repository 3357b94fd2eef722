# SPDX-License-Identifier: Apache-2.0
"""The wire format, major version 1: frames of a message, checked header fields, point payloads.

A message is ``[topic][header: msgpack map][payload 0][payload 1] ...``; numbers in payloads are little endian, C order.
docs/wire_format.md describes every byte. Nothing is ever unpickled, and bad bytes raise ``WireError`` only.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import msgpack
import numpy as np

from edge.errors import WireError
from edge.stream.fields import U32, Fields

MAJOR, MINOR = 1, 1
TOPIC_LIMIT_BYTES = 128
HEADER_LIMIT_BYTES = 64 * 2**10
MESSAGE_LIMIT_BYTES = 4 * 2**20
PAYLOAD_LIMIT = 8
HASH_BYTES, BOOT_BYTES = 8, 16

Source = Literal["live", "replay", "sim"]
SOURCES: tuple[Source, ...] = ("live", "replay", "sim")

FLAG_CUT_WINDOW = 1
"""Time, a pose gap or the end of the data closed the window before it covered its travel."""
FLAG_FEW_FRAMES = 2
"""The window holds fewer than 60 frames."""
FLAG_REPEATED = 8
"""Published before; sent again because somebody subscribed."""
FLAG_FINAL = 4
"""The object has left the window: its last shape, made of the window that saw most of it."""

HEARTBEAT_HZ = 10.0
HEATMAP_HZ = 10.0
STATUS_HZ = 1.0

_TOPIC = re.compile(rb"(\d{1,3})/([a-z0-9_-]+/)+")


@dataclass(frozen=True, slots=True)
class Draft:
    """A message before the publisher stamps it.

    Args:
        topic: ASCII, with version and final slash, for example ``1/shape/car/``.
        type: message type, for example ``shape``.
        t_ns: instant of the measurement, CLOCK_MONOTONIC.
        frame: frame of reference of the coordinates, or "".
        flags: FLAG_* bits.
        fields: header keys of this type.
        payloads: binary parts.
    """

    topic: str
    type: str
    t_ns: int
    frame: str = ""
    flags: int = 0
    fields: Mapping[str, Any] = field(default_factory=dict)
    payloads: Sequence[bytes] = ()


@dataclass(frozen=True, slots=True)
class Stamp:
    """What the publisher adds to every message.

    Args:
        boot: 16 random bytes, new with every start of the publisher.
        sequence: number of the message within its topic, from 0.
        t_pub_ns: instant of publication, CLOCK_MONOTONIC.
        utc_ns: the same instant, nanoseconds since 1970 UTC.
        utc_ok: the clock of ``utc_ns`` is disciplined by time synchronisation.
        source: "live", "replay" or "sim".
        config_hash, calibration_hash: first 8 bytes of the hashes of what produced the data.
    """

    boot: bytes
    sequence: int
    t_pub_ns: int
    utc_ns: int
    utc_ok: bool
    source: Source
    config_hash: bytes
    calibration_hash: bytes


@dataclass(frozen=True, slots=True)
class Received:
    """A message whose frame structure, lengths and check sums are right.

    Args:
        topic: as sent.
        fields: the header.
        payloads: binary parts.
    """

    topic: str
    fields: Fields
    payloads: Sequence[bytes]


def pack(draft: Draft, stamp: Stamp) -> list[bytes]:
    """The frames of a message.

    Args:
        draft: content.
        stamp: identity and times.
    Returns:
        Topic, header and payloads.
    Raises:
        WireError: the topic is not one, or the message exceeds the limits of the format.
    """
    header = {
        "v": [MAJOR, MINOR],
        "type": draft.type,
        "boot": stamp.boot,
        "seq": stamp.sequence,
        "t_ns": draft.t_ns,
        "t_pub_ns": stamp.t_pub_ns,
        "utc_ns": stamp.utc_ns,
        "utc_ok": stamp.utc_ok,
        "frame": draft.frame,
        "src": stamp.source,
        "cfg": stamp.config_hash,
        "cal": stamp.calibration_hash,
        "flags": draft.flags,
        "pl": [{"len": len(payload), "crc32": zlib.crc32(payload)} for payload in draft.payloads],
        **draft.fields,
    }
    if not _finite(draft.fields):
        raise WireError(f"{draft.type}: a number of the header is not finite", value=repr(dict(draft.fields))[:200])
    try:
        packed: bytes = msgpack.packb(header, default=_plain)
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError(f"{draft.type}: header cannot be packed ({error})") from error
    frames = [draft.topic.encode("ascii", "replace"), packed, *draft.payloads]
    _check_frames(frames)
    return frames


def unpack(frames: Sequence[bytes]) -> Received:
    """Check the structure of a received message.

    Args:
        frames: as received.
    Returns:
        Topic, header and payloads.
    Raises:
        WireError: not this format: another major version, limits, msgpack, lengths or check sums.
    """
    _check_frames(frames)
    fields = Fields(_unpack_map(frames[1]), "header")
    version = fields.array("v")
    if len(version) < 2 or version[0] != MAJOR:
        raise WireError("another major version", value=repr(version)[:80], allowed=f"[{MAJOR}, any]")
    parts = fields.sections("pl")
    payloads = frames[2:]
    if len(parts) != len(payloads):
        raise WireError("payloads do not match the header", value=len(payloads), allowed=str(len(parts)))
    for number, (part, payload) in enumerate(zip(parts, payloads, strict=True)):
        if part.integer("len") != len(payload) or part.integer("crc32", U32) != zlib.crc32(payload):
            raise WireError(f"payload {number}: length or check sum is wrong", value=len(payload))
    return Received(frames[0].decode("ascii"), fields, payloads)


def join(frames: Sequence[bytes]) -> bytes:
    """The single-frame form: number of frames and their lengths as u32, then the frames; recordings keep this.

    Args:
        frames: of ``pack``.
    Returns:
        One block of bytes.
    """
    return struct.pack(f"<{len(frames) + 1}I", len(frames), *map(len, frames)) + b"".join(frames)


def split(block: bytes) -> list[bytes]:
    """The frames of the single-frame form.

    Args:
        block: of ``join``.
    Returns:
        The frames.
    Raises:
        WireError: lengths that do not add up.
    """
    count = int.from_bytes(block[:4], "little") if len(block) >= 4 else 0
    start = 4 * (count + 1)
    if not 2 <= count <= PAYLOAD_LIMIT + 2 or len(block) < start:
        raise WireError("single-frame message: wrong number of frames", value=count, allowed=f"2..{PAYLOAD_LIMIT + 2}")
    lengths = struct.unpack_from(f"<{count}I", block, 4)
    if start + sum(lengths) != len(block):
        raise WireError("single-frame message: lengths do not add up", value=len(block))
    frames = []
    for length in lengths:
        frames.append(block[start : start + length])
        start += length
    return frames


def conflatable(frames: Sequence[bytes]) -> bytes:
    """A message of one frame that a subscriber still selects by its topic: the topic, then the single-frame form.

    Args:
        frames: of ``pack``.
    Returns:
        One block; ``split_conflatable`` undoes it.
    """
    return frames[0] + join(frames)


def split_conflatable(block: bytes) -> list[bytes]:
    """The frames of a message of ``conflatable``; WireError when it is none.

    No byte of a topic is below 0x20 and the first byte of the single-frame form always is, so the topic ends there.
    """
    end = next((i for i, byte in enumerate(block[: TOPIC_LIMIT_BYTES + 1]) if byte < 0x20), None)
    frames = split(block[end:]) if end is not None else []
    if not frames or frames[0] != block[:end]:
        raise WireError("conflatable message: topic and content do not match", value=block[:TOPIC_LIMIT_BYTES])
    return frames


def _finite(value: object) -> bool:
    """No NaN and no infinity in maps, lists and numbers."""
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, Mapping):
        return all(map(_finite, value.values()))
    return all(map(_finite, value)) if isinstance(value, list | tuple) else True


def _plain(value: object) -> object:
    """numpy scalars as Python numbers."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} in a header")


def _check_frames(frames: Sequence[bytes]) -> None:
    """Number and sizes of the frames, form and version of the topic."""
    if not 2 <= len(frames) <= PAYLOAD_LIMIT + 2:
        raise WireError("wrong number of frames", value=len(frames), allowed=f"2..{PAYLOAD_LIMIT + 2}")
    topic, header = frames[0], frames[1]
    match = _TOPIC.fullmatch(topic) if len(topic) <= TOPIC_LIMIT_BYTES else None
    if match is None or int(match[1]) != MAJOR:
        raise WireError("topic is none of this version", value=topic[:TOPIC_LIMIT_BYTES], allowed=f"{MAJOR}/name/")
    if len(header) > HEADER_LIMIT_BYTES or sum(map(len, frames)) > MESSAGE_LIMIT_BYTES:
        raise WireError(
            "message too large",
            value=(len(header), sum(map(len, frames))),
            allowed=f"header {HEADER_LIMIT_BYTES}, message {MESSAGE_LIMIT_BYTES} bytes",
        )


def _unpack_map(header: bytes) -> object:
    """msgpack without extensions, with text keys that occur once."""
    try:
        return msgpack.unpackb(header, object_pairs_hook=_unique, ext_hook=_no_extension, strict_map_key=False)
    except WireError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(f"header is no msgpack map ({type(error).__name__})") from error


def _unique(pairs: list[tuple[object, object]]) -> dict[object, object]:
    content = dict(pairs) if all(isinstance(key, str) for key, _ in pairs) else {}
    if len(content) != len(pairs):
        raise WireError("header: a key is repeated or no text")
    return content


def _no_extension(code: int, data: bytes) -> object:
    raise WireError("header: msgpack extension types are not part of the format", value=code)
