# SPDX-License-Identifier: Apache-2.0
"""What a run says about its shapes: sizes without strays, points that were seen, and the likeliest class."""

from __future__ import annotations

import numpy as np
import pytest
from cli_run import RIG

from edge.commands.report import Tally, lines, shape_as_dict
from edge.frames import ObjectCloud, Pose, Shape
from edge.pipeline import Pipeline

POINTS_M = np.zeros((16384, 3), np.float32)
POINTS_M[:, 0] = np.linspace(0.0, 4.0, 16384)
POINTS_M[:5] = 50.0
INPUT = ObjectCloud(3, POINTS_M[:3000], POINTS_M[:3000, 0], Pose(0, np.zeros(3), np.array([0.0, 0, 0, 1])),
                    0, 1, 3.0, 60, True, np.zeros(3))  # fmt: skip


def shape(class_name: str, probability: dict[str, float]) -> Shape:
    return Shape(3, class_name, probability, 0.4, POINTS_M, POINTS_M[:1024], INPUT, "0" * 16, {}, 2048)


def test_figures_of_a_shape() -> None:
    facts = shape_as_dict(shape("car", {"car": 1.0}))
    assert facts["size_m"] == pytest.approx([0.98 * 4.0, 0.0, 0.0], abs=2e-3)
    assert facts["input_points"] == 2048


@pytest.mark.parametrize(
    ("class_name", "probability", "told"),
    [
        ("car", {"car": 0.9, "bicycle": 0.1, "unknown": 0.0}, "object 3: car (confidence 0.40)"),
        ("unknown", {"car": 0.95, "bicycle": 0.05, "unknown": 0.0}, "object 3: unknown (car 0.95?) (confidence 0.40)"),
        ("unknown", {"unknown": 1.0}, "object 3: unknown (confidence 0.40)"),
    ],
)
def test_an_unknown_object_says_what_it_is_most_likely(
    class_name: str, probability: dict[str, float], told: str
) -> None:
    tally = Tally()
    tally.shapes[3] = shape(class_name, probability)
    (line,) = [line for line in lines(Pipeline(RIG, None), tally, []) if line.startswith("object")]
    assert line.startswith(told)
    assert line.endswith("from 2048 radar points of 60 frames")
