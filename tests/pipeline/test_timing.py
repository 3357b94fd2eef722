# SPDX-License-Identifier: Apache-2.0
"""Percentiles of known samples; memory that does not grow."""

from __future__ import annotations

import tracemalloc

import pytest

from edge.timing import BOUNDS_US, KEPT, StageTimes


def test_percentiles_of_a_ramp() -> None:
    times = StageTimes()
    for microseconds in range(101):
        times.record("a", float(microseconds))
    summary = times.summary()["a"]
    assert (summary.count, summary.p50_us, summary.p99_us, summary.max_us) == (101, 50.0, 99.0, 100.0)
    assert times.last_us == {"a": 100}


def test_percentiles_are_of_the_last_measurements_and_the_longest_of_all() -> None:
    times = StageTimes()
    times.record("a", 1e6)
    for _ in range(KEPT):
        times.record("a", 7.0)
    summary = times.summary()["a"]
    assert (summary.count, summary.p50_us, summary.p99_us, summary.max_us) == (KEPT + 1, 7.0, 7.0, 1e6)


def test_stages_keep_the_order_in_which_they_came() -> None:
    times = StageTimes()
    for stage in ("z", "a", "z", "m"):
        times.record(stage, 1.0)
    assert list(times.summary()) == ["z", "a", "m"]
    assert StageTimes().summary() == {}


def test_a_body_that_raises_is_not_counted() -> None:
    times = StageTimes()
    with pytest.raises(ValueError, match="no"), times.measure("a"):
        raise ValueError("no")
    with times.measure("a"):
        pass
    assert times.summary()["a"].count == 1


def test_memory_does_not_grow_with_the_run() -> None:
    times = StageTimes()
    times.record("a", 1.0)
    tracemalloc.start()
    for microseconds in range(2 * KEPT):
        times.record("a", float(microseconds))
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 4096


def test_histogram_puts_a_bound_into_its_own_bucket_and_the_rest_into_the_last() -> None:
    times = StageTimes()
    for microseconds in (0.0, 10.0, 10.1, 20.0, 5e6, 5.1e6):
        times.record("a", microseconds)
    histogram = times.histograms()["a"]
    assert BOUNDS_US[:3] == (10.0, 20.0, 50.0)
    assert BOUNDS_US[-1] == 5e6
    assert len(histogram.counts) == len(BOUNDS_US) + 1
    assert histogram.counts[:3] == (2, 2, 0)
    assert histogram.counts[-2:] == (1, 1)
    assert histogram.sum_us == pytest.approx(0.0 + 10.0 + 10.1 + 20.0 + 5e6 + 5.1e6)
    assert sum(histogram.counts) == times.summary()["a"].count
