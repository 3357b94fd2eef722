# SPDX-License-Identifier: Apache-2.0
"""PLY files: byte-exact header, round trip, foreign layouts, and refusals."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from stream_samples import STAMP, shape

from edge.errors import RecordingError
from edge.stream.convert import encode_shape, read_ply, save_shape, write_ply
from edge.stream.decode import decode
from edge.stream.messages import ShapeMessage
from edge.stream.wire import pack


def test_bytes_are_those_of_the_format(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", np.array([[1.0, 2.0, -0.5]], np.float32), {"class": "car"})
    assert (tmp_path / "a.ply").read_bytes() == (
        b"ply\nformat binary_little_endian 1.0\ncomment class car\nelement vertex 1\n"
        b"property float x\nproperty float y\nproperty float z\nend_header\n" + struct.pack("<3f", 1.0, 2.0, -0.5)
    )
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_shape_and_its_message_give_the_same_file(tmp_path: Path) -> None:
    original = shape(1000)
    message = decode(pack(encode_shape(original), STAMP))
    assert isinstance(message, ShapeMessage)
    save_shape(tmp_path / "a.ply", original)
    save_shape(tmp_path / "b.ply", message)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    points, comments = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, original.fine_m)
    assert points.dtype == np.float32
    assert (comments["identity"], comments["class"], comments["confidence"]) == ("5", "car", "0.5000")
    assert comments["position_m"] == "1.000000 2.500000 0.000000"


def test_other_properties_elements_and_types(tmp_path: Path) -> None:
    header = (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty uchar red\nproperty double z\n"
        b"property float x\nproperty short y\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = struct.pack("<Bdfh", 255, 3.0, 1.0, 2) + struct.pack("<Bdfh", 0, 6.0, 4.0, 5)
    (tmp_path / "a.ply").write_bytes(header + rows)
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply")[0], [[1, 2, 3], [4, 5, 6]])


def test_no_points_and_awkward_comments(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", np.empty((0, 3), np.float32), {"note": "two\nend_header\nlines", "empty": ""})
    points, comments = read_ply(tmp_path / "a.ply")
    assert points.shape == (0, 3)
    assert comments == {"note": "two", "empty": ""}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex -1\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n" + bytes(4),
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n",
    ],
)
def test_what_is_no_such_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.ply"):
        read_ply(tmp_path / "a.ply")


def test_cut_absent_and_unwritable_files(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", np.zeros((10, 3), np.float32))
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content[:-1])
    with pytest.raises(RecordingError, match="vertices are missing"):
        read_ply(tmp_path / "a.ply")
    with pytest.raises(RecordingError, match="cannot be read"):
        read_ply(tmp_path / "b.ply")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_ply(tmp_path / "no" / "b.ply", np.zeros((1, 3), np.float32))


HEAD = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"


@settings(max_examples=300, deadline=None)
@example(place=69, insert=b"\n\t", drop=0)
@given(place=st.integers(0, len(HEAD)), insert=st.binary(max_size=6), drop=st.integers(0, 3))
def test_mutated_files(tmp_path_factory: pytest.TempPathFactory, place: int, insert: bytes, drop: int) -> None:
    path = tmp_path_factory.getbasetemp() / "mutated.ply"
    path.write_bytes(HEAD[:place] + insert + HEAD[place + drop :] + b"end_header\n" + bytes(24))
    try:
        points, _ = read_ply(path)
    except RecordingError:
        return
    assert points.shape[1] == 3
