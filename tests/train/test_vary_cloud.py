# SPDX-License-Identifier: Apache-2.0
"""Variation of simulated clouds: windows are frames in a row, a ball hides a ball, strays come after the points."""

from __future__ import annotations

import numpy as np
import pytest

from train import vary_cloud
from train.vary_cloud import borrowed, hidden, strays, stretch, window, with_strays


@pytest.mark.parametrize("frames", [1, 5, 12, 13, 400])
def test_a_window_is_frames_in_a_row(frames: int) -> None:
    rng = np.random.default_rng(0)
    numbers = np.arange(frames)
    lengths, starts = [], []
    for _ in range(200):
        seen = np.flatnonzero(window(numbers, frames, rng))
        assert seen[-1] - seen[0] == len(seen) - 1
        lengths.append(len(seen))
        starts.append(seen[0])
    assert min(lengths) >= min(frames, vary_cloud.LEAST_FRAMES)
    assert max(lengths) <= frames
    if frames == 400:  # log-uniform from 12 to 400: the median is their geometric mean
        assert 50 < np.median(lengths) < 96
        assert 90 <= starts.count(0) <= 130, "half of them from the beginning, and few others by chance"


def test_what_is_hidden_is_a_ball_about_a_point() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (500, 3)).astype(np.float32)
    for _ in range(50):
        gone = hidden(points, rng)
        middles = points[gone]
        assert gone.any()
        reach = np.linalg.norm(points[:, None] - middles[None], axis=2)
        inside = [
            bool((distance[gone].max() < distance[~gone].min()) if (~gone).any() else True) for distance in reach.T
        ]
        assert any(inside)


def test_sizes_spread_about_one() -> None:
    rng = np.random.default_rng(2)
    scales = np.array([stretch(rng) for _ in range(2000)])
    np.testing.assert_allclose(np.log(scales).std(axis=0), vary_cloud.STRETCH_SIGMA, rtol=0.1)
    np.testing.assert_allclose(np.log(scales).mean(axis=0), 0, atol=0.005)


def test_strays_come_after_the_points_and_images_below_the_ground() -> None:
    rng = np.random.default_rng(3)
    cloud = rng.uniform((0, 0, 0.5), (1, 1, 1.5), (200, 3)).astype(np.float32)
    more, below = [], 0
    for _ in range(200):
        result = with_strays(cloud, 2048, rng)
        np.testing.assert_array_equal(result[:200], cloud)
        more.append(len(result) - 200)
        below += bool((result[200:, 2] < -0.2).any())
    assert min(more) == 0
    assert 20 <= max(more) <= 40
    assert 70 <= below <= 130
    assert len(with_strays(cloud, 200, rng)) == 200


def test_strays_are_what_lies_far_from_the_surface() -> None:
    rng = np.random.default_rng(4)
    surface = rng.uniform((-1, -1, 0), (1, 1, 0), (5000, 3)).astype(np.float32)
    heights = np.array([0, 0.1, 0.3, 0.5, 2.0], np.float32)
    cloud = np.column_stack([np.zeros((5, 2), np.float32), heights])
    np.testing.assert_array_equal(strays(cloud, surface), cloud[3:])


def test_borrowed_strays_keep_their_share() -> None:
    rng = np.random.default_rng(5)
    stray = rng.uniform(-1, 1, (40, 3)).astype(np.float32)
    for points, most, expected in ((100, 2048, 10), (1, 2048, 1), (4000, 2048, 40), (400, 7, 7), (400, 0, 0)):
        added = borrowed(points, stray, 400, most, rng)
        assert len(added) == expected
        assert len(np.unique(added, axis=0)) == expected
        assert np.isin(added, stray).all()
    assert borrowed(100, stray[:0], 400, 2048, rng).shape == (0, 3)
