# SPDX-License-Identifier: Apache-2.0
"""The street: what stands where, the same again by seed, the truth in the frames of what the pipeline finds there."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.pipeline import Pipeline
from edge.rig import load_rig
from train.cli import main
from train.nearest import nearest_distance
from train.objects.reference import ObjectRef
from train.objects.sampling import sample_surface
from train.simulate.cloud import Windows
from train.simulate.scene import footprint
from train.simulate.street import USERS, Street, StreetSettings, make_street

RIG = load_rig("cascade_demo")


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(RIG, seed=3)


def test_all_kinds_of_road_users_stand_in_a_line_that_is_driven_past(street: Street) -> None:
    assert [user.ref.class_name for user in street.users] == ["car", "motorcycle", "bicycle", "pedestrian"]
    assert all(ref.split == "test" for ref in USERS)
    boxes = [footprint(u.mesh, np.asarray(u.placed.position_m), u.placed.yaw_rad) for u in street.users]
    gaps = [after.low_m[0] - before.high_m[0] for before, after in pairwise(boxes)]
    assert gaps == pytest.approx([boxes[0].low_m[0]] * 3), "even, also before the first"
    assert boxes[-1].high_m[0] + gaps[0] == pytest.approx(15.0)
    assert min(gaps) > RIG.settings.objects.neighbour_m
    assert all(3.5 <= box.low_m[1] <= 3.8 for box in boxes)
    first, last = (street.drive.true_pose(t).position_m for t in street.drive.span_ns)
    assert first == pytest.approx([0.0, 0.0, 0.8])
    assert last == pytest.approx([15.0, 0.0, 0.8], abs=0.03)
    assert street.drive.frames == 600


def test_a_seed_is_a_street(street: Street) -> None:
    same, other = make_street(RIG, seed=3), make_street(RIG, seed=4)
    for number in (0, 300):
        adc = street.drive.frame("vertical", number).adc
        assert np.array_equal(same.drive.frame("vertical", number).adc, adc)
        assert not np.array_equal(other.drive.frame("vertical", number).adc, adc)
    yaws = [user.placed.yaw_rad for user in street.users]
    assert [user.placed.yaw_rad for user in same.users] == yaws
    assert [user.placed.yaw_rad for user in other.users] != yaws
    frame, again = street.drive.frame("horizontal", 599).adc, street.drive.frame("horizontal", 599).adc
    assert np.array_equal(frame, again)


def test_true_points_lie_in_the_world(street: Street) -> None:
    for user in street.users:
        points = user.points_m(2000, np.random.default_rng(0))
        box = footprint(user.mesh, np.asarray(user.placed.position_m), user.placed.yaw_rad)
        assert points.dtype == np.float32
        assert (points[:, :2] >= box.low_m - 1e-4).all()
        assert (points[:, :2] <= box.high_m + 1e-4).all()
        assert -1e-4 <= points[:, 2].min() < 0.1
        assert points[:, 2].max() == pytest.approx(user.mesh.size_m[2], abs=0.1)


def test_what_the_pipeline_finds_lies_on_the_true_surfaces() -> None:
    """Two users, past whom the rig drives in two seconds; reported poses have errors, the truth moves with them."""
    users = (ObjectRef("motorcycle", "parametric_00008"), ObjectRef("pedestrian", "parametric_00017"))
    street = make_street(RIG, StreetSettings(users, length_m=6.0, speed_m_s=3.0, clutter_points=0), seed=1)
    windows = Windows()
    pipeline = Pipeline(street.drive.rig, None, [windows])
    for item in street.drive:
        pipeline.feed(item)
    pipeline.finish()
    shares: dict[int, float] = {}
    for window in windows.results:
        for cloud in window.objects:
            number, away_m = street.nearest(window.cloud, cloud.pose)
            rotation, translation_m = street.truth_in_frame(number, window.cloud, cloud.pose)
            mesh = street.users[number].mesh
            truth = sample_surface(mesh.vertices, mesh.faces, 8192, np.random.default_rng(0))
            placed = np.asarray(truth @ rotation.T + translation_m, dtype=np.float32)
            share = float((nearest_distance(cloud.xyz_m, placed) < 0.2).mean())
            assert away_m < 2.0
            shares[number] = max(shares.get(number, 0.0), share)
    assert set(shares) == {0, 1}
    assert min(shares.values()) > 0.7


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"street\.length_m"):
        make_street(RIG, StreetSettings(length_m=10.0))
    with pytest.raises(ConfigError, match=r"street\.users"):
        StreetSettings(users=())


def test_the_verb_drives_along_the_street(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["rig", "cascade_demo", "--scene", "street", "--source", "--pace", "0", "--seconds", "0.2", "--pipeline"]
    assert main(words) == 0
    assert "of every radar a second" in capsys.readouterr().out
    assert main(["rig", "cascade_demo", "--scene", "street", "--object", "car/parametric_00002"]) == 5
    assert "one of them" in capsys.readouterr().err
