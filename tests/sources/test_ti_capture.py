# SPDX-License-Identifier: Apache-2.0
"""TI capture folders: the re-packed corridor read back exactly, segments joined, every contradiction named."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_ti_index import index_bytes

from edge.errors import CaptureError
from edge.frames import Layout, LossCause, RadarFrame
from edge.reference.repack import split_loop_sum
from edge.rig import load_rig
from edge.sources.base import FrameSource, Loss
from edge.sources.pairing import FramePairer
from edge.sources.ti_capture import CaptureFolder

DEVICES = ("master", "slave1", "slave2", "slave3")
LAYOUT = Layout("cascade", 4, 4, 3, 8, 4)
LOOP_BYTES = 3 * 8 * 4 * 4
FRAME_BYTES = 4 * LOOP_BYTES
PERIOD_US = 20_000


def rig(layout: Layout = LAYOUT, packed: bool = False) -> Any:
    schedule = SimpleNamespace(layout=layout, frame_period_s=PERIOD_US / 1e6, packed_12_bit=packed)
    return SimpleNamespace(name="small", radars={"horizontal": SimpleNamespace(schedule=schedule)})


def samples(frames: int, seed: int = 0) -> np.ndarray[Any, np.dtype[np.int16]]:
    return np.random.default_rng(seed).integers(-2000, 2000, (frames, *LAYOUT.shape), dtype=np.int16)


def write_capture(
    folder: Path, adc: np.ndarray[Any, Any], segment: int = 0, times_us: list[int] | None = None, index: bool = True
) -> None:
    """A capture folder as the board writes it: each device's frames one after the other."""
    folder.mkdir(exist_ok=True)
    times_us = times_us if times_us is not None else [1_000_000 + k * PERIOD_US for k in range(len(adc))]
    for device, name in enumerate(DEVICES):
        (folder / f"{name}_{segment:04d}_data.bin").write_bytes(adc[:, device].astype("<i2").tobytes())
        if index:
            content = index_bytes(times_us, adc[0, device].nbytes, device)
            (folder / f"{name}_{segment:04d}_idx.bin").write_bytes(content)


def read(source: CaptureFolder) -> tuple[list[RadarFrame], list[Loss]]:
    items = list(source)
    return [x for x in items if isinstance(x, RadarFrame)], [x for x in items if isinstance(x, Loss)]


def cut(path: Path, nbytes: int) -> None:
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - nbytes)


def test_frames_are_read_back_exactly(tmp_path: Path) -> None:
    adc = samples(3)
    write_capture(tmp_path, adc)
    source = CaptureFolder(tmp_path, rig(), "horizontal")
    assert isinstance(source, FrameSource)
    assert source.total_frames == 3
    for _ in range(2):
        frames, losses = read(source)
        assert losses == []
        assert [f.number for f in frames] == [0, 1, 2]
        assert [f.t_first_chirp_ns for f in frames] == [10**9 + k * PERIOD_US * 1000 for k in range(3)]
        assert all(np.array_equal(f.adc, x) and f.adc.flags.aligned for f, x in zip(frames, adc, strict=True))
    source.close()
    assert read(source) == ([], [])


def test_corridor_repacked(radar_data: Path, tmp_path: Path) -> None:
    """Not an independent file: it checks the reader against the order that TI documents."""
    sums = np.load(radar_data / "cascade_corridor_svenningsson" / "adc_loop_sum.npz")["adc_loop_sum"]
    loops = split_loop_sum(sums, 64)
    write_capture(tmp_path, loops[None], index=False)
    assert (tmp_path / "master_0000_data.bin").stat().st_size == 3_145_728, "frame size of the real index files"
    (frame,), losses = read(CaptureFolder(tmp_path, load_rig("corridor"), "horizontal"))
    assert losses == []
    summed = frame.adc.sum(axis=1, dtype=np.int64)  # [device, slot, sample, rx, (I, Q)]
    for transmitter in range(12):
        for receiver in range(16):
            device, rx = divmod(receiver, 4)
            assert np.array_equal(summed[device, 11 - transmitter, :, rx], sums[transmitter, receiver])


def test_real_index_with_its_gap(radar_data: Path, tmp_path: Path) -> None:
    for name in DEVICES:
        real = radar_data / "cascade_corridor_svenningsson" / f"{name}_0000_idx.bin"
        (tmp_path / real.name).write_bytes(real.read_bytes())
        with (tmp_path / f"{name}_0000_data.bin").open("wb") as file:
            file.truncate(25_165_824)  # sparse zeros: the real samples are not at hand
    source = CaptureFolder(tmp_path, load_rig("corridor"), "horizontal")
    assert source.total_frames == 8
    assert [(g.after, round(g.duration_s * 1e3, 3)) for g in source.gaps] == [(6, 124.65)]
    assert "124.65 ms between frames 6 and 7" in source.notes
    assert any("124.65 ms between frames 6 and 7" in note for note in source.notes)
    with pytest.raises(CaptureError, match=r"master_0000_data\.bin is missing"):
        CaptureFolder(radar_data / "cascade_corridor_svenningsson", load_rig("corridor"), "horizontal")


def test_segments_follow_one_another(tmp_path: Path) -> None:
    adc = samples(5)
    write_capture(tmp_path, adc[:3])
    write_capture(tmp_path, adc[3:], 1, [1_000_000 + k * PERIOD_US for k in (3, 4)])
    frames, _ = read(CaptureFolder(tmp_path, rig(), "horizontal", t_start_ns=7))
    assert [f.number for f in frames] == [0, 1, 2, 3, 4]
    assert [f.t_first_chirp_ns for f in frames] == [7 + k * PERIOD_US * 1000 for k in range(5)]
    assert np.array_equal(np.stack([f.adc for f in frames]), adc)
    for name in DEVICES:
        (tmp_path / f"{name}_0000_data.bin").rename(tmp_path / f"{name}_0002_data.bin")
    with pytest.raises(CaptureError, match=r"_0000_data\.bin is missing"):
        CaptureFolder(tmp_path, rig(), "horizontal")


def test_skipped_periods_are_gaps_in_the_numbers(tmp_path: Path) -> None:
    write_capture(tmp_path, samples(4), times_us=[0, PERIOD_US, 4 * PERIOD_US + 30, 5 * PERIOD_US])
    source = CaptureFolder(tmp_path, rig(), "horizontal")
    assert [f.number for f in read(source)[0]] == [0, 1, 4, 5]
    pairer = FramePairer(["horizontal"])
    for item in source:
        for _ in pairer.add(item)[0]:  # type: ignore[arg-type]
            pairer.ledgers["horizontal"].ok()
    pairer.ledgers["horizontal"].check()
    assert pairer.ledgers["horizontal"].snapshot().lost == {LossCause.GAP: 2}


@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("names", [("slave3",), DEVICES])
def test_cut_last_frame_is_a_counted_loss(tmp_path: Path, index: bool, names: tuple[str, ...]) -> None:
    adc = samples(3)
    write_capture(tmp_path, adc, index=index)
    for name in names:
        cut(tmp_path / f"{name}_0000_data.bin", 10)
    source = CaptureFolder(tmp_path, rig(), "horizontal")
    frames, losses = read(source)
    assert source.total_frames == 3
    assert np.array_equal(np.stack([f.adc for f in frames]), adc[:2])
    assert [(x.number, x.cause, x.count) for x in losses] == [(2, LossCause.TRUNCATED, 1)]


def test_a_file_that_shrinks_while_it_is_read_is_a_loss(tmp_path: Path) -> None:
    write_capture(tmp_path, samples(2))
    source = CaptureFolder(tmp_path, rig(), "horizontal")
    cut(tmp_path / "slave1_0000_data.bin", 1)
    assert [x.cause for x in read(source)[1]] == [LossCause.TRUNCATED]


def test_without_index_the_times_are_said_to_be_made_up(tmp_path: Path) -> None:
    write_capture(tmp_path, samples(2), index=False)
    source = CaptureFolder(tmp_path, rig(), "horizontal")
    assert "no index files" in source.notes[0]
    assert [f.t_first_chirp_ns for f in read(source)[0]] == [0, PERIOD_US * 1000]


def test_another_frame_period_is_said(tmp_path: Path) -> None:
    write_capture(tmp_path, samples(4), times_us=[0, 100_000, 200_000, 300_000])
    source = CaptureFolder(tmp_path, rig(), "horizontal")
    assert source.notes == ["frames came every 100.00 ms, the schedule says 20.00 ms"]
    assert source.gaps == []


def test_wrong_loops_say_which_would_fit(tmp_path: Path) -> None:
    write_capture(tmp_path, samples(3), index=False)
    wrong = rig(Layout("cascade", 4, 5, 3, 8, 4))
    with pytest.raises(CaptureError, match=r"loops that fit: 1, 2, 3, 4, 6, 12; set schedule\.loops"):
        CaptureFolder(tmp_path, wrong, "horizontal")
    write_capture(tmp_path, samples(3))
    with pytest.raises(CaptureError, match="loops that fit: 4;"):
        CaptureFolder(tmp_path, wrong, "horizontal")
    with pytest.raises(CaptureError, match="none, so samples or slots differ"):
        CaptureFolder(tmp_path, rig(Layout("cascade", 4, 4, 3, 10, 4)), "horizontal")


def _remove_slave(folder: Path) -> None:
    (folder / "slave2_0000_data.bin").unlink()


def _lengthen(folder: Path) -> None:
    with (folder / "slave1_0000_data.bin").open("ab") as file:
        file.write(bytes(2))


def _shorten(folder: Path) -> None:
    cut(folder / "slave3_0000_data.bin", FRAME_BYTES + 1)


def _fewer_entries(folder: Path) -> None:
    (folder / "slave1_0000_idx.bin").write_bytes(index_bytes([1_000_000, 1_020_000], FRAME_BYTES, 1))
    cut(folder / "slave1_0000_data.bin", FRAME_BYTES)


def _other_device(folder: Path) -> None:
    times_us = [1_000_000 + k * PERIOD_US for k in range(3)]
    (folder / "slave1_0000_idx.bin").write_bytes(index_bytes(times_us, FRAME_BYTES, 3))


def _other_times(folder: Path) -> None:
    (folder / "slave1_0000_idx.bin").write_bytes(index_bytes([1, 2, 3], FRAME_BYTES, 1))


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink() if "idx" in path.name else path.write_bytes(b"")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_remove_slave, r"slave2_0000_data\.bin is missing"),
        (_lengthen, "slave1_0000_data.bin: size contradicts slave1_0000_idx.bin"),
        (_shorten, "slave3_0000_data.bin: size contradicts slave3_0000_idx.bin"),
        (_fewer_entries, "different numbers of frames"),
        (_other_device, "written by another device"),
        (_other_times, "frames of other times"),
        (_empty, "not one whole frame"),
    ],
)
def test_contradictions_are_named(tmp_path: Path, damage: Any, message: str) -> None:
    write_capture(tmp_path, samples(3))
    damage(tmp_path)
    with pytest.raises(CaptureError, match=message):
        CaptureFolder(tmp_path, rig(), "horizontal")


def test_folders_and_rigs_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no capture folder"):
        CaptureFolder(tmp_path / "none", rig(), "horizontal")
    with pytest.raises(CaptureError, match="no capture in this folder"):
        CaptureFolder(tmp_path, rig(), "horizontal")
    write_capture(tmp_path, samples(1))
    with pytest.raises(CaptureError, match="no such radar"):
        CaptureFolder(tmp_path, rig(), "vertical")
    with pytest.raises(CaptureError, match="does not capture"):
        CaptureFolder(tmp_path, rig(packed=True), "horizontal")
    with pytest.raises(CaptureError, match="has no place in this rig"):
        CaptureFolder(tmp_path, rig(Layout("cascade", 2, 4, 3, 8, 4)), "horizontal")


def test_dead_channels_are_named_and_silent_frames_are_not_dead(tmp_path: Path) -> None:
    adc = samples(3)
    adc[:, 2, ..., 1, :] = 0
    adc[0] = 0
    write_capture(tmp_path, adc)
    source = CaptureFolder(tmp_path, rig(), "horizontal")
    assert source.dead_channels() == ("slave2 RX2",)
    assert len(read(source)[0]) == 3
    adc[2, 2, 3, 2, 7, 1, 1] = 1
    write_capture(tmp_path, adc)
    assert CaptureFolder(tmp_path, rig(), "horizontal").dead_channels() == ()
