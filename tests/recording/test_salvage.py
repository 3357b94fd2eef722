# SPDX-License-Identifier: Apache-2.0
"""recover: every chunk that is whole is saved, wherever the damage is; garbage costs bounded time and no bytes."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from recording_rigs import BIG, LAYOUT, Item, assert_same, content, inputs, results, same, small_rig, write

from edge.errors import RecordingError
from edge.frames import Layout
from edge.recording import salvage
from edge.recording.reader import RecordingReader
from edge.recording.salvage import recover
from edge.recording.writer import RecordingWriter


def make(folder: Path, items: Sequence[Item], layout: Layout = LAYOUT, every: int = 1) -> Path:
    path = folder / "made.mcap"
    path.unlink(missing_ok=True)
    with RecordingWriter(path, small_rig(folder / "rig", layout), ["a note"]) as writer:
        for number, item in enumerate(items, 1):
            write(writer, [item])
            if number % every == 0:
                writer.flush()
    return path


def chunks(path: Path) -> list[tuple[int, int]]:
    """First and last byte of every chunk, as the MCAP project's reader says."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length) for c in summary.chunk_indexes]


def everything(path: Path) -> list[object]:
    """Inputs, then results; every CRC and the summary are checked by the MCAP project's reader."""
    with path.open("rb") as file:
        count = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
    with RecordingReader(path) as reader:
        found = [*reader, *reader.results()]
        assert not reader.truncated
        assert reader.report.missing == 0
    assert len(found) == count
    return found


def fresh(path: Path) -> Path:
    path.unlink(missing_ok=True)
    return path


def test_a_whole_recording_is_copied(tmp_path: Path) -> None:
    items = content(5)
    report = recover(make(tmp_path, items), tmp_path / "out.mcap")
    assert report.was_whole
    assert report.has_rig
    assert (report.bytes_lost, report.unknown, report.chunks) == (0, 0, 20)
    assert report.kept == {"/radar/horizontal/raw": 5, "/radar/vertical/raw": 5, "/pose": 5, "/shape": 5}
    assert_same(everything(tmp_path / "out.mcap"), inputs(items) + results(items))
    with RecordingReader(tmp_path / "out.mcap") as reader:
        assert reader.rig_name == "rig"
        assert reader.notes == ["a note", "recovered from a cut or damaged recording"]


def test_the_chunks_behind_a_wrong_length_are_found(tmp_path: Path) -> None:
    """A reader that follows the chain of records ends at the wrong length; ``recover`` goes on behind it."""
    items = content(6, BIG)
    path = make(tmp_path, items, BIG)
    start, _ = chunks(path)[4]
    with path.open("r+b") as file:
        file.seek(start + 1)
        file.write(b"\xff" * 8)
    report = recover(path, tmp_path / "out.mcap")
    assert report.chunks == 23
    assert report.missing == {"horizontal": 1, "vertical": 0}
    assert BIG.nbytes < report.bytes_lost < BIG.nbytes + 300
    kept = [item for number, item in enumerate(items) if number != 4]
    assert_same(everything(tmp_path / "out.mcap"), inputs(kept) + results(kept))


def test_a_lost_beginning_costs_the_rig_and_no_frame(tmp_path: Path) -> None:
    items = inputs(content(4))
    path = make(tmp_path, items)
    first = chunks(path)[0][0]
    with path.open("r+b") as file:
        file.write(b"\x55" * first)
    report = recover(path, tmp_path / "out.mcap")
    assert not report.has_rig
    assert report.bytes_lost == first
    assert_same(everything(tmp_path / "out.mcap"), inputs(items))
    with pytest.raises(RecordingError, match="holds no rig"), RecordingReader(tmp_path / "out.mcap") as reader:
        reader.read_rig()


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(1, 255)), max_size=5),
    st.integers(0, 1 << 20),
    st.booleans(),
    st.integers(1, 5),
)
def test_every_untouched_chunk_is_kept(
    tmp_path_factory: pytest.TempPathFactory,
    flips: list[tuple[int, int]],
    length: int,
    cut: bool,
    every: int,
) -> None:
    folder, items = tmp_path_factory.getbasetemp(), inputs(content(6))
    path = make(folder, items, every=every)
    spans = chunks(path)
    damaged = bytearray(path.read_bytes())
    touched = {position % len(damaged) for position, _ in flips}
    for position, mask in flips:
        damaged[position % len(damaged)] ^= mask
    end = length % (len(damaged) + 1) if cut else len(damaged)
    path.write_bytes(damaged[:end])
    whole = [span for span in spans if span[1] <= end and not any(span[0] <= at < span[1] for at in touched)]
    out = fresh(folder / "saved.mcap")
    if not whole:
        with contextlib.suppress(RecordingError):  # a chunk may be touched by two flips that cancel
            recover(path, out)
        return
    report = recover(path, out)
    assert report.chunks >= len(whole)
    saved = everything(out)
    expected = iter(items)
    assert all(any(same(item, other) for other in expected) for item in saved), "nothing else, in order"
    assert out.stat().st_size <= 2 * len(damaged) + 20_000
    again = recover(out, fresh(folder / "again.mcap"))
    assert again.was_whole
    assert_same(everything(folder / "again.mcap"), saved)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=2000))
def test_garbage_holds_nothing(tmp_path_factory: pytest.TempPathFactory, garbage: bytes) -> None:
    path, out = tmp_path_factory.getbasetemp() / "garbage.mcap", tmp_path_factory.getbasetemp() / "nothing.mcap"
    path.write_bytes(garbage)
    with pytest.raises(RecordingError, match="nothing can be saved"):
        recover(path, out)
    assert not out.exists()


def test_garbage_that_looks_like_heads_costs_bounded_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Heads in a row, each claiming the rest of the file: every one of them would cost a CRC over all of it."""
    count, size = 4000, salvage.HEAD_BYTES
    heads = []
    for number in range(count):
        rest = (count - number - 1) * size
        heads.append(struct.pack("<BQQQQIIQ", 6, 40 + rest, 1, 2, rest, 3, 0, rest))
    path = tmp_path / "heads.mcap"
    path.write_bytes(b"".join(heads))
    seen = 0

    def counted(data: bytes, value: int = 0) -> int:
        nonlocal seen
        seen += len(data)
        return 1

    monkeypatch.setattr(salvage.zlib, "crc32", counted)
    monkeypatch.setattr(salvage, "LARGEST_CHUNK", 1 << 20)
    with pytest.raises(RecordingError, match="nothing can be saved"):
        recover(path, tmp_path / "out.mcap")
    assert count * size < seen <= (salvage.WORK + 1) * path.stat().st_size + (1 << 20)


def test_nothing_is_overwritten_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path = make(tmp_path, content(1))
    with pytest.raises(RecordingError, match="choose another name"):
        recover(path, path)
    assert os.path.getsize(path) > 0
    with pytest.raises(RecordingError, match="cannot be opened"):
        recover(tmp_path / "none.mcap", tmp_path / "out.mcap")
