# SPDX-License-Identifier: Apache-2.0
"""Late subscribers get the last values, those who know them are not bothered; only the newest on request."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace

import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st
from stream_samples import heatmap, pose, shape, status
from stream_sockets import LOCAL, WAIT_S, client_messages, publisher, subscribed

from edge import connect
from edge.errors import ConfigError, WireError
from edge.stream.client import Client
from edge.stream.messages import HeartbeatMessage, Message, PoseMessage, ShapeMessage, StatusMessage
from edge.stream.publisher import Publisher
from edge.stream.wire import FLAG_REPEATED, conflatable, split_conflatable

LATEST = replace(LOCAL, latest_endpoints=("tcp://127.0.0.1:*",))


def served(sender: Publisher, client: Client, count: int) -> list[Message]:
    """The first messages that are no heartbeats, while the publisher only gives signs of life."""
    found: list[Message] = []
    deadline = time.monotonic() + WAIT_S
    while len(found) < count and time.monotonic() < deadline:
        sender.heartbeat()
        message = client.recv(0.005)
        if message is not None and not isinstance(message, HeartbeatMessage):
            found.append(message)
    return found


def test_a_late_subscriber_is_served_with_the_last_status_and_the_last_shape_of_each_class() -> None:
    with publisher() as sender:
        sender.status(status())
        sender.pose(pose())
        for identity in (1, 2):
            sender.shape(replace(shape(), identity=identity))
        sender.shape(replace(shape(), class_name="bicycle", identity=3))
        with connect(sender.endpoints[0]) as client:
            got = served(sender, client, 3)
    shapes = {m.class_name: m for m in got if isinstance(m, ShapeMessage)}
    assert {name: m.identity for name, m in shapes.items()} == {"car": 2, "bicycle": 3}
    assert [type(m) for m in got].count(StatusMessage) == 1
    assert all(m.header.flags & FLAG_REPEATED for m in got)
    assert shapes["car"].header.sequence == 2
    assert client.lost == {}


def test_only_what_was_subscribed_is_repeated() -> None:
    with publisher() as sender:
        sender.status(status())
        sender.shape(shape())
        sender.shape(replace(shape(), class_name="bicycle"))
        with connect(sender.endpoints[0], ("shape/bicycle",)) as client:
            got = served(sender, client, 1)
        assert isinstance(got[0], ShapeMessage)
        assert got[0].class_name == "bicycle"
        assert sender.shape(shape())
        assert sender._sequence["1/shape/car/"] == 2


def test_who_knows_it_already_loses_nothing_and_hears_nothing_twice() -> None:
    with publisher() as sender, subscribed(sender, "shape", "pose") as early:
        sender.shape(shape())
        assert len(client_messages(early, 1)) == 1
        with connect(sender.endpoints[0], ("shape",)) as late:
            assert len(served(sender, late, 1)) == 1
        sender.pose(pose())
        assert isinstance(client_messages(early, 1)[0], PoseMessage)
        assert early.repeated == 1
        assert early.lost == {}
        assert early.restarts == 0


def test_many_subscriptions_do_not_flood_the_others() -> None:
    """A subscriber that subscribes a thousand times: repeats stay below REPEAT_HZ, counted by sequence numbers."""
    with publisher() as sender:
        sender.shape(shape())
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        storm = context.socket(zmq.SUB)
        storm.connect(sender.endpoints[0])
        start = time.monotonic()
        for _ in range(1000):
            storm.setsockopt(zmq.SUBSCRIBE, b"1/shape/")
            storm.setsockopt(zmq.UNSUBSCRIBE, b"1/shape/")
        for _ in range(200):
            sender.heartbeat()
            time.sleep(0.001)
        repeats = sender._sequence["1/shape/car/"] - 1
        assert 1 <= repeats <= 2 + 6 * (time.monotonic() - start)
        storm.close(linger=0)
        context.term()


def test_upstream_bytes_that_are_no_subscription_are_ignored() -> None:
    with publisher() as sender, subscribed(sender, "pose") as client:
        sender.shape(shape())
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        upstream = context.socket(zmq.XSUB)
        upstream.connect(sender.endpoints[0])
        for content in (b"", b"\x02", b"\x05" * 100, b"\x01" + b"x" * 200, b"\x00nothing"):
            upstream.send(content)
        upstream.send(b"\x01" + b"1/shape/")
        deadline = time.monotonic() + WAIT_S
        while not upstream.poll(5) and time.monotonic() < deadline:
            sender.heartbeat()
        assert upstream.recv_multipart()[0] == b"1/shape/car/"
        sender.pose(pose())
        assert isinstance(client_messages(client, 1)[0], PoseMessage)
        upstream.close(linger=0)
        context.term()


def test_conflated_reader_gets_the_newest_of_each_topic_however_long_it_sleeps() -> None:
    with publisher(LATEST) as sender, connect(sender.latest_endpoints[0], ("pose", "heat"), conflate=True) as client:
        sender.pose(pose())
        sender.heatmap(heatmap("vertical"))
        assert {type(m).__name__ for m in served(sender, client, 2)} == {"PoseMessage", "HeatmapMessage"}
        frames = [sender.pose(pose()) for _ in range(50)]
        assert len(frames) == 50
        newest, deadline = 0, time.monotonic() + WAIT_S
        while newest < 50 and time.monotonic() < deadline:  # a full queue may have lost the newest: the next one comes
            message = client.recv(0.2)
            newest = message.header.sequence if isinstance(message, PoseMessage) else newest
            if newest < 50:
                sender.pose(pose())
        assert newest >= 50
        assert client.lost == {}
        assert client.skipped > 0


def test_conflated_late_reader_is_served_with_any_topic() -> None:
    with publisher(LATEST) as sender:
        sender.pose(pose())
        with connect(sender.latest_endpoints[0], ("pose",), conflate=True) as client:
            assert isinstance(served(sender, client, 1)[0], PoseMessage)
            assert client.alive
            with connect(sender.latest_endpoints[0], ("pose",), conflate=True) as second:
                assert isinstance(served(sender, second, 1)[0], PoseMessage)
            sender.pose(pose())
            following = client_messages(client, 1)[0]
            assert isinstance(following, PoseMessage)
            assert following.header.sequence == 1
            assert client.restarts == 0


def test_conflate_needs_topics() -> None:
    with pytest.raises(ConfigError, match="topics"):
        connect("tcp://127.0.0.1:1", conflate=True)


def test_one_frame_begins_with_its_topic_and_is_undone() -> None:
    frames = [b"1/shape/car/", b"header", b"payload", b""]
    block = conflatable(frames)
    assert block.startswith(b"1/shape/car/\x04\x00\x00\x00")
    assert split_conflatable(block) == frames
    for bad in (b"", b"1/pose/", b"x" * 500, block[:-1], b"1/pose/" + block[12:], block[12:]):
        with pytest.raises(WireError):
            split_conflatable(bad)


@given(st.binary(max_size=200))
@settings(max_examples=500, deadline=None)
def test_any_bytes_raise_one_kind_of_error(content: bytes) -> None:
    with pytest.raises(WireError):
        split_conflatable(content)


def test_a_hundred_stuck_subscribers_cost_the_others_nothing() -> None:
    """By counters: the reader misses no message, and what the stuck ones miss is dropped at their own queues."""
    stuck_count, rounds = 100, 40
    with publisher(replace(LOCAL, send_high_water_mark=4)) as sender:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        context.set(zmq.MAX_SOCKETS, 4096)
        stuck = []
        for _ in range(stuck_count):
            receiver = context.socket(zmq.SUB)
            receiver.setsockopt(zmq.RCVHWM, 1)
            receiver.setsockopt(zmq.RCVBUF, 4096)
            receiver.setsockopt(zmq.SUBSCRIBE, b"1/shape/")
            receiver.connect(sender.endpoints[0])
            stuck.append(receiver)
        with subscribed(sender, "shape") as reader:
            got = Counter[int]()
            for _ in range(rounds):
                sent = sender.shape(shape(4096))
                assert sent
                message = client_messages(reader, 1)[0]
                assert isinstance(message, ShapeMessage)
                got[message.header.sequence] += 1
            assert set(got.values()) == {1}
            assert len(got) == rounds
            assert reader.lost == {}
        for receiver in stuck:
            receiver.close(linger=0)
        context.term()
