# SPDX-License-Identifier: Apache-2.0
"""Segments of two cascades: numbers go on, times are the host's, missing frames are counted by their causes."""

from __future__ import annotations

import math
import shutil
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_ti_index import index_bytes

from edge.board_settings import PoseSettings
from edge.drivers.board import Progress, StartTimes
from edge.drivers.fetch import FolderFetcher
from edge.errors import LinkError
from edge.frames import RADARS, LossCause, Pose, RadarFrame, RadarId
from edge.odometry.source import PoseEvent, make_pose_source
from edge.rig import Rig, load_rig
from edge.sources.base import FrameSource, Loss
from edge.sources.pairing import FramePairer
from edge.sources.pose_feed import PoseFeed
from edge.sources.segments import MARGIN_S, BoardClock, SegmentSource
from edge.sources.ti_capture import DEVICES

FRAMES = 5


def small_rig() -> Rig:
    rig = load_rig("cascade_pair")
    schedule = rig.radars["horizontal"].schedule
    small = replace(schedule, loops=1, profile=replace(schedule.profile, samples=32))
    return replace(rig, radars={name: replace(radar, schedule=small) for name, radar in rig.radars.items()})


RIG = small_rig()
SCHEDULE = RIG.radars["horizontal"].schedule
MARGIN = math.ceil(MARGIN_S / SCHEDULE.frame_period_s_actual)
PERIOD_NS = round(SCHEDULE.frame_period_s_actual * 1e9)


def samples(radar: RadarId, segment: int, index: int) -> np.ndarray[Any, np.dtype[np.int16]]:
    """Of frame ``index`` of a recording."""
    rng = np.random.default_rng((RADARS.index(radar), segment, index))
    return rng.integers(-2000, 2000, SCHEDULE.layout.shape, dtype=np.int16)


class ExactClock:
    """Time passes as it does, but a sleep ends exactly when it should, however busy the machine is."""

    def __init__(self) -> None:
        self._woken_ns: int | None = None

    def now_ns(self) -> int:
        woken_ns, self._woken_ns = self._woken_ns, None
        return time.monotonic_ns() if woken_ns is None else woken_ns

    def sleep_until(self, t_ns: int) -> None:
        time.sleep(max(0, t_ns - time.monotonic_ns()) / 1e9)
        self._woken_ns = t_ns


@dataclass
class Recorder:
    """A board that writes what a real one would, at ``stop``.

    ``absent`` holds (segment, frame) that it does not record, ``cut`` a segment whose last frame is cut, ``broken`` the
    segments in which it does not answer.
    """

    radar: RadarId
    storage: Path
    clock: ExactClock = field(default_factory=ExactClock)
    born_ns: int = 77_000_000_000
    absent: set[tuple[int, int]] = field(default_factory=set)
    cut: set[int] = field(default_factory=set)
    broken: set[int] = field(default_factory=set)
    calls: list[str] = field(default_factory=list)
    directory: str = ""
    segment: int = -1
    began_ns: int = 0
    frames: int = 0
    late_ns: int = 0

    def plan(self) -> list[str]:
        return []

    def connect(self) -> None:
        self.calls.append("connect")

    def configure(self, progress: Progress) -> list[str]:
        progress("everything", 0, 1)
        self.calls.append("configure")
        return ["a note"]

    def arm(self, frames: int) -> None:
        self.segment, self.frames = self.segment + 1, frames
        self.directory = f"/mnt/ssd/capture_{self.segment}"
        if self.segment in self.broken:
            raise LinkError("the board rebooted")

    def start(self) -> StartTimes:
        self.began_ns = self.clock.now_ns()
        late_ns, self.late_ns = self.late_ns, 0
        return StartTimes(self.began_ns, self.began_ns + 1000 + late_ns)

    def stop(self) -> None:
        have = [k for k in range(self.frames) if (self.segment, k) not in self.absent]
        folder = self.storage / Path(self.directory).name
        folder.mkdir(parents=True)
        base_us = (self.began_ns + self.born_ns) // 1000
        times_us = [base_us + k * PERIOD_NS // 1000 for k in have]
        adc = np.stack([samples(self.radar, self.segment, k) for k in have])
        for device, name in enumerate(DEVICES):
            data = adc[:, device].astype("<i2").tobytes()
            keep = len(data) - (100 if self.segment in self.cut else 0)
            (folder / f"{name}_0000_data.bin").write_bytes(data[:keep])
            (folder / f"{name}_0000_idx.bin").write_bytes(index_bytes(times_us, adc[0, device].nbytes, device))

    def close(self) -> None:
        self.calls.append("close")


Make = Callable[..., tuple[SegmentSource, dict[RadarId, Recorder]]]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    def made(segments: int | None = 2, **options: Any) -> tuple[SegmentSource, dict[RadarId, Recorder]]:
        clock = ExactClock()
        boards = {radar: Recorder(radar, tmp_path / radar, clock) for radar in RADARS}
        fetchers = {radar: FolderFetcher(tmp_path / radar) for radar in RADARS}
        folder = tmp_path / "here"
        wanted: dict[str, Any] = {"frames": FRAMES, "segments": segments, "folder": folder, "clock": clock, **options}
        return SegmentSource(RIG, boards, fetchers, **wanted), boards

    return made


def read(source: SegmentSource) -> tuple[dict[RadarId, list[RadarFrame]], list[Loss]]:
    frames: dict[RadarId, list[RadarFrame]] = {radar: [] for radar in RADARS}
    losses: list[Loss] = []
    for item in source:
        if isinstance(item, RadarFrame):
            frames[item.radar].append(item)
        elif isinstance(item, Loss):
            losses.append(item)
    return frames, losses


def alone(source: SegmentSource, segment: int) -> int:
    """Frames of the horizontal radar before the vertical one ran."""
    start = source.reports[segment].start
    assert start is not None
    return (start.times["vertical"].sent_ns - start.times["horizontal"].sent_ns) // PERIOD_NS


def recorded(source: SegmentSource, frame: RadarFrame) -> tuple[int, int]:
    """Segment and index in its recording, of a frame that the source numbered."""
    segment, index = divmod(frame.number, FRAMES)
    return segment, index + (alone(source, segment) if frame.radar == "horizontal" else 0)


def accounts(source: SegmentSource) -> dict[RadarId, tuple[int, dict[LossCause, int]]]:
    """Frames in and losses by the pairer that the pipeline uses."""
    pairer, found = FramePairer(RADARS), Counter[RadarId]()
    for item in source:
        if isinstance(item, RadarFrame | Loss):
            pairs, _ = pairer.add(item)
            for pair in pairs:
                for radar in pair.frames:
                    pairer.ledgers[radar].ok()
                    found[radar] += 1
    pairer.flush()
    for ledger in pairer.ledgers.values():
        ledger.check()
    return {r: (x.snapshot().frames_in, dict(x.snapshot().lost)) for r, x in pairer.ledgers.items()}


def test_numbers_go_on_and_samples_are_those_of_the_boards(make: Make, tmp_path: Path) -> None:
    source, _ = make(segments=2)
    assert isinstance(source, FrameSource)
    assert source.total_frames == 2 * 2 * FRAMES
    frames, losses = read(source)
    assert losses == []
    for radar in RADARS:
        assert [frame.number for frame in frames[radar]] == list(range(2 * FRAMES))
        assert all(np.array_equal(x.adc, samples(radar, *recorded(source, x))) for x in frames[radar])
        assert list((tmp_path / radar).iterdir()) == [], "a segment that was played is removed"
    assert [report.frames for report in source.reports] == [{"horizontal": FRAMES, "vertical": FRAMES}] * 2
    assert not any(report.text for report in source.reports)


def test_times_are_the_hosts_and_radar_two_is_half_a_period_later(make: Make) -> None:
    before_ns = time.monotonic_ns()
    source, _ = make(segments=2)
    items = [item for item in source if isinstance(item, RadarFrame)]
    times_ns = [item.t_first_chirp_ns for item in items]
    assert times_ns == sorted(times_ns)
    assert before_ns < times_ns[0]
    assert times_ns[-1] < time.monotonic_ns()
    for segment, report in enumerate(source.reports):
        assert report.start is not None
        for radar in RADARS:
            own = [i.t_first_chirp_ns for i in items if i.radar == radar and i.number // FRAMES == segment]
            before_ns = own[0] - report.start.times[radar].sent_ns
            assert before_ns == pytest.approx(
                PERIOD_NS * (alone(source, segment) if radar == "horizontal" else 0), abs=9e3
            )
            assert np.abs(np.diff(own) - PERIOD_NS).max() <= 2000, "stamps of the board are whole microseconds"
        assert report.start.offset_s == pytest.approx(0.5e-9 * PERIOD_NS, abs=1e-7)
    pairs = zip(*([i.t_first_chirp_ns for i in items if i.radar == radar] for radar in RADARS), strict=True)
    assert all(b - a == pytest.approx(PERIOD_NS / 2, abs=1e4) for a, b in pairs), "frames of one number"
    assert source.alone["horizontal"] == source.alone["vertical"] == 2 * MARGIN


def test_missing_and_cut_frames_are_counted(make: Make) -> None:
    source, boards = make(segments=3)
    boards["vertical"].absent = {(0, 2), (1, 3), (1, 4)}
    boards["vertical"].cut = {2}
    frames, losses = read(source)
    found = [(x.radar, x.number, x.cause, x.count) for x in losses]
    assert found == [
        ("vertical", 2, LossCause.GAP, 1),
        ("vertical", FRAMES + 3, LossCause.GAP, 2),
    ]
    numbers = {radar: {frame.number for frame in frames[radar]} for radar in RADARS}
    assert numbers["vertical"] == set(range(3 * FRAMES)) - {2, FRAMES + 3, FRAMES + 4}
    assert numbers["horizontal"] == set(range(3 * FRAMES))
    assert all(np.array_equal(x.adc, samples("vertical", *recorded(source, x))) for x in frames["vertical"])


def test_a_recording_that_ended_early(make: Make) -> None:
    """A power cut leaves a half frame; what comes behind it was never recorded."""
    source, boards = make(segments=1)
    boards["vertical"].cut = {0}
    boards["vertical"].absent = {(0, k) for k in range(3, FRAMES + MARGIN)}
    _, losses = read(source)
    found = [(x.radar, x.number, x.cause, x.count) for x in losses]
    assert found == [("vertical", 2, LossCause.TRUNCATED, 1), ("vertical", 3, LossCause.GAP, FRAMES - 3)]


def test_missing_first_frames_are_seen_by_the_boards_clock(make: Make) -> None:
    source, boards = make(segments=3)
    boards["vertical"].absent = {(1, 0), (1, 1)}
    frames, losses = read(source)
    assert [(x.radar, x.number, x.count) for x in losses] == [("vertical", FRAMES, 2)]
    assert all(np.array_equal(x.adc, samples("vertical", *recorded(source, x))) for x in frames["vertical"])
    own = {frame.number: frame.t_first_chirp_ns for frame in frames["vertical"]}
    start = source.reports[1].start
    assert start is not None
    assert own[FRAMES + 2] == pytest.approx(start.times["vertical"].sent_ns + 2 * PERIOD_NS, abs=1e6)


def test_the_account_is_exact(make: Make) -> None:
    source, boards = make(segments=3)
    boards["vertical"].absent, boards["vertical"].broken = {(0, 1), (2, 4)}, {1}
    assert accounts(source) == {
        "vertical": (3 * FRAMES, {LossCause.GAP: 2 + FRAMES}),
        "horizontal": (3 * FRAMES, {LossCause.GAP: FRAMES, LossCause.UNPAIRED: 2}),
    }


def test_a_board_that_rebooted_is_configured_anew(make: Make) -> None:
    source, boards = make(segments=3)
    boards["vertical"].broken = {1}
    _, losses = read(source)
    assert {(x.radar, x.number, x.count) for x in losses} == {(radar, FRAMES, FRAMES) for radar in RADARS}
    assert all("rebooted" in x.detail for x in losses)
    assert [report.text for report in source.reports][1] == "the board rebooted"
    assert all(board.calls == ["close", "connect", "configure"] for board in boards.values())


def test_a_board_that_stays_away_ends_the_source(make: Make) -> None:
    source, boards = make(segments=None)
    boards["horizontal"].broken = set(range(100))
    lost = 0
    items = iter(source)
    for _ in range(3 * len(RADARS)):
        item = next(items)
        assert isinstance(item, Loss)
        lost += item.count
    with pytest.raises(LinkError, match="rebooted"):
        next(items)
    assert lost == 3 * 2 * FRAMES
    assert source.total_frames is None


def test_a_copy_that_fails_costs_one_radars_segment(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, _ = make(segments=2)
    fetch = FolderFetcher.fetch

    def failing(self: FolderFetcher, session: str, *rest: Any) -> Path:
        if self.folder.name == "vertical" and session.endswith("_0"):
            shutil.rmtree(self.folder / session)
        return fetch(self, session, *rest)

    monkeypatch.setattr(FolderFetcher, "fetch", failing)
    frames, losses = read(source)
    assert [(x.radar, x.number, x.count) for x in losses] == [("vertical", 0, FRAMES)]
    assert "No such file" in losses[0].detail
    assert [len(frames[radar]) for radar in RADARS] == [2 * FRAMES, FRAMES]


def test_it_ends_when_asked(make: Make) -> None:
    asked = [False]
    source, boards = make(segments=None, stopped=lambda: asked[0])
    for count, _ in enumerate(source, 1):
        asked[0] = count == 2 * FRAMES
    assert count == 2 * FRAMES
    assert all(board.segment == 0 for board in boards.values())
    closed, boards = make(segments=None)
    closed.close()
    assert list(closed) == []


def test_a_start_that_missed_is_recorded_again(make: Make, tmp_path: Path) -> None:
    source, boards = make(segments=1)
    boards["vertical"].late_ns = 30_000_000
    frames, losses = read(source)
    report = source.reports[0]
    assert report.start is not None
    assert report.start.attempts == 2
    assert losses == []
    assert [frame.number for frame in frames["vertical"]] == list(range(FRAMES))
    assert np.array_equal(frames["vertical"][0].adc, samples("vertical", 1, 0)), "of the second recording"
    assert list((tmp_path / "vertical").iterdir()) == [], "the first one is removed as well"


def test_recordings_are_kept_on_demand(make: Make, tmp_path: Path) -> None:
    source, _ = make(segments=1, keep=True)
    read(source)
    assert [path.name for path in (tmp_path / "vertical").iterdir()] == ["capture_0"]


def test_poses_come_in_between(make: Make) -> None:
    rig = replace(RIG, pose=PoseSettings(kind="constant", speed_m_s=1.0, rate_hz=200.0))
    pose_source = make_pose_source(rig)
    assert pose_source is not None
    feed = PoseFeed(pose_source)
    try:
        items = list(make(segments=2, poses=feed)[0])
    finally:
        feed.close()
    assert feed.first.is_set()
    poses = [item for item in items if isinstance(item, Pose)]
    assert [item.kind for item in items if isinstance(item, PoseEvent)] == ["started"]
    assert len(poses) > 2 * FRAMES
    steps = np.diff([pose.t_ns for pose in poses])
    assert (steps > 0).all()
    kinds = [type(item) for item in items if not isinstance(item, PoseEvent)]
    assert sum(a is not b for a, b in pairwise(kinds)) > 2, "merged by time, not appended"


def test_one_radar_alone(tmp_path: Path) -> None:
    rig = replace(RIG, radars={"horizontal": RIG.radars["horizontal"]})
    board = Recorder("horizontal", tmp_path)
    fetcher = FolderFetcher(tmp_path)
    source = SegmentSource(
        rig, {"horizontal": board}, {"horizontal": fetcher}, frames=FRAMES, segments=1, folder=tmp_path
    )
    assert len(list(source)) == FRAMES
    assert source.reports[0].start is None


def test_the_boards_clock() -> None:
    clock = BoardClock(0.0166667)
    period_ns = 16_666_700
    assert clock.missing(10**9, 10**12, 3) == 0, "the first segment says nothing"
    assert clock.missing(10**9 + 10**10 + 300_000, 10**12 + 10**10, 3) == 0, "30 ppm in 10 s"
    assert clock.missing(10**9 + 2 * 10**10 + 2 * period_ns, 10**12 + 2 * 10**10, 3) == 2
    assert clock.missing(10**9 + 3 * 10**10, 10**12 + 3 * 10**10, 3) == 0
    assert clock.missing(5, 10**12 + 4 * 10**10, 3) == 0, "the board rebooted: another clock"
    assert clock.missing(5 + 10**10 + period_ns, 10**12 + 5 * 10**10, 0) == 0, "none is missing"
