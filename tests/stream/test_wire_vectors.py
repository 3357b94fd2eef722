# SPDX-License-Identifier: Apache-2.0
"""The test vectors of docs/wire_format.md, read out of the document, decode to what it says and encode to its bytes."""

from __future__ import annotations

import json
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from stream_samples import STAMP, pose, shape

from edge.stream import convert, wire
from edge.stream.decode import decode
from edge.stream.messages import HeartbeatMessage, PoseMessage, ShapeMessage

DOCUMENT = (Path(__file__).resolve().parents[2] / "docs" / "wire_format.md").read_text(encoding="utf-8")
DRAFTS = {
    "heartbeat": convert.encode_heartbeat("RUN", 1_000_000_000),
    "pose": convert.encode_pose(pose()),
    "shape": convert.encode_shape(shape()),
    "shape in millimetres": convert.encode_shape(shape(), "i2"),
}


def blocks(name: str, language: str) -> str:
    """Text of the first code block of a language under a vector's heading."""
    section = DOCUMENT.split(f"### Vector: {name}\n")[1].split("\n### ")[0]
    found = re.search(rf"```{language}\n(.*?)```", section, re.DOTALL)
    assert found is not None
    return found[1]


def frames(name: str) -> list[bytes]:
    """The frames of a vector, in order."""
    parts = re.split(r"^[a-z]+(?: \d)?:$", blocks(name, "hex"), flags=re.MULTILINE)[1:]
    return [bytes.fromhex(part) for part in parts]


def plain(value: Any) -> Any:
    """The document's JSON with binary values as bytes."""
    if isinstance(value, dict):
        return bytes.fromhex(value["hex"]) if set(value) == {"hex"} else {k: plain(v) for k, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, list) else value


@pytest.mark.parametrize("name", DRAFTS)
def test_bytes_and_json_of_the_document_agree(name: str) -> None:
    header = plain(json.loads(blocks(name, "json")))
    assert msgpack.unpackb(frames(name)[1]) == header
    assert [(p["len"], p["crc32"]) for p in header["pl"]] == [(len(p), zlib.crc32(p)) for p in frames(name)[2:]]


@pytest.mark.parametrize("name", DRAFTS)
def test_the_publisher_writes_the_documents_bytes(name: str) -> None:
    assert wire.pack(DRAFTS[name], STAMP) == frames(name)


def test_heartbeat_and_pose_decode() -> None:
    beat, where = decode(frames("heartbeat")), decode(frames("pose"))
    assert isinstance(beat, HeartbeatMessage)
    assert (beat.state, beat.header.sequence, beat.header.boot) == ("RUN", 7, bytes(range(16)))
    assert isinstance(where, PoseMessage)
    np.testing.assert_array_equal(where.pose.position_m, [1.0, 2.5, 0.0])
    np.testing.assert_array_equal(where.pose.quaternion_xyzw, [0.0, 0.0, 0.6, 0.8])


@pytest.mark.parametrize("name", ["shape", "shape in millimetres"])
def test_shape_decodes(name: str) -> None:
    message = decode(frames(name))
    assert isinstance(message, ShapeMessage)
    np.testing.assert_allclose(message.fine_m, [[0.5, -1.0, 0.25], [2.0, 1.0, 1.75]], atol=1e-6)
    assert message.header.topic == "1/shape/car/"
    assert message.model == "0123456789abcdef"


def test_shape_is_read_with_nothing_but_the_document() -> None:
    _, header, payload, _ = frames("shape in millimetres")
    points = msgpack.unpackb(header)["pts"]
    offsets = {name: offset for name, offset, kind, _ in points["fields"] if kind == 3}
    read = [
        [points["scale"] * struct.unpack_from("<h", payload, i * points["step"] + offsets[axis])[0] for axis in "xyz"]
        for i in range(points["n"])
    ]
    np.testing.assert_allclose(read, [[0.5, -1.0, 0.25], [2.0, 1.0, 1.75]])


def test_single_frame_form() -> None:
    block = frames("heartbeat in the single-frame form")[0]
    assert wire.split(block) == frames("heartbeat")
    assert wire.join(frames("heartbeat")) == block


def test_the_document_names_every_key_flag_and_limit() -> None:
    from test_wire import DRAFTS as ALL

    for draft in ALL.values():
        header = msgpack.unpackb(wire.pack(draft, STAMP)[1])
        missing = [key for key in header if f"`{key}`" not in DOCUMENT]
        assert not missing, f"{draft.type}: {missing}"
        assert f"`{draft.type}`" in DOCUMENT
    for text in ("[1, 1]", "header 64 KiB", "whole message 4 MiB", "topic 128 bytes", "8 payloads"):
        assert text in DOCUMENT
