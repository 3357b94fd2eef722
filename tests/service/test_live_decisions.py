# SPDX-License-Identifier: Apache-2.0
"""What is decided without clocks: which shapes are asked for, which load is shed, which state it is and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.frames import ObjectCloud, Pose
from edge.service.shape_schedule import FADING, SHAPES_HZ, ShapeSchedule
from edge.service.shedding import LoadShedder, ShedSettings, Step
from edge.service.states import HOLD_S, Code, Facts, StateMachine

MS, S = 1_000_000, 1_000_000_000


def thing(identity: int, points: int) -> ObjectCloud:
    pose = Pose(0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    xyz = np.zeros((points, 3), np.float32)
    return ObjectCloud(identity, xyz, xyz[:, 0], pose, 0, 0, 0.0, 1, True, np.zeros(3))


# --- shapes


@given(st.lists(st.integers(1, 400), min_size=2, max_size=120), st.sampled_from([1, 2]))
@settings(max_examples=100, deadline=None)
def test_never_more_than_four_a_second_of_one_object(steps_ms: list[int], slower: int) -> None:
    schedule, t_ns, asked = ShapeSchedule(), 0, list[int]()
    for step_ms in steps_ms:
        t_ns += step_ms * MS
        asked += [t_ns for wanted in schedule.see([thing(7, 100)], t_ns, slower) if not wanted.final]
    assert asked[0] == steps_ms[0] * MS
    gaps = np.diff(asked)
    assert (gaps >= slower * S / SHAPES_HZ).all()
    assert len(asked) <= 1 + (t_ns - asked[0]) / (slower * S / SHAPES_HZ)


def test_segmentation_is_due_four_times_a_second_and_after_time_went_backwards() -> None:
    schedule = ShapeSchedule()
    assert schedule.due(5 * S)
    schedule.see([], 5 * S)
    assert [schedule.due(5 * S + n * 50 * MS) for n in range(6)] == [False] * 5 + [True]
    assert not schedule.due(5 * S + 250 * MS, slower=2)
    assert schedule.due(1 * S)


def test_an_object_that_left_gets_a_final_shape_of_its_richest_window() -> None:
    schedule, points = ShapeSchedule(), [50, 200, 300, 280, 140, 90]
    asked = [schedule.see([thing(1, n), thing(2, 500)], k * 250 * MS) for k, n in enumerate(points)]
    firsts = [[len(cloud) for cloud in wanted if cloud.identity == 1] for wanted in asked]
    assert firsts == [[50], [200], [300], [280], [], []], "below half of the most it shows nothing new"
    assert FADING * 300 > 140
    later = [schedule.see([thing(2, 500)], (6 + k) * 250 * MS) for k in range(3)]
    finals = [(c.identity, len(c)) for wanted in later for c in wanted if c.final]
    assert finals == [(1, 300)]
    assert schedule.identities == [2]
    assert [(c.identity, c.final) for c in schedule.leave()] == [(2, True)]
    assert len(schedule) == 0
    assert schedule.leave() == []


# --- load

LIMITS = ShedSettings()
HIGH, BETWEEN, LOW = 2 * LIMITS.high_delay_s, 0.5 * (LIMITS.high_delay_s + LIMITS.low_delay_s), 0.0


def drive(shedder: LoadShedder, start_s: float, seconds: float, delay_s: float, fill: float = 0.0) -> float:
    """Observations ten times a second; returns the end."""
    for n in range(1, round(10 * seconds) + 1):
        shedder.update(start_s + n / 10, fill, delay_s)
    return start_s + seconds


def test_one_step_at_a_time_up_and_more_slowly_down() -> None:
    shedder, now_s, steps = LoadShedder(), 0.0, list[Step]()
    for _ in range(6):
        now_s = drive(shedder, now_s, 0.7, HIGH)
        steps.append(shedder.step)
    assert steps == [Step.VIEWER, Step.HALF_SHAPES, Step.HALF_PAIRS, Step.DETECTIONS_ONLY, *[Step.DETECTIONS_ONLY] * 2]
    now_s = drive(shedder, now_s, 2.5, LOW)
    assert shedder.step == Step.DETECTIONS_ONLY
    now_s = drive(shedder, now_s, 1.0, LOW)
    assert shedder.step == Step.HALF_PAIRS
    drive(shedder, now_s, 15.0, LOW)
    assert shedder.step == Step.NOTHING
    assert shedder.changes == 8


def test_a_full_queue_is_overload_too_and_the_middle_holds() -> None:
    shedder = LoadShedder()
    now_s = drive(shedder, 0.0, 0.7, LOW, fill=0.75)
    assert shedder.step == Step.VIEWER
    drive(shedder, now_s, 60.0, BETWEEN)
    assert shedder.step == Step.VIEWER


def test_one_bad_moment_changes_nothing() -> None:
    shedder, now_s = LoadShedder(), 0.0
    for _ in range(50):
        now_s = drive(shedder, now_s, 0.3, HIGH)
        now_s = drive(shedder, now_s, 0.2, LOW)
    assert (shedder.step, shedder.changes) == (Step.NOTHING, 0)


def test_late_shapes_shed_no_frames() -> None:
    shedder = LoadShedder()
    for n in range(600):
        shedder.update(n / 10, 0.0, 0.0, shape_s=1.0)
    assert shedder.step == Step.HALF_SHAPES


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 1.0), st.none() | st.floats(0.0, 1.0)), max_size=200))
@settings(max_examples=200, deadline=None)
def test_steps_move_by_one_and_never_faster_than_their_time(seen: list[tuple[float, float, float | None]]) -> None:
    shedder, now_s, before, moved_s = LoadShedder(), 0.0, Step.NOTHING, 0.0
    for step_s, fill, delay_s in seen:
        now_s += step_s
        step = shedder.update(now_s, fill, delay_s)
        if step != before:
            assert abs(step - before) == 1
            assert now_s - moved_s >= (LIMITS.up_s if step > before else LIMITS.down_s) - 1e-9
            before, moved_s = step, now_s


# --- states

RUNNING = Facts(silent_s={"horizontal": 0.01, "vertical": 0.01}, poses_silent_s=0.01)


@pytest.mark.parametrize(
    ("facts", "state", "code"),
    [
        (RUNNING, "RUN", None),
        (replace(RUNNING, started=False), "INIT", None),
        (replace(RUNNING, ending=True), "STOP", None),
        (replace(RUNNING, silent_s={"horizontal": 1.5, "vertical": 9.0}), "WAIT", Code.NO_FRAMES),
        (replace(RUNNING, silent_s={"horizontal": 0.0, "vertical": 9.0}), "DEGRADED", Code.RADAR_SILENT),
        (replace(RUNNING, silent_s={"vertical": 9.0}, poses_silent_s=None), "WAIT", Code.NO_FRAMES),
        (replace(RUNNING, poses_silent_s=2.0), "DEGRADED", Code.POSES_SILENT),
        (replace(RUNNING, no_shapes="model x is not made for rig y"), "DEGRADED", Code.NO_SHAPES),
        (replace(RUNNING, shed=Step.HALF_SHAPES), "DEGRADED", Code.SHED_HALF_SHAPES),
        (replace(RUNNING, source_error="LinkError: gone"), "FAULT", Code.SOURCE_FAILED),
        (replace(RUNNING, stuck=("completion",)), "FAULT", Code.STAGE_STUCK),
        (replace(RUNNING, counts={"OVERFLOW": 3}), "DEGRADED", "OVERFLOW"),
    ],
)
def test_states_and_their_reasons(facts: Facts, state: str, code: str | None) -> None:
    verdict = StateMachine().update(5 * S, facts)
    assert verdict.state == state
    assert code is None or code in {reason.code for reason in verdict.reasons}
    assert code is not None or verdict.reasons == ()


def test_every_step_of_load_shedding_is_a_reason() -> None:
    verdict = StateMachine().update(0, replace(RUNNING, shed=Step.DETECTIONS_ONLY))
    assert [reason.code for reason in verdict.reasons] == [
        *(Code.SHED_VIEWER, Code.SHED_HALF_SHAPES, Code.SHED_HALF_PAIRS, Code.SHED_DETECTIONS_ONLY)
    ]


def test_an_event_is_a_reason_for_some_seconds_and_its_count_goes_on() -> None:
    machine, once = StateMachine(), replace(RUNNING, counts={"ALL_ZERO": 1}, last_fault="horizontal frame 7: all zero")
    assert machine.update(10 * S, once).reasons[0].detail == "horizontal frame 7: all zero"
    assert machine.update(round((10 + HOLD_S) * S), once).state == "DEGRADED"
    assert machine.update(round((10.1 + HOLD_S) * S), once).state == "RUN"
    again = machine.update(60 * S, replace(RUNNING, counts={"ALL_ZERO": 3}))
    (reason,) = again.reasons
    assert (reason.count, reason.first_ns, reason.last_ns) == (3, 10 * S, 60 * S)


def test_a_condition_keeps_the_instant_at_which_it_began() -> None:
    machine, silent = StateMachine(), replace(RUNNING, poses_silent_s=2.0)
    machine.update(3 * S, silent)
    assert machine.update(9 * S, silent).reasons[0].first_ns == 3 * S
    machine.update(10 * S, RUNNING)
    assert machine.update(11 * S, silent).reasons[0].first_ns == 11 * S
