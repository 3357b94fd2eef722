# SPDX-License-Identifier: Apache-2.0
"""Two clocks, one hour, no overlap: the window's edges, the start procedure and the watch, all in virtual time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from edge.constraints import GUARD_S
from edge.drivers.board import Board, Progress, StartTimes
from edge.drivers.interleave import ATTEMPTS, InterleaveStarter, MonotonicClock, OffsetWatch
from edge.drivers.offset import LEAST_ERROR, PhaseLine, window_of
from edge.errors import ConfigError, LinkError
from edge.frames import Float64, RadarId
from edge.rig import Rig, load_rig

CASCADE, SINGLE = load_rig("cascade_pair"), load_rig("awr1843_pair")
PPM = 1e-6


class VirtualClock:
    """Time that passes only when somebody waits; a sleep ends late by up to ``late_s``."""

    def __init__(self, seed: int = 0, late_s: float = 0.0) -> None:
        self.t_ns, self._random, self._late_s = 10**12, np.random.default_rng(seed), late_s

    def now_ns(self) -> int:
        return self.t_ns

    def sleep_until(self, t_ns: int) -> None:
        self.t_ns = max(self.t_ns, t_ns) + round(1e9 * self._random.uniform(0, self._late_s))

    def pass_s(self, duration_s: float) -> None:
        self.t_ns += round(1e9 * duration_s)


class VirtualBoard:
    """Starts its frames within ``jitter_s`` after the command, by a clock that runs fast by ``ppm``."""

    def __init__(self, radar: RadarId, clock: VirtualClock, ppm: float = 0.0, jitter_s: float = 0.0) -> None:
        self.radar: RadarId = radar
        self.clock, self.rate, self.jitter_s = clock, 1.0 + ppm * PPM, jitter_s
        self.random = np.random.default_rng(7)
        self.first_chirp_ns, self.starts, self.stops = 0, 0, 0
        self.slow_answers_s: list[float] = []

    def start(self) -> StartTimes:
        self.starts += 1
        sent_ns = self.clock.now_ns()
        way_s = 0.5e-3 + self.random.uniform(0, self.jitter_s)
        self.first_chirp_ns = sent_ns + round(1e9 * way_s)
        extra_s = self.slow_answers_s.pop(0) if self.slow_answers_s else 0.0
        self.clock.pass_s(way_s + self.random.uniform(0, self.jitter_s) + extra_s)
        return StartTimes(sent_ns, self.clock.now_ns())

    def stop(self) -> None:
        self.stops += 1
        self.clock.pass_s(0.05)

    def plan(self) -> list[str]:
        return []

    def connect(self) -> None: ...
    def configure(self, progress: Progress) -> list[str]:
        return []

    def arm(self, frames: int) -> None: ...
    def close(self) -> None: ...


def overlap_s(first_s: Float64, second_s: Float64, burst_first_s: float, burst_second_s: float) -> float:
    """Total time that bursts which begin at these instants, ascending, share: by definition, interval by interval."""
    total = 0.0
    index = np.searchsorted(second_s, first_s)
    for shift in (-1, 0):
        inside = (index + shift >= 0) & (index + shift < len(second_s))
        begin = second_s[(index + shift)[inside]]
        shared = np.minimum(first_s[inside] + burst_first_s, begin + burst_second_s) - np.maximum(
            first_s[inside], begin
        )
        total += float(np.maximum(shared, 0.0).sum())
    return total


def nothing() -> None: ...


def test_windows() -> None:
    """Hardware notes 6.4: burst 4.32 ms of 16.667 ms leave 4.01 ms on both sides of half a period."""
    for rig, burst_ms, guard_ms in ((CASCADE, 4.320, 4.01), (SINGLE, 2.736, 5.60)):
        now = window_of(rig, hold_s=0.0)
        assert now.target_s == pytest.approx(now.period_s / 2)
        assert 1e3 * (now.target_s - now.earliest_s + GUARD_S) == pytest.approx(guard_ms, abs=0.01)
        assert 1e3 * now.earliest_s == pytest.approx(burst_ms + 0.5)
        kept = window_of(rig)
        assert 1e3 * kept.guard_s == pytest.approx(0.5 + 40e-3 * 60)
        assert kept.target_s == pytest.approx(now.target_s)
        assert now.overlap_s(0.0) == pytest.approx(now.burst_first_s)
        assert now.overlap_s(now.burst_first_s - 1e-3) == pytest.approx(1e-3)
        assert now.overlap_s(now.period_s - now.burst_second_s + 2e-4) == pytest.approx(2e-4)
        assert now.overlap_s(now.burst_first_s) == 0.0 == now.overlap_s(7 * now.period_s + now.target_s)
        assert now.contains(now.earliest_s - now.period_s + 1e-9, now.latest_s - now.period_s - 1e-9)
        assert not now.contains(now.earliest_s - 1e-6, now.target_s)
        assert not now.contains(now.target_s, now.latest_s + 1e-6)


def test_unequal_range_resolution_is_refused() -> None:
    vertical = SINGLE.radars["vertical"]
    profile = replace(vertical.schedule.profile, samples=240)
    other = replace(vertical, schedule=replace(vertical.schedule, profile=profile))
    with pytest.raises(ConfigError, match="range bins"):
        InterleaveStarter(replace(SINGLE, radars={**SINGLE.radars, "vertical": other}))
    longer = replace(vertical, schedule=replace(vertical.schedule, frame_period_s=0.0333))
    with pytest.raises(ConfigError, match="periods"):
        window_of(replace(SINGLE, radars={**SINGLE.radars, "vertical": longer}))
    with pytest.raises(ConfigError, match="one radar"):
        window_of(load_rig("corridor"))


def test_start_at_half_a_period() -> None:
    clock = VirtualClock(seed=1, late_s=50e-6)
    first, second = VirtualBoard("horizontal", clock), VirtualBoard("vertical", clock)
    started = InterleaveStarter(CASCADE, clock).start(first, second, nothing)
    assert started.attempts == 1
    assert started.offset_s == pytest.approx(1 / 120, abs=60e-6)
    true_s = (second.first_chirp_ns - first.first_chirp_ns) / 1e9 % CASCADE.radars["vertical"].schedule.frame_period_s
    assert true_s == pytest.approx(1 / 120, abs=60e-6)
    assert set(started.times) == {"horizontal", "vertical"}
    assert "attempts" not in started.text()


@pytest.mark.parametrize("late", ["first", "second"])
def test_a_late_answer_is_tried_again(late: str) -> None:
    """An answer 20 ms late leaves open where in the period the frames began: stopped, armed, started again."""
    clock, armed = VirtualClock(), list[int]()
    first, second = VirtualBoard("horizontal", clock), VirtualBoard("vertical", clock)
    (first if late == "first" else second).slow_answers_s = [20e-3, 0.0]
    started = InterleaveStarter(CASCADE, clock).start(first, second, lambda: armed.append(clock.now_ns()))
    assert (started.attempts, first.stops, second.stops, first.starts, second.starts) == (2, 1, 1, 2, 2)
    assert started.offset_s == pytest.approx(1 / 120, abs=1e-5)
    assert started.times["horizontal"].sent_ns >= armed[0]
    second.slow_answers_s = [20e-3] * 2 * ATTEMPTS
    with pytest.raises(LinkError, match="between the bursts") as caught:
        InterleaveStarter(CASCADE, clock).start(first, second, nothing)
    assert len(second.slow_answers_s) == ATTEMPTS
    assert "7.22..9.45" in caught.value.allowed, "the guard for the drift until the next re-arm counts too"


def test_by_hardware_nothing_is_timed() -> None:
    rig = replace(
        SINGLE,
        radars={r: replace(x, schedule=replace(x.schedule, hardware_trigger=True)) for r, x in SINGLE.radars.items()},
    )
    clock = VirtualClock()
    second = VirtualBoard("vertical", clock)
    second.slow_answers_s = [1.0]
    started = InterleaveStarter(rig, clock).start(VirtualBoard("horizontal", clock), second, nothing)
    assert started.attempts == 1


@pytest.mark.parametrize(
    ("rig", "ppm", "expected"),
    [
        (CASCADE, (20.0, -20.0), True),
        (CASCADE, (-20.0, 20.0), True),
        (SINGLE, (20.0, -20.0), True),
        (SINGLE, (3.0, 3.0), False),
    ],
)
def test_an_hour_without_overlap(rig: Rig, ppm: tuple[float, float], expected: bool) -> None:
    """40 ppm of drift, 1 ms of start jitter, exponential jitter of the stamps: no burst ever meets another."""
    clock = VirtualClock(seed=3, late_s=100e-6)
    first, second = VirtualBoard("horizontal", clock, ppm[0], 0.4e-3), VirtualBoard("vertical", clock, ppm[1], 0.4e-3)
    rearms, shared_s, watch = simulate(rig, clock, first, second, 3600.0)
    assert shared_s == 0.0
    assert watch.overlaps == 0
    if not expected:
        assert rearms == 0
    else:  # from the middle +-0.4 ms the guard of 0.5 ms is reached after this, less the lead and the fit's error
        quiet_s = (window_of(rig, hold_s=0.0).latest_s - window_of(rig).target_s) / 40e-6
        assert 3600 / quiet_s - 1 <= rearms <= 3600 / (0.6 * quiet_s)


def simulate(
    rig: Rig, clock: VirtualClock, first: VirtualBoard, second: VirtualBoard, duration_s: float
) -> tuple[int, float, OffsetWatch]:
    """Re-arms, true overlap and the watch; the loop looks at the watch once a second."""
    period_s = rig.radars["horizontal"].schedule.frame_period_s_actual
    burst_s = rig.radars["horizontal"].schedule.burst_s
    starter, watch, jitter = InterleaveStarter(rig, clock), OffsetWatch(rig), np.random.default_rng(5)
    starter.start(first, second, nothing)
    rearms, shared_s, end_ns = 0, 0.0, clock.now_ns() + duration_s * 1e9
    done: dict[str, int] = {"horizontal": 0, "vertical": 0}
    while clock.now_ns() < end_ns:
        clock.pass_s(1.0)
        bursts: list[Float64] = []
        for board in (first, second):
            step_s = period_s / board.rate
            count = math.floor((clock.now_ns() - board.first_chirp_ns) / 1e9 / step_s)
            numbers = np.arange(done[board.radar], count)
            true_s = board.first_chirp_ns / 1e9 + numbers * step_s
            for number, t_s in zip(
                numbers.tolist(), (true_s + jitter.exponential(2e-4, len(numbers))).tolist(), strict=True
            ):
                watch.add(board.radar, number, round(t_s * 1e9))
            done[board.radar] = count
            bursts.append(true_s)
        shared_s += overlap_s(bursts[0], bursts[1], burst_s, burst_s)
        watch.measure()
        if watch.rearm_due:
            for board in (second, first):
                board.stop()
            starter.start(first, second, nothing)
            watch.restarted("horizontal")
            watch.restarted("vertical")
            done = {"horizontal": 0, "vertical": 0}
            rearms += 1
    return rearms, shared_s, watch


def test_the_watch_measures_offset_and_drift() -> None:
    watch, period_ns = OffsetWatch(SINGLE), SINGLE.radars["vertical"].schedule.frame_period_s_actual * 1e9
    assert watch.measure() is None
    for number in range(1200):
        watch.add("horizontal", number, 10**9 + round(number * period_ns))
        watch.add("vertical", 500 + number, 10**9 + round(0.006e9 + number * period_ns * (1 + 30e-6)))
    found = watch.measure()
    assert found is not None
    assert found.drift == pytest.approx(30e-6, abs=1e-9)
    assert found.offset_s == pytest.approx(0.006 + 30e-6 * 1199 * period_ns / 1e9, abs=1e-8)
    expected_s = (watch.window.latest_s - found.offset_s) / (30e-6 + 3 * LEAST_ERROR)
    assert found.closes_in_s == pytest.approx(expected_s, rel=1e-3)
    assert not watch.overlap
    assert not watch.rearm_due
    assert "drift +30.0 ppm" in found.text()


def test_the_watch_flags_overlap() -> None:
    watch, period_ns = OffsetWatch(SINGLE), SINGLE.radars["vertical"].schedule.frame_period_s_actual * 1e9
    for number in range(60):
        watch.add("horizontal", number, round(number * period_ns))
        watch.add("vertical", number, round(0.0020e9 + number * period_ns))
    found = watch.measure()
    assert found is not None
    assert found.overlap_s == pytest.approx(0.736e-3, abs=1e-6)
    assert (watch.overlap, watch.rearm_due, watch.overlaps, found.closes_in_s) == (True, True, 1, 0.0)
    assert "OVERLAP" in found.text()
    watch.restarted("vertical")
    assert not watch.overlap


def test_phase_line_against_polyfit() -> None:
    random, line = np.random.default_rng(2), PhaseLine(span_s=10.0)
    numbers = np.cumsum(random.integers(1, 4, 900))
    t_ns = np.round(numbers * 16.6667e6 + random.normal(0, 1e5, 900)).astype(np.int64) + 10**15
    for number, t in zip(numbers.tolist(), t_ns.tolist(), strict=True):
        line.add(number, t)
    kept = t_ns >= t_ns[-1] - 10_000_000_000
    x, y = numbers[kept].astype(float) - float(numbers[-1]), (t_ns[kept] - t_ns[-1]).astype(float)
    coefficients, covariance = np.polyfit(x, y, 1, cov=True)
    value, slope, error = line.fit()
    assert len(line) == kept.sum()
    assert line.origin_ns + value == pytest.approx(float(t_ns[-1]) + coefficients[1], abs=200.0)
    assert slope == pytest.approx(coefficients[0], rel=1e-9)
    assert error == pytest.approx(math.sqrt(covariance[0, 0]), rel=1e-3)


def test_the_real_clock_is_never_early() -> None:
    clock, due_ns = MonotonicClock(), time.monotonic_ns() + 3_000_000
    clock.sleep_until(due_ns)
    assert time.monotonic_ns() >= due_ns


def test_boards_of_this_test_are_boards() -> None:
    board: Board = VirtualBoard("vertical", VirtualClock())
    check: Callable[[], None] = board.close
    check()
