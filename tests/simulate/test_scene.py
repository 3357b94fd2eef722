# SPDX-License-Identifier: Apache-2.0
"""Scenes: the target where it is asked for, nothing inside something else, wall behind, mover beside the target."""

from __future__ import annotations

import numpy as np
import pytest

from edge.frames import Float64
from train.objects.mesh import Mesh
from train.objects.reference import ObjectRef
from train.simulate.scene import NEAREST_M, make_scene
from train.simulate.settings import SceneSettings
from train.simulate.surface import Placed
from train.simulate.surface_settings import SurfaceSettings

TRAVEL_M, DURATION_S, WAVELENGTH_M = 3.0, 6.0, 3.8e-3


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return ObjectRef("bicycle", "parametric_00000").mesh()


def scene_of(mesh: Mesh, scene: SceneSettings, seed: int = 0) -> list[Placed]:
    return make_scene(mesh, scene, SurfaceSettings(), TRAVEL_M, DURATION_S, WAVELENGTH_M, seed)


def box(placed: Placed) -> tuple[Float64, Float64]:
    ground = (placed.surface.vertices @ placed.rotation.T + placed.position_m)[:, :2]
    return ground.min(axis=0), ground.max(axis=0)


@pytest.mark.parametrize("yaw_deg", [0.0, 37.0, 180.0, 290.0])
def test_the_target_stands_where_it_is_asked_for(mesh: Mesh, yaw_deg: float) -> None:
    (target,) = scene_of(mesh, SceneSettings(side_m=4.5, along_m=0.5, yaw_deg=yaw_deg))
    low, high = box(target)
    assert low[1] == pytest.approx(4.5, abs=1e-3)
    assert 0.5 * (low[0] + high[0]) == pytest.approx(2.0, abs=1e-3)
    assert float((target.surface.vertices @ target.rotation.T)[:, 2].min()) == pytest.approx(0.0, abs=1e-3)
    heading = target.rotation @ np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(heading[:2], [np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))], atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_neighbours_keep_their_distance_and_the_wall_is_behind_all(mesh: Mesh, seed: int) -> None:
    placed = scene_of(mesh, SceneSettings(side_m=3.0, neighbours=4, gap_m=0.8, wall_m=1.0), seed)
    assert len(placed) == 6
    boxes = [box(one) for one in placed]
    for k, (low, high) in enumerate(boxes):
        assert low[1] >= NEAREST_M - 1e-6
        for other_low, other_high in boxes[:k]:
            assert np.maximum(low - other_high, other_low - high).max() >= 0.8 - 1e-3
    assert boxes[-1][0][1] == pytest.approx(max(high[1] for _, high in boxes[:-1]) + 1.0, abs=1e-3)
    assert not any(np.any(one.velocity_m_s) for one in placed)


@pytest.mark.parametrize("seed", range(8))
def test_the_mover_passes_the_target_in_the_middle_of_the_drive(mesh: Mesh, seed: int) -> None:
    target, mover = scene_of(mesh, SceneSettings(side_m=4.0, mover_speed_m_s=2.0), seed)
    low, high = box(target)
    at = mover.at(0.5 * DURATION_S).position_m
    assert abs(at[0] - 0.5 * (low[0] + high[0])) <= 1.0
    assert at[1] > high[1] or at[1] < low[1]
    assert np.linalg.norm(mover.velocity_m_s) == pytest.approx(2.0)
    forward = mover.rotation @ np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(forward * 2.0, mover.velocity_m_s, atol=1e-9)


def test_the_same_seed_gives_the_same_scene(mesh: Mesh) -> None:
    settings = SceneSettings(neighbours=2, mover_speed_m_s=1.0)
    one, again, other = (scene_of(mesh, settings, seed) for seed in (3, 3, 4))
    for a, b in zip(one, again, strict=True):
        assert (a.position_m == b.position_m).all()
        assert a.yaw_rad == b.yaw_rad
        assert (a.surface.patches.reflection == b.surface.patches.reflection).all()
    assert any((a.position_m != b.position_m).any() for a, b in zip(one, other, strict=True))
