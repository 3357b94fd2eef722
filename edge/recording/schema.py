# SPDX-License-Identifier: Apache-2.0
"""What a recording is made of: topics, schema names, and the bytes of a frame and of a pose.

A recording is an MCAP file of profile ``rfconstruct``, chunked, uncompressed, with CRCs. Log times are nanoseconds of
CLOCK_MONOTONIC. The rig's folder and calibrations are attachments, so a recording replays by itself.

A raw frame is a header of 64 bytes (little endian) and the int16 samples in the capture's own order:
``4s magic, u16 version, u8 radar, u8 kind, u64 number, i64 t_first_chirp_ns, u16 devices, loops, slots, samples, rx,
u16 IQ order``, zeros to 64; kind 0 cascade, 1 dca1000, 2 dca1000_real. A pose is JSON that Foxglove shows
(``foxglove.PoseInFrame``) with exact numbers.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np

from edge.errors import CaptureError, PoseError, RecordingError
from edge.frames import RADARS, Layout, Pose, RadarFrame, RadarId

PROFILE = "rfconstruct"
FORMAT_VERSION = 1
METADATA = "rfconstruct"
RIG_PREFIX = "rig/"
CALIBRATION_PREFIX = "calibration/"

FRAME_TOPICS: dict[RadarId, str] = {radar: f"/radar/{radar}/raw" for radar in RADARS}
POSE_TOPIC = "/pose"
RESULT_TOPIC_OF = {
    "shape": "/shape",
    "cloud": "/cloud",
    "det": "/detections",
    "heat": "/heatmap",
    "status": "/status",
    "pose": "/rig_pose",
    "hb": "/heartbeat",
}
"""Name in the topic of the stream (``1/shape/car/``) -> topic in the recording."""
OTHER_TOPIC = "/other"
RESULT_TOPICS = (*RESULT_TOPIC_OF.values(), OTHER_TOPIC)
"""Results are stored as the stream encodes them, with their own topic, in the single-frame form."""

FRAME_SCHEMA, FRAME_ENCODING = "rfconstruct.RawFrame.v1", "x-rfconstruct-frame"
RESULT_SCHEMA, RESULT_ENCODING = "rfconstruct.Stream.v1", "x-rfconstruct-stream"
POSE_SCHEMA, POSE_ENCODING = "foxglove.PoseInFrame", "json"
_NUMBERS = {"type": "number"}
POSE_JSON_SCHEMA = json.dumps(
    {
        "title": POSE_SCHEMA,
        "type": "object",
        "properties": {
            "timestamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
            "frame_id": {"type": "string"},
            "pose": {
                "type": "object",
                "properties": {
                    "position": {"type": "object", "properties": dict.fromkeys("xyz", _NUMBERS)},
                    "orientation": {"type": "object", "properties": dict.fromkeys("xyzw", _NUMBERS)},
                },
            },
        },
    }
).encode()

FRAME_HEADER = struct.Struct("<4sHBBQq6H28x")
FRAME_MAGIC = b"RFCF"
_KINDS: tuple[Literal["cascade", "dca1000", "dca1000_real"], ...] = ("cascade", "dca1000", "dca1000_real")
_IQ_ORDERS: tuple[Literal["IQ"], Literal["QI"]] = ("IQ", "QI")


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """A result as it was published.

    Args:
        topic: one of RESULT_TOPICS.
        t_ns: log time.
        payload: the stream's bytes.
    """

    topic: str
    t_ns: int
    payload: bytes


def result_topic(stream_topic: bytes) -> str:
    """Where a message of the stream is stored."""
    parts = stream_topic.split(b"/")
    return RESULT_TOPIC_OF.get(parts[1].decode("ascii", "replace") if len(parts) > 1 else "", OTHER_TOPIC)


def frame_header(frame: RadarFrame) -> bytes:
    """The 64 bytes before a frame's samples; RecordingError when a value does not fit."""
    layout = frame.layout
    try:
        return FRAME_HEADER.pack(
            FRAME_MAGIC,
            FORMAT_VERSION,
            RADARS.index(frame.radar),
            _KINDS.index(layout.kind),
            frame.number,
            frame.t_first_chirp_ns,
            layout.devices,
            layout.loops,
            layout.slots,
            layout.samples,
            layout.rx,
            _IQ_ORDERS.index(layout.iq_order),
        )
    except struct.error as error:
        raise RecordingError(
            f"{frame.radar} frame cannot be recorded",
            value=(frame.number, frame.t_first_chirp_ns),
            allowed="number and time in 0..2^63-1",
        ) from error


def decode_frame(payload: memoryview) -> RadarFrame:
    """A frame from a message's bytes; its samples are copied once, so that they are aligned and the reader's own.

    Raises:
        RecordingError: another version, or a size that contradicts the header.
    """
    if len(payload) < FRAME_HEADER.size:
        raise RecordingError(
            "raw frame without its header", value=len(payload), allowed=f">= {FRAME_HEADER.size} bytes"
        )
    magic, version, radar, kind, number, t_ns, devices, *axes, iq_order = FRAME_HEADER.unpack_from(payload)
    if magic != FRAME_MAGIC or version != FORMAT_VERSION:
        raise RecordingError(
            "raw frame of an unknown version",
            value=(magic, version),
            allowed=f"{FRAME_MAGIC!r}, {FORMAT_VERSION}",
            action="read it with the version of rfconstruct that wrote it",
        )
    samples = payload[FRAME_HEADER.size :]
    loops, slots, samples_per_chirp, rx = axes
    single_chip = devices == 1 and samples_per_chirp % 2 == 0
    known = max(radar, iq_order) <= 1 and kind < len(_KINDS)
    if not known or not all((devices, *axes)) or (kind >= 1 and not single_chip):
        raise RecordingError("raw frame with an impossible header", value=(radar, kind, iq_order, devices, *axes))
    layout = Layout(_KINDS[kind], devices, loops, slots, samples_per_chirp, rx, _IQ_ORDERS[iq_order])
    if len(samples) != layout.nbytes:
        raise RecordingError("raw frame of a wrong size", value=len(samples), allowed=f"{layout.nbytes} bytes")
    adc = np.frombuffer(samples, dtype="<i2").astype(np.int16).reshape(layout.shape)
    try:
        return RadarFrame(RADARS[radar], number, t_ns, adc, layout)
    except CaptureError as error:
        raise RecordingError(error.what, value=error.value, allowed=error.allowed) from error


def encode_pose(pose: Pose) -> bytes:
    """JSON of a pose; floats are written so that they read back exactly."""
    position, quaternion = pose.position_m.tolist(), pose.quaternion_xyzw.tolist()
    return json.dumps(
        {
            "timestamp": {"sec": pose.t_ns // 10**9, "nsec": pose.t_ns % 10**9},
            "frame_id": "odom",
            "pose": {
                "position": dict(zip("xyz", position, strict=True)),
                "orientation": dict(zip("xyzw", quaternion, strict=True)),
            },
        },
        allow_nan=False,
    ).encode()


def decode_pose(payload: memoryview) -> Pose:
    """A pose from a message's bytes; RecordingError when it is none."""
    try:
        message = json.loads(bytes(payload))
        time, pose = message["timestamp"], message["pose"]
        position = [float(pose["position"][axis]) for axis in "xyz"]
        quaternion = [float(pose["orientation"][axis]) for axis in "xyzw"]
        t_ns = int(time["sec"]) * 10**9 + int(time["nsec"])
        return Pose(t_ns, np.array(position), np.array(quaternion))
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, PoseError) as error:
        raise RecordingError("recorded pose is no pose", value=str(error)) from error
