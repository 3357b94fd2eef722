# SPDX-License-Identifier: Apache-2.0
"""Records of the camera's process: byte layout, and a reader that only ever gives what was sent."""

from __future__ import annotations

import math
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.odometry.oak_record import (
    MAGIC,
    RECORD_BYTES,
    TEXT_BYTES,
    Kind,
    PoseFlag,
    PoseRecord,
    RecordReader,
    TextRecord,
    unpack,
)

POSE = PoseRecord(
    7, PoseFlag.TIME_GUESSED, 2**53 + 1, 2**53 + 9, (1.0, -2.0, 0.1), (0.0, 0.6, 0.0, 0.8), (0.5, 0.25, -1.0), 0.125
)


def test_every_byte_of_a_pose() -> None:
    body = struct.pack("<qq7d4f", 2**53 + 1, 2**53 + 9, 1.0, -2.0, 0.1, 0.0, 0.6, 0.0, 0.8, 0.5, 0.25, -1.0, 0.125)
    expected = b"RFPO" + bytes([1, 0, 2, 0, 7, 0, 0, 0, 2, 0, 0, 0]) + body + bytes(20)
    assert len(expected) == 124
    assert POSE.pack() == expected + zlib.crc32(expected).to_bytes(4, "little")
    assert unpack(POSE.pack()) == POSE


def test_nan_turn_rate_means_unknown() -> None:
    record = unpack(PoseRecord(0, PoseFlag(0), 1, 1, (0, 0, 0), (0, 0, 0, 1), (0, 0, 0), math.nan).pack())
    assert isinstance(record, PoseRecord)
    assert math.isnan(record.turn_rate_rad_s)


def test_text_is_cut_to_its_place() -> None:
    record = unpack(TextRecord(Kind.ERROR, 3, 11, "no camera " * 30).pack())
    assert isinstance(record, TextRecord)
    assert (record.kind, record.code, len(record.text)) == (Kind.ERROR, 11, TEXT_BYTES)


@pytest.mark.parametrize("at", [0, 4, 6, 8, 20, 90, 123, 124, 127])
def test_one_wrong_bit_anywhere_is_no_record(at: int) -> None:
    block = bytearray(POSE.pack())
    block[at] ^= 0x10
    assert unpack(bytes(block)) is None


@pytest.mark.parametrize(("place", "value"), [(4, 2), (6, 9)])
def test_another_version_or_kind_with_a_right_sum_is_no_record(place: int, value: int) -> None:
    block = bytearray(POSE.pack())
    block[place] = value
    block[-4:] = zlib.crc32(bytes(block[:-4])).to_bytes(4, "little")
    assert unpack(bytes(block)) is None


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.one_of(st.binary(max_size=200), st.integers(0, 5), st.just(MAGIC * 3)), max_size=12),
    st.integers(1, 97),
)
def test_records_between_garbage_all_come_and_every_byte_is_accounted(parts: list[bytes | int], step: int) -> None:
    records, stream, garbage = [], b"", 0
    for number, part in enumerate(parts):
        if isinstance(part, int):
            records.append(TextRecord(Kind.ALIVE, number, part, "x" * part))
            stream += records[-1].pack()
        else:
            stream, garbage = stream + part, garbage + len(part)
    stream += bytes(RECORD_BYTES)  # lets the last candidate be decided
    reader, found = RecordReader(), []
    for start in range(0, len(stream), step):
        found += reader.feed(stream[start : start + step])
        assert len(reader._rest) < RECORD_BYTES + step
    assert found == records
    assert reader.garbage_bytes + len(reader._rest) == garbage + RECORD_BYTES


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=1000))
def test_random_bytes_are_no_records(data: bytes) -> None:
    reader = RecordReader()
    assert reader.feed(data) == []
    assert reader.garbage_bytes + len(reader._rest) == len(data)
