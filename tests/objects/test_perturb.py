# SPDX-License-Identifier: Apache-2.0
"""The geometric perturbation: every step does what it says, nothing else, and can be switched off."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from edge.errors import ConfigError
from edge.frames import Float32
from train.depth_scan import scan
from train.objects.mesh import Mesh
from train.objects.parametric import generate
from train.objects.sampling import sample_surface
from train.perturb import (
    PerturbSettings,
    View,
    add_artefacts,
    base_sample,
    cut_holes,
    draw_view,
    noise_spheres,
    perturb,
    snapshot,
    specular_weights,
    with_neighbour,
)

PLAIN = PerturbSettings.paper()
CLEAN = replace(PLAIN, noise=False, holes=False)


@pytest.fixture(scope="module")
def car() -> Mesh:
    return generate("car", 0)


def test_view_points_are_where_a_passing_car_would_be(car: Mesh) -> None:
    rng = np.random.default_rng(0)
    half = float(car.size_m[0]) / 2
    azimuths = []
    for number in range(400):
        view = draw_view(car, PerturbSettings(), rng, number)
        middle = view.middle
        assert 3 + half <= np.hypot(*middle[:2]) <= 12 + half
        assert 0.4 <= middle[2] <= 1.2
        assert len(view.positions) in (1, 2, 3, 4)
        if len(view.positions) > 1:
            path = view.positions[-1] - view.positions[0]
            assert np.linalg.norm(path) == pytest.approx(3)
            assert path[:2] @ middle[:2] == pytest.approx(0, abs=1e-9)  # passes the object, does not approach it
            np.testing.assert_allclose(path[:2] / 3, view.along, atol=1e-9)
        assert number % 8 * 45 <= np.degrees(view.azimuth_rad) % 360 <= number % 8 * 45 + 45
        azimuths.append(view.azimuth_rad)
    assert np.histogram(azimuths, 8, (0, 2 * np.pi))[0].tolist() == [50] * 8


def test_distance_is_log_uniform(car: Mesh) -> None:
    rng = np.random.default_rng(1)
    settings = replace(PerturbSettings(), path_probability=0)
    half = float(car.size_m[0]) / 2
    distance = [np.hypot(*draw_view(car, settings, rng).middle[:2]) - half for _ in range(2000)]
    assert np.mean(np.array(distance) < 6) == pytest.approx(0.5, abs=0.04)  # sqrt(3 * 12) is the median


def test_without_noise_and_holes_the_points_lie_on_the_surface(car: Mesh) -> None:
    surface = cKDTree(sample_surface(car.vertices, car.faces, 60_000, np.random.default_rng(2)))
    points, _ = perturb(car, CLEAN, np.random.default_rng(3))
    assert 400 <= len(points) <= 1500
    assert surface.query(points)[0].max() < 0.06  # spacing of 60,000 points on 40 m^2


@pytest.mark.parametrize("by_distance", [False, True])
def test_noise_spheres_have_bounded_radius(by_distance: bool) -> None:
    rng = np.random.default_rng(4)
    points = np.stack([np.arange(200) * 2.0, np.zeros(200), np.ones(200)], axis=1).astype(np.float32)
    settings = replace(PLAIN, noise_by_distance=by_distance)
    radar = np.array([200.0, -500.0, 1.0])
    noisy = noise_spheres(points, radar, settings, rng)
    origin = np.rint(noisy[:, 0] / 2).astype(int)
    radius = np.linalg.norm(noisy - points[origin], axis=1)
    assert radius.max() <= 0.30 + 1e-4
    copies = np.bincount(origin, minlength=200)
    assert copies.min() == 2
    assert copies.max() == 6
    for number in range(200):  # all copies of a point are on one sphere
        own = radius[origin == number]
        assert np.ptp(own) < 1e-4


def test_noise_grows_with_distance() -> None:
    """R0 = (0.02 R + 0.03) U(0.5, 1.5): the largest radius is 0.105 m at 2 m and 0.255 m at 7 m."""
    points = np.zeros((3000, 3), np.float32)
    settings = replace(PLAIN, noise_by_distance=True)
    for distance, largest in ((2.0, 0.105), (7.0, 0.255)):
        seen = [
            np.linalg.norm(
                noise_spheres(points, np.array([distance, 0, 0]), settings, np.random.default_rng(s)), axis=1
            )
            for s in range(40)
        ]
        top = max(r.max() for r in seen)
        assert 0.9 * largest < top <= largest + 1e-5


def test_ellipsoids_are_flat_along_the_ray() -> None:
    points = np.zeros((4000, 3), np.float32)
    settings = replace(PLAIN, ellipsoid_probability=1.0, noise_radius_m=(0.3, 0.3))
    noisy = noise_spheres(points, np.array([8.0, 0, 0]), settings, np.random.default_rng(5))
    assert np.abs(noisy[:, 0]).max() <= 0.03 + 1e-4  # half a range bin
    assert np.abs(noisy[:, 1]).max() > 0.25


def test_holes_remove_exactly_the_balls() -> None:
    rng = np.random.default_rng(6)
    points = rng.uniform(-1, 1, (2000, 3)).astype(np.float32)
    left, holes = cut_holes(points, 3.0, PLAIN, rng)
    assert 1 <= len(holes) <= 6
    inside = np.zeros(len(points), bool)
    for center, radius in holes:
        assert 0.08 * 3 <= radius <= 0.25 * 3
        inside |= np.linalg.norm(points - center, axis=1) <= radius
    np.testing.assert_array_equal(left, points[~inside])
    assert len(left) >= 0.25 * len(points)


def test_first_hole_is_near_the_centre() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-1, 1, (500, 3)).astype(np.float32)
        _, holes = cut_holes(points, 1.0, PLAIN, rng)
        distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
        assert np.linalg.norm(holes[0][0] - points.mean(axis=0)) <= np.quantile(distance, 0.16)


def test_a_hole_that_would_leave_too_little_is_skipped() -> None:
    points = np.random.default_rng(7).normal(0, 0.01, (100, 3)).astype(np.float32)
    left, holes = cut_holes(points, 10.0, PLAIN, np.random.default_rng(8))
    assert len(left) == 100
    assert holes == []


def test_order_decides_whether_rims_are_sharp(car: Mesh) -> None:
    """Noise first leaves the balls of the last cut empty (paper); holes first lets noise reach into them (ours)."""

    def emptiest(noise_first: bool) -> list[float]:
        settings = replace(PLAIN, noise_first=noise_first, hole_count=(1, 1), noise_radius_m=(0.2, 0.2))
        radii = []
        for seed in range(12):
            rng = np.random.default_rng(seed)
            view = draw_view(car, settings, rng)
            points = base_sample(snapshot(car, view, settings), view, settings, rng)
            if noise_first:
                points = noise_spheres(points, view.middle, settings, rng)
            left, ((center, radius),) = cut_holes(points, 2.0, settings, rng)
            if not noise_first:
                left = noise_spheres(left, view.middle, settings, rng)
            radii.append(float(np.linalg.norm(left - center, axis=1).min()) / radius)
        return radii

    assert min(emptiest(True)) >= 1
    assert np.mean(np.array(emptiest(False)) < 1) > 0.8
    same = [perturb(car, replace(PLAIN, noise_first=order), np.random.default_rng(9))[0] for order in (True, False)]
    assert same[0].shape != same[1].shape or not np.array_equal(same[0], same[1])


def test_specular_weight_is_concentrated(car: Mesh) -> None:
    rng = np.random.default_rng(10)
    view = draw_view(car, CLEAN, rng)
    hits = snapshot(car, view, CLEAN)
    weight = specular_weights(hits.points, hits.cosine, PerturbSettings(), rng)
    assert weight.sum() == pytest.approx(1)
    heaviest = np.sort(weight)[::-1]
    assert heaviest[: len(weight) // 4].sum() > 0.5


def test_artefacts_keep_the_range_of_streaks_and_the_points() -> None:
    points = np.random.default_rng(11).uniform(0.2, 1.5, (1000, 3)).astype(np.float32)
    view = View(0.0, np.array([[8.0, 0.0, 0.8]]), np.zeros((1, 3)))
    streaks = replace(PLAIN, streak_probability=1.0, streak_share=0.05)
    added = add_artefacts(points, view, streaks, np.random.default_rng(12))
    np.testing.assert_array_equal(added[:1000], points)
    assert len(added) == 1050
    ranges = np.linalg.norm(points - view.middle, axis=1)
    moved = np.linalg.norm(added[1000:] - view.middle, axis=1)
    assert cKDTree(ranges[:, None]).query(moved[:, None])[0].max() < 1e-4  # same range
    assert cKDTree(points).query(added[1000:])[0].min() >= 0  # and no copy in place
    np.testing.assert_array_equal(add_artefacts(points, view, PLAIN, np.random.default_rng(13)), points)


def test_each_artefact_has_its_own_switch_and_does_one_thing() -> None:
    """Drift shears, outliers fill the widened box, ghosts lie below the ground; the given points stay as they are."""
    points = np.random.default_rng(20).uniform(0.3, 1.5, (1000, 3)).astype(np.float32)
    view = View(0.0, np.array([[8.0, 0.0, 0.8]]), np.zeros((1, 3)))

    def only(**changes: float) -> Float32:
        return add_artefacts(points, view, replace(PLAIN, **changes), np.random.default_rng(21))

    drifted = only(drift_probability=1.0)
    assert drifted.shape == points.shape
    slope = (drifted - points)[:, :2] / points[:, 1:2]  # the path runs along y
    np.testing.assert_allclose(slope, np.broadcast_to(slope[0], slope.shape), atol=1e-4)
    assert 0 < np.abs(slope[0]).max() < 0.15
    np.testing.assert_array_equal(drifted[:, 2], points[:, 2])
    outliers = only(outlier_probability=1.0, outlier_share=0.1, outlier_margin_m=0.4)
    np.testing.assert_array_equal(outliers[:1000], points)
    assert len(outliers) == 1100
    assert outliers.min() >= points.min() - 0.4
    assert (np.abs(outliers[1000:] - 0.9) > 0.6).any()
    ghosts = only(ghost_probability=1.0, ghost_share=0.2, ghost_ground_sigma_m=0.0)
    np.testing.assert_array_equal(ghosts[:1000], points)
    mirrored = ghosts[1000:] * np.array([1, 1, -1], np.float32)
    assert len(mirrored) == 200
    assert cKDTree(points).query(mirrored)[0].max() < 1e-6


def test_the_paper_does_four_things_in_its_order(car: Mesh) -> None:
    """Camera, snapshot, noise spheres, holes, put together here by hand; every addition of ours is off."""
    settings = PerturbSettings.paper()
    off = [f.name for f in fields(settings) if f.name.endswith("_probability")]
    assert len(off) == 9
    assert all(getattr(settings, name) == 0 for name in off)
    assert (settings.noise, settings.holes, settings.noise_first) == (True, True, True)
    assert (settings.clip, settings.thin, settings.noise_by_distance) == (False, False, False)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        view = draw_view(car, settings, rng)
        expected = noise_spheres(
            base_sample(snapshot(car, view, settings), view, settings, rng), view.middle, settings, rng
        )
        expected, _ = cut_holes(expected, float(np.linalg.norm(car.size_m)), settings, rng)
        points, _ = perturb(car, replace(settings, max_points=100_000), np.random.default_rng(seed))
        assert len(points) == len(expected)
        np.testing.assert_array_equal(np.unique(points, axis=0), np.unique(expected, axis=0))


def test_every_step_can_be_left_out(car: Mesh) -> None:
    """Without a step the result differs from the one with it; with all off only points of the surface are left."""
    full = {f.name: 1.0 for f in fields(PerturbSettings) if f.name.endswith("_probability")}
    on = replace(PerturbSettings(), **full)  # type: ignore[arg-type]
    before, _ = perturb(car, on, np.random.default_rng(30))
    for name in [*full, "holes", "noise", "noise_by_distance", "clip"]:
        after, _ = perturb(car, replace(on, **{name: False}), np.random.default_rng(30))  # type: ignore[arg-type]
        assert before.shape != after.shape or not np.array_equal(before, after), name


def test_all_steps_stay_inside_the_limits_and_never_pad(car: Mesh) -> None:
    counts = []
    for seed in range(60):
        points, _ = perturb(car, PerturbSettings(), np.random.default_rng(seed))
        counts.append(len(points))
        assert points.dtype == np.float32
        assert np.isfinite(points).all()
        assert points[:, 2].min() > 0
        assert points[:, 2].max() < 3
        assert len(np.unique(points, axis=0)) == len(points)
    assert max(counts) <= 2048
    assert min(counts) < 300 < max(counts)  # sparse and dense ones


def test_clouds_resemble_those_of_the_radar_pipeline(car: Mesh) -> None:
    """Measured on fused clouds: 82 to 96 % of the points within 10 cm of the surface."""
    surface = cKDTree(sample_surface(car.vertices, car.faces, 60_000, np.random.default_rng(0)))
    near = [
        np.mean(surface.query(perturb(car, PerturbSettings(), np.random.default_rng(s))[0])[0] < 0.1) for s in range(40)
    ]
    assert 0.75 < np.mean(near) < 0.97


def test_the_radar_stands_where_the_view_was_drawn_and_sees_the_near_side(car: Mesh) -> None:
    for seed in range(20):
        points, radar_m = perturb(car, CLEAN, np.random.default_rng(seed))
        np.testing.assert_array_equal(radar_m, draw_view(car, CLEAN, np.random.default_rng(seed)).middle)
        away = -radar_m[:2] / np.linalg.norm(radar_m[:2])
        assert (points[:, :2] @ away).mean() < (car.vertices[:, :2] @ away).mean()


def test_same_seed_same_cloud(car: Mesh) -> None:
    first, second, other = (perturb(car, PerturbSettings(), np.random.default_rng(s))[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_an_object_that_is_not_seen_gives_no_points(car: Mesh) -> None:
    behind = Mesh(car.vertices + np.array([500, 0, 0], np.float32), car.faces, 0, "car/away")
    hits = scan(behind.vertices, behind.faces, np.array([0.0, 0, 1]), np.array([-1.0, 0, 1]))
    view = draw_view(car, PerturbSettings(), np.random.default_rng(0))
    assert base_sample(hits, view, PerturbSettings(), np.random.default_rng(0)).shape == (0, 3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("distance_m", (5.0, 3.0)),
        ("distance_m", (0.0, 3.0)),
        ("max_points", 0),
        ("noise_copies", (0, 3)),
        ("specular_probability", 1.5),
        ("hole_min_keep", -0.1),
    ],
)
def test_settings_that_cannot_work_are_refused(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=key):
        PerturbSettings(**{key: value})  # type: ignore[arg-type]


def test_a_neighbour_stands_beside_the_cloud() -> None:
    rng = np.random.default_rng(4)
    cloud = (rng.uniform(-1, 1, (200, 3)) * (1.0, 0.3, 0.7) + (5, 2, 0.7)).astype(np.float32)
    sides = set()
    for _ in range(40):
        both = with_neighbour(cloud, 2048, rng)
        np.testing.assert_array_equal(both[:200], cloud)
        other = both[200:]
        assert 10 <= len(other) <= 120
        gap = max(other[:, 1].min() - cloud[:, 1].max(), cloud[:, 1].min() - other[:, 1].max())
        assert gap + 1e-5 >= 0.4
        assert gap <= 1.5 + 1e-5
        assert (other[:, 2] >= 0).all()
        sides.add(bool(other[0, 1] > cloud[0, 1]))
    assert sides == {False, True}
    assert len(with_neighbour(cloud, 210, rng)) <= 210
