# SPDX-License-Identifier: Apache-2.0
"""Tables and small formulas of the DSP against numpy and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from edge.config import AntennaSettings
from edge.dsp import tables, tdm
from edge.dsp.antenna import across_loss_db, along_loss_db
from edge.dsp.interpolation import fit_response


@pytest.mark.parametrize("points", [64, 128, 256, 512, 1024, 2048])
@pytest.mark.parametrize("sign", [-1, 1])
def test_stages_and_row_order_make_a_fourier_transform(points, sign):
    """The stages written as numpy, fed with the tables, against numpy's own transform."""
    rng = np.random.default_rng(points)
    x = rng.standard_normal(points) + 1j * rng.standard_normal(points)
    twiddle = tables.twiddles(points, sign, 0).astype(float).reshape(-1, 3, 2)
    work, start, done = x.copy(), 0, 1
    for quarter in tables.stage_quarters(points):
        a, b, c, d = work.reshape(done, 4, quarter).transpose(1, 0, 2)
        w = (twiddle[start : start + quarter] @ (1, 1j)).T
        j = 1j * sign
        parts = (a + b + c + d, (a + j * b - c - j * d) * w[0], (a - b + c - d) * w[1], (a - j * b - c + j * d) * w[2])
        work = np.stack(parts, axis=1).reshape(-1)
        start, done = start + quarter, 4 * done
    if done < points:
        pair = work.reshape(-1, 2)
        work = np.stack((pair[:, 0] + pair[:, 1], pair[:, 0] - pair[:, 1]), axis=1).reshape(-1)
    expected = np.fft.fft(x) if sign < 0 else np.fft.ifft(x) * points
    np.testing.assert_allclose(work, expected[tables.frequency_of_row(points)], atol=1e-4)


def test_expanded_twiddles_repeat_every_lane():
    narrow, wide = tables.twiddles(64, -1, 0), tables.twiddles(64, -1, 4)
    assert len(wide) == 4 * len(narrow)
    first = wide[: 6 * 16 * 4].reshape(6, 16, 4)
    assert np.array_equal(first[:, :, 0].T.ravel(), narrow[: 6 * 16])
    assert np.array_equal(first[:, :, 0], first[:, :, 3])


def test_hann_windows_are_symmetric_about_their_centre():
    n = np.arange(256)
    np.testing.assert_allclose(tables.window("hann", 256, 128.0), np.sin(np.pi * n / 256) ** 2, atol=1e-15)
    array = tables.window("hann", 86, 42.5)
    np.testing.assert_allclose(array, array[::-1], atol=1e-15)
    assert array[0] > 0
    assert tables.window("rectangular", 5, 2.5).tolist() == [1.0] * 5


@pytest.mark.parametrize("range_m", [0.5, 3.0, 100.0])
def test_curvature_is_the_extra_path(range_m):
    a, b = np.array([-0.05, 0.02]), np.array([0.06, 0.0])
    expected = np.hypot(range_m, a) + np.hypot(range_m, b) - 2 * range_m
    np.testing.assert_allclose(tables.curvature_m(range_m, a, b), expected, atol=1e-14)
    assert np.all(tables.curvature_m(np.inf, a, b) == 0)


def test_hann_fit_knows_the_closed_form():
    """A Hann line's bins are sin(pi d) / (pi d (1 - d^2)): the parabola's error must be removed everywhere."""
    fit = fit_response(tables.window("hann", 256, 128.0), 256, np.ones(1), np.zeros(1))
    for d in np.linspace(-0.49, 0.49, 21):
        amplitude = [np.abs(np.sinc(x) / (1 - x * x)) if abs(abs(x) - 1) > 1e-9 else 0.5 for x in (d + 1, d, d - 1)]
        p = 0.5 * (amplitude[2] - amplitude[0]) / (2 * amplitude[1] - amplitude[0] - amplitude[2])
        assert abs(p + p * (1 - 4 * p * p) * (fit[0] + fit[1] * p * p) - d) < 1e-3
        assert amplitude[1] * (fit[4] + fit[5] * d**2 + fit[6] * d**4) == pytest.approx(1.0, abs=2e-3)


def test_rectangular_range_window_is_read_by_the_two_point_formula():
    assert fit_response(np.ones(256), 256, np.ones(1), np.zeros(1))[9] == 1.0
    assert fit_response(np.ones(182), 256, np.ones(1), np.zeros(1))[9] == 0.0


def test_coherent_loops_follow_the_written_rule():
    """0.25 m/s of travel at 8 loops (design, section 4)."""
    wavelength_m, loop_s = 299792458.0 / 78.74e9, 12 * 45e-6
    travel = np.array([0.0, 0.249, 0.0])
    assert tdm.coherent_loops(tdm.radial_speed_in_fov_m_s(travel), wavelength_m, loop_s, 8) == 8
    assert tdm.coherent_loops(tdm.radial_speed_in_fov_m_s(1.01 * travel), wavelength_m, loop_s, 8) == 7
    assert tdm.coherent_loops(0.0, wavelength_m, loop_s, 64) == 64
    assert tdm.coherent_loops(50.0, wavelength_m, loop_s, 64) == 1


@pytest.mark.parametrize("velocity", [(1.0, 0, 0), (0, -1.0, 0), (0, 0, 1.0), (0.5, 0.5, 0), (-0.3, 0.8, 0.1)])
def test_radial_speed_is_the_largest_in_the_field_of_view(velocity):
    velocity = np.array(velocity)
    cosine = np.linspace(np.sqrt(0.5), 1, 2001)
    across = np.hypot(velocity[1], velocity[2])
    largest = (abs(velocity[0]) * cosine + across * np.sqrt(1 - cosine**2)).max()
    assert tdm.radial_speed_in_fov_m_s(velocity) == pytest.approx(largest, rel=1e-5)


def test_doppler_phasors_are_those_of_the_bin_s_speed():
    """v = lambda k / (2 slots Tc L)."""
    time_s = np.arange(12) * 45e-6
    speed = 0.0038 * 3 / (2 * 12 * 45e-6 * 8)
    np.testing.assert_allclose(tdm.doppler_phasors(3, 8, 12), tdm.speed_phasors(speed, time_s, 0.0038), atol=1e-6)


def test_antenna_loss_is_quadratic_and_capped():
    antenna = AntennaSettings()
    assert along_loss_db(antenna, np.sin(np.radians(35.0))) == pytest.approx(1.5)
    assert along_loss_db(antenna, 0.0) == 0.0
    assert across_loss_db(antenna, np.sin(np.radians(20.0))) == pytest.approx(6.0)
    assert across_loss_db(antenna, [1.0, -2.0]).tolist() == [15.0, 15.0]


@pytest.mark.parametrize(("nbar", "sidelobe_db"), [(4, 30.0), (5, 35.0), (8, 45.0)])
def test_taylor_windows_are_scipys_and_keep_their_sidelobes(nbar, sidelobe_db):
    windows = pytest.importorskip("scipy.signal.windows")
    taper = tables.window("taylor", 86, 42.5, nbar, sidelobe_db)
    np.testing.assert_allclose(taper, windows.taylor(86, nbar, sidelobe_db, norm=True), atol=1e-12)
    response = np.abs(np.fft.fft(taper, 64 * 86)) / taper.sum()
    beyond = response[int(64 * tables.main_lobe(taper, 86)) + 64 : 64 * 43]
    assert 20 * np.log10(beyond.max()) == pytest.approx(-sidelobe_db, abs=1.0)


@pytest.mark.parametrize(("name", "count", "bins"), [("hann", 256, 256), ("hann", 86, 256), ("taylor", 86, 256)])
def test_no_bin_of_a_point_exceeds_its_envelope(name, count, bins):
    taper, n = tables.window(name, count, (count - 1) / 2), np.arange(count)
    envelope, distance = tables.response_envelope(taper, bins), np.minimum(np.arange(bins), bins - np.arange(bins))
    beyond = distance >= tables.main_lobe(taper, bins) + 0.5
    for offset in np.linspace(-0.5, 0.5, 21):
        line = np.abs(np.fft.fft(taper * np.exp(2j * np.pi * n * offset / bins), bins))
        assert np.all((line <= line[0] * envelope * (1 + 1e-9))[beyond])


@pytest.mark.parametrize("points", [64, 128, 256, 512, 1024])
def test_last_stage_ends_in_natural_order(points):
    order, last = tables.last_stage_order(points), points // len(tables.last_stage_order(points))
    frequency = tables.frequency_of_row(points)
    groups = points // last
    for p in range(last):
        np.testing.assert_array_equal(frequency[order + p], np.arange(groups) + p * groups)
