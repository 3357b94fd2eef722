# SPDX-License-Identifier: Apache-2.0
"""Optimal association: brute force, closed forms of gate and level term, what the assignment must not do."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import types
from numba.core.runtime import _nrt_python, rtsys
from test_association import BIN_M, both, rig

from edge.config import AssociationSettings, RigGeometry
from edge.errors import ConfigError
from edge.frames import Float64
from edge.fusion import kernels_assignment as kernels
from edge.fusion.association import CANDIDATES, Associator
from edge.reference.association import worthiest

SCALE_DB = AssociationSettings().level_scale_db
GATE_M = AssociationSettings().range_gate_bins * BIN_M


def assigned(value: Float64) -> list[tuple[int, int]]:
    """The kernel's pairs for a full table of values."""
    rows, columns = value.shape
    order = np.arange(rows + columns)
    first, start = np.zeros(rows, dtype=np.int64), np.arange(rows + 1) * columns
    price, scratch = np.zeros((3, rows + columns)), np.zeros((4, rows + columns), dtype=np.int64)
    pairs, counts = np.zeros((2, min(rows, columns) or 1), dtype=np.int64), np.zeros(11, dtype=np.int64)
    weight = -np.maximum(value, 0.0).ravel()
    found = kernels.assign(order, rows, rows + columns, first, start, weight, price, scratch, pairs, counts)
    return [(int(h), int(v) - rows) for h, v in pairs[:, :found].T]


def total(value: Float64, pairs: list[tuple[int, int]]) -> float:
    return float(sum(value[i, j] for i, j in pairs))


def brute_force(value: Float64) -> float:
    """Largest total over all one-to-one assignments, by trying every one."""
    table = np.maximum(value if value.shape[0] <= value.shape[1] else value.T, 0.0)
    rows, columns = table.shape
    chosen = itertools.permutations(range(columns), rows)
    return max((float(table[np.arange(rows), list(c)].sum()) for c in chosen), default=0.0)


def random_values(rng: np.random.Generator, rows: int, columns: int, share: float) -> Float64:
    return np.where(rng.random((rows, columns)) < share, rng.uniform(0.0, 4.5, (rows, columns)), -1.0)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 6), st.integers(0, 6), st.sampled_from([0.2, 0.5, 1.0]))
def test_no_assignment_is_worth_more(seed: int, rows: int, columns: int, share: float) -> None:
    value = random_values(np.random.default_rng(seed), rows, columns, share)
    pairs, defined = assigned(value), worthiest(value)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    assert all(value[i, j] > 0.0 for i, j in pairs)
    assert total(value, pairs) == pytest.approx(brute_force(value), abs=1e-9)
    assert pairs == defined


@pytest.mark.parametrize(("rows", "columns", "share"), [(107, 90, 0.05), (90, 107, 0.3), (60, 60, 1.0)])
def test_large_crowds_agree_with_an_independent_solver(rows: int, columns: int, share: float) -> None:
    optimize = pytest.importorskip("scipy.optimize")
    value = random_values(np.random.default_rng(rows), rows, columns, share)
    best = optimize.linear_sum_assignment(-np.maximum(value, 0.0))
    assert total(value, assigned(value)) == pytest.approx(float(np.maximum(value, 0.0)[best].sum()), rel=1e-12)


def test_equal_ranges_pair_by_rank_as_in_the_paper() -> None:
    """A convex level term makes the sorted assignment the best one, however far the levels are shifted."""
    horizontal = [[5.0, 0.1, 30.0], [5.0, 0.2, 20.0], [5.0, 0.3, 10.0]]
    vertical = [[5.0, -0.1, 5.0], [5.0, -0.2, 15.0], [5.0, -0.3, 25.0]]
    expected = sorted([(0.1, -0.3), (0.2, -0.2), (0.3, -0.1)])
    for rule in ("paper", "optimal"):
        xyz = Associator(rig(rule=rule)).process(*both(horizontal, vertical)).xyz_m / 5.0
        np.testing.assert_allclose(sorted(map(tuple, xyz[:, 1:].tolist())), expected, rtol=1e-6, atol=1e-9)


def test_a_detection_goes_where_it_leaves_the_better_choice_to_the_others() -> None:
    """The middle pair is the nearest; taking it first would leave both others alone."""
    step = 0.3 * BIN_M
    horizontal, vertical = [[5.0, 0.1, 9.0], [5.0 + 2 * step, 0.2, 9.0]], [[5.0 + 0.9 * step, -0.1, 9.0]]
    horizontal[1][0], vertical = 5.0 + 1.1 * step, [*vertical, [5.0 + 2.0 * step, -0.2, 9.0]]
    cloud = Associator(rig()).process(*both(horizontal, vertical))
    np.testing.assert_array_equal(cloud.range_horizontal_m, np.float32([5.0, 5.0 + 1.1 * step]))
    np.testing.assert_array_equal(cloud.range_vertical_m, np.float32([5.0 + 0.9 * step, 5.0 + 2.0 * step]))


def test_the_range_gate_is_where_equal_levels_are_worth_nothing() -> None:
    for share, points in ((0.999, 1), (1.001, 0)):
        assert len(Associator(rig()).process(*both([[5.0, 0, 1]], [[5.0 + share * GATE_M, 0, 1]]))) == points


def test_the_level_difference_of_a_lone_pair_has_a_closed_form() -> None:
    """2 ln cosh(d / 2 s) = 9 / 2 at equal ranges."""
    widest_db = 2.0 * SCALE_DB * math.acosh(math.exp(9.0 / 4.0))
    for share, points in ((0.999, 1), (1.001, 0)):
        assert len(Associator(rig()).process(*both([[5, 0, 0]], [[5, 0, share * widest_db]]))) == points


def test_radial_speeds_tell_apart_what_ranges_and_levels_do_not() -> None:
    """Beside a rig at 5 m/s the vertical radar's detections have the speeds of their lateral directions."""
    horizontal = [[5.0, 0.3, 10.0, -1.5], [5.001, -0.2, 10.0, 1.0]]
    vertical = [[5.0, 0.1, 10.0, 1.1], [5.001, -0.1, 10.0, -1.6]]
    xyz = Associator(rig()).process(*both(horizontal, vertical)).xyz_m
    np.testing.assert_allclose(xyz[:, 1:], [[1.5, -0.5001], [-1.0002, 0.5]], atol=1e-4)
    for row in horizontal + vertical:
        row[3] = math.nan
    xyz = Associator(rig()).process(*both(horizontal, vertical)).xyz_m
    np.testing.assert_allclose(xyz[:, 1:], [[1.5, 0.5], [-1.0002, -0.5001]], atol=1e-4)


def test_three_sigma_of_radial_speed_are_worth_nothing() -> None:
    sigma_m_s = AssociationSettings().doppler_sigma_m_s
    for share, points in ((2.99, 1), (3.01, 0)):
        frames = both([[5.0, 0.0, 1.0, 0.0]], [[5.0, 0.0, 1.0, share * sigma_m_s]])
        assert len(Associator(rig()).process(*frames)) == points


@pytest.mark.parametrize(("w", "cause"), [(-0.25, "below ground"), (0.6, "too high"), (0.69, "no vector")])
def test_what_can_be_no_point_takes_no_partner_away(w: float, cause: str) -> None:
    """A ghost with exactly the level of the target: the paper's rule gives it the target's partner."""
    horizontal, vertical = [[5.0, 0.66, 10.0]], [[5.0, w, 10.0], [5.0, 0.1, 8.0]]
    geometry = RigGeometry(height_m=0.8 if cause == "below ground" else 5.0)
    limits: Any = {"geometry": geometry, "max_height_m": 7.0 if cause == "too high" else 30.0, "fov_deg": 60}
    if cause == "no vector":
        horizontal[0][1] = 0.8
    found = Associator(rig(**limits)).process(*both(horizontal, vertical))
    np.testing.assert_allclose(found.xyz_m[:, 2], [0.5], rtol=1e-6)
    assert len(Associator(rig(**limits, rule="paper")).process(*both(horizontal, vertical))) == 0, cause


def test_report_tells_who_had_no_possible_partner_and_who_lost_one() -> None:
    horizontal = [[5.0, 0.1, 9.0], [5.001, 0.2, 4.0], [7.0, 0.0, 9.0]]
    associator = Associator(rig())
    associator.process(*both(horizontal, [[5.0, -0.1, 9.0], [9.0, 0.0, 9.0]]))
    report = associator.last_report
    assert (report.bins, report.pairs, report.points, report.power, report.unmatched) == (1, 1, 1, 1, 2)


def test_sidelobes_at_the_range_of_a_strong_reflector_are_left_out() -> None:
    strong, weak, apart = [5.0, 0.1, 40.0], [5.02, -0.4, 14.9], [5.0 + 2 * BIN_M, 0.4, 14.9]
    associator = Associator(rig())
    cloud = associator.process(*both([strong, weak, apart], [[5.0, 0.0, 40.0], [5.02, 0.3, 15.1], apart]))
    assert associator.last_report.sidelobe == 1, "25.1 dB below at the same range; 24.9 dB or two bins away is none"
    np.testing.assert_allclose(cloud.range_horizontal_m, [5.0, 5.0 + 2 * BIN_M], rtol=1e-6)
    assert len(Associator(rig(sidelobe_db=200.0)).process(*both([strong, weak], [strong, weak]))) == 2


def test_a_full_crowd_needs_no_second_look() -> None:
    """More candidates than the first buffer holds: the result is that of a fresh associator."""
    rng = np.random.default_rng(3)
    rows = np.stack([rng.uniform(5.0, 5.4, 300), rng.uniform(-0.5, 0.5, 300), rng.uniform(0, 12, 300)], axis=1)
    associator = Associator(rig())
    frames = both(rows[:150], rows[150:])
    one = associator.process(*frames).xyz_m
    dense = np.stack([np.full(300, 5.0), rows[:, 1], rows[:, 2]], axis=1)
    assert CANDIDATES < 150 * 150
    assert len(associator.process(*both(dense[:150], dense[150:]))) > 100
    np.testing.assert_array_equal(associator.process(*frames).xyz_m, one)


def test_kernels_allocate_nothing() -> None:
    """Numba counts one descriptor for every array that a call hands over, and nothing else."""
    value = random_values(np.random.default_rng(0), 40, 30, 0.3)
    (signature,) = kernels.assign.nopython_signatures
    handed = sum(isinstance(argument, types.Array) for argument in signature.args)
    _nrt_python.memsys_enable_stats()
    assigned(value)
    before = rtsys.get_allocation_stats()
    assigned(value)
    assert rtsys.get_allocation_stats().alloc - before.alloc <= handed


@pytest.mark.parametrize("key", ["level_scale_db", "doppler_sigma_m_s", "sidelobe_db", "range_gate_bins"])
def test_settings_that_cannot_work_are_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=f"association.{key}"):
        AssociationSettings(**{key: 0.0})
    with pytest.raises(ConfigError, match=r"association\.rule"):
        AssociationSettings(rule="hungarian")  # type: ignore[arg-type]
