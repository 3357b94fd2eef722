# SPDX-License-Identifier: Apache-2.0
"""CFAR on correlated cells: effective numbers against brute force, false alarms of thermal noise through the chain."""

from __future__ import annotations

import numpy as np
import pytest
from dsp_radars import cascade_radar, single_chip_radar

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp import tables
from edge.dsp.detector import Detector
from edge.dsp.effective_cells import Ring, mean_cells, noise_correlation, rank_cells, shared_noise
from edge.dsp.imager import Imager
from edge.dsp.ring_tables import INDEPENDENT, RingTables
from edge.frames import RadarFrame

ANGLE = noise_correlation(tables.window("hann", 86, 42.5) ** 2, 256)
RANGE = noise_correlation(tables.window("hann", 256, 128.0) ** 2, 256)


def ring(low=-8, high=8, guard=(6, 2), train=(14, 8)):
    angle, ranges = np.arange(-train[0], train[0] + 1), np.arange(-train[1], train[1] + 1)
    inside = (ranges >= low) & (ranges <= high)
    boxes = np.abs(angle) <= train[0], np.abs(angle) <= guard[0], inside, inside & (np.abs(ranges) <= guard[1])
    return Ring(*(box.astype(float) for box in boxes))


def covariance(chosen):
    """Of the noise in all cells of a ring, the tested cell last."""
    inside = np.outer(chosen.angle, chosen.ranges) - np.outer(chosen.guard_angle, chosen.guard_ranges)
    a, r = np.nonzero(inside)
    a, r = np.append(a, len(chosen.angle) // 2), np.append(r, len(chosen.ranges) // 2)
    return ANGLE[(a[:, None] - a) % 256] * RANGE[(r[:, None] - r) % 256]


@pytest.mark.parametrize("cut", [(-8, 8), (1, 8), (-8, -1), (-8, 0), (-3, 8)])
def test_sums_over_pairs_and_triples_are_those_of_brute_force(cut):
    chosen, all_cells = ring(*cut), covariance(ring(*cut))
    rho = all_cells[:-1, :-1]
    assert chosen.cells == len(rho)
    orders = np.array([1, 2, 5])
    expected = [(np.abs(rho) ** (2 * n)).sum() for n in orders]
    np.testing.assert_allclose(chosen.pair_sum(ANGLE, RANGE, orders), expected, rtol=1e-9)
    assert chosen.triple_sum(ANGLE, RANGE) == pytest.approx(np.trace(rho @ rho @ rho).real, rel=1e-9)
    assert shared_noise(chosen, ANGLE, RANGE) == pytest.approx((np.abs(all_cells[-1, :-1]) ** 2).mean(), rel=1e-9)


@pytest.mark.parametrize("cut", [(-8, 8), (-8, -1)])
def test_the_mean_s_laplace_transform_is_the_determinant(cut):
    """exp(-T mean) of correlated exponential powers has the mean det(1 + T rho / N)^-1, exactly."""
    chosen, rho = ring(*cut), covariance(ring(*cut))[:-1, :-1]
    for factor in (5.0, 8.0, 11.0):
        exact = np.exp(-np.linalg.slogdet(np.eye(len(rho)) + factor / len(rho) * rho)[1])
        cells = mean_cells(chosen, ANGLE, RANGE, factor)
        assert (1.0 + factor / cells) ** -cells == pytest.approx(exact, rel=0.04)


@pytest.mark.parametrize("cut", [(-8, 8), (-2, 8), (3, 8)])
def test_independent_cells_count_fully(cut):
    chosen = ring(*cut)
    assert mean_cells(chosen, INDEPENDENT, INDEPENDENT, 7.0) == pytest.approx(chosen.cells, rel=1e-6)
    assert rank_cells(chosen, INDEPENDENT, INDEPENDENT, 0.75) == pytest.approx(chosen.cells, rel=1e-6)
    assert shared_noise(chosen, INDEPENDENT, INDEPENDENT) == 0.0


def test_share_below_a_quantile_scatters_as_the_expansion_says():
    """Exponential powers of two correlated complex Gaussians: both below the quantile, against a simulation."""
    rng = np.random.default_rng(4)
    z = rng.standard_normal((2, 400_000, 2)).view(np.complex128)[..., 0] / np.sqrt(2.0)
    rho = 0.8
    x, y = np.abs(z[0]) ** 2, np.abs(rho * z[0] + np.sqrt(1 - rho**2) * z[1]) ** 2
    pair = Ring(np.array([1.0, 1.0, 0.0]), np.zeros(3), np.ones(1), np.zeros(1))
    along = np.array([1.0, rho, 0.0, 0.0, 0.0, rho], dtype=np.complex128)
    for quantile in (0.5, 0.75, 0.9):
        below = np.stack((x, y)) < -np.log1p(-quantile)
        expected = quantile * (1 - quantile) / below.mean(axis=0).var()
        assert rank_cells(pair, along, INDEPENDENT, quantile) == pytest.approx(expected, rel=0.01)


def noise_frames(radar, count, seed):
    rng, layout = np.random.default_rng(seed), radar.schedule.layout
    for n in range(count):
        codes = np.rint(18.0 * rng.standard_normal(layout.shape, dtype=np.float32)).astype(np.int16)
        yield RadarFrame(radar.radar, n, n, codes, layout)


@pytest.mark.parametrize(
    ("p_fa", "frames"), [(1e-2, 30), (1e-3, 120), pytest.param(1e-4, 1500, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("window", ["hann", pytest.param("taylor", marks=pytest.mark.slow)])
def test_false_alarms_of_thermal_noise_are_as_designed(p_fa, frames, window):
    """Every cell of a cascade's heatmap beyond 0.6 m, all directions, both ends of range."""
    radar = cascade_radar()
    imager = Imager(radar, HeatmapSettings(range_window=window, angle_window=window), AntennaSettings())
    detectors = [Detector(radar, CfarSettings(kind=kind, p_fa=p_fa)) for kind in ("ca", "go", "so", "os")]
    rates = np.zeros(4)
    for frame in noise_frames(radar, frames, 11):
        heatmap = imager.process(frame)
        tested = heatmap.range_m >= 0.6
        rates += [d.decisions(heatmap)[:, tested].mean() / frames for d in detectors]
    np.testing.assert_allclose(rates, p_fa, rtol=0.2)


@pytest.mark.slow
def test_eight_elements_keep_the_false_alarm_rate_too():
    radar = single_chip_radar()
    imager = Imager(radar, HeatmapSettings(angle_bins=64), AntennaSettings())
    chosen = {"p_fa": 1e-2, "guard_angle": 14, "train_angle": 24}
    detectors = [Detector(radar, CfarSettings(kind=kind, **chosen)) for kind in ("ca", "go", "so", "os")]
    rates = np.zeros(4)
    for frame in noise_frames(radar, 150, 12):
        heatmap = imager.process(frame)
        rates += [d.decisions(heatmap)[:, heatmap.range_m >= 0.6].mean() / 150 for d in detectors]
    np.testing.assert_allclose(rates, 1e-2, rtol=0.2)


def test_cells_taken_as_independent_have_the_textbook_factor():
    response = Imager(cascade_radar(), HeatmapSettings(), AntennaSettings())._response
    plain = RingTables.of(CfarSettings(correlated=False), 256, 10, response)
    assert np.array_equal(plain.factor, RingTables.of(CfarSettings(), 256, 10).factor)
    assert np.all(RingTables.of(CfarSettings(), 256, 10, response).factor[12:] > 1.1 * plain.factor[12:])
