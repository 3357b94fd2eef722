# SPDX-License-Identifier: Apache-2.0
"""A source through the live pipeline to its end, its death or Ctrl-C; what the observer says and does meanwhile."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from live_scenes import (
    NOTHING_LOST,
    PERIOD_NS,
    RIG,
    T0_NS,
    Item,
    LiveKeep,
    StandInModel,
    balanced,
    drive,
    feed_patiently,
    live,
    pose_at,
    stand_ins,
    threads_of,
    wait_until,
)

from edge.errors import CaptureError, LinkError
from edge.frames import LossCause
from edge.pipeline import Pipeline
from edge.service import observer as observer_module
from edge.service import serve as serve_module
from edge.service import states as states_module
from edge.service.live import LivePipeline
from edge.service.observer import Observer
from edge.service.serve import serve
from edge.service.shedding import Step
from edge.sources.base import Loss


def gently(road: LivePipeline, items: list[Item], end: Exception | None = None) -> Iterator[Item]:
    """A source that keeps to the pipeline's pace, then dies."""
    for item in items:
        road.book.wait_below(6, 60.0)
        yield item
    if end is not None:
        raise end


def test_a_source_to_its_end() -> None:
    road, keep = live(model=StandInModel())
    observer, taken = Observer(road, {"rfconstruct": "1"}), list[Item]()
    assert observer.tick().state == "INIT"
    serve(gently(road, drive(40)), road, observer, taken=taken.append)
    assert balanced(road) == NOTHING_LOST
    assert observer.verdict.state == "STOP"
    assert len(taken) == len(drive(40))
    assert len(keep.frames) == 40
    assert threads_of(road) == []
    assert gc.isenabled()


@pytest.mark.parametrize(
    ("error", "raised"), [(LinkError("the card is gone"), LinkError), (ValueError("a defect"), CaptureError)]
)
def test_a_source_that_dies(error: Exception, raised: type[Exception]) -> None:
    road, keep = live()
    observer = Observer(road)
    with pytest.raises(raised):
        serve(gently(road, drive(10), error), road, observer)
    assert balanced(road) == NOTHING_LOST
    assert len(keep.frames) == 10
    assert (observer.verdict.state, observer.verdict.reasons[0].code) == ("FAULT", "SOURCE_FAILED")
    assert threads_of(road) == []


def test_ctrl_c_ends_in_order() -> None:
    road, keep = live()
    serve(gently(road, drive(400)), road, Observer(road), stopped=lambda: len(keep.frames) >= 5)
    assert all(set(causes) <= {"no_pose", "unpaired"} for causes in balanced(road).values()), "cut where it stood"
    assert len(keep.frames) >= 5
    assert threads_of(road) == []


def test_a_source_that_blocks_is_woken_or_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve_module, "LEAVE_S", 0.3)
    woken = threading.Event()

    def blocks(deaf: bool) -> Iterator[Item]:
        yield from drive(3)
        while not woken.wait(0.02) or deaf:
            if release.is_set():
                return

    for deaf in (False, True):
        woken.clear()
        release = threading.Event()
        road, keep = live()
        kept = keep.frames
        serve(blocks(deaf), road, Observer(road), stopped=lambda kept=kept: len(kept) == 3, close=woken.set)  # type: ignore[misc]
        assert balanced(road) == NOTHING_LOST
        release.set()


def test_an_exception_in_the_watching_thread_finishes_the_pipeline_too() -> None:
    road, _ = live()

    def stopped() -> bool:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        serve(gently(road, drive(200)), road, Observer(road), stopped=stopped)
    assert all(ledger.snapshot().pending == 0 for ledger in road.ledgers.values())
    assert threads_of(road) == []


def test_the_watchdog_is_fed_unless_a_stage_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observer_module, "STUCK_S", 0.2)
    gate, fed = threading.Event(), list[float]()
    road, keep = live(lambda radar, number: bool(number == 2 and gate.wait(60.0)) and None)
    observer = Observer(road, watchdog=lambda: fed.append(time.monotonic()))
    observer.live()
    observer.tick()
    assert len(fed) == 1, "idle is legal"
    for item in drive(6):
        road.feed(item)
    assert wait_until(lambda: any(stage.busy_s > 0.3 for stage in road.stages))
    verdict = observer.tick()
    assert (verdict.state, len(fed)) == ("FAULT", 1)
    assert "image-" in verdict.reasons[0].detail
    gate.set()
    assert wait_until(lambda: len(keep.frames) == 6)
    observer.tick()
    assert len(fed) == 2
    observer.ending()
    road.finish()


@pytest.fixture
def patient_judge(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that stands still for a second is no reason here."""
    monkeypatch.setattr(states_module, "SILENT_S", 1e9)


@pytest.mark.usefixtures("patient_judge")
def test_states_and_figures_of_a_run() -> None:
    road, _ = live(model=StandInModel())
    observer = Observer(road, {"rfconstruct": "1"}, poses_from="recorded", counts=lambda: {"NOT_SENT": 2})
    observer.live()
    feed_patiently(road, drive(30))
    assert wait_until(lambda: not len(road.book) and not len(road.asked))
    verdict = observer.tick()
    assert verdict.state == "DEGRADED"
    assert {reason.code: reason.count for reason in verdict.reasons} == {"NOT_SENT": 2}
    status, snapshot = observer.status(), observer.snapshot()
    assert status.radars["vertical"].frames_ok == 30
    assert status.pose is not None
    assert (status.pose.source, status.pose.gaps) == ("recorded", 0)
    assert {"to_points", "heatmap", "associate", "objects"} <= set(status.latency_us)
    assert sum(snapshot.latency["to_points"].counts) == 30
    assert sum(snapshot.objects.values()) == 1
    assert set(snapshot.queues) == {"poses", "pairs", "imaged", "shapes", "results"}
    assert observer.status("STOP").state == "STOP"
    observer.ending()
    road.finish()


@pytest.mark.usefixtures("patient_judge")
def test_a_rig_without_a_model_streams_points_and_says_why() -> None:
    road, keep = live(no_shapes="model default is not made for rig x")
    observer = Observer(road)
    observer.live()
    feed_patiently(road, drive(30))
    assert wait_until(lambda: len(keep.frames) == 30)
    verdict = observer.tick()
    assert (verdict.state, verdict.reasons[0].code) == ("DEGRADED", "NO_SHAPES")
    assert verdict.reasons[0].detail == "model default is not made for rig x"
    observer.ending()
    road.finish()
    assert keep.shapes == []
    assert keep.windows[0].objects


def test_the_observer_sheds_load_and_takes_it_back(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [1_000_000_000]
    road, _ = live()
    observer = Observer(road)
    monkeypatch.setattr(observer_module.time, "monotonic_ns", lambda: now_ns[0])
    observer.live()
    for _ in range(40):
        now_ns[0] += 100_000_000
        road.times.record("to_points", 200_000.0)
        observer.tick()
    assert road.shedder.step == Step.DETECTIONS_ONLY
    assert "SHED_HALF_PAIRS" in {reason.code for reason in observer.verdict.reasons}
    for _ in range(200):
        now_ns[0] += 100_000_000
        road.times.record("to_points", 2_000.0)
        observer.tick()
    assert road.shedder.step == Step.NOTHING
    monkeypatch.undo()
    observer.ending()
    road.finish()


def test_what_is_seen_is_what_the_one_thread_sees() -> None:
    """Points and windows of both pipelines, number for number; the live one is given its time."""
    rig = replace(
        RIG, settings=replace(RIG.settings, objects=replace(RIG.settings.objects, core_points=1, min_points=2))
    )
    keep_one, items = LiveKeep(), drive(150)
    one = Pipeline(rig, None, [keep_one], stand_ins())
    for item in items:
        one.feed(item)
    one.finish()
    road, keep = live()
    feed_patiently(road, items)
    road.finish()
    delivered = {result.number: result for result in keep.frames}
    for expected in keep_one.frames:
        if expected.number in delivered and expected.cloud is not None:
            cloud = delivered[expected.number].cloud
            assert cloud is not None
            np.testing.assert_array_equal(cloud.xyz_m, expected.cloud.xyz_m)
    assert len(delivered) > 100
    assert [window.cloud.frames for window in keep.windows] == [window.cloud.frames for window in keep_one.windows]
    for mine, theirs in zip(keep.windows, keep_one.windows, strict=True):
        np.testing.assert_array_equal(mine.cloud.xyz_m, theirs.cloud.xyz_m)


def test_shapes_of_an_object_while_it_is_seen_and_a_final_one_when_it_left() -> None:
    model = StandInModel()
    road, keep = live(model=model)
    feed_patiently(road, drive(60))
    wait_until(lambda: not len(road.book))
    far = 60 + round(7.0 * 1e9 / PERIOD_NS)
    feed_patiently(road, drive(30, first=far))
    road.finish()
    finals = [shape for shape in keep.shapes if shape.input.final]
    running = [shape for shape in keep.shapes if not shape.input.final]
    assert len({shape.identity for shape in finals}) == len(finals) >= 2
    by_identity: dict[int, list[int]] = {}
    for shape in running:
        by_identity.setdefault(shape.identity, []).append(shape.input.t_end_ns)
    for times in by_identity.values():
        assert (np.diff(times) >= 250_000_000).all()
    ages = [shape.input.age_s for shape in keep.shapes if shape.identity == keep.shapes[0].identity]
    assert ages == sorted(ages)
    assert ages[-1] > 0.5
    assert all(shape.pose_vehicle is not None for shape in keep.shapes)


def test_the_vehicle_sees_the_object_beside_it() -> None:
    """Rig looks left from 0.8 m up; vehicle frame is the ground below it, turned by -90 degrees."""
    road, keep = live(model=StandInModel())
    feed_patiently(road, drive(10))
    road.finish()
    shape = keep.shapes[0]
    assert shape.pose_vehicle is not None
    seen_odom_m = shape.input.pose.position_m
    here = pose_at(shape.input.t_end_ns).position_m
    offset = np.array(RIG.geometry.offset_m)
    expected = np.array([seen_odom_m[0] - here[0] + offset[0], seen_odom_m[1] - here[1] + offset[1], 0.0])
    np.testing.assert_allclose(shape.pose_vehicle.position_m[:2], expected[:2], atol=1e-6)
    assert shape.pose_vehicle.position_m[1] > 2.0, "on the left"
    assert shape.pose_vehicle.t_ns == shape.input.t_end_ns


def test_losses_and_poses_of_a_source_count_as_signs_of_life() -> None:
    road, _ = live()
    road.feed(Loss("horizontal", 0, LossCause.TRUNCATED, "short", T0_NS))
    road.feed(pose_at(T0_NS))
    assert set(road.arrivals) == {"horizontal"}
    assert road.poses.count == 1
    road.feed(pose_at(T0_NS + 400_000_000))
    assert road.poses.gaps == 1
    road.finish()
