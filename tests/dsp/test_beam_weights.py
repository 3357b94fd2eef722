# SPDX-License-Identifier: Apache-2.0
"""One loop at 10 m/s: sidelobes of a static scene as at rest, places kept, noise as one loop's.

Lobes are sought in the field of view, 45 degrees to both sides; rows beyond belong to no direction that is steered.
"""

from __future__ import annotations

import numpy as np
import pytest
from dsp_radars import cascade_radar, place

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp import tables, tdm
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
            moving = fine.process(frame_of(radar, range_m, angle_deg, velocity), np.array([*velocity, 0.0]))
            assert highest_lobe_db(moving) < resting + 1.0, (velocity, angle_deg)


def test_against_the_array_gaps_leave_lobes(imagers):
    """Blocks of four elements drift apart to 1.47 elements: 0.75 wavelengths; low windows stay at -20 to -25 dB."""
    radar, _, fine, _ = imagers
    for angle_deg in (-40.0, -20.0, 0.0, 10.0, 35.0):
        moving = fine.process(frame_of(radar, 6.0, angle_deg, BACKWARD), np.array([*BACKWARD, 0.0]))
        assert highest_lobe_db(moving) < (-17.0 if imagers[1] == "rectangular" else -20.0)


@pytest.mark.parametrize("velocity", [FORWARD, ALONG, BACKWARD, (7.0, -7.0)])
def test_places_are_within_a_twentieth_of_a_bin(imagers, velocity):
    radar, _, _, usual = imagers
    detector = Detector(radar, CfarSettings(kind="os"))
    for range_m, angle_deg in ((3.0, -20.0), (6.0, -40.0), (6.0, 0.0), (6.0, 10.0), (9.0, 35.0)):
        found = detector.process(
            usual.process(frame_of(radar, range_m, angle_deg, velocity), np.array([*velocity, 0.0]))
        )
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
        weight = steering._beam_weights.of(sector, *velocity)
        assert weight.sum() == pytest.approx(1.0, abs=1e-9)
        assert np.square(weight).sum() < 10.0**0.15 * resting


def test_first_round_is_the_ridge_regression():
    rng = np.random.default_rng(5)
    rows, wanted, beyond = rng.standard_normal((62, 9)), rng.standard_normal(31), rng.random(31) < 0.5
    share = np.where(beyond, 1.0, 2.0) / 31
    normal = np.einsum("p,pki,pkj->ij", share, rows.reshape(31, 2, 9), rows.reshape(31, 2, 9)) + 0.1 * np.eye(9)
    expected = np.linalg.solve(normal, (share * wanted) @ rows[::2])
    weight = np.zeros((2, 9))
    highest = level_lobes(rows, wanted, beyond, 2.0, 0.1, 0.0, 1, np.zeros((9, 9)), weight)
    np.testing.assert_allclose(weight[0], expected / expected.sum(), rtol=1e-9)
    response = rows.reshape(31, 2, 9) @ weight[0]
    assert highest == pytest.approx(np.linalg.norm(response, axis=1)[beyond].max(), rel=1e-9)


def test_more_rounds_level_the_lobes():
    """A uniform line of 16: the lowest equal lobes for a main lobe to the window's null are Dolph and Chebyshev's."""
    n, null = 16, 2.5 / 16
    x, d = np.arange(n) - 7.5, np.linspace(null, 0.5, 200)
    phase = 2.0 * np.pi * np.outer(np.r_[0.0, d], x)
    rows = np.stack((np.cos(phase), np.sin(phase)), axis=1).reshape(-1, n)
    beyond = np.arange(201) > 0
    weight = np.zeros((2, n))
    highest = level_lobes(rows, np.where(beyond, 0.0, 1.0), beyond, 2.0, 1e-6, 0.0, 200, np.zeros((n, n)), weight)
    chebyshev = 1.0 / np.cosh((n - 1) * np.arccosh(1.0 / np.cos(np.pi * null)))
    assert highest == pytest.approx(chebyshev, rel=0.05)
