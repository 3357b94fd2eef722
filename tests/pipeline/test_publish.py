# SPDX-License-Identifier: Apache-2.0
"""What the pipeline publishes arrives at a client, equal to what the pipeline gave."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import RIG, T0_NS, Item, Keep, columns, finish, frames_of, in_time_order, scene_poses

from edge.config import StreamSettings
from edge.errors import WireError
from edge.frames import LossCause, ObjectCloud, Shape
from edge.pipeline import Pipeline
from edge.publish import PublishingSink
from edge.sources.base import Loss
from edge.stream.client import Client, connect
from edge.stream.messages import (
    CloudMessage,
    DetectionsMessage,
    HeartbeatMessage,
    HeatmapMessage,
    Message,
    PoseMessage,
    ShapeMessage,
    StatusMessage,
)
from edge.stream.publisher import Publisher
from edge.timing import StageTime

FRAMES = 6
POINTS_M = np.random.default_rng(3).normal(0.0, 1.0, (16384, 3)).astype(np.float32)


class Complete:
    """A completion that always gives the same points."""

    def complete(self, cloud: ObjectCloud) -> Shape:
        probability = {"car": 0.9, "unknown": 0.1}
        coarse_m = POINTS_M[:1024]
        return Shape(cloud.identity, "car", probability, 0.9, POINTS_M, coarse_m, cloud, "0" * 16, {"nn": 5})


@pytest.fixture
def publisher(tmp_path: Path) -> Iterator[Publisher]:
    settings = StreamSettings(endpoints=(f"ipc://{tmp_path}/stream",), send_high_water_mark=1000)
    with Publisher(settings, RIG.config_hash, RIG.calibration_hash, "sim") as opened:
        yield opened


def joined(publisher: Publisher) -> Client:
    """A client that has heard the publisher."""
    client = connect(publisher.endpoints[0], timeout_s=2.0)
    while client.recv(0.02) is None:
        publisher.heartbeat("INIT")
    return client


def collect(client: Client, into: list[Message]) -> threading.Thread:
    """Take messages on a thread of their own until the publisher says STOP."""

    def take() -> None:
        for message in client:
            into.append(message)
            if isinstance(message, StatusMessage) and message.status.state == "STOP":
                return

    thread = threading.Thread(target=take)
    thread.start()
    return thread


def play(publisher: Publisher, items: list[Item]) -> tuple[Pipeline, Keep, list[Message]]:
    objects = replace(RIG.settings.objects, min_points=3, core_points=2)
    rig, keep = replace(RIG, settings=replace(RIG.settings, objects=objects)), Keep()
    sink = PublishingSink(publisher, "1.2.3")
    pipeline = Pipeline(rig, Complete(), [keep, sink])  # type: ignore[arg-type]
    sink.watch(pipeline)
    messages: list[Message] = []
    with joined(publisher) as client:
        thread = collect(client, messages)
        sink.invite(0.25)
        for item in items:
            pipeline.feed(item)
        finish(pipeline, keep)
        sink.report("STOP")
        thread.join(timeout=10.0)
        assert not thread.is_alive()
        assert (client.lost, client.malformed) == ({}, 0)
    return pipeline, keep, messages


def test_everything_arrives_as_it_was(publisher: Publisher) -> None:
    frames = frames_of(FRAMES)
    lost = Loss("vertical", FRAMES, LossCause.TRUNCATED, "98 bytes", T0_NS + 10**9)
    items = [*in_time_order(scene_poses(FRAMES), frames["horizontal"], frames["vertical"]), lost]
    pipeline, keep, messages = play(publisher, items)

    detections = [m for m in messages if isinstance(m, DetectionsMessage)]
    assert [m.number for m in detections] == list(range(FRAMES))
    for message, result in zip(detections, keep.frames, strict=True):
        assert message.horizontal is not None
        assert message.vertical is not None
        assert message.points is not None
        assert columns([message.horizontal, message.vertical]) == columns(list(result.detections.values()))
        np.testing.assert_array_equal(message.points.xyz_m, result.cloud.xyz_m if result.cloud else None)
        assert message.header.t_ns == result.t_ns
    poses = [m for m in messages if isinstance(m, PoseMessage)]
    assert [m.pose.t_ns for m in poses] == [result.t_ns for result in keep.frames]

    heatmaps = [m for m in messages if isinstance(m, HeatmapMessage)]
    assert {m.radar for m in heatmaps} == {"horizontal", "vertical"}
    first = keep.frames[0].heatmaps["horizontal"].power
    np.testing.assert_allclose(heatmaps[0].power_db.max(), 10 * np.log10(first.max()), atol=0.25)

    (window,) = keep.windows
    (cloud,) = [m for m in messages if isinstance(m, CloudMessage)]
    np.testing.assert_array_equal(cloud.cloud.xyz_m, window.cloud.xyz_m)
    shapes = [m for m in messages if isinstance(m, ShapeMessage)]
    assert len(shapes) == len(window.shapes) >= 1
    np.testing.assert_array_equal(shapes[0].fine_m, POINTS_M)
    assert shapes[0].header.topic == "1/shape/car/"

    status = next(m for m in messages if isinstance(m, StatusMessage) and m.status.state == "STOP").status
    for radar, ledger in pipeline.ledgers.items():
        account = ledger.snapshot()
        assert (status.radars[radar].frames_in, status.radars[radar].frames_ok) == (account.frames_in, FRAMES)
        assert status.radars[radar].lost == {cause.value: count for cause, count in account.lost.items()}
    assert [(reason.code, reason.count) for reason in status.reasons] == [("TRUNCATED", 1)]
    assert status.versions == {"rfconstruct": "1.2.3"}
    assert {m.header.source for m in messages} == {"sim"}
    assert any(isinstance(m, HeartbeatMessage) for m in messages)


def test_what_the_wire_cannot_carry_is_counted_and_the_rest_goes_on(
    publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(shape: Shape) -> list[bytes]:
        raise WireError("too far for this encoding")

    monkeypatch.setattr(publisher, "shape", refuse)
    frames = frames_of(FRAMES)
    items = in_time_order(scene_poses(FRAMES), frames["horizontal"], frames["vertical"])
    pipeline, keep, messages = play(publisher, items)
    assert any(isinstance(m, CloudMessage) for m in messages)
    status = next(m for m in messages if isinstance(m, StatusMessage) and m.status.state == "STOP").status
    assert [(reason.code, reason.count) for reason in status.reasons] == [("NOT_SENT", len(keep.windows[0].shapes))]
    assert pipeline.faults.last == "too far for this encoding"


def test_heartbeats_say_init_while_kernels_compile(publisher: Publisher) -> None:
    sink = PublishingSink(publisher, "1")
    sink.watch(Pipeline(RIG, None))
    with joined(publisher) as client:
        with sink.starting():
            beats: list[HeartbeatMessage] = []
            while len(beats) < 3:
                message = client.recv(10.0)
                assert message is not None
                if isinstance(message, HeartbeatMessage):
                    beats.append(message)
        assert {beat.state for beat in beats} == {"INIT"}
    assert not [thread for thread in threading.enumerate() if thread.name == "starting"]


def test_percentiles_are_not_computed_for_every_frame(publisher: Publisher, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline, sink = Pipeline(RIG, None), PublishingSink(publisher, "1")
    sink.watch(pipeline)
    calls: list[int] = []

    def summary() -> dict[str, StageTime]:
        calls.append(1)
        return {}

    monkeypatch.setattr(pipeline.times, "summary", summary)
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0)
    for _ in range(50):
        sink.report()
    assert len(calls) == 1
