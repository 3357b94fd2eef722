# SPDX-License-Identifier: Apache-2.0
"""Recordings in the viewer: the store, the player's clock, jumps, and both kinds of recording."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from view_samples import S, block, drive, heatmap_draft, pose_draft, shape_draft

from edge.recording import schema
from edge.recording.reader import RecordingReader
from edge.recording.writer import RecordingWriter
from edge.stream.messages import HeatmapMessage, PoseMessage, ShapeMessage
from edge.stream.wire import Draft
from edge.view.digest import Digest, copy_results, run_pipeline
from edge.view.playback import LONGEST_STEP_S, PATH_POSES, Player
from edge.view.store import MessageStore

sys.path.append(str(Path(__file__).resolve().parents[1] / "pipeline"))


def filled(drafts: list[Draft]) -> MessageStore:
    store = MessageStore()
    for draft in drafts:
        store.add(draft.topic, draft.t_ns, block(draft))
    store.ended = True
    return store


def test_the_store_gives_back_what_was_added() -> None:
    drafts = drive(1.0)
    store = filled(drafts)
    assert len(store) == len(drafts)
    assert store.span_ns == (0, S)
    assert [store.message(k).header.topic for k in range(len(store))] == [d.topic for d in drafts]  # type: ignore[union-attr]
    store.close()


def test_the_stores_clock_never_goes_back() -> None:
    store = filled([pose_draft(1.0), shape_draft(1, 0.4), pose_draft(1.1)])
    assert [store.t_ns(k) for k in range(3)] == [S, S, round(1.1 * S)]
    store.close()


def test_a_full_store_says_so() -> None:
    store = MessageStore(limit_bytes=1000)
    for number in range(20):
        store.add("1/pose/", number, bytes(100))
    assert (store.full, len(store)) == (True, 10)
    store.close()


def test_messages_come_when_they_are_due_at_every_speed() -> None:
    store = filled([pose_draft(k / 10) for k in range(101)])
    player = Player(store)
    assert len(list(player.step(0.0)[1])) == 1
    assert len(list(player.step(0.4)[1])) == 4
    player.set_speed(10.0)
    assert len(list(player.step(0.8)[1])) == 40
    player.play(False)
    assert list(player.step(1.2)[1]) == []
    assert player.position_s == pytest.approx(4.4)
    player.play(True)
    assert len(list(player.step(1.5)[1])) == 30
    store.close()


def test_a_stall_is_not_made_up_for() -> None:
    store = filled([pose_draft(k / 10) for k in range(101)])
    player = Player(store)
    player.step(0.0)
    player.step(60.0)
    assert player.position_s == pytest.approx(LONGEST_STEP_S)
    store.close()


def test_the_player_stops_at_the_end_and_begins_again() -> None:
    store = filled([pose_draft(0.0), pose_draft(0.1)])
    player = Player(store)
    player.step(0.0)
    player.step(0.5)
    assert (player.playing, player.position_s) == (False, pytest.approx(0.1))
    player.play(True)
    empty_first, messages = player.step(0.6)
    assert (empty_first, len(list(messages)), player.position_s) == (True, 1, 0.0)
    store.close()


def test_a_jump_rebuilds_the_scene_with_as_little_as_possible() -> None:
    drafts = [draft for k in range(400) for draft in (pose_draft(k / 10), heatmap_draft("horizontal", k / 10, k))]
    drafts.append(shape_draft(1, 39.0))
    store = filled(sorted(drafts, key=lambda draft: draft.t_ns))
    player = Player(store)
    player.seek(39.5)
    empty_first, due = player.step(0.0)
    messages = list(due)
    poses = [m for m in messages if isinstance(m, PoseMessage)]
    (heatmap,) = [m for m in messages if isinstance(m, HeatmapMessage)]
    assert empty_first
    assert (poses[-1].header.t_ns, heatmap.header.t_ns) == (round(39.5 * S), round(39.5 * S))
    assert poses[0].header.t_ns == pytest.approx(9.5 * S, abs=0.2 * S)
    assert sum(isinstance(m, ShapeMessage) for m in messages) == 1
    player.seek(-5.0)
    assert len(list(player.step(0.1)[1])) == 2
    player.seek(1e9)
    player.step(0.2)
    assert player.position_s == pytest.approx(39.9)
    store.close()


def test_a_jump_thins_a_long_path() -> None:
    store = filled([pose_draft(k / 100) for k in range(2 * PATH_POSES + 500)])
    player = Player(store)
    player.seek(1e9)
    messages = list(player.step(0.0)[1])
    assert len(messages) <= PATH_POSES + 2
    assert messages[-1].header.t_ns == round((2 * PATH_POSES + 499) / 100 * S)
    store.close()


def test_a_damaged_message_is_counted_and_passed_over() -> None:
    store = MessageStore()
    bad = bytearray(block(pose_draft(0.0)))
    bad[-3] ^= 0xFF
    store.add("1/pose/", 0, bytes(bad[:-1]))
    store.add("1/pose/", 0, block(pose_draft(0.0)))
    player = Player(store)
    assert len(list(player.step(0.0)[1])) == 1
    assert player.damaged == 1
    store.close()


def test_a_recording_of_results_is_taken_as_it_is(tmp_path: Path) -> None:
    drafts = drive(1.0)
    with RecordingWriter(tmp_path / "results.mcap", None) as writer:
        for draft in drafts:
            writer.message(schema.result_topic(draft.topic.encode()), block(draft), draft.t_ns)
    store = MessageStore()
    with RecordingReader(tmp_path / "results.mcap") as reader:
        copy_results(reader, store, lambda: False)
    assert len(store) == len(drafts)
    assert store.progress == pytest.approx(1.0)
    store.close()


def test_raw_frames_go_through_the_pipeline(tmp_path: Path) -> None:
    from pipeline_scenes import RIG, TRUTH_ODOM_M, in_time_order, scene_frame, scene_poses

    from edge.frames import RADARS, Pose
    from edge.odometry.transforms import transform_points
    from edge.pipeline import Pipeline
    from edge.stream.messages import DetectionsMessage, StatusMessage

    frames = 6
    items = in_time_order(*[[scene_frame(radar, n) for n in range(frames)] for radar in RADARS], scene_poses(frames))
    with RecordingWriter(tmp_path / "raw.mcap", RIG) as writer:
        for item in items:
            writer.pose(item) if isinstance(item, Pose) else writer.frame(item)  # type: ignore[arg-type]
    store = MessageStore()
    with RecordingReader(tmp_path / "raw.mcap") as reader:
        run_pipeline(reader, Pipeline(RIG, None), store, lambda: False)
    messages = [store.message(number) for number in range(len(store))]
    accounts = [m.status.radars["vertical"] for m in messages if isinstance(m, StatusMessage)]
    assert (accounts[-1].frames_in, accounts[-1].frames_ok) == (frames, frames)
    poses = {m.pose.t_ns: m.pose for m in messages if isinstance(m, PoseMessage)}
    points = [m for m in messages if isinstance(m, DetectionsMessage)]
    assert len(points) == frames
    last = points[-1].points
    assert last is not None
    placed_m = transform_points(poses[last.t_ns], last.xyz_m)
    nearest_m = np.linalg.norm(placed_m[:, None] - TRUTH_ODOM_M, axis=2).min(axis=0)
    assert (nearest_m < 0.2).sum() >= 3
    store.close()


def test_a_failure_of_the_work_is_kept_in_words() -> None:
    from edge.errors import RecordingError

    def fail(stopped: object) -> None:
        raise RecordingError("the disk is full")

    store = MessageStore()
    Digest(store, fail).stop()
    assert (store.ended, store.failure) == (True, "the disk is full")
    store.close()
