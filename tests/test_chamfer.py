# SPDX-License-Identifier: Apache-2.0
"""Chamfer distance: closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.reference.chamfer import chamfer_l1_m, nearest_distance_m


def test_a_shifted_lattice_is_as_far_as_the_shift() -> None:
    lattice = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3)
    assert chamfer_l1_m(lattice, lattice + np.array([0.1, 0.0, 0.0])) == pytest.approx(0.1, abs=1e-7)


def test_it_is_the_mean_of_both_directions() -> None:
    near, both = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    assert chamfer_l1_m(near, both) == pytest.approx(0.5 * (0.0 + 2.5))
    assert chamfer_l1_m(both, near) == pytest.approx(0.5 * (0.0 + 2.5))


def test_distances_far_from_the_origin_keep_their_precision() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(1500, 3)), rng.normal(size=(700, 3))
    direct = np.linalg.norm(a[:, None] - b[None], axis=-1).min(axis=1)
    np.testing.assert_allclose(nearest_distance_m(a, b), direct, atol=1e-7)
    np.testing.assert_allclose(nearest_distance_m(a + 1e4, b + 1e4), direct, atol=1e-5)


def test_nothing_to_compare_with_is_refused() -> None:
    with pytest.raises(ConfigError, match="at least one point"):
        nearest_distance_m(np.zeros((3, 3)), np.zeros((0, 3)))
