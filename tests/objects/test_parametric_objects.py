# SPDX-License-Identifier: Apache-2.0
"""Parametric road users: true sizes, on the ground, the same for the same seed; and the demo's car."""

from __future__ import annotations

import numpy as np
import pytest

from train.objects.demo_object import DEMO_FILE, demo_car
from train.objects.mesh import CLASSES, ClassName
from train.objects.parametric import generate
from train.objects.parametric_car import _RANGES, STYLES, draw_shape, top_profile
from train.objects.parametric_person import random_body, two_link, walking
from train.objects.primitives import capsule, join, tube
from train.objects.sampling import face_areas

# Extremes that road users of the class have, with mirrors, bars, riders and bags: length, width, height in metres.
LIMITS: dict[ClassName, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "car": ((3.4, 5.8), (1.7, 2.45), (1.15, 2.8)),
    "bicycle": ((1.1, 2.1), (0.35, 1.0), (0.7, 2.2)),
    "motorcycle": ((1.6, 2.6), (0.6, 1.1), (0.95, 2.0)),
    "pedestrian": ((0.2, 1.2), (0.25, 0.8), (0.95, 2.1)),
}


@pytest.mark.parametrize("name", CLASSES)
def test_sizes_are_true_and_the_ground_is_at_zero(name: ClassName) -> None:
    for seed in range(40):
        mesh = generate(name, seed)
        for extent, (low, high) in zip(mesh.size_m, LIMITS[name], strict=True):
            assert low <= extent <= high, (mesh.object_id, mesh.size_m)
        assert mesh.vertices[:, 2].min() == 0
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        np.testing.assert_allclose(low[:2], -high[:2], atol=1e-5)
        assert 500 < len(mesh.faces) < 20_000
        assert mesh.label == CLASSES.index(name)


@pytest.mark.parametrize("name", CLASSES)
def test_same_seed_same_object(name: ClassName) -> None:
    first, second, other = generate(name, 5), generate(name, 5), generate(name, 6)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)
    assert first.vertices.shape != other.vertices.shape or not np.array_equal(first.vertices, other.vertices)


@pytest.mark.parametrize("style", list(STYLES))
def test_cars_have_the_measures_that_were_drawn(style: str) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        shape = draw_shape(rng, style)
        for value, (low, high) in zip((shape.length, shape.width, shape.height), _RANGES[style], strict=True):
            assert low <= value <= high
        assert 0.5 < shape.wheelbase / shape.length < 0.65
        assert shape.axles[1] + shape.wheel_radius < shape.length  # the rear wheel is under the car
        profile = top_profile(shape)
        assert np.all(np.diff(profile[:, 0]) > 0)
        assert profile[:, 1].max() <= shape.height
        assert profile[0, 1] > shape.clearance + 0.2


def test_styles_are_what_their_names_say() -> None:
    """Side view at three quarters of a car behind the roof: a boot is low, a hatch high, a bed lower than its cabin."""
    assert {"sedan", "hatchback", "suv", "van", "pickup"} <= set(STYLES)
    for seed in range(20):
        tail, height = {}, {}
        for style in STYLES:
            shape = draw_shape(np.random.default_rng(seed), style)
            profile = top_profile(shape)
            tail[style] = float(np.interp(0.95 * shape.length, profile[:, 0], profile[:, 1])) / shape.height
            height[style] = shape.height
        assert tail["sedan"] < 0.72
        assert tail["pickup"] < 0.72
        assert tail["van"] > 0.85
        assert height["sedan"] < height["suv"] < height["van"] + 0.3
        assert min(tail["hatchback"], tail["suv"]) > 0.6


@pytest.mark.parametrize("name", CLASSES)
def test_seeds_never_give_the_same_object_twice(name: ClassName) -> None:
    """Sizes of forty of them differ pairwise by more than rounding."""
    sizes = np.array([generate(name, seed).size_m for seed in range(40)])
    away = np.abs(sizes[:, None] - sizes[None]).max(axis=2) + 10 * np.eye(40)
    assert away.min() > 1e-4


def test_wheels_touch_the_ground_and_body_does_not() -> None:
    mesh = generate("car", 0)
    low = mesh.vertices[mesh.vertices[:, 2] < 0.1]
    assert np.unique(np.sign(low[:, 0])).tolist() == [-1, 1]  # front and rear
    assert np.abs(low[:, 1]).min() > 0.4  # only under the wheels, left and right


def test_gait_alternates() -> None:
    """Half a cycle later left and right have swapped places."""
    body = random_body(np.random.default_rng(2))
    now, _ = join(walking(body, 0.1, 1.0, np.random.default_rng(3)))
    later, _ = join(walking(body, 0.6, 1.0, np.random.default_rng(3)))
    swapped = later * np.array([1, -1, 1])
    np.testing.assert_allclose(now.min(axis=0), swapped.min(axis=0), atol=0.02)
    np.testing.assert_allclose(now.max(axis=0), swapped.max(axis=0), atol=0.02)
    assert 0.4 < np.ptp(now[now[:, 2] < now[:, 2].min() + 0.1 * body.stature][:, 0]) < 1.1  # length of a step


def test_two_links_reach_their_end() -> None:
    middle, end = two_link([0, 0, 1], [0.3, 0, 0.4], 0.4, 0.45, [1, 0, 0])
    np.testing.assert_allclose(end, [0.3, 0, 0.4], atol=1e-9)
    assert np.linalg.norm(middle - [0, 0, 1]) == pytest.approx(0.4)
    assert np.linalg.norm(end - middle) == pytest.approx(0.45)
    _, far = two_link([0, 0, 1], [0, 0, -5], 0.4, 0.45, [1, 0, 0])
    assert np.linalg.norm(far - [0, 0, 1]) <= 0.85


def test_area_of_tube_and_capsule() -> None:
    for part, expected in (
        (tube([[0, 0, 0], [0, 0, 2]], 0.1, 64), 2 * np.pi * 0.1 * 2),
        (capsule([0, 0, 0], [1, 1, 0], 0.2, 0.2, 64), 2 * np.pi * 0.2 * np.sqrt(2) + 4 * np.pi * 0.2**2),
    ):
        vertices, faces = join([part])
        assert face_areas(vertices, faces, np.empty(len(faces))) == pytest.approx(expected, rel=0.03)


def test_demo_car_is_what_its_command_writes() -> None:
    assert DEMO_FILE.stat().st_size < 60_000
    mesh = demo_car()
    with np.load(DEMO_FILE) as archive:
        assert (archive["vertices"].dtype, archive["faces"].dtype) == (np.float32, np.int32)
        np.testing.assert_allclose(archive["vertices"], mesh.vertices, atol=2e-3)
        np.testing.assert_array_equal(archive["faces"], mesh.faces)
        assert archive["vertices"][:, 2].min() == 0
