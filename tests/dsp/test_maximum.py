# SPDX-License-Identifier: Apache-2.0
"""Noise of the largest of several maps: closed forms for independent and equal maps, simulated Gaussian noise else."""

from __future__ import annotations

import numpy as np
import pytest
from dsp_radars import cascade_radar

from edge.config import AntennaSettings, HeatmapSettings
from edge.dsp.effective_cells import Ring, mean_cells, rank_cells, shared_noise
from edge.dsp.imager import Imager
from edge.dsp.maximum import Maximum, both_above
from edge.dsp.threshold import cfar_scale


def independent(maps, angles=8):
    correlation = np.zeros((maps, angles))
    correlation[0, 0] = 1.0
    return Maximum.of(correlation)


def noise(rng, *shape):
    return rng.standard_normal((*shape, 2)).view(np.complex128)[..., 0] / np.sqrt(2.0)


class TestBothAbove:
    def test_independent_and_equal_powers(self):
        level = np.array([0.1, 1.0, 5.0, 20.0])
        np.testing.assert_allclose(both_above(level, 0.0), np.exp(-2.0 * level), rtol=1e-12)
        np.testing.assert_allclose(both_above(level, 1.0), np.exp(-level), rtol=1e-12)

    @pytest.mark.parametrize("correlation", [0.3, 0.73, 0.975])
    def test_is_the_integral_of_the_conditional_probability(self, correlation):
        """Given X = u, Y is a noncentral chi-square variable of two degrees of freedom (Rice)."""
        ncx2 = pytest.importorskip("scipy.stats").ncx2
        for level in (0.5, 2.0, 7.0):
            u = level + (np.arange(40_000) + 0.5) * 1e-3
            given = ncx2.sf(2.0 * level / (1.0 - correlation), 2, 2.0 * correlation * u / (1.0 - correlation))
            expected = (np.exp(-u) * given).sum() * 1e-3
            assert both_above(np.array([level]), correlation)[0] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("maps", [2, 4, 8])
def test_independent_maps_have_the_known_distribution(maps):
    """F_1^n; the maximum is a sum of E_j / j (Renyi 1953): mean H_n, variance sum 1 / j^2."""
    maximum, j = independent(maps), np.arange(1, maps + 1)
    np.testing.assert_allclose(maximum.below, maps * np.log1p(-np.exp(-maximum.level)), rtol=1e-9)
    assert maximum.mean == pytest.approx((1.0 / j).sum(), rel=1e-3)
    assert maximum.relative_variance == pytest.approx((1.0 / j**2).sum() / (1.0 / j).sum() ** 2, rel=1e-3)
    assert maximum.share == pytest.approx((1.0 / j).sum() ** 2 / maps / (1.0 / j**2).sum(), rel=2e-3)
    assert maximum.quantile(0.5) == pytest.approx(-np.log1p(-(0.5 ** (1.0 / maps))), rel=1e-3)


@pytest.mark.parametrize("p_fa", [1e-2, 1e-5])
def test_equal_maps_are_one_map(p_fa):
    maximum = Maximum.of(np.ones((5, 8)))
    assert maximum.share == pytest.approx(1.0, abs=2e-3)
    for kind, cells, other in (("ca", 36.6, 0.0), ("go", 18.6, 12.0), ("so", 18.6, 12.0), ("so", 5.0, 0.0)):
        expected = cfar_scale(kind, cells, p_fa, other=other)
        assert maximum.scale(kind, cells, p_fa, other=other) == pytest.approx(expected, rel=5e-3)
    assert maximum.scale("os", 48.0, p_fa, 36.0) == pytest.approx(cfar_scale("os", 48.0, p_fa, 36.0), rel=5e-3)


@pytest.mark.parametrize("kind", ["ca", "so", "os"])
def test_independent_maps_and_cells_have_the_simulated_false_alarms(kind):
    rng, cells, maps = np.random.default_rng(2), 24, 6
    power = rng.exponential(size=(100_000, cells + 1, maps)).max(axis=2)
    ring = power[:, 1:]
    statistic = ring.mean(axis=1) if kind == "ca" else np.partition(ring, 17, axis=1)[:, 17]
    if kind == "so":
        statistic = np.minimum(ring[:, :12].mean(axis=1), ring[:, 12:].mean(axis=1))
    halves = (12, 12) if kind == "so" else (cells, 0)
    factor = independent(maps).scale(kind, halves[0], 1e-2, 18.0, halves[1])
    assert (power[:, 0] > factor * statistic).mean() == pytest.approx(1e-2, rel=0.1)


@pytest.fixture(scope="module", params=[(13, 1), (13, 3), (21, 3)])
def across(request):
    """Noise of the row's channels, summed for every map and direction: |rho|^2, and the largest power of 1500 draws."""
    maps, loops = request.param
    radar = cascade_radar("vertical", loops=loops)
    imager, rng = Imager(radar, HeatmapSettings(), AntennaSettings()), np.random.default_rng(6)
    geometry, channels = imager.geometry, imager._channels
    taper = np.cos(np.pi * ((np.arange(geometry.count) + 0.5) / geometry.count - 0.5)) ** 2
    weight = geometry.channel_weight(taper)[channels.slot, channels.receiver]
    time_s = imager._transmit_time_s[channels.slot] + imager._loop_time_s * np.arange(loops)[:, None]
    wavelength_m = radar.schedule.profile.wavelength_m
    speeds_m_s = imager._across.step_m_s * np.arange(maps)
    turn = np.exp(4j * np.pi / wavelength_m * speeds_m_s[:, None, None] * time_s)
    steer = np.exp(2j * np.pi / 256 * np.outer(channels.element, np.arange(256)))
    largest = np.zeros((1500, 256))
    for draw in largest:
        row = (turn * (weight * noise(rng, *time_s.shape))).sum(axis=1)
        draw[:] = np.square(np.abs(row @ steer)).max(axis=0)
    return imager._across.correlation(maps, loops), largest / (loops * np.square(weight).sum())


def test_distribution_of_the_largest_map_is_the_simulated_one(across):
    correlation, largest = across
    maximum = Maximum.of(correlation)
    assert maximum.mean == pytest.approx(largest.mean(), rel=0.02)
    assert maximum.relative_variance == pytest.approx(largest.var() / largest.mean() ** 2, rel=0.06)
    for share in (0.5, 0.9, 0.99):
        assert maximum.quantile(share) == pytest.approx(np.quantile(largest, share), rel=0.02)


def test_cells_of_the_largest_map_correlate_as_simulated(across):
    """By the scatter of the mean over 29 neighbouring cells, which CFAR needs; one map's cells count half as much."""
    correlation, largest = across
    maximum = Maximum.of(correlation)
    along, across_range = np.sqrt(maximum.correlation).astype(complex), np.array([1.0 + 0.0j])
    ring = Ring(np.ones(29), np.zeros(29), np.ones(1), np.zeros(1))
    total = ring.pair_sum(along, across_range, np.arange(1, 129))
    share = maximum.share
    variance = share * ((1.0 - share) ** np.arange(128) @ total) / 29**2
    means = np.mean([np.roll(largest, shift, axis=1) for shift in range(29)], axis=0)
    assert variance == pytest.approx(means.var() / largest.var(), rel=0.1)
    alone = ring.pair_sum(np.sqrt(correlation[0]).astype(complex), across_range, np.array([1]))[0] / 29**2
    assert alone < 0.8 * variance


def test_share_of_higher_orders_is_that_of_every_pair():
    """Sums of beta c / (1 - (1 - beta) c) and of the quantile's expansion in it, against every pair of cells."""
    rng = np.random.default_rng(1)
    spectrum = rng.uniform(0.2, 1.0, 12)
    along = np.fft.fft(np.r_[spectrum, np.zeros(20)]) / spectrum.sum()
    ring = Ring(np.ones(7), np.r_[0, 0, 1, 1, 1, 0, 0].astype(float), np.ones(1), np.ones(1))
    cells, beta = np.array([-3, -2, 2, 3]), 0.6
    c = np.square(np.abs(along[(cells[:, None] - cells) % 32]))
    of = beta * c / (1.0 - (1.0 - beta) * c)
    one = np.array([1.0 + 0.0j])
    skewed = mean_cells(ring, along, one, 6.0)
    assert mean_cells(ring, along, one, 6.0, beta) == pytest.approx(skewed * c.sum() / of.sum(), rel=1e-9)
    tested = np.square(np.abs(along[cells % 32]))
    expected = (beta * tested / (1.0 - (1.0 - beta) * tested)).mean()
    assert shared_noise(ring, along, one, beta) == pytest.approx(expected, rel=1e-9)
    x, laguerre = np.log(4.0), np.polynomial.laguerre.Laguerre
    orders = np.arange(1, 129)
    q = np.exp(-x) * np.array([laguerre.basis(n)(x) - laguerre.basis(n - 1)(x) for n in orders])
    pairs = np.array([(of**n).sum() for n in orders])
    expected = 16 * 0.75 * 0.25 / float(q**2 @ pairs + 4.0 * (0.75 * 0.25 - (q**2).sum()))
    assert rank_cells(ring, along, one, 0.75, beta) == pytest.approx(expected, rel=2e-3)
