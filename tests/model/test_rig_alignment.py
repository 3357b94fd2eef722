# SPDX-License-Identifier: Apache-2.0
"""Mounting of two boards: measurements computed from a known geometry come back to it, and bad ones are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge.errors import CalibrationError, ConfigError
from edge.frames import RADARS
from edge.reflector_stops import Sight, Stop, StopFinder, read_survey
from edge.rig import load_rig
from edge.rig_alignment import align

RIG = load_rig("cascade_demo")
PLACES = [(5, 0, 0), (5, 2.5, 0.5), (5, -2.5, -0.4), (4, 0, 1.8), (4, 1, -0.7), (6, -2, 1.5), (4, -2, 1), (5, 2, 1.6)]
MOVED_M, OFFSET_M, POWER_DB = np.array([0.0, 0.02, -0.015]), 0.01, 1.2


def stops(places, noise=0.0, moved_m=MOVED_M, survey_m=None, turn_rad=0.0, seed=0):
    """Exact measurements of the boards, the vertical one moved, its ranges too short and its powers too low.

    ``turn_rad``: the vertical array leans forward by this angle about y.
    """
    rng = np.random.default_rng(seed)
    a, b = (np.array(RIG.radars[radar].mounting.position_m) for radar in RADARS)
    b = b + moved_m
    loss = RIG.settings.antenna.across_loss_db / RIG.settings.antenna.across_edge_deg**2
    found = []
    for place in np.array(places, dtype=float):
        r_h, r_v = np.linalg.norm(place - a), np.linalg.norm(place - b)
        u = (place - a)[1] / r_h
        w = (place - b) @ (np.sin(turn_rad), 0.0, np.cos(turn_rad)) / r_v
        e = rng.standard_normal(6) * (noise, noise, 100 * noise, noise, noise, 100 * noise)
        across = (place - a)[2] / r_h, (place - b)[1] / r_v
        level = [60.0 - 2 * loss * np.degrees(np.arcsin(c)) ** 2 for c in across]
        horizontal = Sight(r_h + e[0], u + e[1], level[0] + e[2])
        vertical = Sight(r_v - OFFSET_M + e[3], w + e[4], level[1] - POWER_DB + e[5])
        found.append(Stop(horizontal, vertical, 1, None if survey_m is None else place + survey_m))
    return found


def value(found, name):
    return next(estimate.value for estimate in found.estimates if estimate.name == name)


def test_exact_measurements_give_the_exact_mounting():
    found = align(RIG, stops(PLACES))
    assert value(found, "vertical y_m") == pytest.approx(MOVED_M[1], abs=3e-4)
    assert value(found, "vertical z_m") == pytest.approx(MOVED_M[2], abs=3e-4)
    assert value(found, "vertical range_offset_m") == pytest.approx(OFFSET_M, abs=3e-4)
    assert found.power_offset_db == pytest.approx(POWER_DB, abs=0.1)
    assert found.held == ("vertical x_m",)
    assert found.mounting["vertical"].position_m[1:] == pytest.approx((0.02, 0.125), abs=5e-4)
    assert found.mounting["horizontal"] == RIG.radars["horizontal"].mounting


def test_noise_stays_within_five_millimetres_and_its_standard_error():
    """40 draws of 1 mm and 0.001: rms errors below 5 mm and 0.2 dB, and as large as the standard errors say."""
    names, truth = ("vertical y_m", "vertical z_m", "vertical range_offset_m"), (*MOVED_M[1:], OFFSET_M)
    draws = [align(RIG, stops(PLACES, 1e-3, seed=seed)) for seed in range(40)]
    for name, true in zip(names, truth, strict=True):
        error = np.array([value(found, name) - true for found in draws])
        sigma = np.sqrt(np.mean([found.sigma(name) ** 2 for found in draws]))
        assert np.sqrt(np.mean(error**2)) < 0.005
        assert np.sqrt(np.mean(error**2)) == pytest.approx(sigma, rel=0.4)
    power = np.array([found.power_offset_db for found in draws]) - POWER_DB
    assert np.sqrt(np.mean(power**2)) < 0.2


def test_survey_shows_tilt_and_absolute_place():
    turn = np.radians(1.0)
    found = align(RIG, stops(PLACES, turn_rad=turn, survey_m=0.0))
    assert value(found, "vertical turn_y_rad") == pytest.approx(turn, abs=np.radians(0.05))
    assert value(found, "horizontal y_m") == pytest.approx(0.0, abs=1e-3)
    assert found.surveyed
    assert "[radars.horizontal.mounting]" in found.toml()


def test_snippet_is_a_rig_table(tmp_path):
    import tomllib

    found = align(RIG, stops(PLACES))
    mounting = tomllib.loads(found.toml())["radars"]["vertical"]["mounting"]
    assert mounting["position_m"] == pytest.approx(found.mounting["vertical"].position_m, abs=1e-4)
    assert mounting["power_offset_db"] == pytest.approx(1.2, abs=0.1)
    assert "held" in found.toml()


@pytest.mark.parametrize(
    ("places", "message"),
    [
        (PLACES[:2], "too few stops"),
        ([(5, 0, 0), (6, 0, 0), (4, 0.1, 0), (7, 0, 0)], "degenerate"),
        ([(5, 0, 0), (5, 2, 0), (5, -2, 0), (6, 1, 0)], r"degenerate.*vertical z_m"),
        ([(5, 0, 0), (5, 0, 1.5), (5, 0, -0.5), (6, 0, 1)], r"degenerate.*vertical y_m"),
    ],
)
def test_degenerate_stops_are_refused_with_what_stays_open(places, message):
    with pytest.raises(CalibrationError, match=message):
        align(RIG, stops(places))


def test_a_rig_of_one_radar_is_refused():
    with pytest.raises(ConfigError, match="one radar"):
        align(load_rig("corridor"), stops(PLACES))


def test_a_stop_on_another_echo_widens_the_errors():
    places = [*PLACES, (5, -1, 1.2), (4.5, 1.5, 1.5), (5.5, -2.5, 1), (4, 1.5, -0.5)]
    good, spoiled = align(RIG, stops(places)), stops(places)
    other = spoiled[2].horizontal
    spoiled[2] = Stop(Sight(other.range_m + 0.01, other.cosine, other.power_db), spoiled[2].vertical)
    bad = align(RIG, spoiled)
    assert bad.residual_rms > 1.5
    assert bad.sigma("vertical y_m") == pytest.approx(good.sigma("vertical y_m") * bad.residual_rms, rel=0.1)


def test_survey_file_is_read_and_refused_by_line(tmp_path):
    path = tmp_path / "s.csv"
    path.write_text("# from the rig origin\nx_m,y_m,z_m\n5,0,0\n 4.0, -2 ,1.5\n")
    assert np.array_equal(read_survey(path), [(5, 0, 0), (4, -2, 1.5)])
    for text, message in (("5,0\n", "line 1"), ("5,0,0\n5,nan,0\n", "line 2"), ("a,b,c\n", "line 1"), ("", "no place")):
        path.write_text(text)
        with pytest.raises(CalibrationError, match=message):
            read_survey(path)
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_survey(Path("nowhere.csv"))


def test_no_stop_is_refused():
    with pytest.raises(CalibrationError, match="no stop"):
        StopFinder(RIG).result()
