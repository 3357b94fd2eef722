# SPDX-License-Identifier: Apache-2.0
"""Recordings that end badly: cut at every byte, damaged anywhere, killed writers, full disks."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from recording_rigs import BIG, LAYOUT, Item, assert_prefix, content, frame, inputs, pose, same, small_rig, write

from edge.errors import RecordingError
from edge.frames import Layout, Pose, RadarFrame
from edge.recording import schema
from edge.recording.reader import RecordingReader
from edge.recording.writer import RecordingWriter

TOPICS = ("/radar/horizontal/raw", "/radar/vertical/raw", "/pose", "/shape")
CHILD = """
import sys, time
sys.path.insert(0, {here!r})
from pathlib import Path
from recording_rigs import BIG, LAYOUT, content, small_rig, write
from edge.recording.writer import RecordingWriter
layout, count = (BIG, 400) if sys.argv[2] == "big" else (LAYOUT, 3)
writer = RecordingWriter(Path(sys.argv[1]) / "a.mcap", small_rig(Path(sys.argv[1]) / "rig", layout))
for n, item in enumerate(content(count, layout)):
    write(writer, [item])
    print(n + 1, flush=True)
time.sleep(600)
"""


def make(folder: Path, items: Sequence[Item], layout: Layout, flush_every: int) -> Path:
    path = folder / "a.mcap"
    path.unlink(missing_ok=True)
    with RecordingWriter(path, small_rig(folder / "rig", layout)) as writer:
        for n, item in enumerate(items, start=1):
            write(writer, [item])
            if n % flush_every == 0:
                writer.flush()
    return path


def ends(path: Path, items: Sequence[Item], flush_every: int) -> list[int]:
    """Where the chunk of each item ends in the file, found by the items' bytes: behind a frame or at a flush."""
    whole, found, position = path.read_bytes(), [], 0
    for item in items:
        if isinstance(item, RadarFrame):
            payload = item.adc.astype("<i2").tobytes()
        else:
            payload = schema.encode_pose(item) if isinstance(item, Pose) else item.payload
        position = whole.index(payload, position) + len(payload)
        found.append(position)
    for n in range(len(items) - 2, -1, -1):
        if not (isinstance(items[n], RadarFrame) or (n + 1) % flush_every == 0):
            found[n] = found[n + 1]
    return found


def test_cut_at_every_byte_of_a_small_file(tmp_path: Path) -> None:
    items = content(2)
    path = make(tmp_path, items, LAYOUT, flush_every=100)
    last_byte, size = ends(path, items, 100), path.stat().st_size
    for length in range(size, -1, -1):
        os.truncate(path, length)
        if length < 8:
            with pytest.raises(RecordingError, match="no MCAP file"):
                RecordingReader(path)
            continue
        with RecordingReader(path) as reader:
            count = assert_prefix(reader, items)
            assert count == sum(end <= length for end in last_byte)
            assert reader.truncated == (length < size)
            assert reader.recovered == count


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_cut_anywhere_in_a_larger_file(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder, items = tmp_path_factory.getbasetemp(), content(6, BIG)
    flush_every = data.draw(st.integers(1, 9))
    path = make(folder, items, BIG, flush_every)
    last_byte = ends(path, items, flush_every)
    length = data.draw(st.integers(8, path.stat().st_size))
    os.truncate(path, length)
    with RecordingReader(path) as reader:
        assert assert_prefix(reader, items) == sum(end <= length for end in last_byte)
        assert reader.info()["truncated"] or length == path.stat().st_size


def test_what_was_lost_is_said(tmp_path: Path) -> None:
    items = content(4, BIG)
    path = make(tmp_path, items, BIG, 1)
    last_byte = ends(path, items, 1)
    os.truncate(path, last_byte[8] - 1)  # the horizontal frame of number 2 lacks a byte
    with RecordingReader(path) as reader:
        info = reader.info()
        assert info["truncated"] is True
        assert info["topics"] == {"/radar/horizontal/raw": 2, "/pose": 2, "/radar/vertical/raw": 2, "/shape": 2}
        assert isinstance(info["bytes_lost"], int)
        assert BIG.nbytes < info["bytes_lost"] < BIG.nbytes + 400
        assert reader.total_frames == 4
        assert reader.rig_name == "rig"


def test_a_damaged_chunk_is_left_out_and_the_rest_read(tmp_path: Path) -> None:
    items = content(4, BIG)
    path = make(tmp_path, items, BIG, 1)
    position = ends(path, items, 1)[4] - 1000  # inside the horizontal frame of number 1
    with path.open("r+b") as file:
        file.seek(position)
        byte = file.read(1)[0]
        file.seek(position)
        file.write(bytes([byte ^ 4]))
    with RecordingReader(path) as reader:
        read = list(reader)
        expected = [item for item in inputs(items) if not same(item, items[4])]
        assert len(read) == len(expected)
        assert all(map(same, read, expected))
        assert not reader.truncated
        report = reader.verify()
        assert (report.messages, report.damaged_chunks, report.missing) == (15, 1, 1)
        assert report.bytes_lost > BIG.nbytes


@settings(max_examples=400, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 1 << 16), st.integers(1, 255)), min_size=1, max_size=4), st.integers(0, 99))
def test_flipped_bytes_never_give_wrong_data(
    tmp_path_factory: pytest.TempPathFactory, flips: list[tuple[int, int]], cut: int
) -> None:
    """Everything that is read was written, in order; anything else is a declared error."""
    folder, items = tmp_path_factory.getbasetemp(), content(3)
    pristine = folder / "pristine.mcap"
    if not pristine.exists():
        make(folder, items, LAYOUT, 4).rename(pristine)
    whole = bytearray(pristine.read_bytes())
    for position, mask in flips:
        whole[position % len(whole)] ^= mask
    path = folder / "flipped.mcap"
    path.write_bytes(whole[: len(whole) - 4 * cut] if cut > 50 else whole)
    try:
        with RecordingReader(path) as reader:
            info, read = reader.info(), list(reader)
    except RecordingError:
        return
    expected = iter(inputs(items))
    assert all(any(same(item, other) for other in expected) for item in read)
    if whole == path.read_bytes():
        known = sum(count for topic, count in info["topics"].items() if topic in TOPICS)  # type: ignore[attr-defined]
        assert len(read) == 9 or reader.truncated or reader.report.missing or known < 12


@given(st.binary(max_size=300))
def test_any_bytes_after_the_magic_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, tail: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + tail)
    try:
        with RecordingReader(path) as reader:
            assert list(reader) == []
            assert reader.truncated
    except RecordingError:
        pass


def test_a_length_beyond_the_file_allocates_nothing(tmp_path: Path) -> None:
    path = make(tmp_path, content(1), LAYOUT, 1)
    with path.open("r+b") as file:
        file.seek(chunk_start(path) + 1)
        file.write(b"\xff" * 8)
    with RecordingReader(path) as reader:
        assert list(reader) == []
        assert reader.report.bytes_lost > LAYOUT.nbytes


def chunk_start(path: Path) -> int:
    """Where the first chunk begins, as the MCAP project's reader says."""
    summary = make_reader(BytesIO(path.read_bytes())).get_summary()
    assert summary is not None
    return summary.chunk_indexes[0].chunk_start_offset


def start_child(folder: Path, size: str) -> subprocess.Popen[str]:
    script = CHILD.format(here=str(Path(__file__).parent))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", script, str(folder), size]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def test_kill_9_loses_nothing_that_was_in_the_file(tmp_path: Path) -> None:
    with start_child(tmp_path, "big") as child:
        assert child.stdout is not None
        written = 0
        for line in child.stdout:
            written = int(line)
            if written >= 100:
                child.send_signal(signal.SIGKILL)
        assert child.wait(60) == -signal.SIGKILL
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert reader.truncated
        count = assert_prefix(reader, content(400, BIG)[: written + 8])
        assert count >= written - 3, "the last frame and all before it; small messages after it may wait half a second"


def test_small_messages_reach_the_file_without_further_calls(tmp_path: Path) -> None:
    with start_child(tmp_path, "small") as child:
        assert child.stdout is not None
        for line in child.stdout:
            if int(line) == 12:
                break
        recovered = 0
        for _ in range(600):  # half a second, unless the machine is busy
            with RecordingReader(tmp_path / "a.mcap") as reader:
                recovered = reader.recovered
            if recovered == 12:
                break
            time.sleep(0.05)
        child.send_signal(signal.SIGKILL)
        child.wait(60)
    assert recovered == 12
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert assert_prefix(reader, content(3)) == 12


def test_full_disk_stops_the_recording_and_leaves_it_readable(tmp_path: Path) -> None:
    """A file size limit acts as a disk that becomes full in the middle of a write."""
    items, path = [frame("horizontal", n, BIG) for n in range(50)], tmp_path / "a.mcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer, written = RecordingWriter(path, small_rig(tmp_path / "rig", BIG)), 0
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20 * BIG.nbytes, before[1]))
        with pytest.raises(RecordingError, match=r"recording stopped.*free space"):  # noqa: PT012 - which call is open
            while written < len(items):
                writer.frame(items[written])
                written += 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with pytest.raises(RecordingError, match="recording stopped"):
        writer.pose(pose(0))
    with pytest.raises(RecordingError, match="recording stopped"):
        writer.flush()
    writer.close()
    assert 15 <= written < 20
    with RecordingReader(path) as reader:
        assert assert_prefix(reader, items) == written
        assert reader.truncated
        assert reader.report.bytes_lost == 0, "the failed write was taken back whole"
