# SPDX-License-Identifier: Apache-2.0
"""Objects and identities: the kernel equals its definition; scenes whose objects are known by construction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.config import ObjectSettings, RigGeometry
from edge.errors import CaptureError, ConfigError
from edge.frames import Float64, FusedCloud, ObjectCloud, Pose
from edge.fusion import kernels_cluster as kernels
from edge.fusion.identities import IdentityKeeper
from edge.fusion.objects import ObjectReport, ObjectTracker
from edge.odometry.transforms import inverse, transform_points
from edge.reference import clustering

S = 1_000_000_000
HEIGHT_M = 0.8
SENSOR_M = np.array([1.5, 0.25, HEIGHT_M])
"""Mean position of the rig over the windows, odometry frame."""
CAR_M, PERSON_M = (4.0, 1.8, 1.5), (0.5, 0.5, 1.7)


def yaw(angle_rad: float) -> Float64:
    return np.array([0.0, 0.0, np.sin(angle_rad / 2), np.cos(angle_rad / 2)])


def box(x_m: float, y_m: float, size_m: tuple[float, float, float], ground_m: float = 0.0) -> Float64:
    """Lattice of points in odom that fills a box from 0.2 m above the ground up; its plan is centred on (x_m, y_m)."""
    lengths = (np.linspace(-s / 2, s / 2, round(s / 0.1) + 1) for s in size_m[:2])
    grid = np.meshgrid(*lengths, np.linspace(0.2, size_m[2], 6), indexing="ij")
    return np.stack([axis.ravel() for axis in grid], axis=1) + np.array([x_m, y_m, ground_m])


def cloud(odom_m: Float64, t_end_s: float = 2.0, reference: Pose | None = None) -> FusedCloud:
    """Window with these odometry-frame points; power is the point's number."""
    t_end_ns = round(t_end_s * S)
    pose = reference or Pose(t_end_ns - S, np.array([0.0, 0.0, HEIGHT_M]), yaw(0.0))
    xyz_m = transform_points(inverse(pose), odom_m.reshape(-1, 3)).astype(np.float32)
    return FusedCloud(
        xyz_m=xyz_m,
        power_db=np.arange(len(xyz_m), dtype=np.float32),
        frame_number=np.zeros(len(xyz_m), np.int64),
        reference=pose,
        t_start_ns=pose.t_ns,
        t_end_ns=t_end_ns,
        travel_m=3.0,
        frames=60,
        complete=True,
        sensor_m=transform_points(inverse(pose), SENSOR_M[None])[0],
    )


def tracker(**changes: float) -> ObjectTracker:
    return ObjectTracker(replace(ObjectSettings(), **changes), RigGeometry(height_m=HEIGHT_M))


def in_odom(found: ObjectCloud) -> Float64:
    return transform_points(found.pose, found.xyz_m)


def sensor_in_odom(found: ObjectCloud) -> Float64:
    return transform_points(found.pose, found.sensor_m[None])[0]


@pytest.mark.parametrize("seed", range(60))
def test_kernel_equals_definition(seed: int) -> None:
    """Equal label by label, so equal up to a permutation too; every third cloud is a lattice, full of ties."""
    rng = np.random.default_rng(seed)
    spread_m, offset_m = rng.choice([0.5, 3.0, 9.0]), rng.choice([0.0, 5000.0])
    xy_m, query_m = (spread_m * rng.uniform(-1, 1, (n, 2)) + offset_m for n in (rng.integers(0, 300), 80))
    if seed % 3 == 0:
        xy_m, query_m = np.round(xy_m / 0.25) * 0.25, np.round(query_m / 0.125) * 0.125
    radius_m, core_points = rng.choice([0.25, 0.6, 1.0]), int(rng.integers(1, 9))
    grid = kernels.make_grid(len(xy_m) + 1)
    labels, found = np.empty(len(xy_m), np.int32), np.empty(len(query_m), np.int32)
    clusters = kernels.dbscan(xy_m, radius_m, core_points, grid, labels)
    expected = clustering.dbscan(xy_m, radius_m, core_points)
    np.testing.assert_array_equal(labels, expected)
    assert clusters == expected.max(initial=-1) + 1
    kernels.nearest_labels(query_m, xy_m, radius_m, grid, labels, found)
    np.testing.assert_array_equal(found, clustering.nearest_label(xy_m, expected, query_m, radius_m))


def test_order_of_the_points_does_not_matter() -> None:
    """Clusters are the same sets of points after a shuffle (no ties in a random cloud)."""
    rng = np.random.default_rng(7)
    xy_m = rng.uniform(-4, 4, (400, 2))
    shuffle = rng.permutation(400)
    grid, partitions = kernels.make_grid(400), []
    for index in (np.arange(400), shuffle):
        labels = np.empty(400, np.int32)
        count = kernels.dbscan(np.ascontiguousarray(xy_m[index]), 0.4, 4, grid, labels)
        partitions.append({frozenset(index[labels == label].tolist()) for label in range(count)})
    assert len(partitions[0]) > 3
    assert partitions[0] == partitions[1]


def test_neighbourhood_includes_its_rim_and_no_more() -> None:
    for step_m, clusters in ((0.5, 1), (np.nextafter(0.5, 1.0), 0)):
        xy_m = np.stack([step_m * np.array([0.0, 1.0, 2.0]), np.zeros(3)], axis=1)
        labels = np.empty(3, np.int32)
        assert kernels.dbscan(xy_m, 0.5, 3, kernels.make_grid(3), labels) == clusters


def test_a_car_and_a_pedestrian_stand_in_their_own_frames() -> None:
    """Object frame: odom axes, middle of the plan, ground at zero; powers stay with their points."""
    rig = Pose(S, np.array([1000.0, -2000.0, 3.0 + HEIGHT_M]), yaw(0.7))
    car = box(1008.0, -1998.0, CAR_M, ground_m=3.0)
    person = box(1003.0, -1999.0, PERSON_M, ground_m=3.0)
    window = cloud(np.concatenate([car, person]), reference=rig)
    seg = tracker()
    near, far = seg.process(window)
    for found, truth, center_m, size_m in (
        (near, person, (1003.0, -1999.0), PERSON_M),
        (far, car, (1008.0, -1998.0), CAR_M),
    ):
        np.testing.assert_allclose(found.pose.position_m, [*center_m, 3.0], atol=1e-5)
        np.testing.assert_array_equal(found.pose.quaternion_xyzw, [0, 0, 0, 1])
        assert found.pose.t_ns == found.t_end_ns == 2 * S
        np.testing.assert_allclose(in_odom(found), truth, atol=1e-5)
        np.testing.assert_allclose(sensor_in_odom(found), SENSOR_M, atol=1e-9)
        np.testing.assert_allclose(found.xyz_m.max(axis=0), [size_m[0] / 2, size_m[1] / 2, size_m[2]], atol=1e-5)
        assert found.xyz_m.dtype == np.float32
    np.testing.assert_array_equal(far.power_db, np.arange(len(car)))
    assert (far.travel_m, far.frames, far.complete, far.t_start_ns) == (3.0, 60, True, S)
    total = len(car) + len(person)
    assert seg.last_report == ObjectReport(points=total, in_objects=total, clusters=2, objects=2)


def test_tilt_of_the_rig_does_not_tilt_the_ground() -> None:
    roll = np.array([np.sin(0.1), 0.0, 0.0, np.cos(0.1)])
    car = box(10.0, 4.0, CAR_M)
    (found,) = tracker().process(cloud(car, reference=Pose(S, np.array([0.0, 0.0, HEIGHT_M]), roll)))
    np.testing.assert_allclose(in_odom(found), car, atol=1e-5)
    np.testing.assert_allclose(sensor_in_odom(found), SENSOR_M, atol=1e-9)
    assert found.xyz_m[:, 2].min() == pytest.approx(0.2, abs=1e-5)


def test_two_cars_one_metre_apart_stay_two() -> None:
    cars = np.concatenate([box(8.0, 0.0, CAR_M), box(8.0, 2.8, CAR_M)])
    first, second = tracker().process(cloud(cars))
    assert {round(float(c.pose.position_m[1]), 3) for c in (first, second)} == {0.0, 2.8}
    assert first.identity != second.identity


def test_ground_clutter_does_not_merge_objects_and_joins_the_nearest() -> None:
    """A carpet of ground returns under and between two cars 1 m apart: split at the middle, out to neighbour_m."""
    cars = np.concatenate([box(8.0, 0.0, CAR_M), box(8.0, 2.8, CAR_M)])
    lattice = np.meshgrid(np.arange(5.0, 11.0, 0.1), np.arange(-2.0, 5.0, 0.0999), indexing="ij")
    carpet = np.stack([lattice[0].ravel(), lattice[1].ravel(), np.full(lattice[0].size, 0.05)], axis=1)
    seg = tracker()
    found = seg.process(cloud(np.concatenate([cars, carpet])))
    assert len(found) == 2
    for car in found:
        low = in_odom(car)[car.xyz_m[:, 2] < 0.15]
        middle_y = 0.0 if low[:, 1].mean() < 1.4 else 2.8
        reach = np.abs(low[:, :2] - [8.0, middle_y]) - [2.0, 0.9]
        assert len(low) > 500
        assert np.hypot(*np.maximum(reach, 0).T).max() <= ObjectSettings().neighbour_m + 1e-5
        assert ((low[:, 1] - 1.4) * (middle_y - 1.4) > 0).all()
    report = seg.last_report
    assert report.loose > 0
    assert report.points == report.in_objects + report.dropped + report.loose == len(cars) + len(carpet)


def test_walls_and_specks_are_dropped_and_counted() -> None:
    """The heading of a 9 m wall does not matter, though its box in odom axes may be 7.5 m only."""
    wall = box(6.0, 6.0, (9.0, 0.2, 2.0))
    turn = np.array([[np.cos(0.6), np.sin(0.6), 0], [-np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    speck = np.tile([3.0, -5.0, 1.0], (23, 1))
    loner = np.array([[3.0, -9.0, 1.0]])
    car = box(8.0, 0.0, CAR_M)
    for scene_wall in (
        wall,
        (wall - [6, 6, 0]) @ turn + [6, 12, 0],
    ):
        seg = tracker()
        (found,) = seg.process(cloud(np.concatenate([scene_wall, speck, loner, car])))
        assert len(found) == len(car)
        report = seg.last_report
        assert (report.clusters, report.objects, report.too_small, report.too_long) == (3, 1, 1, 1)
        assert (report.in_objects, report.dropped, report.loose) == (len(car), len(wall) + 23, 1)


def test_neighbours_along_a_kerb_that_links_join_come_apart() -> None:
    """Two cars 0.7 m apart: one chain of 0.8 m links, 9 m long; links of 0.6 m tell them apart. One car is not cut."""
    length = CAR_M[0]
    first, second = box(8.0, 0.0, CAR_M), box(8.0 + length + 0.7, 0.0, CAR_M)
    seg = tracker()
    found = seg.process(cloud(np.concatenate([first, second])))
    assert [len(one) for one in found] == [len(first), len(second)]
    assert (seg.last_report.clusters, seg.last_report.too_long) == (2, 0)
    (joined,) = tracker(max_extent_m=30.0).process(cloud(np.concatenate([first, second])))
    assert len(joined) == len(first) + len(second)
    seg = tracker(least_neighbour_m=0.8)  # no shorter links: dropped as before
    assert seg.process(cloud(np.concatenate([first, second]))) == []
    assert (seg.last_report.clusters, seg.last_report.too_long) == (1, 1)


def test_points_on_one_spot_are_one_object_without_extent() -> None:
    (found,) = tracker().process(cloud(np.tile([5.0, 1.0, 1.0], (20_000, 1))))
    np.testing.assert_allclose(found.xyz_m, np.tile([0.0, 0.0, 1.0], (20_000, 1)), atol=1e-6)


def test_empty_cloud_and_ground_only() -> None:
    seg = tracker()
    assert seg.process(cloud(np.empty((0, 3)))) == []
    assert seg.last_report == ObjectReport()
    assert seg.process(cloud(np.tile([5.0, 1.0, 0.0], (100, 1)))) == []
    assert seg.last_report == ObjectReport(points=100, loose=100)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -2e4])
def test_points_that_cannot_be_are_refused(bad: float) -> None:
    points = box(8.0, 0.0, CAR_M)
    window = cloud(points)
    window.xyz_m[3, 1] = bad
    with pytest.raises(CaptureError, match="cannot be"):
        tracker().process(window)


def test_identities_last_from_window_to_window() -> None:
    """Overlapping windows from a moving, turning rig; the objects come in another order each time."""
    seg, seen = tracker(), []
    for n in range(6):
        scene = [box(6.0 + 0.02 * n, 0.0, CAR_M), box(3.0, 5.0, PERSON_M), box(-4.0, 1.0, PERSON_M)]
        order = np.random.default_rng(n).permutation(3)
        rig = Pose(n * S // 2 + 1, np.array([0.5 * n, 0.1 * n, HEIGHT_M]), yaw(0.3 * n))
        window = cloud(np.concatenate([scene[k] for k in order]), t_end_s=3 + 0.5 * n, reference=rig)
        seen.append({found.identity: np.round(found.pose.position_m[:2], 1).tolist() for found in seg.process(window)})
    for names in seen[1:]:
        assert names.keys() == seen[0].keys()
        assert all(np.hypot(*np.subtract(names[key], seen[0][key])) < 0.2 for key in names)


def test_results_come_nearest_first() -> None:
    scene = np.concatenate([box(9.0, 0.0, PERSON_M), box(0.0, 4.0, PERSON_M), box(-6.0, 0.0, PERSON_M)])
    distances = [float(np.hypot(*c.pose.position_m[:2])) for c in tracker().process(cloud(scene))]
    np.testing.assert_allclose(distances, [4.0, 6.0, 9.0], atol=1e-5)


def test_swapped_order_keeps_identities() -> None:
    keeper = IdentityKeeper(match_m=1.5, forget_s=5.0)
    a, b = [0.0, 0.0], [2.0, 0.0]
    first = keeper.update(np.array([a, b]), 0)
    assert keeper.update(np.array([b, a]), S) == first[::-1]


def test_one_to_one_and_nearest_first() -> None:
    keeper = IdentityKeeper(match_m=1.5, forget_s=5.0)
    (known,) = keeper.update(np.array([[0.0, 0.0]]), 0)
    far, near = keeper.update(np.array([[1.0, 0.0], [0.1, 0.0]]), S)
    assert near == known
    assert far != known
    assert keeper.update(np.array([[0.1, 1.6]]), 2 * S)[0] not in (near, far)  # 1.6 m away from both or more


def test_a_lost_identity_takes_no_object_from_one_that_is_followed() -> None:
    """Front and rear of a car become one object, which then loses its rear: it stays the same object."""
    keeper = IdentityKeeper(match_m=1.5, forget_s=5.0)
    front, rear, whole = [4.0, 0.0], [1.0, 0.0], [2.4, 0.0]
    rear_number, front_number = keeper.update(np.array([rear, front]), 0)
    (whole_number,) = keeper.update(np.array([whole]), S)
    assert whole_number == rear_number, "1.4 m away, the front 1.6 m"
    assert keeper.update(np.array([[3.6, 0.0]]), 2 * S) == [rear_number], "the lost front is 0.4 m away, this one 1.2 m"
    assert keeper.update(np.array([[3.6, 0.0], front]), 3 * S) == [rear_number, front_number], "it may come back"


def test_unseen_identities_retire_and_never_return() -> None:
    keeper = IdentityKeeper(match_m=1.5, forget_s=5.0)
    spot = np.array([[3.0, 4.0]])
    (first,) = keeper.update(spot, 2**62)
    keeper.update(np.empty((0, 2)), 2**62 + 3 * S)
    assert keeper.update(spot, 2**62 + 5 * S) == [first]
    (second,) = keeper.update(spot, 2**62 + 10 * S + 1)
    assert second > first
    assert len(keeper) == 1
    keeper.update(np.empty((0, 2)), 2**62 + 30 * S)
    assert len(keeper) == 0


def test_settings_that_cannot_work_are_refused() -> None:
    for change in ({"neighbour_m": 0.0}, {"core_points": 0}, {"forget_s": -1.0}):
        with pytest.raises(ConfigError, match="objects\\."):
            replace(ObjectSettings(), **change)
