# SPDX-License-Identifier: Apache-2.0
"""Queues drop their oldest and say so; pairs are dropped whole; a book closes every frame exactly once."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.accounting import FrameLedger
from edge.frames import RADARS, Detections, LossCause, ObjectCloud, Pose, RadarId
from edge.pair_gate import ReadyPair
from edge.pipeline import FrameResult
from edge.service.jobs import Job, JobBook, Part
from edge.service.outbox import Outbox
from edge.service.queues import DropQueue, PairQueue, ShapeQueue
from edge.service.stage import Stage
from edge.sources.pairing import FramePair

NONE = np.zeros(0, np.float32)


def job(number: int) -> Job:
    """A pair without frames: queues do not look at them."""
    return Job(ReadyPair(FramePair(number, None, None), None, None, 0), 0)


class _Pair:
    """A pair of two frames, as far as the book looks at it."""

    frames: dict[RadarId, None] = dict.fromkeys(RADARS)


def counted_job(ledgers: dict[RadarId, FrameLedger]) -> Job:
    for ledger in ledgers.values():
        ledger.frame_in()
    return Job(ReadyPair(_Pair(), None, None, 0), 0)  # type: ignore[arg-type]


def part() -> Part:
    return Part(Detections("horizontal", 0, 0, NONE, NONE, NONE, NONE, NONE), None)


def thing(identity: int, points: int = 1, final: bool = False) -> ObjectCloud:
    pose = Pose(0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    xyz = np.zeros((points, 3), np.float32)
    return ObjectCloud(identity, xyz, xyz[:, 0], pose, 0, 0, 0.0, 1, True, np.zeros(3), final=final)


def test_the_oldest_goes_and_comes_back_to_who_put() -> None:
    line = DropQueue[int](2)
    assert [line.put(n) for n in range(4)] == [None, None, 0, 1]
    assert [line.take(0.0) for _ in range(3)] == [2, 3, None]


def test_every_imager_gets_every_pair_in_order() -> None:
    line, jobs = PairQueue(RADARS, 3), [job(n) for n in range(3)]
    assert [line.put(one) for one in jobs] == [None] * 3
    assert [line.take("horizontal", 0.0) for _ in range(4)] == [*jobs, None]
    assert len(line) == 3
    assert [line.take("vertical", 0.0) for _ in range(4)] == [*jobs, None]
    assert len(line) == 0


def test_a_pair_that_nobody_has_begun_goes_first() -> None:
    line, jobs = PairQueue(RADARS, 2), [job(n) for n in range(4)]
    line.put(jobs[0])
    line.put(jobs[1])
    assert line.take("horizontal", 0.0) is jobs[0]
    assert line.put(jobs[2]) is jobs[1]
    assert line.take("horizontal", 0.0) is jobs[2]
    assert line.put(jobs[3]) is jobs[0], "the vertical imager hangs: the oldest goes"
    assert line.take("vertical", 0.0) is jobs[2]


def test_of_an_object_only_the_newest_waits_and_every_final_one() -> None:
    line = ShapeQueue(3, clock_ns=lambda: 7)
    first, newer, other, final, again = thing(1), thing(1, 2), thing(2), thing(1, 3, final=True), thing(1, 4)
    assert line.put(first) is None
    assert line.put(other) is None
    assert line.put(newer) is first
    assert line.put(final) is newer
    assert line.put(again) is None, "it was found again: a new ask, and the final one stays"
    assert line.put(thing(3)) is other, "without room the oldest goes that is no final one"
    assert [line.take(0.0) for _ in range(2)] == [(final, 7), (again, 7)]
    full = ShapeQueue(1)
    full.put(final)
    assert full.put(first) is final, "only final ones: the oldest goes"


def test_windows_and_shapes_leave_before_frames_and_drops_are_counted() -> None:
    box = Outbox(frames=2, results=1)
    frames = [FrameResult(n, n, {}, {}, None, None) for n in range(3)]
    for frame in frames:
        box.put(frame)
    shape = object()
    box.put(shape)  # type: ignore[arg-type]
    assert box.dropped == 1
    assert [box.take(0.0) for _ in range(4)] == [shape, frames[1], frames[2], None]


Event = tuple[int, str]
EVENTS = st.lists(st.tuples(st.integers(0, 5), st.sampled_from(["h", "v", "h-", "v-", "ok", "lose"])), max_size=60)


@given(EVENTS)
@settings(max_examples=300, deadline=None)
def test_whatever_the_order_the_account_balances(events: list[Event]) -> None:
    """Stages may report late, twice, or after the pair was given up."""
    ledgers = {radar: FrameLedger(radar) for radar in RADARS}
    book, jobs = JobBook(ledgers), [counted_job(ledgers) for _ in range(6)]
    for one in jobs:
        book.open(one)
    for index, what in events:
        one = jobs[index]
        if what == "ok":
            book.ok(one)
        elif what == "lose":
            book.lose(one, LossCause.OVERFLOW)
        else:
            radar = RADARS[what[0] == "v"]
            book.imaged(one, radar, LossCause.ALL_ZERO if what.endswith("-") else part())
        for ledger in ledgers.values():
            account = ledger.snapshot()
            assert account.pending == len(book)
    left = len(book)
    assert book.give_up(LossCause.FAILED) == left
    for ledger in ledgers.values():
        ledger.check()
        assert ledger.snapshot().frames_in == 6


def test_a_bad_frame_takes_its_partner_along() -> None:
    ledgers = {radar: FrameLedger(radar) for radar in RADARS}
    book, one = JobBook(ledgers), counted_job(ledgers)
    book.open(one)
    assert not book.imaged(one, "horizontal", LossCause.SATURATED)
    assert not book.imaged(one, "vertical", part())
    assert dict(ledgers["horizontal"].snapshot().lost) == {LossCause.SATURATED: 1}
    assert dict(ledgers["vertical"].snapshot().lost) == {LossCause.UNPAIRED: 1}
    assert not book.ok(one)


def test_a_stage_survives_what_its_work_and_its_report_raise() -> None:
    line, done, failed = DropQueue[int](8), list[int](), list[int]()

    def work(item: int) -> None:
        if item % 2:
            raise ValueError(item)
        done.append(item)

    def report(item: int, error: Exception) -> None:
        failed.append(item)
        raise RuntimeError("the report failed, too")

    stage = Stage("test", line.take, work, report, poll_s=0.01)
    for item in range(6):
        line.put(item)
    stage.start()
    assert stage.end(20.0)
    assert (done, failed) == ([0, 2, 4], [1, 3, 5])
    assert (stage.handled, stage.failures, stage.busy_s) == (6, 6, 0.0)


def test_a_stage_that_hangs_says_so_and_is_left_behind() -> None:
    line, release = DropQueue[int](8), threading.Event()
    stage = Stage(
        "test", line.take, lambda item: bool(release.wait(30.0)) and None, lambda item, error: None, poll_s=0.01
    )
    stage.start()
    line.put(1)
    assert not stage.end(0.2)
    assert stage.busy_s > 0.1
    release.set()
    assert stage.end(20.0)


@pytest.mark.parametrize("name", ["completion", "much longer than fifteen bytes"])
def test_the_kernel_shows_the_threads_name(name: str) -> None:
    seen = list[str]()

    def read() -> None:
        with open("/proc/thread-self/comm", encoding="ascii") as comm:
            seen.append(comm.read().strip())

    line = DropQueue[int](1)
    stage = Stage(name, line.take, lambda item: read(), lambda item, error: None)
    line.put(1)
    stage.start()
    assert stage.end(20.0)
    assert seen == [name[:15]]
