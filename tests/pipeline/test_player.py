# SPDX-License-Identifier: Apache-2.0
"""Pacing against a clock of the test's own, and the order of what is fed."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from edge import player
from edge.frames import Layout, LossCause, Pose, RadarFrame
from edge.player import LONGEST_NAP_S, Pace, play
from edge.sources.base import Loss

NS = 1_000_000_000
LAYOUT = Layout("dca1000", 1, 1, 1, 2, 1)


class Clock:
    """Stands still unless somebody sleeps."""

    def __init__(self) -> None:
        self.now_ns = 77 * NS
        self.naps_s: list[float] = []

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.naps_s.append(seconds)
        self.now_ns += max(1, round(seconds * 1e9))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    fake = Clock()
    monkeypatch.setattr(time, "monotonic_ns", fake.monotonic_ns)
    monkeypatch.setattr(time, "sleep", fake.sleep)
    return fake


@pytest.mark.parametrize("speed", [1.0, 4.0, 0.5])
def test_items_are_due_as_far_apart_as_recorded(clock: Clock, speed: float) -> None:
    pace, start_ns = Pace(speed), clock.now_ns
    for recorded_ns in (5 * NS, 5 * NS + 16_666_667, 7 * NS, 9 * NS):
        pace.wait(recorded_ns)
        assert clock.now_ns == pytest.approx(start_ns + (recorded_ns - 5 * NS) / speed, abs=10)


def test_full_speed_never_sleeps(clock: Clock) -> None:
    pace = Pace(0.0)
    for t_ns in (0, NS, 100 * NS):
        pace.wait(t_ns)
    assert clock.naps_s == []


def test_time_spent_elsewhere_is_made_up_for(clock: Clock) -> None:
    pace, start_ns = Pace(1.0), clock.now_ns
    pace.wait(0)
    clock.now_ns += 3 * NS
    pace.wait(NS)
    assert clock.naps_s == []
    pace.wait(4 * NS)
    assert clock.now_ns == pytest.approx(start_ns + 4 * NS, abs=10)


@pytest.mark.parametrize("jump_s", [3600, -3600])
def test_a_jump_of_the_recorded_clock_is_not_waited_for_and_pacing_goes_on(clock: Clock, jump_s: int) -> None:
    pace = Pace(2.0)
    pace.wait(10_000 * NS)
    pace.wait((10_000 + jump_s) * NS)
    assert clock.naps_s == []
    before_ns = clock.now_ns
    pace.wait((10_002 + jump_s) * NS)
    assert clock.now_ns - before_ns == pytest.approx(1 * NS, abs=10)


def test_signs_of_life_are_given_while_it_waits(clock: Clock) -> None:
    beats_ns: list[int] = []
    pace = Pace(1.0, lambda: beats_ns.append(clock.now_ns))
    pace.wait(0)
    pace.wait(2 * NS)
    assert max(clock.naps_s) <= LONGEST_NAP_S
    assert max(np.diff(beats_ns)) <= LONGEST_NAP_S * 1e9 + 1
    assert len(beats_ns) == pytest.approx(2 / LONGEST_NAP_S, abs=1)


def test_a_wait_ends_when_the_run_is_stopped(clock: Clock) -> None:
    pace = Pace(1.0, stopped=lambda: len(clock.naps_s) >= 3)
    pace.wait(0)
    pace.wait(50 * NS)
    assert len(clock.naps_s) == 3


class Recorder:
    """Takes the pipeline's place."""

    def __init__(self) -> None:
        self.fed: list[object] = []

    def feed(self, item: object) -> None:
        self.fed.append(item)

    def finish(self) -> None:
        self.fed.append("finish")


class Bar:
    def __init__(self) -> None:
        self.done = 0

    def update(self, count: int) -> None:
        self.done += count

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *error: object) -> None:
        return None


def test_everything_is_fed_in_order_and_the_bar_ends_at_the_total(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = RadarFrame("horizontal", 0, 5 * NS, np.zeros(LAYOUT.shape, np.int16), LAYOUT)
    loss = Loss("horizontal", 1, LossCause.TRUNCATED, "cut", 0, 3)
    pose = Pose(6 * NS, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    bar = Bar()
    monkeypatch.setattr(player, "progress", lambda total, wanted: bar)
    recorder: Any = Recorder()
    play([frame, loss, pose], recorder, 1.0, total=4)
    assert recorder.fed == [frame, loss, pose, "finish"]
    assert bar.done == 4
    assert sum(clock.naps_s) == pytest.approx(1.0, abs=1e-6)


def test_a_stopped_run_leaves_the_rest_and_finishes() -> None:
    frames = [RadarFrame("horizontal", n, n, np.zeros(LAYOUT.shape, np.int16), LAYOUT) for n in range(5)]
    recorder: Any = Recorder()
    play(frames, recorder, 0.0, show_progress=False, stopped=lambda: len(recorder.fed) == 2)
    assert recorder.fed == [*frames[:2], "finish"]
