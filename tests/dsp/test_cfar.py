# SPDX-License-Identifier: Apache-2.0
"""CFAR: false-alarm rates against the design, decisions against brute force, dynamic range, invariance."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from edge.config import CfarSettings
from edge.dsp.detector import Detector
from edge.dsp.interpolation import PARABOLA
from edge.dsp.threshold import cfar_scale, incomplete_beta, os_rank
from edge.errors import ConfigError
from edge.frames import Heatmap, PointResponse
from edge.reference import cfar as definition

RADAR = SimpleNamespace(radar="horizontal")
KINDS = ["ca", "go", "so", "os"]


def heatmap(power, first_range_m=0.0):
    angles, ranges = power.shape
    cosine = ((np.arange(angles) - angles // 2) / angles).astype(np.float32)
    range_m = (first_range_m + 0.05 * np.arange(ranges)).astype(np.float32)
    return Heatmap("horizontal", 0, 0, np.ascontiguousarray(power, dtype=np.float32), cosine, range_m)


def settings(kind, p_fa=1e-3, **changes):
    return dataclasses.replace(CfarSettings(kind=kind, p_fa=p_fa, min_range_m=0.0), **changes)


class TestScale:
    @pytest.mark.parametrize("cells", [1, 16, 120, 264])
    @pytest.mark.parametrize("p_fa", [1e-2, 1e-4, 1e-8])
    @pytest.mark.parametrize("kind", ["ca", "os"])
    def test_inverts_the_probability(self, kind, cells, p_fa):
        rank = os_rank(cells, 0.75)
        factor = cfar_scale(kind, cells, p_fa, rank)
        assert definition.false_alarm_probability(kind, cells, rank, factor) == pytest.approx(p_fa, rel=1e-9)

    def test_known_values(self):
        assert cfar_scale("ca", 1, 0.1) == pytest.approx(9.0)
        assert cfar_scale("ca", 10**7, 1e-6) == pytest.approx(math.log(1e6), rel=1e-5)
        assert cfar_scale("os", 1, 0.1, 1) == pytest.approx(9.0)
        assert cfar_scale("os", 16, 1e-6, 12) == pytest.approx(20.9, abs=0.1), "Rohling 1983, table for N = 16, k = 12"

    @pytest.mark.parametrize(("cells", "other"), [(1, 1), (8, 8), (206, 206), (206, 15), (15, 206), (3, 60)])
    @pytest.mark.parametrize("p_fa", [1e-2, 1e-4, 1e-6])
    @pytest.mark.parametrize("kind", ["go", "so"])
    def test_halves_invert_the_integral(self, kind, cells, other, p_fa):
        factor = cfar_scale(kind, cells, p_fa, other=other)
        probability = definition.false_alarm_probability(kind, cells, 0, factor, other)
        assert probability == pytest.approx(p_fa, rel=2e-4)

    def test_halves_of_one_cell_have_a_closed_form(self):
        """exp(-T min) of two unit exponentials has the mean 2 / (2 + T), of the greater one 2 / (1 + T) less that."""
        assert cfar_scale("so", 1, 0.1, other=1) == pytest.approx(18.0)
        t = cfar_scale("go", 1, 0.1, other=1)
        assert 2.0 / (1.0 + t) - 2.0 / (2.0 + t) == pytest.approx(0.1)

    @pytest.mark.parametrize("kind", ["go", "so"])
    def test_an_empty_half_leaves_cell_averaging(self, kind):
        expected = cfar_scale("ca", 33, 1e-3)
        assert cfar_scale(kind, 0, 1e-3, other=33) == cfar_scale(kind, 33, 1e-3, other=0) == expected

    def test_incomplete_beta_is_scipys(self):
        betainc = pytest.importorskip("scipy.special").betainc
        for a, b in ((0.5, 0.5), (1.0, 7.3), (20.0, 3.7), (200.0, 2000.0)):
            for x in (0.0, 1e-6, 0.1, 0.5, a / (a + b), 0.999, 1.0):
                assert incomplete_beta(a, b, x) == pytest.approx(betainc(a, b, x), rel=1e-9, abs=1e-14)

    def test_rank_outside_the_cells_is_refused(self):
        with pytest.raises(ConfigError, match="rank"):
            cfar_scale("os", 16, 1e-3, 17)
        with pytest.raises(ConfigError, match="cells"):
            cfar_scale("ca", 0, 1e-3)


def false_alarm_rates(kind, p_fa, maps, ranges, seed):
    """Share of exponential cells decided, for range columns nearer to an end than the box and for all others."""
    rng = np.random.default_rng(seed)
    detector = Detector(RADAR, settings(kind, p_fa))
    hits = np.zeros(ranges)
    for _ in range(maps):
        hits += detector.decisions(heatmap(rng.standard_exponential((256, ranges), dtype=np.float32))).sum(axis=0)
    edge = np.minimum(np.arange(ranges), np.arange(ranges)[::-1]) < detector.settings.train_range
    return hits[edge].sum() / (maps * 256 * edge.sum()), hits[~edge].sum() / (maps * 256 * (~edge).sum())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("p_fa", "maps"), [(1e-2, 250), (1e-3, 2500)])
def test_false_alarm_rate_is_the_designed_one_inside_and_at_both_ends(kind, p_fa, maps):
    """About 10,000 events each: the standard deviation of a rate is 1 %, the limit 5 %."""
    edge, interior = false_alarm_rates(kind, p_fa, maps, 32, 5)
    assert edge == pytest.approx(p_fa, rel=0.05)
    assert interior == pytest.approx(p_fa, rel=0.05)


SPACED_ROWS = np.arange(0, 4095, 5)
"""Angle rows whose rings, of half width 2, have no cell in common."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("p_fa", "maps"), [(1e-2, 300), (1e-3, 3000), pytest.param(1e-4, 30000, marks=pytest.mark.slow)]
)
def test_false_alarms_of_cells_that_share_nothing_are_binomial(kind, p_fa, maps):
    """The two columns at either end and two inside, rings disjoint: 4900 events each, 5 % are 3.5 sigma."""
    rng = np.random.default_rng(17)
    chosen = settings(kind, p_fa, guard_angle=1, train_angle=2, guard_range=1, train_range=2)
    detector = Detector(RADAR, chosen)
    edge, interior, power = 0, 0, np.empty((4095, 18), dtype=np.float32)
    for n in range(maps):
        rng.standard_exponential(out=power, dtype=np.float32)
        decided = detector.decisions(heatmap(power))[SPACED_ROWS]
        edge += int(decided[:, (n % 2, 17 - n % 2)].sum())
        interior += int(decided[:, (6, 11)].sum())
    cells = 2 * maps * len(SPACED_ROWS)
    for events in (edge, interior):
        assert events == pytest.approx(p_fa * cells, rel=0.05)
        assert abs(events - p_fa * cells) < 3.5 * math.sqrt(p_fa * cells)


def test_false_alarm_rate_holds_where_the_angle_axis_closes():
    rng = np.random.default_rng(8)
    detector = Detector(RADAR, settings("ca", 1e-2))
    hits = np.zeros(64)
    for _ in range(400):
        hits += detector.decisions(heatmap(rng.standard_exponential((64, 48)))).sum(axis=1)
    rate = hits / (400 * 48)
    assert rate[:8].mean() == pytest.approx(1e-2, rel=0.08)
    assert rate[-8:].mean() == pytest.approx(1e-2, rel=0.08)


def independent_factor(chosen, r, first, ranges):
    """Factor for the ring at range r by counting its cells."""
    ones = np.ones((2 * chosen.train_angle + 1, ranges))
    count = [len(definition.ring_values(ones, chosen.train_angle, r, chosen, first, side)) for side in (0, -1, 1)]
    if chosen.kind in ("go", "so"):
        return cfar_scale(chosen.kind, count[1], chosen.p_fa, other=count[2])
    return cfar_scale(chosen.kind, count[0], chosen.p_fa, os_rank(count[0], chosen.os_quantile))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "shape",
    [
        (6, 14, 2, 8),
        (1, 5, 3, 12),
        *(pytest.param(s, marks=pytest.mark.slow) for s in [(14, 24, 2, 8), (0, 1, 0, 1), (3, 4, 0, 2)]),
    ],
)
def test_every_decision_is_that_of_brute_force(kind, shape):
    guard_angle, train_angle, guard_range, train_range = shape
    chosen = settings(
        *(kind, 0.03),
        guard_angle=guard_angle,
        train_angle=train_angle,
        guard_range=guard_range,
        train_range=train_range,
        min_range_m=0.2,
    )
    rng = np.random.default_rng(sum(shape))
    power = (rng.standard_exponential((64, 70)) * 10 ** rng.uniform(0, 2, (64, 1))).astype(np.float32)
    first = 4
    columns = np.r_[first : first + 14, 30, 40, 56:70]
    cells = np.array([(a, r) for a in (0, 1, 2, 20, 33, 61, 62, 63) for r in columns])
    expected = definition.decisions(
        power.astype(float),
        chosen,
        first,
        lambda r: independent_factor(chosen, r, first, 70),
        cells,
    )
    decided = Detector(RADAR, chosen).decisions(heatmap(power))
    assert np.array_equal(decided[cells[:, 0], cells[:, 1]], expected)
    assert expected.any()
    assert not decided[:, :first].any()


@pytest.mark.parametrize("kind", KINDS)
def test_every_peak_is_that_of_brute_force(kind):
    """Decisions on the received power, its maxima; plateaus and both ends of either axis."""
    rng = np.random.default_rng(12)
    pattern = np.exp(-(np.linspace(-2, 2, 64) ** 2)).astype(np.float32)
    received = rng.standard_exponential((64, 50)).astype(np.float32)
    received[[0, 0, 63, 63, 30, 30, 31, 31], [0, 49, 20, 21, 30, 31, 30, 31]] = 40.0
    received[[10, 11, 12], 15] = 30.0, 31.0, 30.5
    response = PointResponse(PARABOLA, PARABOLA, 1.0 / pattern, 0.0, 0.0, 0.0)
    map_ = dataclasses.replace(heatmap(received / pattern[:, None]), response=response)
    detector = Detector(RADAR, settings(kind, 0.05))
    found = detector.process(map_)
    expected = [
        50 * a + r
        for a, r in np.argwhere(detector.decisions(map_)).tolist()
        if definition.is_local_maximum((map_.power * detector._pattern[:, None]).astype(float), a, r)
    ]
    assert detector._cells[: len(found)].tolist() == expected
    assert {50 * 11 + 15, 30 * 50 + 30} <= set(expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("exponent", [-20, 20])
def test_scaling_by_a_power_of_two_changes_nothing_at_all(kind, exponent):
    """Floating-point products with 2^n are exact: here every decision must be the same."""
    power = np.random.default_rng(1).standard_exponential((256, 64)).astype(np.float32)
    detector = Detector(RADAR, settings(kind, 1e-2))
    plain = detector.decisions(heatmap(power))
    assert plain.any()
    assert np.array_equal(detector.decisions(heatmap(power * np.float32(2.0**exponent))), plain)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scaling_changes_no_decision(kind, scale):
    power = np.random.default_rng(1).standard_exponential((256, 64)).astype(np.float32)
    detector = Detector(RADAR, settings(kind, 1e-2))
    plain, scaled = detector.decisions(heatmap(power)), detector.decisions(heatmap(power * np.float32(scale)))
    assert (plain != scaled).mean() < 1e-4
    one, other = detector.process(heatmap(power)), detector.process(heatmap(power * np.float32(scale)))
    assert len(one) == pytest.approx(len(other), abs=1)


@pytest.mark.parametrize("kind", KINDS)
def test_the_antenna_s_compensation_changes_no_decision(kind):
    """What is compensated by powers of two is decided as it was received, exactly."""
    rng = np.random.default_rng(21)
    received = rng.standard_exponential((64, 50)).astype(np.float32)
    gain = (2.0 ** rng.integers(0, 12, 64)).astype(np.float32)
    response = PointResponse(PARABOLA, PARABOLA, gain, 0.0, 0.0, 0.0)
    compensated = dataclasses.replace(heatmap(received * gain[:, None]), response=response)
    one, other = (Detector(RADAR, settings(kind, 0.05)).decisions(m) for m in (heatmap(received), compensated))
    assert one.any()
    assert np.array_equal(one, other)


def test_greatest_and_smallest_choose_their_side_of_a_step():
    """A step of 30 dB in range: the greatest-of noise is the high side's, the smallest-of the low one's."""
    power = np.ones((64, 64), dtype=np.float32)
    power[:, 32:] = 1000.0
    for kind, expected in (("go", 1000.0), ("so", 1.0)):
        noise = Detector(RADAR, settings(kind)).noise(heatmap(power))
        np.testing.assert_allclose(noise[:, [31, 32]], expected, rtol=1e-5)


@pytest.mark.parametrize("shape", [(0, 1, 0, 1), (0, 2, 1, 4), (1, 4, 0, 3), (1, 5, 2, 3), (2, 6, 1, 6)])
@pytest.mark.parametrize("angles", [13, 14, 15, 16])
def test_every_mean_is_that_of_brute_force(shape, angles):
    """Rings narrower and wider than the group of rows that is summed together, numbers of rows that groups leave."""
    guard_angle, train_angle, guard_range, train_range = shape
    ring = {"guard_angle": guard_angle, "train_angle": train_angle, "guard_range": guard_range}
    chosen = settings("ca", train_range=train_range, **ring)
    power = np.random.default_rng(sum(shape)).standard_exponential((angles, 21)).astype(np.float32)
    expected = [
        [definition.statistic(power.astype(float), a, r, chosen, 0) for r in range(21)] for a in range(len(power))
    ]
    np.testing.assert_allclose(Detector(RADAR, chosen).noise(heatmap(power)), expected, rtol=2e-6)


def test_a_peak_of_100_db_beside_does_not_touch_the_noise_estimate():
    power = np.random.default_rng(2).standard_exponential((256, 128)).astype(np.float32)
    strong = power.copy()
    strong[100, 60] = 1e10
    detector = Detector(RADAR, settings("ca"))
    quiet = detector.noise(heatmap(power)).copy()
    beside = detector.noise(heatmap(strong))
    ring, inside = detector.settings, np.zeros_like(power, dtype=bool)
    for value, a, r in ((True, ring.train_angle, ring.train_range), (False, ring.guard_angle, ring.guard_range)):
        inside[100 - a : 101 + a, 60 - r : 61 + r] = value
    assert np.array_equal(beside[~inside], quiet[~inside])
    expected = np.array(
        [definition.ring_values(power, a, r, detector.settings, 0).mean() for a, r in ((99, 61), (107, 70))]
    )
    measured = np.array([beside[99, 61], beside[107, 70]])
    np.testing.assert_allclose(measured, expected, rtol=1e-5)


def test_ordered_statistic_forgets_strong_neighbours():
    rng = np.random.default_rng(3)
    power = rng.standard_exponential((64, 64)).astype(np.float32)
    power[32, 32] = 100.0
    power[rng.integers(25, 40, 20), 38] = 1e10
    found = Detector(RADAR, settings("os", 1e-6)).process(heatmap(power))
    assert (np.abs(found.range_m - 32 * 0.05) < 0.05).any()
    averaged = Detector(RADAR, settings("ca", 1e-6)).process(heatmap(power))
    assert not (np.abs(averaged.range_m - 32 * 0.05) < 0.05).any()


def test_near_ranges_are_neither_tested_nor_averaged():
    power = np.random.default_rng(4).standard_exponential((64, 64)).astype(np.float32)
    leaking = power.copy()
    leaking[:, :12] *= 1e6
    chosen = settings("ca", 1e-2, min_range_m=0.6)
    one, other = (Detector(RADAR, chosen).decisions(heatmap(p)) for p in (power, leaking))
    assert np.array_equal(one, other)
    assert not other[:, :12].any()


def test_ring_wider_than_the_angle_axis_is_refused():
    with pytest.raises(ConfigError, match="train_angle"):
        Detector(RADAR, settings("ca", train_angle=16)).decisions(heatmap(np.ones((32, 64))))
