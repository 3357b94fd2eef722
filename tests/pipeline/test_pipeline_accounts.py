# SPDX-License-Identifier: Apache-2.0
"""Every bad input is a typed error or a counted, named loss, and the account of frames balances exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pipeline_scenes import (
    LOOKING_LEFT,
    PERIOD_NS,
    RIG,
    T0_NS,
    Item,
    Keep,
    finish,
    frames_of,
    in_time_order,
    instant,
    lost,
    pose_at,
    run,
    scene_frame,
    scene_poses,
)

from edge.errors import CaptureError, PoseError, RfconstructError
from edge.frames import RADARS, Detections, Float64, LossCause, PointCloud, Pose, RadarFrame, RadarId
from edge.fusion.association import Associator
from edge.pipeline import MAX_WAITING_PAIRS, REFUSED_POSES, Pipeline
from edge.sources.base import Loss

COUNT = 6
FRAMES = frames_of(COUNT)
GAP_FRAMES = int(RIG.settings.fusion.max_pose_gap_s * 1e9 / PERIOD_NS) + 2
"""Frame periods that are a pose gap."""
ADC = {radar: FRAMES[radar][0].adc for radar in RADARS}
LAYOUT = RIG.radars["horizontal"].schedule.layout


def frame(radar: RadarId, number: int, t_ns: int | None = None, adc: np.ndarray | None = None) -> RadarFrame:
    due_ns = T0_NS + number * PERIOD_NS + (radar == "vertical") * (PERIOD_NS // 2)
    return RadarFrame(radar, number, due_ns if t_ns is None else t_ns, ADC[radar] if adc is None else adc, LAYOUT)


def lanes(change: Callable[[list[RadarFrame]], list[Item]], poses: list[Pose] | None = None) -> list[Item]:
    """Frames in order of time, the horizontal ones changed; poses all around them unless others are given."""
    known = scene_poses(COUNT) if poses is None else poses
    return [*known, *in_time_order(change(list(FRAMES["horizontal"])), FRAMES["vertical"])]


def replaced(number: int, item: Item) -> Callable[[list[RadarFrame]], list[Item]]:
    return lambda frames: [*frames[:number], item, *frames[number + 1 :]]


ZERO = np.zeros(LAYOUT.shape, dtype=np.int16)
RAILS = np.full(LAYOUT.shape, 32767, dtype=np.int16)


@pytest.mark.parametrize(
    ("item", "cause"),
    [
        (frame("horizontal", 2, adc=ZERO), "all_zero"),
        (frame("horizontal", 2, adc=RAILS), "saturated"),
        (Loss("horizontal", 2, LossCause.TRUNCATED, "98 of 196608 bytes", T0_NS + 2 * PERIOD_NS), "truncated"),
        (Loss("horizontal", 2, LossCause.NOT_FINITE, "NaN", T0_NS + 2 * PERIOD_NS), "not_finite"),
    ],
)
def test_a_bad_frame_takes_its_partner_along_and_nothing_else(item: Item, cause: str) -> None:
    pipeline, keep = run(lanes(replaced(2, item)))
    assert lost(pipeline) == {"horizontal": {cause: 1}, "vertical": {"unpaired": 1}}
    assert [result.number for result in keep.frames] == [0, 1, 3, 4, 5]
    assert pipeline.faults.last


def test_a_dropped_number_is_a_gap() -> None:
    pipeline, keep = run(lanes(lambda frames: [*frames[:2], *frames[3:]]))
    assert lost(pipeline) == {"horizontal": {"gap": 1}, "vertical": {"unpaired": 1}}
    assert [result.number for result in keep.frames] == [0, 1, 3, 4, 5]


def test_a_partner_that_never_comes() -> None:
    pipeline, keep = run([*scene_poses(COUNT), *FRAMES["vertical"]])
    assert lost(pipeline) == {"vertical": {"unpaired": COUNT}}
    assert keep.frames == []
    assert keep.windows == []


def test_duplicates_are_lost_and_their_first_is_not() -> None:
    pipeline, keep = run(lanes(lambda frames: [*frames[:3], frames[2], *frames[3:]]))
    assert lost(pipeline) == {"horizontal": {"backwards_time": 1}}
    assert [result.number for result in keep.frames] == list(range(COUNT))


def test_a_frame_out_of_order_is_lost() -> None:
    swapped = [*FRAMES["horizontal"][:2], FRAMES["horizontal"][3], FRAMES["horizontal"][2], *FRAMES["horizontal"][4:]]
    pipeline, keep = run([*scene_poses(COUNT), *swapped, *FRAMES["vertical"]])
    assert lost(pipeline) == {"horizontal": {"gap": 1, "backwards_time": 1}, "vertical": {"unpaired": 1}}
    assert [result.number for result in keep.frames] == [0, 1, 3, 4, 5]


def test_a_stamp_that_goes_back_loses_that_frame() -> None:
    early = frame("horizontal", 3, T0_NS + PERIOD_NS)
    pipeline, keep = run([*scene_poses(COUNT), *replaced(3, early)(FRAMES["horizontal"]), *FRAMES["vertical"]])
    assert lost(pipeline) == {"horizontal": {"backwards_time": 1}, "vertical": {"unpaired": 1}}
    assert [result.number for result in keep.frames] == [0, 1, 2, 4, 5]


def test_all_clocks_going_back_loses_frames_until_the_old_time_is_reached() -> None:
    """The numbers go on, the stamps do not: frames 3.. are as early as 0.. were."""
    again = [frame(radar, n + 3, T0_NS + n * PERIOD_NS + (radar == "vertical") * 8_000_000)
             for n in range(6) for radar in RADARS]  # fmt: skip
    first = [one for n in range(3) for one in (FRAMES["horizontal"][n], FRAMES["vertical"][n])]
    pipeline, keep = run([*scene_poses(COUNT), *first, *again])
    assert lost(pipeline) == {radar: {"backwards_time": 3} for radar in RADARS}
    assert [result.t_ns for result in keep.frames] == [T0_NS + n * PERIOD_NS for n in range(6)]


def test_bursts_of_one_number_far_apart_do_not_belong_together() -> None:
    late = [frame("vertical", n, T0_NS + (n + 3) * PERIOD_NS) for n in range(3)]
    pipeline, keep = run([*scene_poses(COUNT), *FRAMES["horizontal"][:3], *late])
    assert lost(pipeline) == {radar: {"unpaired": 3} for radar in RADARS}
    assert keep.frames == []
    assert "too far apart" in pipeline.faults.last


def test_frames_inside_a_pose_gap_are_lost_and_cut_the_window() -> None:
    frames = [frame(radar, n) for n in range(GAP_FRAMES + 11) for radar in RADARS]
    poses = scene_poses(GAP_FRAMES + 11)
    known = [p for p in poses if not 5.5 * PERIOD_NS <= p.t_ns - T0_NS <= (5.5 + GAP_FRAMES) * PERIOD_NS]
    pipeline, keep = run(in_time_order(known, frames))
    assert lost(pipeline) == {radar: {"no_pose": GAP_FRAMES} for radar in RADARS}
    assert [window.cloud.frames for window in keep.windows] == [6, 5]
    assert "gap of" in pipeline.faults.last


def test_without_poses_frames_wait_only_so_long() -> None:
    pipeline = Pipeline(RIG, None)
    for n in range(MAX_WAITING_PAIRS + 10):
        for radar in RADARS:
            pipeline.feed(frame(radar, n))
    assert pipeline.ledgers["vertical"].snapshot().pending == MAX_WAITING_PAIRS
    pipeline.finish()
    assert lost(pipeline) == {radar: {"no_pose": MAX_WAITING_PAIRS + 10} for radar in RADARS}
    assert "no pose yet" in pipeline.faults.last


def test_backward_and_duplicate_poses_are_refused_and_counted() -> None:
    poses = [p for pose in scene_poses(COUNT) for p in (pose, pose, pose_at(pose.t_ns - 5_000_000))]
    pipeline, keep = run([*poses, *in_time_order(FRAMES["horizontal"], FRAMES["vertical"])])
    assert pipeline.faults.poses_refused == 2 * len(poses) // 3
    assert lost(pipeline) == {}
    assert len(keep.frames) == COUNT


def test_one_pose_from_the_far_future_does_not_end_everything() -> None:
    count = REFUSED_POSES + 20
    spoiled = [*scene_poses(count, PERIOD_NS)]
    spoiled.insert(4, pose_at(T0_NS + 3600 * 10**9))
    frames = [frame(radar, n) for n in range(count) for radar in RADARS]
    pipeline = Pipeline(RIG, None)
    while frames or spoiled:
        now_ns = frames[0].t_first_chirp_ns if frames else instant(spoiled[0])
        if spoiled and (not frames or instant(spoiled[0]) <= now_ns or instant(spoiled[0]) > T0_NS + 10**12):
            pipeline.feed(spoiled.pop(0))
        else:
            pipeline.feed(frames.pop(0))
    pipeline.finish()
    assert pipeline.faults.poses_refused == REFUSED_POSES
    account = pipeline.ledgers["horizontal"].snapshot()
    assert account.balanced
    assert set(account.lost) == {LossCause.NO_POSE}
    assert account.frames_ok >= 15


def test_after_all_clocks_restart_results_come_again() -> None:
    """Frames and poses start again at an earlier time: once the pose track has restarted, all goes on as before."""
    count, objects = REFUSED_POSES + 20, replace(RIG.settings.objects, min_points=3, core_points=2)
    rig = replace(RIG, settings=replace(RIG.settings, objects=objects))
    frames = [frame(radar, n) for n in range(count) for radar in RADARS]
    numbered = [replace(f, number=f.number + count) for f in frames]
    pipeline, keep = run([
        *in_time_order([pose for pose in scene_poses(count, PERIOD_NS) if pose.t_ns > T0_NS - 10**7], frames),
        *in_time_order(scene_poses(count, PERIOD_NS), numbered),
    ], Pipeline(rig, None))  # fmt: skip
    before, after = (window.cloud for window in keep.windows)
    assert after.t_start_ns < before.t_end_ns
    assert keep.frames[-1].number == 2 * count - 1
    assert sum(len(window.objects) for window in keep.windows) > 0
    assert set(lost(pipeline)["horizontal"]) <= {"backwards_time", "no_pose"}
    assert len(keep.frames) >= count + 15


def test_a_pose_that_stands_alone_gives_no_velocity_and_so_no_frame() -> None:
    alone = [pose_at(T0_NS + n * GAP_FRAMES * PERIOD_NS) for n in range(2)]
    frames = [frame(radar, n) for n in range(GAP_FRAMES + 1) for radar in RADARS]
    pipeline, keep = run(in_time_order(alone, frames))
    assert keep.frames == []
    assert lost(pipeline) == {radar: {"no_pose": GAP_FRAMES + 1} for radar in RADARS}
    assert "velocity" in pipeline.faults.last


def test_positions_beyond_the_earth_are_refused() -> None:
    wild = [Pose(p.t_ns, p.position_m * 1e300, LOOKING_LEFT) for p in scene_poses(COUNT)]
    pipeline, _ = run([*wild, *in_time_order(FRAMES["horizontal"], FRAMES["vertical"])])
    assert lost(pipeline) == {radar: {"no_pose": COUNT} for radar in RADARS}


@pytest.mark.parametrize("quaternion", [[0.0, 0.0, 0.0, 1.01], [0.0] * 4, [np.nan] * 4])
def test_what_is_no_rotation_is_no_pose(quaternion: list[float]) -> None:
    with pytest.raises(PoseError, match="norm 1"):
        Pose(T0_NS, np.zeros(3), np.array(quaternion))


def test_points_that_are_not_finite_are_not_fused(monkeypatch: pytest.MonkeyPatch) -> None:
    process = Associator.process

    def spoil(self: Associator, h: Detections, v: Detections, velocity: Float64 | None = None) -> PointCloud:
        cloud = process(self, h, v, velocity)
        if cloud.number == 3:
            cloud.xyz_m[0, 1] = np.nan
        return cloud

    monkeypatch.setattr(Associator, "process", spoil)
    pipeline, keep = run(lanes(list))
    assert lost(pipeline) == {radar: {"not_finite": 1} for radar in RADARS}
    assert [result.number for result in keep.frames] == [0, 1, 2, 4, 5]
    assert np.isfinite(keep.windows[0].cloud.xyz_m).all()


def test_another_layout_is_refused_before_it_is_counted() -> None:
    two_loops = replace(LAYOUT, loops=2)
    wrong = RadarFrame("horizontal", 1, T0_NS + PERIOD_NS, np.zeros(two_loops.shape, np.int16), two_loops)
    pipeline = Pipeline(RIG, None)
    with pytest.raises(CaptureError, match="use the rig") as caught:
        pipeline.feed(wrong)
    assert "loops=2" in str(caught.value)
    run(lanes(list), pipeline)
    assert lost(pipeline) == {}


def test_a_radar_that_the_rig_lacks_is_refused() -> None:
    pipeline = Pipeline(replace(RIG, radars={"horizontal": RIG.radars["horizontal"]}), None)
    with pytest.raises(CaptureError, match="does not have"):
        pipeline.feed(FRAMES["vertical"][0])
    pipeline.finish()


def test_a_dead_receiver_is_named() -> None:
    adc = ADC["horizontal"].copy()
    adc[1, :, :, :, 2] = 0
    pipeline, _ = run(lanes(replaced(5, frame("horizontal", 5, adc=adc))))
    assert pipeline.faults.dead_channels == {"horizontal": ("RX7",), "vertical": ()}


OFFSETS = st.integers(-3, 6)
STEPS = st.one_of(
    st.tuples(st.just("frame"), st.sampled_from(RADARS), OFFSETS, OFFSETS),
    st.tuples(st.just("loss"), st.sampled_from(RADARS), OFFSETS, st.integers(1, 3)),
    st.tuples(st.just("pose"), st.sampled_from([1.0, 1e3, 1e150]), OFFSETS, OFFSETS),
    st.tuples(st.just("pair"), st.sampled_from(["ok", "zero", "rails"]), st.just(0), st.just(0)),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(STEPS, max_size=40), st.booleans())
def test_any_sequence_balances(steps: list[tuple[str, object, int, int]], one_radar: bool) -> None:
    radars: tuple[RadarId, ...] = ("horizontal",) if one_radar else RADARS
    pipeline = Pipeline(replace(RIG, radars={radar: RIG.radars[radar] for radar in radars}), None)
    keep = Keep()
    pipeline.sinks.append(keep)
    number, now_ns = 0, T0_NS
    for kind, what, a, b in steps:
        number, now_ns = max(0, number + 1), now_ns + PERIOD_NS
        items: list[Item] = []
        if kind == "frame":
            items = [frame("vertical" if what == "vertical" else "horizontal", max(0, number + a), now_ns + b * 10**7)]
        elif kind == "loss":
            radar: RadarId = "vertical" if what == "vertical" else "horizontal"
            items = [Loss(radar, max(0, number + a), LossCause.TRUNCATED, "cut", now_ns, b)]
        elif kind == "pose":
            scale = what if isinstance(what, float) else 1.0
            items = [Pose(now_ns + a * 10**7, scale * np.array([0.05 * number, 0.0, 0.8]), LOOKING_LEFT)]
        else:
            adc = {"ok": None, "zero": ZERO, "rails": RAILS}[str(what)]
            items = [pose_at(now_ns), *(frame(r, number, now_ns + (r == "vertical") * 10**6, adc) for r in radars)]
        for item in items:
            try:
                pipeline.feed(item)
            except CaptureError:
                assert one_radar
                assert getattr(item, "radar", "") == "vertical"
    finish(pipeline, keep)


def test_the_ledger_catches_a_frame_that_is_closed_twice() -> None:
    pipeline, _ = run([pose_at(T0_NS), pose_at(T0_NS + PERIOD_NS), scene_frame("horizontal", 0)])
    with pytest.raises(RfconstructError, match="twice"):
        pipeline.ledgers["horizontal"].ok()
