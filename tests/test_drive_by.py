# SPDX-License-Identifier: Apache-2.0
"""The small scene: geometry, visibility and levels by hand."""

from __future__ import annotations

import numpy as np
import pytest

from edge.config import AntennaSettings, RigGeometry
from edge.errors import ConfigError
from edge.reference.drive_by import (
    EPOCH_NS,
    DriveBy,
    DriveByScene,
    Surface,
    antenna_amplitude,
    place,
    poses,
    sample_surface,
    visible,
)
from edge.rig import load_rig

SQUARE = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def test_samples_lie_on_the_surface_and_spread_by_area() -> None:
    surface = sample_surface(SQUARE, FACES, 20_000, np.random.default_rng(0))
    assert np.all(surface.points_m[:, 1] == 0.0)
    assert surface.points_m.min(axis=0) == pytest.approx([0, 0, 0], abs=0.01)
    assert surface.points_m.mean(axis=0) == pytest.approx([1.0, 0.0, 0.5], abs=0.02)
    np.testing.assert_allclose(np.abs(surface.normals), np.tile([0.0, 1.0, 0.0], (20_000, 1)), atol=1e-12)


def test_the_object_stands_beside_the_middle_of_the_track() -> None:
    settings = DriveBy(frames=61, frame_period_s=0.1, speed_m_s=0.5, lateral_m=3.0)
    placed = place(SQUARE + np.array([0.0, 0.0, 7.0]), settings, yaw_deg=90.0)
    assert placed.min(axis=0) == pytest.approx([1.5, 3.0, 0.0])
    assert placed.max(axis=0) == pytest.approx([1.5, 5.0, 1.0])


def test_a_wall_hides_what_is_behind_it() -> None:
    wall = sample_surface(SQUARE * [2.0, 1.0, 3.0] + [-2.0, 2.0, -1.5], FACES, 40_000, np.random.default_rng(0))
    points = Surface(np.array([[0.0, 4.0, 0.0], [0.0, 2.0, 0.0], [6.0, 2.0, 0.0]]), np.zeros((3, 3)))
    assert visible(points, wall, np.zeros(3)).tolist() == [False, True, True]


def test_poses_cover_every_frame_and_look_to_the_left() -> None:
    settings = DriveBy(frames=10)
    track = poses(settings, RigGeometry(height_m=0.8, yaw_deg=90.0))
    assert track[0].t_ns < EPOCH_NS
    assert track[-1].t_ns > EPOCH_NS + 1e9 * settings.frames * settings.frame_period_s - 1e8
    seconds = (track[-1].t_ns - EPOCH_NS) / 1e9
    assert track[-1].position_m == pytest.approx([settings.speed_m_s * seconds, 0.0, 0.8], abs=1e-9)
    assert track[0].quaternion_xyzw == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_the_pattern_costs_its_loss_twice_at_the_edges() -> None:
    antenna = AntennaSettings()
    along = np.array([[np.cos(np.radians(70)), np.sin(np.radians(70)), 0.0]])
    across = np.array([[np.cos(np.radians(20)), 0.0, np.sin(np.radians(20))]])
    assert 20 * np.log10(antenna_amplitude("horizontal", along, antenna)) == pytest.approx(-12.0)
    assert 20 * np.log10(antenna_amplitude("horizontal", across, antenna)) == pytest.approx(-12.0)
    assert 20 * np.log10(antenna_amplitude("vertical", across, antenna)) == pytest.approx(-12.0 * (20 / 70) ** 2)


def test_a_frame_depends_on_nothing_but_its_number() -> None:
    rig = load_rig("cascade_demo")
    settings = DriveBy(frames=4, scatterers=20)
    arguments = (rig.radars, rig.geometry, rig.settings.antenna, place(SQUARE, settings), FACES, settings)
    first, second = DriveByScene(*arguments), DriveByScene(*arguments)
    late = second.frame("vertical", 3)
    first.frame("horizontal", 0)
    np.testing.assert_array_equal(first.frame("vertical", 3).adc, late.adc)
    half_period_s = 0.5 * rig.radars["vertical"].schedule.frame_period_s
    assert late.t_first_chirp_ns == EPOCH_NS + round(1e9 * (3 * settings.frame_period_s + half_period_s))
    assert first.velocity_rig_m_s == pytest.approx([0.0, -settings.speed_m_s, 0.0], abs=1e-12)


def test_impossible_scenes_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"drive_by\.frames"):
        DriveBy(frames=1)
