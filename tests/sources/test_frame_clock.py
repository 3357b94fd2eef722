# SPDX-License-Identifier: Apache-2.0
"""Times of live frames: an even beat is recovered from arrivals that are late, and only late, by varying amounts."""

from __future__ import annotations

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.sources.frame_clock import FrameClock

PERIOD_S = 1 / 60
PERIOD_NS = 1e9 * PERIOD_S


def test_exact_arrivals() -> None:
    clock = FrameClock(PERIOD_S, delay_ns=57_000)
    assert not clock.known
    for k in range(5):
        clock.add(k, 10**15 + round(k * PERIOD_NS))
        assert clock.at(k) == pytest.approx(10**15 + k * PERIOD_NS - 57_000, abs=2)
    assert clock.at(-3) == pytest.approx(10**15 - 3 * PERIOD_NS - 57_000, abs=2), "frames before the first that came"
    clock.clear()
    assert not clock.known


@pytest.mark.parametrize("drift", [-80e-6, 0.0, 80e-6])
def test_late_arrivals_of_a_drifting_clock(drift: float) -> None:
    """Late by 2 ms in the mean, exponentially; from the first second on the beat is known to 0.3 ms."""
    rng = np.random.default_rng(0)
    clock, errors, raw = FrameClock(PERIOD_S), [], []
    for k in range(900):
        true_ns = 5_000 + k * PERIOD_NS * (1 + drift)
        late_ns = rng.exponential(2e6)
        clock.add(k, round(true_ns + late_ns))
        assert clock.at(k) <= true_ns + late_ns + 1, "no frame begins after its first packet came"
        if k >= 60:
            errors.append(clock.at(k) - true_ns)
            raw.append(late_ns)
    assert np.median(raw) > 1e6
    assert np.percentile(np.abs(errors), 95) < 0.3e6
    assert clock.drift == pytest.approx(drift, abs=40e-6)


def test_frames_that_are_missing() -> None:
    clock = FrameClock(PERIOD_S)
    for k in (0, 1, 2, 50, 51, 400, 401):
        clock.add(k, round(k * PERIOD_NS))
    assert clock.at(300) == pytest.approx(300 * PERIOD_NS, abs=3)


def test_one_very_late_frame_moves_nothing() -> None:
    clock = FrameClock(PERIOD_S)
    for k in range(300):
        clock.add(k, round(k * PERIOD_NS) + (50_000_000 if k == 299 else 0))
    assert clock.at(299) == pytest.approx(299 * PERIOD_NS, abs=3)


def test_bad_settings() -> None:
    with pytest.raises(ConfigError):
        FrameClock(0.0)
    with pytest.raises(ConfigError):
        FrameClock(1.0).at(0)
