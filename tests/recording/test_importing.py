# SPDX-License-Identifier: Apache-2.0
"""Imports: captures become recordings sample by sample, every frame accounted for; trajectories become poses."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_rigs import BIG, LAYOUT, pose, small_rig

from edge.constraints import start_offset_s
from edge.errors import CaptureError, PoseError, RecordingError
from edge.frames import RADARS, LossCause, Pose, RadarFrame
from edge.recording.importing import ImportReport, import_capture, import_poses, open_captures
from edge.recording.reader import RecordingReader
from edge.reference.repack import split_loop_sum
from edge.rig import load_rig
from edge.sources.pairing import FramePairer

DEVICES = ("master", "slave1", "slave2", "slave3")
PERIOD_NS = 20_000_000


def write_ti(folder: Path, adc: np.ndarray[Any, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for device, name in enumerate(DEVICES):
        (folder / f"{name}_0000_data.bin").write_bytes(adc[:, device].astype("<i2").tobytes())


def samples(frames: int, shape: tuple[int, ...], seed: int) -> np.ndarray[Any, np.dtype[np.int16]]:
    return np.random.default_rng(seed).integers(-2000, 2000, (frames, *shape), dtype=np.int16)


def assert_balanced(report: ImportReport) -> None:
    for radar, count in report.frames_in.items():
        assert count == report.frames_ok[radar] + sum(report.lost[radar].values())


def test_corridor(radar_data: Path, tmp_path: Path) -> None:
    sums = np.load(radar_data / "cascade_corridor_svenningsson" / "adc_loop_sum.npz")["adc_loop_sum"]
    loops = split_loop_sum(sums, 64)
    write_ti(tmp_path / "capture", loops[None])
    rig, out = load_rig("corridor"), tmp_path / "corridor.mcap"
    steps: list[tuple[int, int]] = []
    report = import_capture(tmp_path / "capture", rig, out, progress=lambda done, total: steps.append((done, total)))
    assert_balanced(report)
    assert (report.frames_ok, steps) == ({"horizontal": 1}, [(1, 1)])
    with RecordingReader(out) as reader:
        (frame,) = reader
        assert isinstance(frame, RadarFrame)
        assert np.array_equal(frame.adc, loops)
        assert reader.read_rig().config_hash == rig.config_hash
    with pytest.raises(RecordingError, match="never overwritten"):
        import_capture(tmp_path / "capture", rig, out)


@pytest.mark.parametrize("as_mapping", [True, False])
def test_two_radars_with_poses_in_time_order(tmp_path: Path, as_mapping: bool) -> None:
    rig = small_rig(tmp_path / "rig", BIG)
    adc = {radar: samples(4 - k, BIG.shape, k) for k, radar in enumerate(RADARS)}
    adc["vertical"][..., 0, :] = 0
    for radar in RADARS:
        write_ti(tmp_path / radar, adc[radar])
    file = tmp_path / "vertical" / "slave3_0000_data.bin"
    file.write_bytes(file.read_bytes()[:-2])
    captures = {radar: tmp_path / radar for radar in RADARS} if as_mapping else tmp_path
    poses = [Pose(k * PERIOD_NS // 2, np.zeros(3), pose(k).quaternion_xyzw) for k in range(7)]
    report = import_capture(captures, rig, tmp_path / "a.mcap", poses)  # type: ignore[arg-type]
    assert_balanced(report)
    assert report.frames_in == {"horizontal": 4, "vertical": 3}
    assert report.frames_ok == {"horizontal": 4, "vertical": 2}
    assert report.lost["vertical"] == {LossCause.TRUNCATED: 1}
    assert report.poses == 7
    assert "vertical: slave2 RX1 is dead" in report.notes
    assert "assumed, not measured" in report.notes[-1]
    with RecordingReader(tmp_path / "a.mcap") as reader:
        items = list(reader)
        assert reader.notes == report.notes
    times = [x.t_first_chirp_ns if isinstance(x, RadarFrame) else x.t_ns for x in items]
    assert times == sorted(times)
    pairer = FramePairer(RADARS)
    pairs = [pair for x in items if isinstance(x, RadarFrame) for pair in pairer.add(x)[0]]
    assert [p.number for p in pairs] == [0, 1]
    for pair in pairs:
        for radar, frame in pair.frames.items():
            assert np.array_equal(frame.adc, adc[radar][pair.number])
            pairer.ledgers[radar].ok()
    pairer.flush()
    for ledger in pairer.ledgers.values():
        ledger.check()


@pytest.mark.parametrize("start_ns", [None, 7_000_000_000])
def test_the_vertical_radar_starts_half_a_period_later(tmp_path: Path, start_ns: int | None) -> None:
    rig = small_rig(tmp_path / "rig", BIG)
    for k, radar in enumerate(RADARS):
        write_ti(tmp_path / radar, samples(3, BIG.shape, k))
    report = import_capture(tmp_path, rig, tmp_path / "a.mcap", t_start_ns=start_ns)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        frames = [x for x in reader if isinstance(x, RadarFrame)]
    for radar, offset_ns in (("horizontal", 0), ("vertical", PERIOD_NS // 2)):
        times = [x.t_first_chirp_ns - (start_ns or 0) for x in frames if x.radar == radar]
        assert times == [k * PERIOD_NS + offset_ns for k in range(3)]
    assert "10.000 ms after the horizontal" in report.notes[-1]


def test_the_shipped_pairs_offset_is_half_a_period() -> None:
    rig = load_rig("cascade_pair")
    schedules = [rig.radars[radar].schedule for radar in RADARS]
    assert start_offset_s(*schedules) == pytest.approx(schedules[0].frame_period_s_actual / 2, abs=1e-9)


def test_a_sum_over_loops_says_where_its_capture_had_a_gap(radar_data: Path, tmp_path: Path) -> None:
    rig, folder = load_rig("corridor"), radar_data / "cascade_corridor_svenningsson"
    report = import_capture(folder, rig, tmp_path / "a.mcap", t_start_ns=5)
    assert report.notes[1] == "horizontal: the capture it is from has 124.65 ms between frames 6 and 7"
    with RecordingReader(tmp_path / "a.mcap") as reader:
        assert reader.notes == report.notes
        assert reader.info()["notes"] == report.notes
        assert [x.t_first_chirp_ns for x in reader if isinstance(x, RadarFrame)] == [5]


def test_dca1000_files_in_the_cards_order(tmp_path: Path) -> None:
    rig = small_rig(tmp_path / "rig", LAYOUT, ["vertical"])
    adc = samples(20, LAYOUT.shape, 3)
    folder = tmp_path / "capture"
    folder.mkdir()
    content = adc.astype("<i2").tobytes() + b"tail"
    for part in range(11):
        end = None if part == 10 else 100 * (part + 1)
        (folder / f"adc_data_Raw_{part}.bin").write_bytes(content[100 * part : end])
    report = import_capture(folder, rig, tmp_path / "a.mcap", t_start_ns=5)
    assert_balanced(report)
    assert report.lost["vertical"] == {LossCause.TRUNCATED: 1}
    with RecordingReader(tmp_path / "a.mcap") as reader:
        frames = [x for x in reader if isinstance(x, RadarFrame)]
    assert np.array_equal(np.stack([f.adc for f in frames]), adc)
    assert [f.t_first_chirp_ns for f in frames] == [5 + k * PERIOD_NS for k in range(20)]


def test_captures_that_do_not_fit_the_rig(tmp_path: Path) -> None:
    rig = small_rig(tmp_path / "rig", BIG)
    with pytest.raises(CaptureError, match="captures do not match"):
        open_captures({"horizontal": tmp_path}, rig)
    with pytest.raises(CaptureError, match="no capture folder"):
        import_capture(tmp_path, rig, tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


def test_tum_trajectory(tmp_path: Path) -> None:
    path = tmp_path / "car.tum"
    path.write_text("# time x y z qx qy qz qw\n1700000000.123456789 1 2 3 0 0 0 1\n\n1700000001.5 1 2 3.5 0 0 1 0\n")
    first, second = import_poses(path)
    assert first.t_ns == 1_700_000_000_123_456_789, "a float64 would be 100 ns off"
    assert second.t_ns == 1_700_000_001_500_000_000
    assert second.position_m.tolist() == [1, 2, 3.5]
    assert second.quaternion_xyzw.tolist() == [0, 0, 1, 0]


def test_own_pose_files(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("5,1,2,3,0,0,0,1\n")
    assert [p.t_ns for p in import_poses(path)] == [5]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "line 1: no pose"),
        ("1 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", "line 2: time does not advance"),
        ("1e3 0 0 0 0 0 0 1\n", "line 1: no pose"),
        ("-1 0 0 0 0 0 0 1\n", "line 1: no pose"),
        ("1 0 0 0 0 0 0 2\n", "line 1: .*is no pose"),
        ("1 0 0 nan 0 0 0 1\n", "line 1: .*is no pose"),
    ],
)
def test_lines_that_are_no_poses_are_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "car.txt"
    path.write_text(text)
    with pytest.raises(PoseError, match=message):
        import_poses(path)
    with pytest.raises(PoseError, match="cannot be read"):
        import_poses(tmp_path / "none.tum")


@given(st.text(max_size=80))
def test_any_text_gives_poses_or_the_declared_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.tum"
    path.write_text(text, encoding="utf-8")
    with contextlib.suppress(PoseError):
        import_poses(path)


def test_a_failed_import_leaves_no_file(tmp_path: Path) -> None:
    rig = small_rig(tmp_path / "rig", BIG, ["horizontal"])
    write_ti(tmp_path / "capture", samples(3, BIG.shape, 0))

    def poses() -> Iterator[Pose]:
        yield pose(0)
        raise PoseError("line 2: no pose")

    with pytest.raises(PoseError, match="line 2"):
        import_capture(tmp_path / "capture", rig, tmp_path / "a.mcap", poses())
    assert not (tmp_path / "a.mcap").exists()
