# SPDX-License-Identifier: Apache-2.0
"""Index files of the capture board: the real ones, contradicting ones, and any bytes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.errors import CaptureError
from edge.sources.ti_capture import describe_capture
from edge.sources.ti_index import describe_indexes, find_gaps, gap_notes, indexed_gaps, read_index

CORRIDOR = "cascade_corridor_svenningsson"


def index_bytes(times_us: list[int], size: int, device: int = 0) -> bytes:
    """An index file written field by field as the hardware notes describe it."""
    entries = [
        struct.pack("<HHIHH4IIQQ", 0x6469, 1, 1 + (device << 8), 0, 0, 0, 0, 0, 0, size, t_us, k * size)
        for k, t_us in enumerate(times_us)
    ]
    return struct.pack("<4sIIIQ", b"bckt", 1, 0, len(entries), size * len(entries)) + b"".join(entries)


@pytest.mark.parametrize("device", range(4))
def test_real_files(radar_data: Path, device: int) -> None:
    name = ("master", "slave1", "slave2", "slave3")[device]
    index = read_index(radar_data / CORRIDOR / f"{name}_0000_idx.bin")
    assert (index.device, len(index), index.data_bytes) == (device, 8, 25_165_824)
    assert (index.size == 3_145_728).all(), "64 loops x 12 chirps x 256 samples x 4 receivers x 4 bytes"
    assert index.offset.tolist() == [k * 3_145_728 for k in range(8)]
    assert np.diff(index.t_ns).tolist() == [x * 1000 for x in (99981, 99997, 99997, 100013, 99996, 100279, 124650)]
    (gap,) = find_gaps(index.t_ns, period_s=0.1)
    assert gap.after == 6
    assert gap.duration_s == pytest.approx(0.12465, abs=1e-9)
    assert gap.missing == 0, "a quarter of a period late: no frame is missing"


def test_real_folder_without_data_files(radar_data: Path) -> None:
    report = describe_indexes(radar_data / CORRIDOR)
    assert report["frames"] == 8
    assert report["device_frame_bytes"] == [3_145_728]
    assert report["period_s"] == pytest.approx(0.099997, abs=1e-6)
    assert report["gaps"] == [{"after_frame": 6, "duration_s": pytest.approx(0.12465), "frames_missing": 0}]


def test_real_folder_described(radar_data: Path) -> None:
    content = describe_capture(radar_data / CORRIDOR)
    assert content["devices"] == ["master", "slave1", "slave2", "slave3"]
    assert "data_bytes" not in content
    assert content["frames"] == 8
    assert gap_notes(indexed_gaps(radar_data / CORRIDOR)) == ["124.65 ms between frames 6 and 7"]


def test_folders_without_index_or_capture(tmp_path: Path) -> None:
    assert describe_capture(tmp_path) == describe_capture(tmp_path / "none") == {}
    assert indexed_gaps(tmp_path) == []
    (tmp_path / "slave2_0000_data.bin").write_bytes(bytes(12))
    content = describe_capture(tmp_path)
    assert (content["devices"], content["data_bytes"]) == (["slave2"], {"slave2_0000_data.bin": 12})
    assert "rig" in str(content["frames"])


def test_gaps_count_missing_periods() -> None:
    times_ns = [0, 100, 200, 500, 600, 650, 760]
    gaps = find_gaps([t * 10**6 for t in times_ns], period_s=0.1)
    assert [(g.after, g.missing) for g in gaps] == [(2, 2)]
    assert gaps[0].duration_s == pytest.approx(0.3)
    assert find_gaps([5], 0.1) == find_gaps([], 0.1) == []


def test_our_writer_of_index_files_agrees_with_the_board(radar_data: Path, tmp_path: Path) -> None:
    real = read_index(radar_data / CORRIDOR / "slave2_0000_idx.bin")
    path = tmp_path / "slave2_0000_idx.bin"
    path.write_bytes(index_bytes((real.t_ns // 1000).tolist(), 3_145_728, device=2))
    ours = read_index(path)
    assert (ours.device, ours.data_bytes) == (real.device, real.data_bytes)
    assert np.array_equal(ours.t_ns, real.t_ns)
    assert np.array_equal(ours.offset, real.offset)


GOOD = index_bytes([10, 20, 30], 64)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not an index"),
        (b"bckx" + GOOD[4:], "not an index"),
        (GOOD[:4] + b"\x02" + GOOD[5:], "unknown version"),
        (GOOD[:-1], "cut or still being written"),
        (GOOD[:-48], "cut or still being written"),
        (GOOD[:24] + b"\0\0" + GOOD[26:], "frame tag"),
        (GOOD[:29] + b"\x01" + GOOD[30:], "more than one device"),
        (GOOD[:16] + struct.pack("<Q", 191) + GOOD[24:], "do not follow one another"),
        (GOOD[:-8] + struct.pack("<Q", 64), "do not follow one another"),
        (GOOD[:-16] + struct.pack("<QQ", 2**63, 128), "beyond any board"),
    ],
)
def test_contradictions_are_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "master_0000_idx.bin"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match=message) as caught:
        read_index(path)
    assert str(path) in str(caught.value)


def test_an_index_that_was_never_closed_is_read_by_its_length(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(GOOD[:12] + bytes(12) + GOOD[24:])
    assert len(read_index(path)) == 3


def test_absent_files(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="cannot be read"):
        read_index(tmp_path / "none")
    with pytest.raises(CaptureError, match="holds no"):
        describe_indexes(tmp_path)


@settings(max_examples=500)
@given(
    st.one_of(
        st.binary(max_size=400),
        st.tuples(st.integers(0, len(GOOD) - 1), st.binary(min_size=1, max_size=9)).map(
            lambda x: GOOD[: x[0]] + x[1] + GOOD[x[0] + len(x[1]) :]
        ),
    )
)
def test_any_bytes_give_an_index_or_the_declared_error(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz_idx.bin"
    path.write_bytes(content)
    try:
        index = read_index(path)
    except CaptureError:
        return
    assert len(index.size) == len(index.offset) == len(index.t_ns) == (len(content) - 24) // 48
