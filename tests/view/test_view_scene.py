# SPDX-License-Identifier: Apache-2.0
"""The scene model: where things are drawn, how long they stay, what is dropped, and that nothing grows."""

from __future__ import annotations

import numpy as np
import pytest
from view_samples import (
    SPEED_M_S,
    brick,
    cloud_draft,
    detections_draft,
    final,
    heatmap_draft,
    message,
    pose_draft,
    shape_draft,
    status_draft,
    thing,
)

from edge.stream import convert
from edge.stream.messages import Reason
from edge.view import colours
from edge.view.boxes import fit_box
from edge.view.health import Banner, Health
from edge.view.panels import LONGEST_TEXT, account_html, banner_html
from edge.view.scene import MOST_OBJECTS, MOST_PATH_POINTS, MOST_WINDOW_POINTS, MOST_WINDOWS, Scene, object_label


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, 75.0, -40.0])
def test_the_box_of_a_turned_brick_is_the_brick(yaw_deg: float) -> None:
    box = fit_box(brick((4.2, 1.8, 1.5), np.radians(yaw_deg)) + np.array([10.0, -3.0, 0.0]))
    np.testing.assert_allclose(box.size_m, [4.2, 1.8, 1.5], rtol=0.05)  # less 1 % of the points at each face
    np.testing.assert_allclose(box.center_m, [10.0, -3.0, 0.75], atol=0.05)
    assert abs((np.degrees(box.yaw_rad) - yaw_deg + 90.0) % 180.0 - 90.0) <= 1.5


def test_a_stray_point_makes_no_box() -> None:
    points = np.concatenate([brick((4.2, 1.8, 1.5)), [[40.0, 40.0, 9.0]]])
    np.testing.assert_allclose(fit_box(points).size_m, [4.2, 1.8, 1.5], rtol=0.05)


def test_corners_and_edges_of_a_box() -> None:
    box = fit_box(brick((4.0, 2.0, 1.5), np.radians(20.0)))
    lengths = np.linalg.norm(np.diff(box.edges(), axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(np.sort(lengths), np.sort(np.repeat(box.size_m, 4)))
    np.testing.assert_allclose(box.corners().mean(axis=0), box.center_m)


def test_a_single_point_has_a_box_of_no_size() -> None:
    np.testing.assert_array_equal(fit_box(np.ones((1, 3), np.float32)).size_m, [0, 0, 0])


def test_everything_is_placed_around_the_first_pose_however_far_the_odometry_is() -> None:
    scene, far_m = Scene(), 2_000_000.0
    scene.add(message(pose_draft(0.0, far_m)), 0.0)
    scene.add(message(convert.encode_shape(thing(1, 1.0, (far_m + 5.0, 4.0)))), 1.0)
    scene.add(message(pose_draft(1.0, far_m)), 1.0)
    drawn = scene.drawables(1.0)
    assert drawn.vehicle is not None
    np.testing.assert_allclose(drawn.vehicle.position_m, [SPEED_M_S, 0.0, 0.8])
    ((one, strength),) = drawn.things
    np.testing.assert_allclose(one.box.center_m, [5.0, 4.0, 0.75], atol=0.05)
    np.testing.assert_allclose(one.points_m.mean(axis=0) + one.box.center_m, [5.0, 4.0, 0.75], atol=0.05)
    assert (strength, drawn.ground_m) == (1.0, 0.0)


def test_path_heading_and_newest_points() -> None:
    scene = Scene()
    for step in range(11):
        scene.add(message(pose_draft(step / 10)), step / 10)
    scene.add(message(detections_draft(1.0)), 1.0)
    drawn = scene.drawables(1.0)
    (piece,) = drawn.path_m
    np.testing.assert_allclose(piece[[0, -1]], [[0.0, 0.0, 0.8], [5.0, 0.0, 0.8]], atol=1e-6)
    assert drawn.heading_rad == pytest.approx(0.0)
    np.testing.assert_allclose(drawn.points_m[0], [5.0, 5.0, 0.8], atol=1e-5)  # 5 m to the left of x = 5 m


def test_a_jump_of_the_odometry_is_no_line_across_the_scene() -> None:
    scene = Scene()
    for t_s in (0.0, 0.1, 0.2, 20.0, 20.1):
        scene.add(message(pose_draft(t_s)), t_s)
    assert [len(piece) for piece in scene.drawables(20.1).path_m] == [3, 2]


def test_a_standing_vehicle_draws_no_path() -> None:
    scene = Scene()
    for number in range(50):
        scene.add(message(pose_draft(0.0)), number / 10)
    assert scene.drawables(5.0).path_m == []
    assert scene.drawables(5.0).heading_rad is None


def test_objects_fade_in_their_last_third_and_go() -> None:
    scene = Scene(keep_s=30.0)
    scene.add(message(shape_draft(1, 1.0)), 100.0)
    strengths = [scene.drawables(100.0 + age).things[0][1] for age in (0.0, 19.9, 22.0, 26.0, 29.9)]
    assert strengths[:2] == [1.0, 1.0]
    assert 1.0 > strengths[2] > strengths[3] > strengths[4] > 0.0
    assert scene.drawables(130.1).things == []
    assert scene.drawables(100.0).things == []  # removed, not only hidden


def test_a_newer_shape_replaces_the_older_and_a_late_one_is_dropped() -> None:
    scene = Scene()
    scene.add(message(pose_draft(0.0)), 0.0)
    assert scene.add(message(shape_draft(1, 2.0, (5.0, 4.0))), 2.0)
    assert scene.add(message(final(thing(1, 3.0, (6.0, 4.0)))), 3.0)
    assert not scene.add(message(shape_draft(1, 2.5, (9.0, 9.0))), 3.1)
    ((one, _),) = scene.drawables(3.1).things
    assert (one.version, one.final, scene.counts.late) == (2, True, 1)
    assert one.box.center_m[0] == pytest.approx(6.0, abs=0.05)


def test_what_comes_out_of_order_is_dropped_and_counted() -> None:
    scene = Scene()
    for t_s in (1.0, 1.1, 1.05, 1.2):
        scene.add(message(pose_draft(t_s)), t_s)
    scene.add(message(heatmap_draft("horizontal", 1.2)), 1.2)
    scene.add(message(heatmap_draft("vertical", 1.1)), 1.2)  # another radar: in order among itself
    scene.add(message(heatmap_draft("horizontal", 1.1)), 1.2)
    assert scene.counts.late == 2
    assert set(scene.heatmaps) == {"horizontal", "vertical"}


def test_a_new_start_of_the_publisher_empties_the_scene() -> None:
    scene = Scene()
    scene.add(message(pose_draft(50.0)), 0.0)
    scene.add(message(shape_draft(1, 50.0)), 0.0)
    before = scene.drawables(0.0)
    scene.add(message(pose_draft(0.5), boot=b"another boot id."), 0.1)
    after = scene.drawables(0.1)
    assert (len(before.things), len(after.things), scene.counts.resets, scene.counts.late) == (1, 0, 1, 0)
    assert after.generation != before.generation


def test_a_recording_that_begins_again_empties_the_scene_and_is_not_late_for_ever() -> None:
    scene = Scene()
    for t_s in (10.0, 20.0, 1.0, 1.1):
        assert scene.add(message(pose_draft(t_s)), t_s)
    assert (scene.counts.resets, scene.counts.late) == (1, 0)


def test_nothing_grows() -> None:
    scene = Scene(keep_s=300.0)
    small = brick((1.0, 1.0, 1.0), count=20)
    for number in range(2 * MOST_OBJECTS):
        scene.add(message(convert.encode_shape(thing(number, 1.0, points_m=small))), 1.0)
    for number in range(MOST_PATH_POINTS + 500):
        scene.add(message(pose_draft(number / 50)), 1.0)
    for number in range(2 * MOST_WINDOWS):
        scene.add(message(cloud_draft(90.0 + number, 50)), 1.0)
    drawn = scene.drawables(1.0)
    assert [thing.identity for thing, _ in drawn.things] == list(range(MOST_OBJECTS, 2 * MOST_OBJECTS))
    assert scene.counts.crowded == MOST_OBJECTS
    assert sum(map(len, drawn.path_m)) == MOST_PATH_POINTS
    assert len(drawn.windows) == MOST_WINDOWS


def test_large_windows_are_thinned_and_that_is_counted() -> None:
    scene = Scene()
    scene.add(message(cloud_draft(1.0, MOST_WINDOW_POINTS + 10)), 1.0)
    (window,) = scene.drawables(1.0).windows
    assert len(window.points_m) + scene.counts.thinned == MOST_WINDOW_POINTS + 10
    assert len(window.points_m) == len(window.power_db) <= MOST_WINDOW_POINTS


def test_the_label_names_identity_class_confidence_and_age() -> None:
    scene = Scene()
    scene.add(message(shape_draft(7, 1.0, class_name="bicycle")), 1.0)
    ((one, _),) = scene.drawables(1.0).things
    assert object_label(one) == "#7  bicycle  90 %  age 0.0 s"


def test_the_banner_tells_waiting_running_and_stale_apart() -> None:
    health = Health()
    states = [health.banner(0.0, "tcp://x").state]
    scene = Scene()
    scene.add(message(status_draft(1.0)), 10.0)
    states += [scene.health.banner(at_s, "tcp://x").state for at_s in (10.5, 11.5)]
    states.append(scene.health.banner(99.0, "tcp://x", stale_s=None).state)
    scene.add(message(status_draft(2.0, "STOP")), 12.0)
    states.append(scene.health.banner(50.0, "tcp://x").state)
    assert states == ["WAITING", "RUN", "STALE", "RUN", "STOP"]


def test_time_stands_still_after_the_publisher_said_stop() -> None:
    scene = Scene()
    for t_s, state in ((1.0, "RUN"), (2.0, "STOP"), (3.0, "STOP")):
        scene.add(message(status_draft(t_s, state)), 10.0 + t_s)  # type: ignore[arg-type]
    assert scene.health.stopped_s == 12.0
    scene.add(message(status_draft(4.0)), 14.0)
    assert scene.health.stopped_s is None


def test_losses_turn_the_banner_to_a_warning_with_reasons() -> None:
    scene = Scene()
    scene.add(message(status_draft(1.0, "DEGRADED", lost=3, detail="gap of 0.3 s")), 10.0)
    banner = scene.health.banner(10.1, "tcp://x")
    assert (banner.level, [(r.code, r.count) for r in banner.reasons]) == ("warn", [("NO_POSE", 3)])
    assert scene.health.history[-1].lost == 6
    assert "gap of 0.3 s" in banner_html(banner)


def test_texts_of_the_network_cannot_become_markup() -> None:
    evil = "<img src=x onerror=alert(1)>"
    html = banner_html(Banner("RUN", "ok", evil, (Reason(evil, 1, 0, 0, evil * 50),)))
    assert "<img" not in html
    assert len(html) < 4 * 6 * LONGEST_TEXT + 1000
    scene = Scene()
    scene.add(message(status_draft(1.0)), 1.0)
    assert "<img" not in account_html(scene.health.status, {evil: evil})


def test_the_ramp_rises_in_brightness_and_fading_ends_at_the_background() -> None:
    brightness = colours.RAMP.astype(float) @ [0.299, 0.587, 0.114]
    assert (np.diff(brightness) >= -0.5).all()
    np.testing.assert_array_equal(colours.ramp(np.array([-9.0, 99.0]), 0.0, 1.0), colours.RAMP[[0, -1]])
    np.testing.assert_array_equal(colours.faded((200, 10, 10), 0.0), colours.BACKGROUND)
    assert colours.class_colour("tram") == colours.class_colour("tram")
