# SPDX-License-Identifier: Apache-2.0
"""The live pipeline accounts for every frame whatever its stages, its sinks and its source do, and nothing hangs."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from live_scenes import (
    NOTHING_LOST,
    RIG,
    Item,
    LiveKeep,
    StandInModel,
    balanced,
    drive,
    feed_patiently,
    frame,
    live,
    threads_of,
    wait_until,
)

from edge.dsp.checks import FrameRejected
from edge.errors import CaptureError, ModelError, RfconstructError
from edge.frames import RADARS, LossCause, ObjectCloud, Pose, RadarFrame, RadarId
from edge.fusion.association import Associator
from edge.service import live as live_module
from edge.service.shedding import Step
from edge.sources.base import Loss

TROUBLES = ("none", "drop", "loss", "twice", "reject", "raise", "slow", "back")


def test_everything_becomes_a_result() -> None:
    road, keep = live()
    feed_patiently(road, drive(30))
    road.finish()
    assert balanced(road) == NOTHING_LOST
    assert [result.number for result in keep.frames] == list(range(30))
    assert all(result.cloud is not None and len(result.cloud) == 5 for result in keep.frames)
    assert threads_of(road) == []


@given(
    st.lists(st.tuples(st.sampled_from(RADARS), st.sampled_from(TROUBLES)), min_size=10, max_size=60),
    st.sets(st.integers(0, 29), max_size=6),
    st.integers(0, 3),
)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_the_account_is_exact_whatever_happens(
    troubles: list[tuple[RadarId, str]], pose_gaps: set[int], sink_fails: int
) -> None:
    kinds = {(radar, n % 30): kind for n, (radar, kind) in enumerate(troubles)}

    def meddle(radar: RadarId, number: int) -> None:
        kind = kinds.get((radar, number))
        if kind == "reject":
            raise FrameRejected(LossCause.SATURATED, "too loud")
        if kind == "raise":
            raise RuntimeError("a stage that has a defect")
        if kind == "slow":
            time.sleep(0.003)

    items: list[Item] = []
    given_frames = dict.fromkeys(RADARS, 0)
    for item in drive(30):
        kind = kinds.get((item.radar, item.number), "none") if isinstance(item, RadarFrame) else "none"
        if isinstance(item, Pose) and (item.t_ns // 33_000_000) % 30 in pose_gaps:
            continue
        if kind == "loss" and isinstance(item, RadarFrame):
            items.append(Loss(item.radar, item.number, LossCause.TRUNCATED, "short", item.t_first_chirp_ns))
        elif kind == "back" and isinstance(item, RadarFrame):
            items.append(frame(item.radar, item.number, 1))
        elif kind != "drop":
            items += [item] * (2 if kind == "twice" else 1)
    for item in items:
        if isinstance(item, RadarFrame):
            given_frames[item.radar] += 1

    class Trouble(LiveKeep):
        def frame(self, result: object) -> None:
            if sink_fails and len(self.frames) % sink_fails == 0:
                raise OSError("disk full")

    road, keep = live(meddle, StandInModel(), [Trouble()])
    for item in items:
        road.feed(item)
        for ledger in road.ledgers.values():
            assert ledger.snapshot().pending >= 0
    road.finish()
    lost = balanced(road)
    for radar, ledger in road.ledgers.items():
        account = ledger.snapshot()
        invented = sum(lost[radar].get(cause, 0) for cause in ("gap", "truncated"))
        assert account.frames_in - invented == given_frames[radar]
        assert account.frames_ok == len(keep.frames) + road.outbox.dropped
    assert threads_of(road) == []


def test_a_busy_imager_drops_pairs_whole_and_only_its_oldest() -> None:
    gate = threading.Event()
    road, keep = live(lambda radar, number: bool(gate.wait(60.0)) and None)
    for item in drive(40):
        road.feed(item)
    assert road.under_way()["in the stages"] == 2 * len(road.book)
    gate.set()
    road.finish()
    lost = balanced(road)
    assert lost["horizontal"] == lost["vertical"]
    assert set(lost["horizontal"]) == {"overflow"}
    assert lost["horizontal"]["overflow"] == 40 - len(keep.frames)
    assert [result.number for result in keep.frames][-5:] == list(range(35, 40))
    assert "overflow" in road.faults.last


def test_an_imager_that_never_comes_back_is_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_module, "DRAIN_S", 0.3)
    gate = threading.Event()
    road, keep = live(lambda radar, number: bool(number == 3 and radar == "vertical" and gate.wait(60.0)) and None)
    for item in drive(6):
        road.feed(item)
    assert wait_until(lambda: len(keep.frames) == 3)
    road.finish()
    assert balanced(road) == {radar: {"failed": 3} for radar in RADARS}
    gate.set()
    assert wait_until(lambda: not threads_of(road))
    assert balanced(road) == {radar: {"failed": 3} for radar in RADARS}, "what comes late counts nowhere"


def test_a_defect_in_fusion_loses_that_pair_only(monkeypatch: pytest.MonkeyPatch) -> None:
    process, calls = Associator.process, list[int]()

    def broken(self: Associator, *arguments: object) -> object:
        calls.append(1)
        if len(calls) == 3:
            raise ZeroDivisionError("a defect")
        return process(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Associator, "process", broken)
    road, keep = live()
    feed_patiently(road, drive(6))
    road.finish()
    assert balanced(road) == {radar: {"failed": 1} for radar in RADARS}
    assert [result.number for result in keep.frames] == [0, 1, 3, 4, 5]
    assert "ZeroDivisionError" in road.faults.last


def test_a_stuck_sink_holds_nothing_up_and_what_it_misses_is_counted() -> None:
    gate = threading.Event()

    class Stuck(LiveKeep):
        def frame(self, result: object) -> None:
            gate.wait(60.0)

    road, keep = live(sinks=[Stuck()])
    feed_patiently(road, drive(60))
    assert wait_until(lambda: all(ledger.snapshot().frames_ok == 60 for ledger in road.ledgers.values()))
    assert keep.frames == []
    gate.set()
    road.finish()
    assert balanced(road) == NOTHING_LOST
    assert len(keep.frames) == 60 - road.outbox.dropped
    assert road.outbox.dropped > 0


def test_a_patient_pipeline_drops_nothing() -> None:
    road, keep = live(lambda radar, number: time.sleep(0.004), patient=True)
    for item in drive(40):
        road.feed(item)
    road.finish()
    assert balanced(road) == NOTHING_LOST
    assert len(keep.frames) + road.outbox.dropped == 40


@pytest.mark.parametrize(
    ("step", "lost", "pointless"), [(Step.HALF_PAIRS, {"shed": 10}, False), (Step.DETECTIONS_ONLY, {"shed": 10}, True)]
)
def test_shed_pairs_are_accounted_for(step: Step, lost: dict[str, int], pointless: bool) -> None:
    road, keep = live()
    road.shedder.step = step
    feed_patiently(road, drive(20))
    road.finish()
    assert balanced(road) == dict.fromkeys(RADARS, lost)
    assert [result.number for result in keep.frames] == [0, 4, 8, 12, 16], "every fourth frame for the viewer"
    assert all(result.heatmaps == {} for result in keep.frames)
    assert all((result.cloud is None) == pointless for result in keep.frames)


def test_without_poses_nothing_is_guessed() -> None:
    road, keep = live()
    for item in drive(10):
        if not isinstance(item, Pose):
            road.feed(item)
    assert road.under_way() == {"waiting for partner or pose": 20, "in the stages": 0}
    road.finish()
    assert balanced(road) == {radar: {"no_pose": 10} for radar in RADARS}
    assert keep.frames == []


def test_a_foreign_frame_is_refused_and_changes_nothing() -> None:
    only = replace(RIG, radars={"horizontal": RIG.radars["horizontal"]})
    road, keep = live(rig=only)
    with pytest.raises(CaptureError, match="does not have"):
        road.feed(frame("vertical", 0))
    for number in range(5):
        road.feed(frame("horizontal", number))
    road.finish()
    assert balanced(road) == {"horizontal": {}}
    assert [result.cloud for result in keep.frames] == [None] * 5
    with pytest.raises(RfconstructError, match="has ended"):
        road.feed(frame("horizontal", 9))
    road.finish()


def test_a_network_that_fails_withholds_the_shape_and_no_frame() -> None:
    def fail(cloud: ObjectCloud) -> None:
        raise (ModelError("not finite") if len(cloud) % 2 else ValueError("a defect"))

    road, keep = live(model=StandInModel(fail))
    feed_patiently(road, drive(40))
    road.finish()
    assert balanced(road) == NOTHING_LOST
    assert keep.shapes == []
    assert road.faults.shapes_withheld > 0


def test_a_new_odometry_frame_cuts_the_window_though_its_first_pairs_are_dropped() -> None:
    road, keep = live(model=StandInModel())
    feed_patiently(road, drive(20))
    assert wait_until(lambda: not len(road.book))
    road.new_pose_frame()
    feed_patiently(road, drive(20, first=20))
    road.finish()
    assert [window.cloud.frames for window in keep.windows] == [20, 20]
    assert sum(shape.input.final for shape in keep.shapes) == 2
