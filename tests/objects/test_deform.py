# SPDX-License-Identifier: Apache-2.0
"""Variation of cars: parts stretch by what was drawn, wheels stay round and on the ground, and two-wheelers lean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from train.objects.deform import BELT_SHARE, DeformSettings, Wheels, find_wheels, stretch, vary
from train.objects.mesh import Mesh
from train.objects.parametric import generate
from train.objects.parametric_car import draw_shape

STILL = DeformSettings(
    overhang_share=0, wheelbase_share=0, greenhouse_share=0, width_share=0, lattice_sigma=(0, 0, 0),
    car_scale_sigma=(0, 0, 0), other_scale_sigma=0, mirror=False, max_lean_deg=0,
)  # fmt: skip


@pytest.fixture(scope="module")
def car() -> Mesh:
    return generate("car", 0)


def test_stretch_in_closed_form() -> None:
    """Length of every part before and after, by hand: axles at 1.5 and -1.3 m, wheels of 0.35 m."""
    wheels = Wheels(1.5, -1.3, 0.35)
    x = np.array([-2.3, -1.65, -1.3, -0.95, 0.1, 1.15, 1.5, 1.85, 2.3])
    z = np.array([1.5, 0.0, 0.35, BELT_SHARE * 1.5, 1.5, 0.0, 0.35, 0.0, 0.5])
    points = np.stack([x, np.full(9, 0.8), z], axis=1).astype(np.float32)
    out = stretch(points, wheels, 0.08, -0.05, 0.04, 0.10, -0.03).astype(float)
    assert out[6, 0] - out[2, 0] == pytest.approx(2.8 * 0.95, abs=1e-5)  # wheelbase
    assert out[8, 0] - out[6, 0] == pytest.approx(0.8 * 1.08, abs=1e-5)  # front overhang
    assert out[2, 0] - out[0, 0] == pytest.approx(1.0 * 1.04, abs=1e-5)  # rear overhang
    assert out[3, 0] - out[1, 0] == pytest.approx(0.7, abs=1e-5)  # a wheel
    assert out[7, 0] - out[5, 0] == pytest.approx(0.7, abs=1e-5)
    np.testing.assert_allclose(out[:, 1], 0.8 * 0.97, atol=1e-6)
    belt = BELT_SHARE * 1.5
    np.testing.assert_allclose(out[[0, 4], 2], belt + 1.1 * (1.5 - belt), atol=1e-5)
    np.testing.assert_allclose(out[[1, 2, 3, 8], 2], z[[1, 2, 3, 8]], atol=1e-6)  # below the belt line nothing


@pytest.mark.parametrize("seed", range(6))
def test_wheels_are_found(seed: int) -> None:
    shape = draw_shape(np.random.default_rng([0, seed]))
    mesh = generate("car", seed)
    wheels = find_wheels(mesh.vertices)
    assert wheels.front - wheels.rear == pytest.approx(shape.wheelbase, abs=0.03)
    assert wheels.radius == pytest.approx(shape.wheel_radius, abs=0.05)


def test_wheels_stay_round_and_carry_the_car(car: Mesh) -> None:
    wheels = find_wheels(car.vertices)
    for seed in range(20):
        varied = vary(car, replace(DeformSettings(), mirror=False), np.random.default_rng(seed)).vertices
        for x in (wheels.front, wheels.rear):
            away = np.hypot(car.vertices[:, 0] - x, car.vertices[:, 2] - wheels.radius)
            outside = np.abs(car.vertices[:, 1]) > 0.3 * float(car.size_m[1])
            wheel = (away < wheels.radius) & outside
            shape = (np.ptp(varied[wheel, 0]) / np.ptp(car.vertices[wheel, 0])) / (
                np.ptp(varied[wheel, 2]) / np.ptp(car.vertices[wheel, 2])
            )
            assert shape == pytest.approx(1, abs=0.02)
            assert varied[wheel, 2].min() < 0.02
    loose = vary(car, replace(DeformSettings(), mirror=False, round_wheels=False), np.random.default_rng(3)).vertices
    assert not np.allclose(loose, vary(car, replace(DeformSettings(), mirror=False), np.random.default_rng(3)).vertices)


@pytest.mark.parametrize("name", ["car", "bicycle", "motorcycle", "pedestrian"])
def test_nothing_moves_when_nothing_is_allowed(name: str) -> None:
    mesh = generate(name, 2)  # type: ignore[arg-type]
    np.testing.assert_allclose(vary(mesh, STILL, np.random.default_rng(0)).vertices, mesh.vertices, atol=2e-5)


@pytest.mark.parametrize(
    ("changes", "axis", "limit"),
    [({"overhang_share": 0.08, "wheelbase_share": 0.08}, 0, 0.08), ({"width_share": 0.05}, 1, 0.05),
     ({"greenhouse_share": 0.1}, 2, 0.1 * (1 - BELT_SHARE))],
)  # fmt: skip
def test_each_stretch_changes_one_extent_within_its_limit(
    car: Mesh, changes: dict[str, float], axis: int, limit: float
) -> None:
    ratios = np.array([
        vary(car, replace(STILL, **changes), np.random.default_rng(s)).size_m / car.size_m  # type: ignore[arg-type]
        for s in range(30)
    ])  # fmt: skip
    others = np.delete(ratios, axis, axis=1)
    np.testing.assert_allclose(others, 1, atol=5e-3)
    assert np.abs(ratios[:, axis] - 1).max() <= limit + 1e-3
    assert np.abs(ratios[:, axis] - 1).max() > 0.5 * limit


def test_two_wheelers_lean_up_to_the_limit() -> None:
    mesh = generate("bicycle", 3, rider=True)
    leans = []
    for seed in range(30):
        vertices = vary(mesh, replace(STILL, max_lean_deg=12), np.random.default_rng(seed)).vertices
        head, ground = (vertices[part, 1].mean() for part in (mesh.vertices[:, 2] > mesh.size_m[2] - 0.05,
                                                              mesh.vertices[:, 2] < 0.02))  # fmt: skip
        leans.append(np.degrees(np.arcsin((ground - head) / float(mesh.size_m[2]))))
    assert max(np.abs(leans)) < 13
    assert min(leans) < -8
    assert max(leans) > 8
