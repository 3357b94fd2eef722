# SPDX-License-Identifier: Apache-2.0
"""Motion inside the burst: sidelobes at speed, level, noise and places of steered sums, and the choice with its reason.

Known answers: a steered static scene looks as if the rig stood still; L loops that add up lower the noise by
10 log10 L dB; a point measured in the middle of the burst is moved back to the first chirp.
"""

from __future__ import annotations

import numpy as np
import pytest
from dsp_radars import cascade_radar, place, settled, single_chip_radar

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp import tdm
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import ConfigError, PoseError
from edge.reference.doppler import steered_power
from edge.reference.point_targets import make_frame

FLAT = AntennaSettings(along_loss_db=0.0)
STEER = HeatmapSettings(doppler="steer")
BIN = 1.0 / (256 * 0.51264)
FORWARD, ALONG, BACKWARD, WALKING = (10.0, 0.0), (0.0, 10.0), (0.0, -10.0), (1.5, 0.0)


@pytest.fixture(scope="module", params=[1, 8])
def radar(request):
    return cascade_radar(loops=request.param)


def seen(imager, radar, angle_deg, velocity, range_m=6.0, amplitude=1e3, **options):
    """Heatmap of one point seen from a moving rig; velocity along boresight and along the array."""
    velocity_rig = np.array([*velocity, 0.0])
    point = [place(range_m, angle_deg)]
    frame = make_frame(radar, point, amplitude, 0, 0, velocity_rig_m_s=velocity_rig, **options)
    return settled(imager, frame, velocity_rig)


def sidelobe_db(power):
    """Highest lobe beside the main one, in the range row of the peak, periodic in angle."""
    row = power[:, power.max(axis=0).argmax()].astype(float)
    row = np.roll(row, len(row) // 2 - row.argmax())
    right, left = row[len(row) // 2 :], row[: len(row) // 2 + 1][::-1]
    beyond = [half[int(np.argmax(np.diff(half) > 0)) :].max() for half in (right, left)]
    return 10 * np.log10(max(beyond) / row.max())


@pytest.fixture(scope="module")
def imager(radar):
    return Imager(radar, HeatmapSettings(angle_window="rectangular", angle_bins=2048, doppler="steer"), FLAT)


class TestSidelobes:
    """Of a static scene within 1 dB of standing still, at 10 m/s: five angles, one loop and eight."""

    @pytest.mark.parametrize("angle_deg", [-40.0, -20.0, 0.0, 10.0, 35.0])
    def test_at_speed_as_standing_still(self, imager, radar, angle_deg):
        still = sidelobe_db(seen(imager, radar, angle_deg, (0.0, 0.0)).power)
        assert still == pytest.approx(-13.0, abs=0.4)
        for velocity in (WALKING, FORWARD, ALONG, BACKWARD):
            assert sidelobe_db(seen(imager, radar, angle_deg, velocity).power) < still + 1.0
            assert imager.last_report.loops == radar.schedule.loops

    def test_motion_left_alone_spoils_them(self, imager, radar):
        frame = make_frame(radar, [place(6.0, -20.0)], 1e3, 0, 0, velocity_rig_m_s=[0.0, 10.0, 0.0])
        assert sidelobe_db(imager.process(frame, np.zeros(3)).power) > -6.0

    @pytest.mark.parametrize("velocity", [(0.0, 1.5), (0.0, -1.5), (1.5, 0.0)])
    def test_hann_at_walking_speed(self, radar, velocity):
        imager = Imager(radar, STEER, FLAT)
        for angle_deg in (-20.0, 10.0):
            still = sidelobe_db(seen(imager, radar, angle_deg, (0.0, 0.0)).power)
            assert sidelobe_db(seen(imager, radar, angle_deg, velocity).power) < still + 1.0

    @pytest.mark.parametrize("velocity", [ALONG, BACKWARD])
    def test_hann_with_eight_loops_at_ten_metres_a_second(self, velocity):
        """The moved loops fill each other's gaps, those of one loop stay (test_beam_weights.py)."""
        radar = cascade_radar(loops=8)
        imager = Imager(radar, STEER, FLAT)
        for angle_deg in (-40.0, -20.0, 0.0, 10.0, 35.0):
            still = sidelobe_db(seen(imager, radar, angle_deg, (0.0, 0.0)).power)
            assert sidelobe_db(seen(imager, radar, angle_deg, velocity).power) < still + 1.0


@pytest.mark.parametrize("velocity", [FORWARD, ALONG, BACKWARD, (7.0, -7.0), (0.5, 0.2)])
@pytest.mark.parametrize("angle_deg", [-40.0, 0.0, 20.0])
def test_places_are_those_of_the_first_chirp(radar, velocity, angle_deg):
    """At 10 m/s a point moves by 4 cm, 0.7 range bins or 0.9 angle bins at 6 m, while eight loops last."""
    imager, detector = Imager(radar, STEER, FLAT), Detector(radar, CfarSettings())
    found = detector.process(seen(imager, radar, angle_deg, velocity))
    assert abs(found.range_m[0] - 6.0) < 1.5e-3
    assert abs(found.direction_cosine[0] - np.sin(np.radians(angle_deg))) < 0.1 * BIN
    assert found.power_db[0] == pytest.approx(60.0, abs=0.6)
    assert np.isnan(found.doppler_m_s).all()


@pytest.mark.parametrize("velocity", [FORWARD, ALONG, (2.0, -1.0)])
def test_steering_recovers_the_noise_of_all_loops(velocity):
    radar = cascade_radar(loops=8)
    rng = np.random.default_rng(1)
    noise = make_frame(radar, [place(6.0, 0.0)], 0.0, 0, 0, noise_lsb=25.0, rng=rng)
    velocity_rig = np.array([*velocity, 0.0])
    levels = {}
    for doppler in ("single", "steer"):
        imager = Imager(radar, HeatmapSettings(doppler=doppler), FLAT)
        power = imager.process(noise, velocity_rig).power[40:216]
        levels[imager.last_report.choice] = 10 * np.log10(power.mean())
    assert set(levels) == {"single", "steer"}
    assert levels["single"] - levels["steer"] > 10 * np.log10(8) - 0.3


@pytest.mark.parametrize(
    ("loops", "velocity"), [(1, (0.0, 3.0)), (1, (10.0, 0.0)), (8, (0.0, -10.0)), (3, (2.0, -1.0))]
)
def test_steered_power_agrees_with_the_definition(loops, velocity):
    radar = cascade_radar(loops=loops)
    settings = HeatmapSettings(doppler="steer")
    imager = Imager(radar, settings, AntennaSettings())
    points, velocity_rig = [place(6.0, -40.0), place(4.0, 10.0)], np.array([*velocity, 0.0])
    frame = make_frame(radar, points, 1e3, 0, 0, velocity_rig_m_s=velocity_rig, noise_lsb=25.0)
    power = settled(imager, frame, velocity_rig).power
    sectors = [(s.centre, s.half_width, s.first, s.last) for s in imager._steering.sectors(velocity[0], loops)]
    beam_weights, used = imager._steering.beam_weights, imager._steering.sectors(velocity[0], loops)
    weights = [beam_weights.of(sector, *velocity) for sector in used] if loops == 1 else []
    expected = steered_power(radar, frame, settings, AntennaSettings(), loops, velocity, sectors, weights)
    rows = np.abs(imager.direction_cosine) < tdm.FOV_COSINE
    error = np.abs(np.sqrt(power) - np.sqrt(expected))[rows]
    assert error.max() < 2e-3 * np.sqrt(expected[rows].max())


class TestChoice:
    def test_of_one_loop(self):
        report = tdm.choose("auto", 1, 1, 1, 3.0)
        assert (report.name, report.loops, report.reason) == ("single", 1, "one loop in use")

    @pytest.mark.parametrize(
        ("wish", "coherent", "steerable", "expected", "loops"),
        [
            ("auto", 8, 8, "sum", 8),
            ("auto", 3, 8, "steer", 8),
            ("auto", 1, 5, "steer", 5),
            ("auto", 1, 1, "fft", 8),
            ("sum", 3, 8, "sum", 3),
            ("steer", 3, 8, "steer", 8),
            ("fft", 8, 8, "fft", 8),
            ("single", 8, 8, "single", 1),
        ],
    )
    def test_of_eight_loops(self, wish, coherent, steerable, expected, loops):
        choice = tdm.choose(wish, 8, coherent, steerable, 3.0)
        assert (choice.name, choice.loops) == (expected, loops)
        assert choice.reason

    def test_report_says_what_and_why(self):
        radar = cascade_radar(loops=8)
        imager = Imager(radar, HeatmapSettings(), FLAT)
        seen(imager, radar, 0.0, (2.0, 0.0))
        assert imager.last_report.choice == "steer"
        assert imager.last_report.reason == "at 2.00 m/s: 1 of 8 loops add up as they are, 8 steered"
        assert (
            imager.choice(None).reason
            == "no velocity given, taken as standing still: 8 of 8 loops add up without cancelling"
        )

    def test_too_fast_for_a_range_bin_uses_fewer_loops(self):
        """Eight loops last 4.3 ms: at 30 m/s a point passes 0.13 m, two bins."""
        imager = Imager(cascade_radar(loops=8), HeatmapSettings(), FLAT)
        bin_m = imager.radar.schedule.profile.range_bin_m
        choice = imager.choice(np.array([30.0, 0.0, 0.0]))
        assert (choice.name, choice.loops) == ("steer", int(bin_m / (30.0 * 12 * 45e-6)))

    def test_velocity_that_is_no_number_is_refused(self):
        radar = cascade_radar()
        frame = make_frame(radar, [place(6.0, 0.0)], 1e3, 0, 0)
        with pytest.raises(PoseError, match="velocity"):
            Imager(radar, HeatmapSettings(), FLAT).process(frame, np.array([np.nan, 0.0, 0.0]))

    def test_unknown_choice_is_refused(self):
        with pytest.raises(ConfigError, match=r"heatmap\.doppler"):
            HeatmapSettings(doppler="best")

    @pytest.mark.parametrize("make", [cascade_radar, single_chip_radar])
    def test_any_speed_gives_finite_power(self, make):
        radar = make(loops=5)
        imager = Imager(radar, HeatmapSettings(angle_bins=256), FLAT)
        frame = make_frame(radar, [place(6.0, 0.0)], 100.0, 0, 0, noise_lsb=25.0)
        rng = np.random.default_rng(0)
        for _ in range(20):
            velocity = rng.standard_normal(3) * 10 ** rng.uniform(-1, 5)
            assert np.isfinite(imager.process(frame, velocity).power).all()


class TestElevationRows:
    @pytest.mark.parametrize("which", ["horizontal", "vertical"])
    @pytest.mark.parametrize("array_sign", [1, -1])
    @pytest.mark.parametrize("across_deg", [-12.0, 0.0, 8.0])
    def test_phases_between_rows_tell_the_height(self, which, array_sign, across_deg):
        """A point out of the array's plane turns the row at elevation h by 2 pi h d w / lambda."""
        radar = cascade_radar(which, array_sign=array_sign)
        w, u, range_m = np.sin(np.radians(across_deg)), 0.25, 8.0
        forward = range_m * np.sqrt(1 - w * w - u * u)
        point = [forward, u * range_m, w * range_m] if which == "horizontal" else [forward, w * range_m, u * range_m]
        imager = Imager(radar, HeatmapSettings(), FLAT)
        heatmap = imager.process(make_frame(radar, [point], 1e3, 0, 0))
        range_bin = int(heatmap.power.max(axis=0).argmax())
        turns, beams = imager.elevation_beams(range_bin, u)
        assert np.abs(turns).round(3).tolist() == (0.5126 * np.array([0.0, 1.0, 4.0, 6.0])).round(3).tolist()
        relative = beams[1:] / beams[0] * np.exp(-2j * np.pi * turns[1:] * w)
        assert np.abs(np.angle(relative)).max() < 0.1
        assert np.abs(relative) == pytest.approx(1.0, abs=0.15)

    def test_rows_left_unread_have_no_beams(self):
        radar = cascade_radar()
        frame = make_frame(radar, [place(6.0, 0.0)], 1e3, 0, 0)
        both = [Imager(radar, HeatmapSettings(read_elevation=read), FLAT) for read in (True, False)]
        powers = [imager.process(frame).power for imager in both]
        assert np.array_equal(*powers)
        with pytest.raises(ConfigError, match="read_elevation"):
            both[1].elevation_beams(100, 0.0)

    def test_saturation_beside_the_row_is_seen_only_when_read(self):
        radar = cascade_radar()
        frame = make_frame(radar, [place(6.0, 0.0)], 100.0, 0, 0, noise_lsb=5.0)
        frame.adc[:, :, 11, :40] = 32767
        for read, expected in ((True, 40 / (12 * 256)), (False, 0.0)):
            settings = HeatmapSettings(read_elevation=read, max_saturated_share=0.5)
            imager = Imager(radar, settings, FLAT)
            imager.process(frame)
            assert imager.last_report.saturated_share == pytest.approx(expected)
