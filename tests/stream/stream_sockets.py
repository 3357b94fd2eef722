# SPDX-License-Identifier: Apache-2.0
"""A publisher, clients that have joined it, and a bare socket that sends what no publisher would."""

from __future__ import annotations

import time
from dataclasses import replace

import zmq
from stream_samples import STAMP, pose

from edge import connect
from edge.config import StreamSettings
from edge.stream.client import Client
from edge.stream.convert import encode_heartbeat, encode_pose
from edge.stream.messages import HeartbeatMessage, PoseMessage
from edge.stream.publisher import Publisher
from edge.stream.wire import pack

LOCAL = StreamSettings(("tcp://127.0.0.1:*",))
WAIT_S = 20.0
"""Upper bound of waits that normally take milliseconds."""


def publisher(settings: StreamSettings = LOCAL) -> Publisher:
    return Publisher(settings, b"configuration", b"calibration", "sim")


def subscribed(sender: Publisher, *topics: str, latest: bool = False) -> Client:
    """A client whose subscription has reached the publisher."""
    client = connect(sender.endpoints[0], topics=topics, timeout_s=WAIT_S, latest=latest)
    deadline = time.monotonic() + WAIT_S
    while not client.alive and time.monotonic() < deadline:
        sender.heartbeat()
        time.sleep(0.005)
    assert client.alive
    return client


class Raw:
    """A bare PUB socket, to send what a publisher never would."""

    def __init__(self) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.bind("tcp://127.0.0.1:*")
        self.endpoints = (self._socket.getsockopt_string(zmq.LAST_ENDPOINT),)
        self._beats = 0

    def heartbeat(self) -> None:
        self.send(pack(encode_heartbeat("RUN", 1), replace(STAMP, sequence=self._beats)))
        self._beats += 1

    def send(self, frames: list[bytes]) -> None:
        self._socket.send_multipart(frames)

    def pose(self, sequence: int, boot: bytes = STAMP.boot) -> None:
        self.send(pack(encode_pose(pose()), replace(STAMP, sequence=sequence, boot=boot)))

    def close(self) -> None:
        self._socket.close(linger=0)
        self._context.term()


def poses(client: Client, count: int) -> list[int]:
    """Sequence numbers of the next ``count`` poses."""
    found: list[int] = []
    while len(found) < count:
        message = client.recv(WAIT_S)
        assert message is not None
        if isinstance(message, PoseMessage):
            found.append(message.header.sequence)
    return found


def client_messages(client: Client, count: int) -> list[object]:
    """The next messages that are no heartbeats."""
    found: list[object] = []
    for message in client:
        if not isinstance(message, HeartbeatMessage):
            found.append(message)
        if len(found) == count:
            break
    return found
