# SPDX-License-Identifier: Apache-2.0
"""Simulated clocks: offset, drift and queueing delays that are known, so the map is too."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.odometry.clock_fit import LATE_FOR_S, ClockFit
from edge.odometry.host_clock import offset_to_monotonic, utc_synchronised

NS = 1_000_000_000
OFFSET_NS = -7_654_321_987_654_321
DRIFT = 40e-6


def local_of(remote_ns: int, drift: float = DRIFT) -> int:
    """The true map: exact integers for the large part."""
    since = remote_ns - 5 * NS
    return remote_ns + OFFSET_NS + round(drift * since)


def messages(
    seconds: float, rate_hz: float, delay_s: float, seed: int, drift: float = DRIFT
) -> Iterator[tuple[int, int]]:
    """Remote stamps and arrivals after exponential delays of that mean; order is kept, as in a queue."""
    rng, arrival_ns = np.random.default_rng(seed), -(2**62)
    for number in range(round(seconds * rate_hz)):
        remote_ns = 5 * NS + round(number * NS / rate_hz)
        arrival_ns = max(arrival_ns, local_of(remote_ns, drift) + round(rng.exponential(delay_s) * NS))
        yield remote_ns, arrival_ns


@pytest.mark.parametrize("drift", [40e-6, -40e-6, 0.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_offset_and_drift_of_another_clock_under_exponential_delays(drift: float, seed: int) -> None:
    fit = ClockFit()
    for remote_ns, arrival_ns in messages(120.0, 60.0, 2e-3, seed, drift):
        fit.add(remote_ns, arrival_ns)
    assert fit.drift == pytest.approx(drift, abs=1e-6)
    errors_ns = [fit.to_local_ns(t) - local_of(t, drift) for t in range(60 * NS, 125 * NS, NS)]
    assert max(map(abs, errors_ns)) < 0.1e-3 * NS  # mean delay 2 ms; the least of thousands is near 0
    assert fit.steps == 0


def test_first_seconds_are_within_the_delay_and_no_drift_is_made_up() -> None:
    fit = ClockFit()
    for remote_ns, arrival_ns in messages(3.0, 60.0, 2e-3, 4):
        fit.add(remote_ns, arrival_ns)
        late_ns = fit.to_local_ns(remote_ns) - local_of(remote_ns)
        assert -0.2e-3 * NS < late_ns < 10e-3 * NS
    assert fit.drift == 0.0


def test_drift_over_an_hour_never_runs_away_and_pairs_are_few() -> None:
    fit, worst_ns = ClockFit(), 0
    for number, (remote_ns, arrival_ns) in enumerate(messages(3600.0, 10.0, 5e-3, 5)):
        fit.add(remote_ns, arrival_ns)
        if number > 1200:
            worst_ns = max(worst_ns, abs(fit.to_local_ns(remote_ns) - local_of(remote_ns)))
    assert worst_ns < 1e-3 * NS
    assert len(fit._above.points) < 150


def test_constant_delay_stays_without_a_handshake_and_goes_with_one() -> None:
    one_way, both = ClockFit(), ClockFit()
    rng = np.random.default_rng(6)
    for number in range(600):
        remote_ns = 5 * NS + number * NS // 10
        there_ns, back_ns = (round((0.004 + rng.exponential(1e-3)) * NS) for _ in range(2))
        true_ns = local_of(remote_ns)
        one_way.add(remote_ns, true_ns + back_ns)
        both.add_exchange(true_ns - there_ns, remote_ns, true_ns + back_ns)
    at_ns = 60 * NS
    assert one_way.to_local_ns(at_ns) - local_of(at_ns) == pytest.approx(0.004 * NS, abs=0.2e-3 * NS)
    assert abs(both.to_local_ns(at_ns) - local_of(at_ns)) < 0.1e-3 * NS
    assert one_way.uncertainty_ns is None
    assert both.uncertainty_ns == pytest.approx(0.004 * NS, abs=0.2e-3 * NS)


def test_noise_free_line_is_met_to_the_nanosecond() -> None:
    fit = ClockFit()
    for remote_ns in range(5 * NS, 65 * NS, NS // 50):
        fit.add(remote_ns, local_of(remote_ns))
    assert abs(fit.to_local_ns(63 * NS) - local_of(63 * NS)) <= 2
    assert fit.drift == pytest.approx(DRIFT, abs=1e-9)


@pytest.mark.parametrize("step_ns", [3600 * NS, NS // 10])
def test_clock_set_forward_is_noticed_at_once(step_ns: int) -> None:
    fit = ClockFit()
    for remote_ns, arrival_ns in messages(20.0, 60.0, 1e-3, 7):
        assert fit.add(remote_ns, arrival_ns)
    assert not fit.add(25 * NS + step_ns, local_of(25 * NS))
    assert fit.steps == 1
    assert abs(fit.to_local_ns(25 * NS + step_ns) - local_of(25 * NS)) < 1000


def test_clock_set_back_is_noticed_after_five_seconds() -> None:
    fit = ClockFit()
    for remote_ns, arrival_ns in messages(20.0, 60.0, 1e-3, 8):
        fit.add(remote_ns, arrival_ns)
    answers = [fit.add(5 * NS + n * NS // 60, local_of(25 * NS + n * NS // 60)) for n in range(360)]
    assert answers.count(False) == 1
    assert answers.index(False) == LATE_FOR_S * 60
    assert abs(fit.to_local_ns(6 * NS) - local_of(26 * NS)) < 1e-3 * NS


def test_one_long_stall_is_a_queue_and_no_step() -> None:
    fit = ClockFit()
    for remote_ns, arrival_ns in messages(20.0, 60.0, 1e-3, 9):
        stall_ns = max(0, local_of(15 * NS) - arrival_ns) if 12 * NS < remote_ns < 15 * NS else 0
        assert fit.add(remote_ns, arrival_ns + stall_ns)
    assert abs(fit.to_local_ns(24 * NS) - local_of(24 * NS)) < 0.2e-3 * NS


def test_pairs_out_of_order_do_not_grow_it() -> None:
    fit = ClockFit()
    fit.add(0, 0)
    for number in range(5000):
        fit.add((number * 7919) % 100 * NS, (number * 7919) % 100 * NS + 1)
    assert len(fit._above.points) <= 256
    assert fit.to_local_ns(50 * NS) == pytest.approx(50 * NS, abs=10)


def test_impossible_use_is_refused() -> None:
    with pytest.raises(ConfigError, match="pair of times"):
        ClockFit().to_local_ns(0)
    with pytest.raises(ConfigError, match="handshake"):
        ClockFit().add_exchange(2, 0, 1)


@pytest.mark.parametrize("clock", ["realtime", "tai"])
def test_clocks_of_this_host_are_bracketed(clock: str) -> None:
    number = {"realtime": time.CLOCK_REALTIME, "tai": time.CLOCK_TAI}[clock]
    before_ns = time.monotonic_ns()
    other_ns = time.clock_gettime_ns(number)
    after_ns = time.monotonic_ns()
    offset = offset_to_monotonic(clock)  # type: ignore[arg-type]
    slack_ns = offset.uncertainty_ns + 1_000_000  # a disciplined clock moves in between
    assert before_ns - slack_ns <= other_ns + offset.offset_ns <= after_ns + slack_ns


def test_monotonic_needs_no_offset() -> None:
    assert offset_to_monotonic("monotonic").offset_ns == 0
    assert utc_synchronised() in (True, False)
