# SPDX-License-Identifier: Apache-2.0
"""The supervisor of the camera's process against a stand-in that loses, garbles, dies and hangs. No depthai here."""

from __future__ import annotations

import importlib.util
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from pose_collecting import Collected, collect

from edge.board_settings import PoseSettings
from edge.config import RigGeometry
from edge.errors import DependencyError
from edge.frames import Pose
from edge.odometry import oak
from edge.odometry.oak import OakSource
from edge.odometry.oak_child import (
    EXIT_NO_PACKAGE,
    OFFLINE,
    PATIENCE,
    FramePairing,
    Sender,
    TurnRate,
    main,
    pose_time,
)
from edge.odometry.oak_record import Kind, PoseFlag, RecordReader, TextRecord
from edge.odometry.source import PoseEvent

FAKE = Path(__file__).with_name("fake_oak_child.py")
IN_PLACE = RigGeometry(yaw_deg=0.0, offset_m=(0.0, 0.0, 0.0))
Maker = Callable[..., OakSource]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Maker]:
    """Started sources of a mode, closed at the end; limits short."""
    monkeypatch.setenv("PYTHONPATH", str(FAKE.parents[2]))
    for name, value in (("STOP_LIMIT_S", 0.2), ("BACKOFF_S", (0.01, 0.02)), ("HEALTHY_S", 0.1)):
        monkeypatch.setattr(oak, name, value)
    made: list[OakSource] = []

    def of(mode: str, geometry: RigGeometry = IN_PLACE, **settings: object) -> OakSource:
        chosen = PoseSettings(**{"kind": "oak", "timeout_s": 5.0, **settings})  # type: ignore[arg-type]
        made.append(OakSource(chosen, geometry, (sys.executable, str(FAKE), mode)))
        made[-1].start()
        return made[-1]

    yield of
    for source in made:
        source.close()
        source.close()
        assert source.pid is None
        assert source.health.state == "ended"


def steps(poses: list[Pose]) -> list[int]:
    """Numbers of the stand-in's poses."""
    return [round(pose.position_m[0] * 100) for pose in poses]


def test_all_poses_come_in_order_and_the_first_event_says_so(make: Maker) -> None:
    source = make("steady")
    got = collect(source, lambda c: len(c.poses) >= 50)
    assert steps(got.poses) == list(range(len(got.poses)))
    assert got.kinds == ["started"]
    assert isinstance(got.items[0], PoseEvent)
    assert not got.events[0].new_frame
    assert source.name == "oak (stand-in, steady)"
    health = source.health
    assert (health.state, health.poses, health.lost, health.refused, health.restarts) == (
        "running", len(got.poses), 0, 0, 0,
    )  # fmt: skip
    assert health.last_pose_ns == got.poses[-1].t_ns
    assert 0.0 < health.rate_hz <= 210.0


def test_mounting_and_rig_are_applied_from_the_sensors_start_on(make: Maker) -> None:
    """Sensor looks back (yaw 180) at (1, 0, 2), rig at (3, 0, 0.8) looks left: driving back moves the rig to -x."""
    source = make(
        "steady", RigGeometry(yaw_deg=90.0, offset_m=(3.0, 0.0, 0.8)), position_m=(1.0, 0.0, 2.0), yaw_deg=180.0
    )
    got = collect(source, lambda c: len(c.poses) >= 11)
    np.testing.assert_allclose(got.poses[0].position_m, [3.0, 0.0, 0.8], atol=1e-12)
    np.testing.assert_allclose(got.poses[10].position_m, [2.9, 0.0, 0.8], atol=1e-12)
    turn = got.poses[10].quaternion_xyzw
    np.testing.assert_allclose(turn * np.sign(turn[3]), [0, 0, math.sqrt(0.5), math.sqrt(0.5)], atol=1e-12)


def test_lost_records_are_counted_exactly(make: Maker) -> None:
    source = make("lose")
    got = collect(source, lambda c: len(c.poses) >= 41)
    last = steps(got.poses)[-1]
    assert source.health.lost == last + 1 - len(got.poses) == sum(n % 5 == 2 for n in range(last + 1))


def test_garbled_records_are_passed_over_and_the_rest_is_exact(make: Maker) -> None:
    source = make("garble")
    got = collect(source, lambda c: len(c.poses) >= 40)
    numbers = steps(got.poses)
    assert numbers == [n for n in range(numbers[-1] + 1) if n % 5 != 2]
    assert source.garbage_bytes >= source.health.lost * 137 > 0


@pytest.mark.parametrize("mode", ["nan", "old", "future"])
def test_what_is_no_pose_of_now_is_refused_and_counted(make: Maker, mode: str) -> None:
    source = make(mode)
    got = collect(source, lambda c: len(c.poses) >= 40)
    numbers = steps(got.poses)
    assert not any(n % 4 == 1 for n in numbers)
    assert source.health.refused == sum(n % 4 == 1 for n in range(numbers[-1] + 1)) > 0
    assert source.health.lost == 0


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ("segfault", "SIGSEGV"),
        ("abort", "signal 6 (SIGABRT), terminate called: X_LINK_ERROR"),
        ("quit", "exit code 12"),
    ],
)
def test_a_dead_process_is_named_and_started_again_in_a_new_frame(make: Maker, mode: str, words: str) -> None:
    source = make(mode)
    got = collect(source, lambda c: c.kinds.count("started") == 2)
    assert got.kinds[:4] == ["started", "died", "restarting", "started"]
    assert words in got.events[1].detail
    assert got.events[3].new_frame
    assert source.health.restarts == 1
    first_run = got.items[: got.items.index(got.events[1])]
    assert sum(isinstance(item, Pose) for item in first_run) == 20  # all it sent before it died


def test_kill_9_is_survived(make: Maker) -> None:
    source = make("steady")
    got = collect(source, lambda c: len(c.poses) >= 5)
    first = source.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    got = collect(source, lambda c: c.kinds.count("started") == 2, got)
    assert "SIGKILL" in got.events[1].detail
    assert source.pid not in (None, first)
    times = [pose.t_ns for pose in got.poses]
    assert times == sorted(set(times))


def test_silence_is_said_and_a_hung_process_is_killed(make: Maker) -> None:
    source = make("hang", timeout_s=0.3)
    got = collect(source, lambda c: c.kinds.count("started") == 2)
    assert got.kinds[:5] == ["started", "silent", "died", "restarting", "started"]
    assert "no pose for 0.3 s" in got.events[1].detail
    assert "SIGKILL" in got.events[2].detail


def test_a_process_that_never_sends_is_stopped_too(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oak, "START_LIMIT_S", 0.3)
    source = make("mute")
    got = collect(source, lambda c: "restarting" in c.kinds)
    assert got.kinds == ["silent", "died", "restarting"]
    assert source.health.age_s(time.monotonic_ns()) == math.inf


def test_restarts_are_bounded(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oak, "RESTART_WINDOW_S", 3600.0)
    source = make("quit")
    got = collect(source, lambda c: c.kinds.count("restarting") == oak.MOST_RESTARTS + 1)
    assert float(got.events[-1].detail.split()[1]) > 3000.0
    assert source.poll(0.1) == []
    assert (source.health.state, source.health.rate_hz) == ("restarting", 0.0)


def test_pauses_grow_and_poses_reset_them(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oak, "BACKOFF_S", (0.01, 0.2, 0.4))
    monkeypatch.setattr(oak, "HEALTHY_S", 3600.0)
    source = make("quit")
    got = collect(source, lambda c: c.kinds.count("restarting") == 4)
    waits = [event.detail.split()[1] for event in got.events if event.kind == "restarting"]
    assert waits == ["0.0", "0.2", "0.4", "0.4"]
    monkeypatch.setattr(oak, "HEALTHY_S", -1.0)
    got = collect(source, lambda c: c.kinds.count("restarting") == 5, got)
    assert got.events[-1].detail.split()[1] == "0.0"


def test_without_depthai_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch, make: Maker) -> None:
    if importlib.util.find_spec("depthai") is None:
        with pytest.raises(DependencyError, match=r"rfconstruct\[oak\]"):
            OakSource(PoseSettings(kind="oak"), IN_PLACE).start()
    source = make("no_package")
    got = collect(source, lambda c: "ended" in c.kinds)
    assert "rfconstruct[oak]" in got.events[-1].detail
    assert source.poll(0.05) == []


@pytest.mark.skipif(importlib.util.find_spec("depthai") is not None, reason="depthai is installed")
def test_the_child_itself_says_that_depthai_is_missing() -> None:
    ours, theirs = os.pipe()
    try:
        assert main(["--records", str(theirs)]) == EXIT_NO_PACKAGE
        (record,) = RecordReader().feed(os.read(ours, 4096))
    finally:
        os.close(ours)
        os.close(theirs)
    assert isinstance(record, TextRecord)
    assert record.code == EXIT_NO_PACKAGE


def test_fast_turns_make_the_odometry_doubtful_until_it_is_slow_again(make: Maker) -> None:
    source = make("spin")
    got = collect(source, lambda c: "trusted" in c.kinds)
    assert got.kinds == ["started", "doubtful", "trusted"]
    doubtful, trusted = (got.items.index(event) for event in got.events[1:])
    during = [item for item in got.items[doubtful:trusted] if isinstance(item, Pose)]
    assert steps(during)[0] == 20
    assert steps(during)[-1] >= 39
    assert source.health.doubtful == len(during)
    assert "57 deg/s, limit 15" in got.events[1].detail


def test_without_gyroscope_the_poses_themselves_tell(make: Maker) -> None:
    got = collect(make("turning"), lambda c: "doubtful" in c.kinds)
    assert "turns at 57 deg/s" in got.events[-1].detail


def test_guessed_times_are_counted(make: Maker) -> None:
    source = make("guessed")
    got = collect(source, lambda c: len(c.poses) >= 10)
    assert source.health.time_guessed == len(got.poses)


def test_the_child_ends_when_this_process_lets_go_of_it(make: Maker) -> None:
    source = make("steady")
    collect(source, lambda c: len(c.poses) >= 1)
    pid = source.pid
    assert pid is not None
    source.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_telemetry_is_off_in_the_only_way_that_counts() -> None:
    assert OFFLINE["DEPTHAI_TELEMETRY"] in ("0", "off", "OFF", "false")
    assert OFFLINE["DEPTHAI_PROTOCOL"] == "usb"


def test_a_full_pipe_never_stops_the_camera_and_shows_in_the_numbers() -> None:
    ours, theirs = os.pipe()
    sender, reader = Sender(theirs), RecordReader()
    for number in range(2000):  # a pipe holds 512
        sender.text(Kind.ALIVE, str(number))
    first = reader.feed(os.read(ours, 1 << 20))
    sender.text(Kind.ALIVE, "after")
    (last,) = reader.feed(os.read(ours, 1 << 20))
    os.close(ours)
    assert [record.sequence for record in first] == list(range(len(first)))
    assert 0 < len(first) < 2000
    assert last.sequence == 2000
    with pytest.raises(BrokenPipeError):
        sender.text(Kind.ALIVE, "nobody reads")
    os.close(theirs)


class Queue:
    """A message queue of the library, as far as pairing uses it."""

    def __init__(self) -> None:
        self.items: list[int] = []
        self.waits = 0

    def tryGet(self) -> int | None:  # noqa: N802
        return self.items.pop(0) if self.items else None

    def get(self, timeout: object) -> int | None:
        self.waits += 1
        return self.tryGet()

    def getSize(self) -> int:  # noqa: N802
        return len(self.items)


def pairing() -> tuple[FramePairing, Queue, Queue]:
    frames, poses = Queue(), Queue()
    return FramePairing(frames, poses, lambda frame: frame), frames, poses


def test_each_pose_has_the_time_of_its_own_frame() -> None:
    pair, frames, _ = pairing()
    frames.items = [101, 102, 103, 104]
    assert pair.times(1) == [101]
    assert pair.times(2) == [102, 103]  # the fourth frame's pose was not taken yet
    assert pair.times(1) == [104]


def test_a_late_frame_is_not_given_to_the_next_pose() -> None:
    pair, frames, _ = pairing()
    assert pair.times(1) == [0]
    frames.items = [101, 102]
    assert pair.times(1) == [102]


def test_a_lost_frame_costs_one_time_and_no_more() -> None:
    pair, frames, _ = pairing()
    assert pair.times(1) == [0]
    for number in (102, 103, 104):
        frames.items.append(number)
        assert pair.times(1) == [number]


def test_frames_whose_poses_were_lost_are_passed_over() -> None:
    pair, frames, _ = pairing()
    frames.items, got = [100], []
    for number in range(101, 110):
        frames.items.append(number)
        got += pair.times(1)
    assert got[0] == 100
    assert got[-1] == 109


def test_it_stops_waiting_for_frames_that_never_come() -> None:
    pair, frames, _ = pairing()
    for _ in range(PATIENCE + 20):
        pair.times(1)
    assert frames.waits <= PATIENCE * 1000
    waited = frames.waits
    pair.times(1)
    assert frames.waits == waited


@pytest.mark.parametrize(
    ("own", "frame", "exact", "expected"),
    [
        (5, 4, True, (5, PoseFlag(0))),
        (0, 4, True, (4, PoseFlag(0))),
        (0, 4, False, (4, PoseFlag.TIME_APPROXIMATE)),
        (0, 0, True, (9, PoseFlag.TIME_GUESSED)),
    ],
)
def test_which_time_a_pose_gets(own: int, frame: int, exact: bool, expected: tuple[int, PoseFlag]) -> None:
    assert pose_time(own, frame, 9, exact) == expected


def test_turn_rate_is_the_fastest_of_the_last_tenth_of_a_second() -> None:
    rate = TurnRate()
    assert math.isnan(rate.fastest(0))
    for t_ms, value in ((0, 3.0), (60, 1.0), (120, 0.5)):
        rate.add(t_ms * 1_000_000, value)
    assert rate.fastest(120_000_000) == 1.0
    assert math.isnan(rate.fastest(10**9))


def test_collected_items_are_poses_or_events() -> None:
    assert Collected().poses == []
