# SPDX-License-Identifier: Apache-2.0
"""Pictures of the panels: a target lies where its metres say, under the ring of its detection."""

from __future__ import annotations

import numpy as np
import pytest
from view_samples import found, heatmap_draft, message

from edge.frames import RADARS, RadarId
from edge.stream.messages import HeatmapMessage

pytest.importorskip("PIL", reason="the viewer's pictures need Pillow: pip install 'rfconstruct[view]'")

from edge.view import canvas
from edge.view.health import Sample


def heatmap(radar: RadarId) -> HeatmapMessage:
    received = message(heatmap_draft(radar, 1.0))
    assert isinstance(received, HeatmapMessage)
    return received


@pytest.mark.parametrize("radar", RADARS)
def test_the_peak_is_drawn_at_its_place_in_metres(radar: RadarId) -> None:
    picture = canvas.HeatmapPainter().paint(heatmap(radar), None)
    sheet = canvas.Sheet(radar, 15.0)
    assert picture.shape == (sheet.height, canvas.WIDTH, 3)
    assert picture.dtype == np.uint8
    places = [(6.0, 0.0), (8.0 * np.sqrt(0.75), 4.0)] if radar == "horizontal" else [(6.0, 0.0)]
    for forward_m, across_m in places:
        column, row = sheet.pixel(forward_m, across_m)
        assert picture[round(row), round(column)].max() > 200  # the bright end of the ramp
    column, row = sheet.pixel(10.0, 0.0)
    assert picture[round(row) + 12, round(column) + 12].max() < 130


def test_left_is_left_and_up_is_up() -> None:
    above, side = canvas.Sheet("horizontal", 15.0), canvas.Sheet("vertical", 15.0)
    assert above.pixel(5.0, 2.0)[0] < above.pixel(5.0, 0.0)[0]
    assert above.pixel(9.0, 0.0)[1] < above.pixel(5.0, 0.0)[1]
    assert side.pixel(5.0, 2.0)[1] < side.pixel(5.0, 0.0)[1]
    assert side.pixel(9.0, 0.0)[0] > side.pixel(5.0, 0.0)[0]


@pytest.mark.parametrize("radar", RADARS)
def test_pixels_and_metres_are_inverse(radar: RadarId) -> None:
    sheet = canvas.Sheet(radar, 15.0)
    forward_m, across_m = sheet.place()
    columns, rows = sheet.pixel(forward_m, across_m)
    left, top, width, height = sheet.box
    np.testing.assert_allclose(columns[0], left + 0.5 + np.arange(width), atol=1e-3)
    np.testing.assert_allclose(rows[:, 0], top + 0.5 + np.arange(height), atol=1e-3)


def test_detections_are_ringed() -> None:
    one = heatmap("horizontal")
    painter = canvas.HeatmapPainter()
    plain, ringed = painter.paint(one, None), painter.paint(one, found("horizontal", 0, 1.0))
    changed = np.argwhere((plain != ringed).any(axis=2))
    sheet = canvas.Sheet("horizontal", 15.0)
    for forward_m, across_m in ((6.0, 0.0), (8.0 * np.sqrt(0.75), 4.0)):
        column, row = sheet.pixel(forward_m, across_m)
        assert (np.hypot(changed[:, 0] - row, changed[:, 1] - column) < 8).sum() > 10


def test_strips_of_any_length() -> None:
    samples = [Sample(float(k), {"heatmap": 1.0 + k % 3, "detect": 0.5}, k // 10, {}) for k in range(90)]
    assert canvas.strip(samples, 90.0).shape[1] == canvas.WIDTH
    np.testing.assert_array_equal(canvas.strip([], 0.0), canvas.strip(samples, 1e6))
    some = canvas.strip(samples, 90.0)
    assert (some == np.array(canvas.LOSS, np.uint8)).all(axis=2).any()
    assert not (canvas.strip(samples[:5], 5.0) == np.array(canvas.LOSS, np.uint8)).all(axis=2).any()
