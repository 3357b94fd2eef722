# SPDX-License-Identifier: Apache-2.0
"""Figures of clouds whose distances, coverage and spacing are known by construction."""

from __future__ import annotations

import math

import numpy as np
import pytest

from train.objects.mesh import Mesh
from train.objects.primitives import box, join
from train.simulate.cloud_statistics import measure, spacing_m, visible_surface

SIZE_M = (2.0, 1.0, 1.0)
FRONT = [np.array([x, -5.0, 0.5]) for x in (-1.0, 0.0, 1.0)]
"""Three positions that see the side y = -0.5 of the box, and from the ends a little of x = -1 and x = 1."""


@pytest.fixture(scope="module")
def cuboid() -> Mesh:
    return Mesh(*join([box((0.0, 0.0, 0.5), SIZE_M)]), 0, "car/box")


def test_only_the_side_that_faces_the_track_is_visible_and_counts_by_area(cuboid: Mesh) -> None:
    points, area = visible_surface(cuboid, [FRONT[1]])
    assert (np.abs(points[:, 1] + 0.5) < 1e-3).all()
    left = area[points[:, 0] < 0].sum() / area.sum()
    assert left == pytest.approx(0.5, abs=0.02)
    quarter = area[points[:, 0] < -0.5].sum() / area.sum()
    assert quarter == pytest.approx(0.25, abs=0.02)


def test_known_distances_shares_and_coverage(cuboid: Mesh) -> None:
    rng = np.random.default_rng(1)
    x, z = np.meshgrid(np.arange(-0.95, 0.0, 0.1), np.arange(0.05, 1.0, 0.1))
    near = np.column_stack((x.ravel(), np.full(x.size, -0.5), z.ravel()))
    far = near + np.array([0.0, -0.15, 0.0])
    wrong = near + np.array([0.0, -1.0, 0.0])
    cloud = np.concatenate((near, far, wrong)).astype(np.float32)
    frame = np.arange(len(cloud)) % 60
    figures = measure(cuboid, cloud, frame, 80, [FRONT[1]], rng)
    assert figures.points == 300
    assert figures.points_per_frame == pytest.approx(300 / 80)
    assert figures.empty_share == pytest.approx(0.25)
    assert figures.within_10cm == pytest.approx(1 / 3)
    assert figures.within_20cm == pytest.approx(2 / 3)
    assert figures.median_m == pytest.approx(0.15, abs=0.01)
    # the left half is covered, and 0.15 m beyond its last column at -0.05, less the corners
    assert figures.coverage == pytest.approx(0.55, abs=0.02)
    assert figures.spacing_m == pytest.approx(0.1, abs=1e-4)


def test_empty_cloud_has_no_figures(cuboid: Mesh) -> None:
    empty = np.zeros((0, 3), np.float32)
    figures = measure(cuboid, empty, np.zeros(0, np.int64), 10, FRONT, np.random.default_rng(0))
    assert (figures.points, figures.coverage, figures.empty_share) == (0, 0.0, 1.0)
    assert math.isnan(figures.spacing_m)


def test_spacing_against_brute_force() -> None:
    cloud = np.random.default_rng(2).normal(size=(700, 3)).astype(np.float32)
    apart = np.linalg.norm(cloud[:, None].astype(float) - cloud[None].astype(float), axis=-1)
    np.fill_diagonal(apart, np.inf)
    assert spacing_m(cloud) == pytest.approx(float(np.median(apart.min(axis=1))), rel=1e-6)
