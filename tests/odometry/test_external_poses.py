# SPDX-License-Identifier: Apache-2.0
"""Poses over ZeroMQ: from the virtual rig's sensor, from a sender with another clock, from senders that misbehave."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
import zmq
from pose_collecting import Collected, collect

from edge.board_settings import PoseSettings
from edge.config import RigGeometry
from edge.errors import ConfigError
from edge.frames import Pose
from edge.odometry import external
from edge.odometry.external import ExternalSource, SenderTime
from edge.odometry.paced import straight
from edge.stream.convert import encode_pose
from edge.stream.decode import decode
from edge.stream.messages import Header, PoseMessage
from edge.stream.wire import BOOT_BYTES, HASH_BYTES, Stamp, pack
from train.simulate.pose_stream import PoseStream

NS = 1_000_000_000
GEOMETRY = RigGeometry(yaw_deg=0.0, offset_m=(2.0, 0.0, 0.5))


class Sender:
    """A publisher of poses with a clock of its own."""

    def __init__(self, address: str = "tcp://127.0.0.1:*", clock_ns: int = 0, boot: int = 1) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self.context.socket(zmq.PUB)
        self.socket.bind(address)
        self.address = self.socket.getsockopt_string(zmq.LAST_ENDPOINT)
        self.clock_ns, self.boot, self.number = clock_ns, bytes([boot]) * BOOT_BYTES, 0

    def send(self, x_m: float, age_ns: int = 0) -> int:
        """A pose of ``age_ns`` before now, at x; returns the true instant on this host's clock."""
        now_ns = time.monotonic_ns()
        their_ns = now_ns + self.clock_ns
        pose = Pose(their_ns - age_ns, np.array([x_m, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))
        stamp = Stamp(self.boot, self.number, their_ns, time.time_ns(), True, "live", bytes(8), bytes(HASH_BYTES))
        self.socket.send_multipart(pack(encode_pose(pose), stamp))
        self.number += 1
        return now_ns - age_ns

    def close(self) -> None:
        self.context.destroy(linger=0)


@pytest.fixture
def sender() -> Iterator[Sender]:
    made = Sender()
    yield made
    made.close()


def source_for(address: str, **settings: object) -> ExternalSource:
    chosen = {"kind": "zmq", "endpoint": address, "timeout_s": 5.0, **settings}
    source = ExternalSource(PoseSettings(**chosen), GEOMETRY)  # type: ignore[arg-type]
    source.start()
    return source


def settle(source: ExternalSource, sender: Sender) -> Collected:
    """Until the subscription is through."""

    def sent(collected: Collected) -> bool:
        sender.send(-1.0)
        time.sleep(0.002)
        return bool(collected.poses)

    return collect(source, sent)


def test_the_virtual_rigs_sensor_is_read_pose_by_pose() -> None:
    settings = PoseSettings(kind="constant", speed_m_s=2.0, rate_hz=200.0)
    stream = PoseStream(straight(settings))
    source = source_for(stream.address, clock="monotonic")
    with stream:
        got = collect(source, lambda c: len(c.poses) >= 100)
    source.close()
    first = got.poses[0]
    for pose in got.poses:
        np.testing.assert_allclose(
            pose.position_m[0] - first.position_m[0], 2.0 * (pose.t_ns - first.t_ns) / NS, atol=1e-6
        )
        np.testing.assert_allclose(pose.position_m[1:], [0.0, 0.5], atol=1e-12)
    assert got.kinds == ["started"]
    assert (source.health.lost, source.health.refused, source.health.restarts) == (0, 0, 0)


def test_poses_of_the_rig_are_taken_as_they_are(sender: Sender) -> None:
    source = source_for(sender.address, poses_of="rig")
    got = settle(source, sender)
    source.close()
    assert got.poses[0].position_m.tolist() == [-1.0, 0.0, 0.0]


def test_another_clock_is_mapped_and_never_earlier_than_the_truth(sender: Sender) -> None:
    sender.clock_ns = -(2**60)
    source = source_for(sender.address)
    got = settle(source, sender)
    time.sleep(0.02)  # the first pose below is of 3 ms ago
    true_ns: dict[int, int] = {}
    for number in range(150):
        true_ns[number] = sender.send(float(number), age_ns=3_000_000)
        got.items += source.poll(0.01)
    collect(source, lambda c: bool(c.poses) and c.poses[-1].position_m[0] == 151.0, got)
    source.close()
    errors_ns = [p.t_ns - true_ns[round(p.position_m[0]) - 2] for p in got.poses if p.position_m[0] >= 2.0]
    assert len(errors_ns) == 150
    assert all(0 <= error_ns < 0.1 * NS for error_ns in errors_ns)  # delay of loopback, on a busy machine
    assert got.kinds == ["started"]


def test_a_sender_that_restarts_begins_a_new_frame_and_clock(sender: Sender) -> None:
    source = source_for(sender.address)
    got = settle(source, sender)
    address = sender.address
    sender.close()
    other = Sender(address, clock_ns=12345 * NS, boot=2)
    try:

        def new(collected: Collected) -> bool:
            other.send(5.0)
            time.sleep(0.002)
            return bool(collected.poses) and collected.poses[-1].position_m[0] == 7.0

        collect(source, new, got)
    finally:
        other.close()
        source.close()
    assert "new_frame" in got.kinds
    event = got.events[got.kinds.index("new_frame")]
    assert event.new_frame
    assert source.health.restarts == 1
    assert abs(time.monotonic_ns() - got.poses[-1].t_ns) < 60 * NS


def test_silence_and_return_are_said_once_each(sender: Sender) -> None:
    source = source_for(sender.address, timeout_s=0.2)
    got = settle(source, sender)
    collect(source, lambda c: c.kinds[-1] == "silent", got)
    before = list(got.kinds)
    got.items += source.poll(0.5)
    assert got.kinds == before
    assert source.health.state == "silent"
    sender.send(3.0)
    collect(source, lambda c: c.kinds[-1] == "resumed", got)
    source.close()


def test_no_sender_at_all_is_said() -> None:
    source = source_for("tcp://127.0.0.1:9", timeout_s=0.1)
    got = collect(source, lambda c: bool(c.events))
    source.close()
    assert got.kinds == ["silent"]
    assert "no sender" in got.events[0].detail


def test_gaps_duplicates_and_garbage_are_counted(sender: Sender) -> None:
    source = source_for(sender.address, clock="monotonic")
    got = settle(source, sender)
    collect(source, lambda c: not source.poll(0.05), got)
    base = source.health
    sender.number += 3
    sender.send(1.0)
    sender.send(2.0, age_ns=NS)  # older than the one before
    sender.send(3.0, age_ns=100 * NS)  # beyond any delay
    for garbage in ([b"1/pose/", b"\x93"], [b"1/pose/"], [b"1/pose/", b"\x80", b"x"]):
        sender.socket.send_multipart(garbage)
    sender.send(4.0)
    collect(source, lambda c: bool(c.poses) and c.poses[-1].position_m[0] == 6.0, got)
    source.close()
    health = source.health
    assert health.lost - base.lost == 3
    assert health.refused - base.refused == 5
    assert health.poses - base.poses == 2


@pytest.mark.parametrize("endpoint", ["nonsense", "tcp://", "udp://a:1"])
def test_an_address_that_is_none_is_named(endpoint: str) -> None:
    source = ExternalSource(PoseSettings(kind="zmq", endpoint=endpoint), GEOMETRY)
    with pytest.raises(ConfigError, match="endpoint"):
        source.start()
    source.close()


def header_of(t_pub_ns: int, utc_ns: int) -> Header:
    pose = Pose(t_pub_ns, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    stamp = Stamp(bytes(BOOT_BYTES), 0, t_pub_ns, utc_ns, True, "live", bytes(8), bytes(HASH_BYTES))
    message = decode(pack(encode_pose(pose), stamp))
    assert isinstance(message, PoseMessage)
    return message.header


def test_stamps_on_utc_are_mapped_through_this_hosts_utc() -> None:
    clock = SenderTime(PoseSettings(kind="zmq", clock="utc"))
    before_ns = time.monotonic_ns()
    header = header_of(5 * NS, time.time_ns())
    local_ns = clock.local_ns(header, 4 * NS)  # measured one second before it was published
    after_ns = time.monotonic_ns()
    assert before_ns - NS - 5_000_000 <= local_ns <= after_ns - NS + 5_000_000


def test_stamps_of_this_hosts_clocks() -> None:
    header = header_of(5 * NS, 0)
    assert SenderTime(PoseSettings(kind="zmq", clock="monotonic")).local_ns(header, 77) == 77
    before_ns = time.monotonic_ns()
    local_ns = SenderTime(PoseSettings(kind="zmq", clock="realtime")).local_ns(header, time.time_ns())
    assert before_ns - 5_000_000 <= local_ns <= time.monotonic_ns() + 5_000_000


def test_a_clock_that_nothing_keeps_right_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(external, "utc_synchronised", lambda: False)
    monkeypatch.setattr(external, "tai_is_set", lambda: False)
    for clock in ("utc", "tai"):
        source = ExternalSource(PoseSettings(kind="zmq", clock=clock), GEOMETRY)  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match=f"clock is {clock}"):
            source.start()
        source.close()
