# SPDX-License-Identifier: Apache-2.0
"""The line of sight: known directions, turns that undo each other, and no direction where there is none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge.completion.sight import LEAST_DISTANCE_M, bearing_rad, turned
from edge.errors import ModelError

POINTS_M = np.array([[1.0, 2.0, 0.5], [3.0, 2.0, 1.5]], np.float32)


@pytest.mark.parametrize(
    ("sensor_m", "expected_deg"),
    [((-4, 2, 0.8), 0), ((2, -1, 0.8), 90), ((2, 5, 9.0), -90), ((0, 0, 0), 45), ((5, 2, 0), 180)],
)
def test_bearing_points_from_the_sensor_to_the_mean_of_the_points(
    sensor_m: tuple[float, float, float], expected_deg: float
) -> None:
    bearing = bearing_rad("car", np.array(sensor_m, float), POINTS_M)
    assert math.degrees(bearing) == pytest.approx(expected_deg)


def test_in_the_line_of_sight_frame_the_sensor_is_behind_the_origin() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        points_m, sensor_m = rng.normal(0, 3, (40, 3)).astype(np.float32), rng.normal(0, 9, 3)
        bearing = bearing_rad("car", sensor_m, points_m)
        seen_m, eye_m = turned(points_m, -bearing), turned(sensor_m[None].astype(np.float32), -bearing)[0]
        x_m, y_m, _ = seen_m.mean(axis=0) - eye_m
        assert x_m > 0
        assert y_m == pytest.approx(0, abs=1e-4)
        np.testing.assert_array_equal(seen_m[:, 2], points_m[:, 2])
        np.testing.assert_allclose(turned(seen_m, bearing), points_m, atol=1e-5)
        assert seen_m.dtype == np.float32


def test_a_quarter_turn_takes_x_to_y() -> None:
    np.testing.assert_allclose(turned(np.float32([[1, 0, 7]]), math.pi / 2), [[0, 1, 7]], atol=1e-7)


def test_no_direction_no_bearing() -> None:
    with pytest.raises(ModelError, match="car/1: where the sensor stood is not known"):
        bearing_rad("car/1", np.array([0.0, np.inf, 0.0]), POINTS_M)
    with pytest.raises(ModelError, match="car/1: the sensor stands above"):
        bearing_rad("car/1", np.array([2.0, 2.0, 5.0]), POINTS_M)
    bearing_rad("car/1", np.array([2.0 - 2 * LEAST_DISTANCE_M, 2.0, 5.0]), POINTS_M)
