# SPDX-License-Identifier: Apache-2.0
"""The emulated pose sensor: messages in the documented format on ZeroMQ, lines that our reader reads, faults."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from edge.errors import ConfigError
from edge.frames import Pose
from edge.odometry.recorded import read_poses
from edge.stream.client import connect
from edge.stream.messages import PoseMessage
from train.simulate.faults import Faults
from train.simulate.pose_stream import PoseStream, PoseStreamSettings, write_poses

SAFETY_MS = 20_000


def poses(count: int) -> list[Pose]:
    turn = np.array([0.0, 0.0, 0.6, 0.8])
    return [Pose(10**9 + k * 10_000_000, np.array([0.1 * k, -0.2, 0.8]), turn) for k in range(count)]


@pytest.fixture
def subscriber() -> Iterator[Any]:
    with zmq.Context() as context, context.socket(zmq.SUB) as one:
        one.setsockopt(zmq.SUBSCRIBE, b"1/pose/")
        one.setsockopt(zmq.RCVTIMEO, SAFETY_MS)
        one.setsockopt(zmq.RCVHWM, 10_000)
        yield one


def attached(stream: PoseStream, subscriber: Any) -> None:
    """Subscribe and wait until the subscription is known to the publisher, then start."""
    monitor = stream._socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)
    subscriber.connect(stream.address)
    assert monitor.poll(SAFETY_MS)
    stream._socket.disable_monitor()
    monitor.close(0)
    # The subscription travels after the handshake: send until it arrives, under a topic that the tests do not count.
    subscriber.setsockopt(zmq.SUBSCRIBE, b"probe")
    while True:
        stream._socket.send(b"probe")
        if subscriber.poll(5):
            break
    while subscriber.poll(20):
        subscriber.recv()
    subscriber.setsockopt(zmq.UNSUBSCRIBE, b"probe")


def received(subscriber: Any, count: int) -> list[dict[str, Any]]:
    return [msgpack.unpackb(subscriber.recv_multipart()[1]) for _ in range(count)]


def test_messages_are_those_of_the_wire_format(subscriber: Any) -> None:
    sent = poses(5)
    stream = PoseStream(sent, PoseStreamSettings(pace=0.0, rebase=False))
    attached(stream, subscriber)
    with stream:
        got = received(subscriber, 5)
    for k, (message, pose) in enumerate(zip(got, sent, strict=True)):
        assert (message["v"][0], message["type"], message["frame"], message["src"]) == (1, "pose", "odom", "sim")
        assert (message["seq"], message["t_ns"]) == (k, pose.t_ns)
        assert message["pose"] == {"t_ns": pose.t_ns, "p": pose.position_m.tolist(), "q": [0.0, 0.0, 0.6, 0.8]}


def test_our_own_client_reads_it() -> None:
    stream = PoseStream(poses(2000), PoseStreamSettings(pace=1.0))
    with connect(stream.address, ["pose"], timeout_s=20.0) as client, stream:
        message = next(iter(client))
    assert isinstance(message, PoseMessage)
    assert message.pose.position_m[1] == -0.2


def test_real_time_moves_the_times(subscriber: Any) -> None:
    stream = PoseStream(poses(3), PoseStreamSettings(pace=1.0))
    attached(stream, subscriber)
    with stream:
        got = received(subscriber, 3)
    stamps = [message["t_ns"] for message in got]
    assert np.diff(stamps).tolist() == [10_000_000, 10_000_000]
    assert all(m["t_pub_ns"] >= m["t_ns"] for m in got), "no pose comes before its instant"


def test_faults(subscriber: Any) -> None:
    faults = Faults(seed=1)
    faults.set("drop", "pose", skip=1, times=1)
    faults.set("duplicate", "pose", skip=2, times=1)
    stream = PoseStream(poses(6), PoseStreamSettings(pace=0.0), faults)
    attached(stream, subscriber)
    with stream:
        got = [message["seq"] for message in received(subscriber, 6)]
    assert sorted(got) == [0, 2, 3, 3, 4, 5], "the missing number shows the loss"


def test_garbled_poses_are_refused_by_the_client(subscriber: Any) -> None:
    faults = Faults(seed=1)
    faults.set("garble", "pose", value=40, times=3)
    stream = PoseStream(poses(6), PoseStreamSettings(pace=0.0), faults)
    attached(stream, subscriber)
    with stream:
        got = [subscriber.recv_multipart()[1] for _ in range(6)]
    assert [readable(raw) for raw in got] == [False] * 3 + [True] * 3


def readable(raw: bytes) -> bool:
    """Whether a header still says what a pose says."""
    try:
        message = msgpack.unpackb(raw)
        return bool(message["type"] == "pose" and message["pose"]["q"] == [0.0, 0.0, 0.6, 0.8])
    except (ValueError, KeyError, TypeError, msgpack.UnpackException):
        return False


def test_unplug_and_stop(subscriber: Any) -> None:
    stream = PoseStream(poses(20_000), PoseStreamSettings(pace=1.0))
    attached(stream, subscriber)
    stream.start()
    received(subscriber, 2)
    stream.unplug()
    while subscriber.poll(60):
        subscriber.recv_multipart()
    stream.plug()
    received(subscriber, 1)
    assert stream.stop()


def test_address_in_use() -> None:
    with PoseStream(poses(1)) as stream, pytest.raises(ConfigError, match="pose stream cannot use its address"):
        PoseStream(poses(1), PoseStreamSettings(address=stream.address))


@pytest.mark.parametrize("form", ["csv", "jsonl"])
def test_lines_are_read_back(tmp_path: Path, form: str) -> None:
    path, sent = tmp_path / "poses", poses(7)
    assert write_poses(path, sent, form) == 7
    got = list(read_poses(path))
    assert [p.t_ns for p in got] == [p.t_ns for p in sent]
    assert all(np.array_equal(a.position_m, b.position_m) for a, b in zip(got, sent, strict=True))
    assert all(np.array_equal(a.quaternion_xyzw, b.quaternion_xyzw) for a, b in zip(got, sent, strict=True))
