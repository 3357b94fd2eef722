# SPDX-License-Identifier: Apache-2.0
"""One loop at 10 m/s: sidelobes of a static scene as at rest, places kept, noise as one loop's.

Lobes are sought in the field of view, 45 degrees to both sides; rows beyond belong to no direction that is steered.
"""

from __future__ import annotations

import numpy as np
import pytest
from dsp_radars import cascade_radar, place, settled

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp import tables, tdm
from edge.dsp.beam_weights import channel_pairs
from edge.dsp.buffers import zeros as floats
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.dsp.kernels_weights import level_lobes
from edge.reference.point_targets import make_frame

FLAT = AntennaSettings(along_loss_db=0.0)
BIN = 1.0 / (256 * 0.51264)
WINDOWS = ("rectangular", "hann", "taylor")
FORWARD, ALONG, BACKWARD, WALKING = (10.0, 0.0), (0.0, 10.0), (0.0, -10.0), (1.5, 0.0)


def highest_lobe_db(heatmap):
    """Highest power of the field of view beyond the main lobe's first minima, in the range row of the peak."""
    row = heatmap.power[:, heatmap.power.max(axis=0).argmax()].astype(float)
    peak = int(row.argmax())
    right = peak + int(np.argmax(np.diff(row[peak:]) > 0.0))
    left = peak - int(np.argmax(np.diff(row[: peak + 1][::-1]) > 0.0))
    inside = np.abs(heatmap.direction_cosine) < tdm.FOV_COSINE
    inside[left + 1 : right] = False
    return 10.0 * np.log10(row[inside].max() / row[peak])


def frame_of(radar, range_m, angle_deg, velocity):
    return make_frame(radar, [place(range_m, angle_deg)], 1e3, 0, 0, velocity_rig_m_s=[*velocity, 0.0])


@pytest.fixture(scope="module", params=WINDOWS)
def imagers(request):
    """With 512 angle bins to see the lobes' tops, and with the usual 256."""
    radar, window = cascade_radar(), request.param
    settings = (HeatmapSettings(angle_window=window, range_window="hann", angle_bins=bins) for bins in (512, 256))
    return radar, window, *(Imager(radar, chosen, FLAT) for chosen in settings)


@pytest.mark.parametrize(("range_m", "angles_deg"), [(3.0, (-25.0, 20.0)), (6.0, (-40.0, -20.0, 0.0, 10.0, 35.0))])
def test_lobes_at_speed_are_within_1_db_of_rest(imagers, range_m, angles_deg):
    radar, window, fine, _ = imagers
    for angle_deg in angles_deg:
        resting = highest_lobe_db(fine.process(frame_of(radar, range_m, angle_deg, (0.0, 0.0)), np.zeros(3)))
        for velocity in (WALKING, FORWARD, ALONG, BACKWARD):
            if velocity == BACKWARD and window != "rectangular":
                continue
            moving = settled(fine, frame_of(radar, range_m, angle_deg, velocity), [*velocity, 0.0])
            assert highest_lobe_db(moving) < resting + 1.0, (velocity, angle_deg)


def test_against_the_array_gaps_leave_lobes(imagers):
    """Blocks of four elements drift apart to 1.47 elements: 0.75 wavelengths; low windows stay at -20 to -25 dB."""
    radar, _, fine, _ = imagers
    for angle_deg in (-40.0, -20.0, 0.0, 10.0, 35.0):
        moving = settled(fine, frame_of(radar, 6.0, angle_deg, BACKWARD), [*BACKWARD, 0.0])
        assert highest_lobe_db(moving) < (-17.0 if imagers[1] == "rectangular" else -20.0)


@pytest.mark.parametrize("velocity", [FORWARD, ALONG, BACKWARD, (7.0, -7.0)])
def test_places_are_within_a_twentieth_of_a_bin(imagers, velocity):
    radar, _, _, usual = imagers
    detector = Detector(radar, CfarSettings(kind="os"))
    for range_m, angle_deg in ((3.0, -20.0), (6.0, -40.0), (6.0, 0.0), (6.0, 10.0), (9.0, 35.0)):
        found = detector.process(settled(usual, frame_of(radar, range_m, angle_deg, velocity), [*velocity, 0.0]))
        assert abs(found.direction_cosine[0] - np.sin(np.radians(angle_deg))) < 0.05 * BIN
        assert abs(found.range_m[0] - range_m) < 1.5e-3


@pytest.mark.parametrize("velocity", [FORWARD, ALONG, BACKWARD])
def test_noise_rises_by_1_5_db_at_most(imagers, velocity):
    _, window, _, usual = imagers
    geometry = usual.geometry
    taper = tables.window(window, geometry.count, 0.5 * (geometry.count - 1))
    resting = np.square(geometry.channel_weight(taper / taper.sum())).sum()
    steering = usual._steering
    for sector in steering.sectors(velocity[0], 1):
        weight = steering.beam_weights.of(sector, *velocity)
        assert weight.sum() == pytest.approx(1.0, abs=1e-9)
        assert np.square(weight).sum() < 10.0**0.15 * resting


def solved(step, point, beyond, element, slot, main_lobe, ridge, rounds):
    """Weights of channels at these elements and slots, and their highest lobe, by the kernel."""
    index = np.stack((element, slot))
    pair, of = channel_pairs(index)
    elements, slots, points, n = element.max() + 1, slot.max() + 1, len(beyond), len(element)
    weight, scratch = np.zeros((3, n)), (floats((2, elements, points)), floats((4, slots, points)))
    place = index - 0.5 * np.array([[elements - 1.0], [slots - 1.0]])
    highest = level_lobes(
        *(step, point, beyond, place, index, pair, of, main_lobe, ridge, 0.0, rounds),
        *(*scratch, floats((6, points)), np.zeros(pair.shape[1]), np.zeros((n, n)), weight),
    )
    return highest, weight[0], np.exp(1j * step.T @ place) * point[0][:, None]


def test_first_round_is_the_ridge_regression():
    rng = np.random.default_rng(5)
    channels = [(e, s) for s in range(3) for e in (s, s + 1, s + 4)]
    element, slot = np.array(channels).T
    step, beyond = rng.uniform(-3.0, 3.0, (2, 31)), rng.random(31) < 0.5
    point = np.stack((rng.uniform(0.2, 1.0, 31), np.where(beyond, 0.0, rng.random(31))))
    highest, weight, rows = solved(step, point, beyond, element.copy(), slot.copy(), 2.0, 0.1, 1)
    emphasis = np.where(beyond, 1.0, 2.0) / 31
    normal = (rows.T * emphasis @ rows.conj()).real + 0.1 * np.eye(9)
    expected = np.linalg.solve(normal, (emphasis * point.prod(axis=0)) @ rows.real)
    np.testing.assert_allclose(weight, expected / expected.sum(), rtol=1e-5, atol=1e-7)
    assert highest == pytest.approx(np.abs(rows @ weight)[beyond].max(), rel=1e-5)


def test_more_rounds_level_the_lobes():
    """A uniform line of 16: the lowest equal lobes for a main lobe to the window's null are Dolph and Chebyshev's."""
    n, null = 16, 2.5 / 16
    step = np.stack((2.0 * np.pi * np.r_[0.0, np.linspace(null, 0.5, 200)], np.zeros(201)))
    beyond = np.arange(201) > 0
    point = np.stack((np.ones(201), np.where(beyond, 0.0, 1.0)))
    highest, _, _ = solved(step, point, beyond, np.arange(n), np.zeros(n, dtype=np.int64), 2.0, 1e-5, 200)
    chebyshev = 1.0 / np.cosh((n - 1) * np.arccosh(1.0 / np.cos(np.pi * null)))
    assert highest == pytest.approx(chebyshev, rel=0.05)


def ramp_up(imager, frame, speeds_m_s):
    """Powers of a frame seen at these speeds ahead, one after the other, and the sectors solved for in each."""
    powers, solves = [], []
    for speed_m_s in speeds_m_s:
        before = imager._steering.beam_weights.solved
        powers.append(imager.process(frame, np.array([speed_m_s, 0.0, 0.0])).power.copy())
        solves.append(imager._steering.beam_weights.solved - before)
    return powers, solves


@pytest.fixture(scope="module")
def frame():
    return frame_of(cascade_radar(), 6.0, 10.0, (5.0, 0.0))


class TestNewSpeeds:
    """Weights of a new speed are solved for one sector a frame, by the frames alone."""

    def test_no_frame_waits_for_more_than_one_sector(self, frame):
        speeds_m_s = [*np.linspace(1.0, 8.0, 25), *8 * [8.0]]
        first, again = (Imager(cascade_radar(), HeatmapSettings(), FLAT) for _ in range(2))
        powers, solves = ramp_up(first, frame, speeds_m_s)
        assert max(solves) == 1
        assert solves[-1] == 0
        for one, other in zip(powers, ramp_up(again, frame, speeds_m_s)[0], strict=True):
            np.testing.assert_array_equal(one, other)

    def test_a_constant_speed_is_done_after_as_many_frames_as_sectors(self, frame):
        imager = Imager(cascade_radar(), HeatmapSettings(), FLAT)
        sectors = imager._steering.sectors(8.0, 1)
        powers, solves = ramp_up(imager, frame, (len(sectors) + 3) * [8.0])
        assert solves == [1] * len(sectors) + 3 * [0]
        for n, sector in enumerate(sectors):
            done, waiting = slice(sector.first, sector.last), slice(sector.last, None)
            np.testing.assert_array_equal(powers[n][done], powers[-1][done])
            assert waiting.start == len(powers[n]) or (powers[n][waiting] != powers[-1][waiting]).any()

    def test_along_the_array_the_first_frame_is_the_last_word(self, frame):
        imager = Imager(cascade_radar(), HeatmapSettings(), FLAT)
        powers = [imager.process(frame, np.array([0.0, 8.0, 0.0])).power.copy() for _ in range(2)]
        np.testing.assert_array_equal(*powers)
        assert imager._steering.beam_weights.solved == 1

    def test_several_maps_of_a_frame_solve_once(self):
        imager = Imager(cascade_radar(), HeatmapSettings(), FLAT)
        frame = make_frame(cascade_radar(), [place(6.0, 10.0)], 1e3, 0, 0)
        for n in range(3):
            assert imager.process(frame, np.array([5.0, 0.0, 2.0])).maps > 1
            assert imager._steering.beam_weights.solved == n + 1

    def test_recalibrated_is_as_new(self, frame):
        first, again = (Imager(cascade_radar(), HeatmapSettings(), FLAT) for _ in range(2))
        ramp_up(first, frame, 8 * [8.0])
        first.recalibrate(first.radar.calibration)
        (power,), solves = ramp_up(first, frame, [8.0])
        assert solves == [1]
        np.testing.assert_array_equal(power, again.process(frame, np.array([8.0, 0.0, 0.0])).power)
