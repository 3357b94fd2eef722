# SPDX-License-Identifier: Apache-2.0
"""Association: hand-worked pairs, exact geometry of displaced and moving boards, the definition on random scenes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.config import (
    ASSOCIATION_RULES,
    AntennaSettings,
    AssociationRule,
    AssociationSettings,
    CfarSettings,
    Mounting,
    RigGeometry,
)
from edge.dsp.antenna import across_loss_db
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import CaptureError, ConfigError, PoseError
from edge.frames import Detections, RadarId
from edge.fusion.association import Associator, up_in_rig
from edge.reference.association import associate
from edge.reference.point_targets import make_frame
from edge.rig import load_rig

BIN_M = 0.0594
PERIOD_NS = 16_666_667
HALF_NS = PERIOD_NS // 2
FLAT = AntennaSettings(across_loss_db=0.0)
CENTRED, HIGH = Mounting(), RigGeometry(height_m=5.0)


def rig(
    horizontal: Mounting = CENTRED,
    vertical: Mounting = CENTRED,
    antenna: AntennaSettings = FLAT,
    geometry: RigGeometry = HIGH,
    **association: Any,
) -> Any:
    association.setdefault("max_height_m", 30.0)
    schedule = SimpleNamespace(profile=SimpleNamespace(range_bin_m=BIN_M), frame_period_s=PERIOD_NS / 1e9)
    mountings = {"horizontal": horizontal, "vertical": vertical}
    return SimpleNamespace(
        radars={name: SimpleNamespace(schedule=schedule, mounting=mounting) for name, mounting in mountings.items()},
        geometry=geometry,
        settings=SimpleNamespace(
            antenna=antenna, association=AssociationSettings(**association), cfar=CfarSettings(max_detections=64)
        ),
    )


def detections(radar: str, rows: Any, t_ns: int = 0, number: int = 7) -> Detections:
    """Rows of range, cosine, power and, where it was measured, radial speed."""
    table = np.array(rows, dtype=np.float32).reshape(len(rows), np.shape(rows)[1] if len(rows) else 3)
    nothing = np.full(len(table), np.nan, dtype=np.float32)
    columns = [np.ascontiguousarray(column) for column in table.T]
    return Detections(radar, number, t_ns, *columns[:3], *(columns[3:] or [nothing]), nothing)  # type: ignore[arg-type]


def both(horizontal: Any, vertical: Any, vertical_t_ns: int = 0) -> tuple[Detections, Detections]:
    return detections("horizontal", horizontal), detections("vertical", vertical, vertical_t_ns)


def observed(point_m: Any, board_m: Any, axis: int, power_db: float = 0.0) -> list[float]:
    """What a board at ``board_m`` with its array along ``axis`` measures of a point."""
    away = np.asarray(point_m, dtype=float) - np.asarray(board_m)
    range_m = float(np.linalg.norm(away))
    return [range_m, away[axis] / range_m, power_db]


def test_one_target_seen_by_both_lies_where_it_is() -> None:
    associator = Associator(rig())
    point = [4.0, 1.5, -0.4]
    cloud = associator.process(*both([observed(point, [0, 0, 0], 1, 3.0)], [observed(point, [0, 0, 0], 2, 5.0)]))
    np.testing.assert_allclose(cloud.xyz_m, [point], atol=1e-6)
    assert cloud.power_db[0] == 4.0
    assert (cloud.number, cloud.t_ns) == (7, 0)
    for range_m in (cloud.range_horizontal_m, cloud.range_vertical_m):
        np.testing.assert_allclose(range_m, [np.linalg.norm(point)], rtol=1e-6)
    assert (cloud.xyz_m.dtype, cloud.power_db.dtype) == (np.float32, np.float32)


def test_equal_counts_pair_by_power_rank_whatever_the_discrepancy() -> None:
    horizontal = [[5.0, 0.1, 30.0], [5.0, 0.2, 20.0], [5.0, 0.3, 10.0]]
    vertical = [[5.0, -0.1, 2.0], [5.0, -0.3, 9.0], [5.0, -0.2, 7.0]]
    associator = Associator(rig(rule="paper"))
    cloud = associator.process(*both(horizontal, vertical))
    np.testing.assert_allclose(cloud.xyz_m[:, 1] / 5.0, [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(cloud.xyz_m[:, 2] / 5.0, [-0.3, -0.2, -0.1], rtol=1e-6)
    assert associator.last_report.bins == 1
    assert associator.last_report.power == 0


def test_unequal_counts_pair_strongest_first_until_3_db() -> None:
    horizontal = [[5.0, 0.1, 30.0], [5.0, 0.2, 20.0], [5.0, 0.3, 10.0], [5.0, 0.4, 5.0]]
    vertical = [[5.0, -0.1, 28.0], [5.0, -0.2, 16.9], [5.0, -0.3, 10.0]]
    associator = Associator(rig(rule="paper"))
    cloud = associator.process(*both(horizontal, vertical))
    np.testing.assert_allclose(cloud.xyz_m[:, 1:] / 5.0, [[0.1, -0.1]], rtol=1e-6)
    report = associator.last_report
    assert (report.pairs, report.power, report.unmatched) == (1, 4, 1), "20 against 16.9 dB stops before 10 = 10"


def test_a_discrepancy_of_exactly_the_limit_still_pairs() -> None:
    associator = Associator(rig(rule="paper"))
    assert len(associator.process(*both([[5, 0.1, 10], [5, 0.2, 4]], [[5, 0.0, 7]]))) == 1
    assert len(associator.process(*both([[5, 0.1, 10.01], [5, 0.2, 4]], [[5, 0.0, 7]]))) == 0


def test_two_targets_in_one_bin_keep_their_own_angles() -> None:
    points = np.array([[4.5, 1.6, 0.3], [4.6, -1.2, 0.5]])
    points *= 5.0 / np.linalg.norm(points, axis=1, keepdims=True)
    powers = [12.0, 18.0]
    frames = both(
        [observed(p, [0, 0, 0], 1, power) for p, power in zip(points, powers, strict=True)],
        [observed(p, [0, 0, 0], 2, power) for p, power in zip(points, powers, strict=True)],
    )
    cloud = Associator(rig(rule="paper")).process(*frames)
    np.testing.assert_allclose(cloud.xyz_m, points[::-1], atol=1e-5)


def test_targets_in_different_bins_do_not_pair() -> None:
    associator = Associator(rig())
    cloud = associator.process(*both([[5.0, 0.0, 1.0]], [[5.0 + 0.51 * BIN_M, 0.0, 1.0]]))
    assert len(cloud) == 0
    assert associator.last_report.unmatched == 2
    assert len(associator.process(*both([[5.0, 0.0, 1.0]], [[5.0 + 0.49 * BIN_M, 0.0, 1.0]]))) == 1


def test_a_chain_longer_than_the_gate_is_cut_at_its_widest_gap() -> None:
    gaps_bins = np.array([0.0, 0.3, 0.75, 1.0])  # horizontal, vertical, horizontal, vertical: linked throughout
    ranges = 5.0 + BIN_M * gaps_bins
    horizontal = [[ranges[0], 0.1, 1.0], [ranges[2], 0.2, 9.0]]
    vertical = [[ranges[1], -0.1, 9.0], [ranges[3], -0.2, 1.0]]
    associator = Associator(rig(rule="paper"))
    cloud = associator.process(*both(horizontal, vertical))
    assert associator.last_report.bins == 2
    np.testing.assert_allclose(cloud.range_horizontal_m, ranges[[0, 2]], rtol=1e-6)
    np.testing.assert_allclose(cloud.range_vertical_m, ranges[[1, 3]], rtol=1e-6)


def test_of_equal_gaps_the_nearest_is_cut() -> None:
    """Horizontal 1 dB, vertical 1, horizontal 8, vertical 8, all 1/32 m apart: the last three are one bin."""
    horizontal, vertical = [[5.0, 0.1, 1.0], [5.0625, 0.2, 8.0]], [[5.03125, -0.1, 1.0], [5.09375, -0.2, 8.0]]
    cloud = Associator(rig(rule="paper", range_gate_bins=0.6)).process(*both(horizontal, vertical))
    np.testing.assert_array_equal(cloud.range_horizontal_m, np.float32([5.0625]))
    np.testing.assert_array_equal(cloud.range_vertical_m, np.float32([5.09375]))


@pytest.mark.parametrize("u", [0.7, -0.7])
def test_boards_20_cm_apart_pair_a_target_at_the_edge_of_the_view(u: float) -> None:
    boards = Mounting((0.0, 0.2, 0.0)), Mounting((0.0, 0.0, 0.15))
    point = np.array([np.sqrt(1 - u * u - 0.01), u, 0.1]) * 5.0
    frames = both([observed(point, boards[0].position_m, 1)], [observed(point, boards[1].position_m, 2)])
    difference_bins = abs(float(frames[0].range_m[0] - frames[1].range_m[0])) / BIN_M
    assert difference_bins > 2.0, "the raw ranges are far beyond the gate"
    cloud = Associator(rig(*boards, range_gate_bins=0.02, fov_deg=50)).process(*frames)
    np.testing.assert_allclose(cloud.xyz_m, [point], atol=1e-5)


@pytest.mark.parametrize("first", ["horizontal", "vertical"])
def test_travel_between_the_bursts_is_undone(first: str) -> None:
    boards = Mounting((0.02, 0.1, 0.0)), Mounting((-0.02, 0.0, 0.12))
    velocity = np.array([3.0, -4.0, 0.5])
    delay_ns = HALF_NS if first == "horizontal" else -HALF_NS
    point = np.array([4.0, -2.5, 0.6])
    later = point - velocity * delay_ns * 1e-9
    frames = both([observed(point, boards[0].position_m, 1)], [observed(later, boards[1].position_m, 2)], delay_ns)
    cloud = Associator(rig(*boards)).process(*frames, velocity)
    np.testing.assert_allclose(cloud.xyz_m, [point], atol=1e-5)
    unmoved = Associator(rig(*boards, range_gate_bins=3.0)).process(*frames)
    assert np.linalg.norm(unmoved.xyz_m - point) > 0.01


def test_radial_travel_of_half_a_bin_between_the_bursts_still_pairs() -> None:
    velocity = np.array([0.6 * BIN_M / (HALF_NS * 1e-9), 0.0, 0.0])
    frames = both([[5.0, 0.0, 1.0]], [[5.0 - 0.6 * BIN_M, 0.0, 1.0]], HALF_NS)
    associator = Associator(rig())
    np.testing.assert_allclose(associator.process(*frames, velocity).xyz_m, [[5.0, 0.0, 0.0]], atol=1e-5)
    assert len(associator.process(*frames)) == 0


def test_power_offsets_of_the_boards_are_added() -> None:
    boards = Mounting(power_offset_db=4.0), Mounting(power_offset_db=-2.0)
    frames = both([[5, 0.1, 10], [5, 0.2, 0]], [[5, 0.0, 16]])
    cloud = Associator(rig(*boards, rule="paper")).process(*frames)
    np.testing.assert_allclose(cloud.power_db, [14.0])
    assert len(Associator(rig(rule="paper")).process(*frames)) == 0


def test_gain_across_the_array_is_compensated_by_the_other_radars_angle() -> None:
    antenna = AntennaSettings()
    power_db, u, w = 20.0, 0.5, 0.2
    loss_h, loss_v = 2 * float(across_loss_db(antenna, w)), 2 * float(across_loss_db(antenna, u))
    assert loss_v - loss_h > 10.0, "far beyond the allowed discrepancy"
    frames = both([[5, u, power_db - loss_h], [5, -0.3, -30.0]], [[5, w, power_db - loss_v]])
    cloud = Associator(rig(antenna=antenna)).process(*frames)
    np.testing.assert_allclose(cloud.xyz_m[:, 1:], [[5 * u, 5 * w]], rtol=1e-6)
    np.testing.assert_allclose(cloud.power_db, [power_db], atol=1e-5)


def test_ranks_follow_the_levels_that_both_radars_share() -> None:
    """Two targets of which the horizontal radar sees the first stronger and the vertical one the second."""
    antenna = AntennaSettings()
    targets = [(0.45, 0.05, 20.0), (0.05, 0.25, 18.0)]
    horizontal = [[5, u, p - 2 * float(across_loss_db(antenna, w))] for u, w, p in targets]
    vertical = [[5, w, p - 2 * float(across_loss_db(antenna, u))] for u, w, p in targets]
    assert horizontal[0][2] > horizontal[1][2]
    assert vertical[0][2] < vertical[1][2]
    cloud = Associator(rig(antenna=antenna)).process(*both(horizontal, vertical))
    expected = {(round(5 * u, 3), round(5 * w, 3)) for u, w, _ in targets}
    assert {(round(float(y), 3), round(float(z), 3)) for _, y, z in cloud.xyz_m} == expected


def test_ground_height_and_field_of_view_are_removed_and_counted() -> None:
    associator = Associator(rig(rule="paper", geometry=RigGeometry(height_m=0.8), max_height_m=3.0))
    rows = {"below": (4.0, 0.1, -0.25), "above": (6.0, 0.1, 0.4), "kept": (8.0, 0.1, 0.0)}
    horizontal = [[r, u, 1.0] for r, u, _ in rows.values()] + [[10.0, 0.72, 1.0]]
    vertical = [[r, w, 1.0] for r, _, w in rows.values()] + [[10.0, -0.72, 1.0]]
    cloud = associator.process(*both(horizontal, vertical))
    np.testing.assert_allclose(cloud.range_horizontal_m, [8.0])
    report = associator.last_report
    assert (report.ground, report.height, report.fov, report.points) == (1, 1, 2, 1)


def test_ground_margin_keeps_points_below_ground_when_negative() -> None:
    frames = both([[5.0, 0.0, 1.0]], [[5.0, -0.18, 1.0]])  # 0.1 m below ground
    assert len(Associator(rig(geometry=RigGeometry(height_m=0.8))).process(*frames)) == 0
    assert len(Associator(rig(geometry=RigGeometry(height_m=0.8), ground_margin_m=-0.2)).process(*frames)) == 1


def test_a_tilted_rig_judges_height_along_the_vertical() -> None:
    down = RigGeometry(height_m=1.0, pitch_deg=10.0)  # nose down: a boresight target at 6 m is 0.04 m below ground
    assert len(Associator(rig(geometry=down)).process(*both([[6, 0, 1]], [[6, 0, 1]]))) == 0
    assert len(Associator(rig(geometry=down)).process(*both([[5.7, 0, 1]], [[5.7, 0, 1]]))) == 1
    np.testing.assert_allclose(up_in_rig(RigGeometry(roll_deg=90.0)), [0, 1, 0], atol=1e-15)  # roll +90: left is up


def test_directions_that_no_vector_has_are_ghosts() -> None:
    associator = Associator(rig(rule="paper", fov_deg=60))
    assert len(associator.process(*both([[5.0, 0.8, 1.0]], [[5.0, 0.65, 1.0]]))) == 0  # 0.64 + 0.4225 > 1
    assert associator.last_report.geometry == 1
    assert len(associator.process(*both([[5.0, 0.8, 1.0]], [[5.0, 0.59, 1.0]]))) == 1


@pytest.mark.parametrize(("h", "v"), [([], []), ([[5, 0, 1]], []), ([], [[5, 0, 1]])])
def test_a_radar_that_sees_nothing_gives_no_points(h: Any, v: Any) -> None:
    associator = Associator(rig())
    cloud = associator.process(*both(h, v))
    assert cloud.xyz_m.shape == (0, 3)
    assert associator.last_report.unmatched == len(h) + len(v)


def test_values_that_are_no_numbers_are_counted_and_left_out() -> None:
    associator = Associator(rig())
    bad = [[np.nan, 0, 1], [5, np.nan, 1], [5, 0, np.inf], [-1, 0, 1], [5, 0, 1]]
    assert len(associator.process(*both(bad, [[5, 0, 1]]))) == 1
    assert associator.last_report.invalid == 4


def test_equal_targets_pair_the_same_way_whichever_order_they_come_in() -> None:
    horizontal = [[5.0, 0.1, 3.0], [5.01, 0.2, 3.0], [5.005, -0.3, 3.0]]
    vertical = [[5.002, 0.0, 3.0], [5.0, 0.3, 3.0], [5.015, -0.1, 3.0]]
    expected = Associator(rig()).process(*both(horizontal, vertical)).xyz_m
    for order in ([1, 2, 0], [2, 1, 0]):
        shuffled = both([horizontal[k] for k in order], [vertical[k] for k in order])
        np.testing.assert_array_equal(Associator(rig()).process(*shuffled).xyz_m, expected)


def test_results_do_not_change_with_the_next_frame() -> None:
    associator = Associator(rig())
    cloud = associator.process(*both([[5, 0.1, 1]], [[5, 0.2, 1]]))
    before = cloud.xyz_m.copy()
    associator.process(*both([[9, -0.1, 1]], [[9, -0.2, 1]]))
    np.testing.assert_array_equal(cloud.xyz_m, before)


def test_more_detections_than_the_detector_may_give_are_taken_too() -> None:
    rows = [[1.0 + 0.1 * n, 0.1, 1.0] for n in range(150)]
    assert len(Associator(rig()).process(*both(rows, rows))) == 150


def test_frames_that_do_not_belong_together_are_refused() -> None:
    associator = Associator(rig())
    one, other = both([[5, 0, 1]], [[5, 0, 1]])
    with pytest.raises(CaptureError, match="do not belong together"):
        associator.process(other, one)
    with pytest.raises(CaptureError, match="horizontal frame 7, vertical frame 8"):
        associator.process(one, detections("vertical", [[5, 0, 1]], number=8))
    with pytest.raises(CaptureError, match="too far apart in time"):
        associator.process(*both([], [], PERIOD_NS + 2))
    with pytest.raises(PoseError, match="velocity"):
        associator.process(one, other, np.array([np.nan, 0.0, 0.0]))


def test_a_rig_of_one_radar_cannot_associate() -> None:
    lone = rig()
    del lone.radars["vertical"]
    with pytest.raises(ConfigError, match="without vertical"):
        Associator(lone)


@pytest.mark.parametrize("sign", [1, -1])
def test_scatterers_come_out_of_raw_frames_where_they_are(sign: Literal[1, -1]) -> None:
    """Displaced boards, turned arrays, cable delay, travel between the bursts: through heatmaps and detections."""
    demo = load_rig("cascade_demo")
    boards: dict[RadarId, Mounting] = {
        "horizontal": Mounting((0.0, 0.2, 0.0), array_sign=sign, range_offset_m=0.1),
        "vertical": Mounting((0.03, 0.0, -0.15), array_sign=sign, range_offset_m=-0.05),
    }
    radars = {name: replace(radar, mounting=boards[name]) for name, radar in demo.radars.items()}
    isotropic = replace(demo.settings, antenna=AntennaSettings(along_loss_db=0.0, across_loss_db=0.0))
    demo = replace(demo, radars=radars, geometry=RigGeometry(height_m=1.5), settings=isotropic)
    scatterers, velocity = np.array([[3.0, 1.2, -0.4], [4.5, -2.0, 0.7], [7.0, 3.0, 0.2]]), np.array([0.05, -0.2, 0.0])
    cfar = replace(demo.settings.cfar, kind="ca", p_fa=1e-6)  # an ordered statistic sees the sidelobes
    seen = []
    for name, t_ns in (("horizontal", 0), ("vertical", HALF_NS)):
        radar = demo.radars[name]  # type: ignore[index]
        frame = make_frame(radar, scatterers - velocity * t_ns * 1e-9, 200.0, 3, t_ns, velocity, noise_lsb=10.0)
        heatmap = Imager(radar, demo.settings.heatmap, demo.settings.antenna).process(frame, velocity)
        seen.append(Detector(radar, cfar).process(heatmap))
    cloud = Associator(demo).process(seen[0], seen[1], velocity)
    assert len(cloud) == len(scatterers)
    np.testing.assert_allclose(cloud.xyz_m, scatterers, atol=0.01)


def random_rows(rng: np.random.Generator, count: int, clustered: bool) -> Any:
    """Detections anywhere, or crowded into a few bins with many equal powers."""
    if clustered:
        range_m, power_db = 5.0 + BIN_M * rng.uniform(0, 0.12 * count + 0.1, count), rng.integers(0, 6, count)
    else:
        range_m, power_db = rng.uniform(0.5, 14.0, count), rng.uniform(-5, 25, count)
    speed_m_s = np.where(rng.random(count) < 0.7, rng.normal(0.0, 0.5, count), np.nan)
    return np.stack([range_m, rng.uniform(-0.9, 0.9, count), power_db, speed_m_s], axis=1)


@settings(max_examples=60, deadline=None)
@given(
    *(st.integers(0, 2**32 - 1), st.integers(0, 60), st.integers(0, 60), st.booleans()),
    *(st.sampled_from([0.25, 0.5, 1.5]), st.sampled_from(ASSOCIATION_RULES)),
)
def test_kernels_equal_the_definition(
    seed: int, n_h: int, n_v: int, clustered: bool, gate_bins: float, rule: AssociationRule
) -> None:
    rng = np.random.default_rng(seed)
    boards = tuple(Mounting(tuple(rng.uniform(-0.2, 0.2, 3)), float(rng.uniform(-3, 3))) for _ in range(2))
    geometry = RigGeometry(height_m=0.8, pitch_deg=float(rng.uniform(-5, 5)), roll_deg=float(rng.uniform(-5, 5)))
    antenna, velocity = AntennaSettings(across_loss_db=2.0), rng.uniform(-2, 2, 3)
    frames = both(random_rows(rng, n_h, clustered), random_rows(rng, n_v, clustered), HALF_NS)
    arrangement = rig(*boards, antenna, geometry, rule=rule, range_gate_bins=gate_bins, max_height_m=3.0)
    associator = Associator(arrangement)
    cloud = associator.process(*frames, velocity)
    expected = associate(
        *(*frames, velocity, boards, up_in_rig(geometry), geometry.height_m, BIN_M),
        *(arrangement.settings.association, antenna),
    )
    columns = (cloud.xyz_m, cloud.power_db[:, None], cloud.range_horizontal_m[:, None], cloud.range_vertical_m[:, None])
    np.testing.assert_allclose(np.concatenate(columns, axis=1), expected, rtol=1e-5, atol=1e-5)
    report = associator.last_report
    assert report.horizontal + report.vertical == (
        report.invalid + report.fov + report.sidelobe + report.unmatched + report.power + 2 * report.pairs
    )
    assert report.pairs == report.points + report.geometry + report.ground + report.height
