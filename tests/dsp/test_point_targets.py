# SPDX-License-Identifier: Apache-2.0
"""The float64 frame maker against the scalar definition of the beat signal."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from dsp_radars import C, cascade_radar, place, single_chip_radar

from edge.errors import CaptureError
from edge.reference.point_targets import element_positions_m, make_frame, pack, unpack
from edge.reference.repack import split_loop_sum


@pytest.mark.parametrize("which", ["horizontal", "vertical"])
@pytest.mark.parametrize("sign", [1, -1])
def test_every_sample_follows_the_equation(which, sign):
    radar = cascade_radar(which, loops=2, array_sign=sign, position_m=(0.01, 0.1, -0.2))
    points = np.array([[3.0, 0.4, 0.2], [7.0, -2.0, 1.0]])
    amplitude = np.array([900.0, 500.0j])
    velocity = np.array([0.7, -1.1, 0.3])
    frame = make_frame(radar, points, amplitude, 5, 77, velocity_rig_m_s=velocity)
    assert (frame.number, frame.t_first_chirp_ns) == (5, 77)
    samples = unpack(frame.adc, frame.layout)
    half = C / (2 * radar.array.design_frequency_hz)
    profile = radar.schedule.profile
    rng = np.random.default_rng(3)
    for _ in range(40):
        loop, slot, rx, n = (int(rng.integers(k)) for k in samples.shape)
        time_s = (loop * 12 + slot) * profile.chirp_time_s
        expected = 0.0
        for point, a in zip(points, amplitude, strict=True):
            position = point - velocity * time_s
            path = 0.0
            antennas = (
                (radar.array.tx_azimuth[slot], radar.array.tx_elevation[slot]),
                (radar.array.rx_azimuth[rx], radar.array.rx_elevation[rx]),
            )
            for azimuth, elevation in antennas:
                along, across = sign * (azimuth - 21.25) * half, sign * elevation * half
                offset = (0, along, across) if which == "horizontal" else (0, -across, along)
                path += np.linalg.norm(position - np.array(radar.mounting.position_m) - offset)
            phase = profile.center_frequency_hz * path / C
            phase += profile.slope_hz_per_s_actual * path / C * (n - 128) / profile.sample_rate_hz
            expected += a * np.exp(2j * np.pi * phase)
        assert abs(samples[loop, slot, rx, n] - expected) < 0.71


def test_vertical_board_is_the_horizontal_one_turned_about_boresight():
    horizontal = np.concatenate(element_positions_m(cascade_radar("horizontal")))
    vertical = np.concatenate(element_positions_m(cascade_radar("vertical")))
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(vertical, horizontal @ turn.T, atol=1e-12)


@pytest.mark.parametrize(
    "radar", [cascade_radar(loops=2), single_chip_radar(iq_order="QI"), single_chip_radar(iq_order="IQ", samples=182)]
)
def test_unpack_inverts_pack(radar):
    layout = radar.schedule.layout
    rng = np.random.default_rng(0)
    shape = (layout.loops, layout.slots, layout.devices * layout.rx, layout.samples)
    codes = rng.integers(-3000, 3000, (*shape, 2)).astype(float)
    samples = codes[..., 0] + 1j * codes[..., 1]
    for order in ("IQ", "QI"):
        turned = dataclasses.replace(layout, iq_order=order)
        assert np.array_equal(unpack(pack(samples, turned), turned), samples)


def test_dca1000_words_are_q0_q1_i0_i1():
    layout = single_chip_radar().schedule.layout
    samples = np.zeros((1, 3, 4, 256), dtype=complex)
    samples[0, 1, 2, 10:12] = 1 + 2j, 3 + 4j
    assert pack(samples, layout)[0, 1, 2, 5].tolist() == [2, 4, 1, 3]


def test_noise_has_the_stated_spread_and_loops_are_independent():
    radar = cascade_radar(loops=2)
    frame = make_frame(radar, [[3, 0, 0]], 0.0, 0, 0, noise_lsb=25.0, rng=np.random.default_rng(1))
    samples = unpack(frame.adc, frame.layout)
    assert samples.std() == pytest.approx(25.0, rel=0.01)
    assert abs(np.vdot(samples[0], samples[1])) / samples[0].size < 0.02 * 25.0**2


def test_codes_are_clipped_at_the_rails():
    frame = make_frame(cascade_radar(), [place(5, 0)], 1e6, 0, 0)
    assert (frame.adc.min(), frame.adc.max()) == (-32768, 32767)


def test_split_loop_sum_is_exact_and_in_cascade_order():
    rng = np.random.default_rng(2)
    total = rng.integers(-60000, 60000, (12, 16, 8, 2)).astype(np.int32)
    loops = split_loop_sum(total, 64)
    assert loops.shape == (4, 64, 12, 8, 4, 2)
    assert loops.dtype == np.int16
    summed = loops.sum(axis=1, dtype=np.int64)
    assert np.array_equal(summed[2, 0, :, 3], total[11, 11])
    assert np.array_equal(summed[0, 11, :, 1], total[0, 1])


def test_split_loop_sum_refuses_what_does_not_fit():
    with pytest.raises(CaptureError, match="int16 loops"):
        split_loop_sum(np.full((12, 16, 8, 2), 40000), 1)
