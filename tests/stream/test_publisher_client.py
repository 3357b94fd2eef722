# SPDX-License-Identifier: Apache-2.0
"""Publisher and client over real sockets: losses, restarts, hostile bytes, addresses."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stream_samples import STAMP, detections, fused_cloud, heatmap, point_cloud, pose, shape, status
from stream_sockets import LOCAL, WAIT_S, Raw, client_messages, poses, publisher, subscribed

from edge import connect
from edge.config import StreamSettings
from edge.errors import ConfigError
from edge.stream.convert import encode_heartbeat, encode_pose
from edge.stream.messages import PoseMessage, ShapeMessage, StatusMessage
from edge.stream.publisher import _Pace
from edge.stream.wire import join, pack, split


@pytest.fixture
def raw() -> Iterator[Raw]:
    sender = Raw()
    yield sender
    sender.close()


@pytest.mark.parametrize("transport", ["tcp", "ipc"])
def test_every_kind_of_message_arrives(transport: str, tmp_path: Path) -> None:
    settings = LOCAL if transport == "tcp" else StreamSettings((f"ipc://{tmp_path}/pub",))
    with publisher(settings) as sender, subscribed(sender) as client:
        sent = [
            sender.shape(shape(16384)),
            sender.cloud(fused_cloud()),
            sender.heatmap(heatmap("horizontal")),
            sender.heatmap(heatmap("vertical")),
            sender.detections(detections("horizontal"), detections("vertical"), point_cloud()),
            sender.pose(pose()),
            sender.status(status()),
        ]
        names = [type(m).__name__ for m in client_messages(client, len(sent))]
    assert names == [
        "ShapeMessage",
        "CloudMessage",
        "HeatmapMessage",
        "HeatmapMessage",
        "DetectionsMessage",
        "PoseMessage",
        "StatusMessage",
    ]
    assert all(split(join(frames)) == frames for frames in sent)


def test_shape_arrives_bit_for_bit_and_sequences_count_by_topic() -> None:
    with publisher() as sender, subscribed(sender, "shape") as client:
        car = shape(16384)
        for item in (car, replace(car, class_name="bicycle"), car):
            sender.shape(item)
        got = client_messages(client, 3)
    assert all(isinstance(m, ShapeMessage) for m in got)
    assert [(m.header.topic, m.header.sequence) for m in got if isinstance(m, ShapeMessage)] == [
        ("1/shape/car/", 0),
        ("1/shape/bicycle/", 0),
        ("1/shape/car/", 1),
    ]
    assert isinstance(got[0], ShapeMessage)
    np.testing.assert_array_equal(got[0].fine_m, car.fine_m)
    assert got[0].header.config_hash == b"configur"
    assert client.lost == {}


def test_only_asked_topics_are_given_but_life_is_known() -> None:
    with publisher() as sender, subscribed(sender, "pose", "heat/vertical") as client:
        sender.shape(shape())
        sender.heatmap(heatmap("horizontal"))
        sender.heatmap(heatmap("vertical"))
        sender.pose(pose())
        topics = [m.header.topic for m in client_messages(client, 2)]  # type: ignore[attr-defined]
        assert topics == ["1/heat/vertical/", "1/pose/"]
        assert client.alive


def test_gaps_are_counted_by_topic(raw: Raw) -> None:
    with subscribed(raw, "pose") as client:  # type: ignore[arg-type]
        for sequence in (5, 6, 9, 10, 15):
            raw.pose(sequence)
        assert poses(client, 5) == [5, 6, 9, 10, 15]
        assert client.lost == {"1/pose/": 6}
        assert client.restarts == 0


@pytest.mark.parametrize(("sequence", "boot"), [(50, b"another boot 16b"), (0, STAMP.boot)])
def test_a_restart_is_no_loss(raw: Raw, sequence: int, boot: bytes) -> None:
    with subscribed(raw, "pose") as client:  # type: ignore[arg-type]
        for number in (3, 4):
            raw.pose(number)
        for number in (sequence, sequence + 1, sequence + 3):
            raw.pose(number, boot)
        poses(client, 5)
        assert client.restarts == 1
        assert client.lost == {"1/pose/": 1}


def test_client_finds_a_restarted_publisher(tmp_path: Path) -> None:
    settings = StreamSettings((f"ipc://{tmp_path}/pub",))
    sender = publisher(settings)
    client = subscribed(sender, "pose")
    for _ in range(3):
        sender.pose(pose())
    poses(client, 3)
    sender.close()
    with client, publisher(settings) as again:
        deadline = time.monotonic() + WAIT_S
        message = None
        while message is None and time.monotonic() < deadline:
            again.pose(pose())
            message = client.recv(0.02)
        assert isinstance(message, PoseMessage)
        assert client.restarts == 1
        assert client.lost == {}


def test_garbage_is_counted_and_the_next_message_is_fine(raw: Raw) -> None:
    good = pack(encode_pose(pose()), STAMP)
    with subscribed(raw) as client:  # type: ignore[arg-type]
        for frames in ([b"1/pose/"], [b"1/pose/", b"\xc1"], [b"", b""], [good[0], good[1][:-1]], [b"x"] * 30):
            raw.send(frames)
        future = pack(replace(encode_pose(pose()), type="weather", topic="1/weather/"), STAMP)
        raw.send(future)
        raw.send(good)
        assert poses(client, 1) == [7]
        assert client.malformed == 5
        assert client.ignored == 1


def test_latest_gives_only_the_newest_of_each_topic(raw: Raw) -> None:
    with subscribed(raw, "pose", latest=True) as client:  # type: ignore[arg-type]
        for number in range(10):
            raw.pose(number)
        got = poses(client, 1)
        while got[-1] != 9:
            got += poses(client, 1)
        assert len(got) + client.skipped == 10
        assert client.lost == {}


def test_a_stuck_subscriber_holds_nobody_up() -> None:
    count, item = 300, shape(16384)
    with publisher() as sender, subscribed(sender, "shape") as stuck, subscribed(sender, "shape") as reader:
        received = 0
        for _ in range(count):
            sender.shape(item)
            received += reader.recv(0.5) is not None
        got = 0
        while stuck.recv(0.2) is not None:
            got += 1
    assert received > 0.9 * count
    assert 0 < got < count


STUCK = """
import sys, time
from edge import connect
with connect(sys.argv[1], ("shape",), timeout_s=float(sys.argv[2])) as client:
    while not client.alive:
        time.sleep(0.01)
    print("there", flush=True)
    time.sleep(6.0)  # longer than the 3 s after which ZeroMQ's heartbeats give a peer up
    first = sum(1 for _ in client)
    print(first, flush=True)
"""


def test_a_reader_that_was_stuck_for_seconds_goes_on_reading() -> None:
    """With heartbeats of its own on a full queue, libzmq aborts the reader's process (issue 3937)."""
    with publisher() as sender:
        command = [sys.executable, "-c", STUCK, sender.endpoints[0], "3.0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as reader:
            assert reader.stdout is not None
            joined = threading.Event()
            beats = threading.Thread(target=lambda: [sender.heartbeat() for _ in iter(lambda: joined.wait(0.01), True)])
            beats.start()
            assert reader.stdout.readline() == "there\n"
            joined.set()
            beats.join()
            for _ in range(300):
                sender.shape(shape(16384))
            received, code = reader.stdout.readline(), reader.wait(60.0)
    assert code == 0
    assert int(received) > 0


def test_hostile_bytes_on_the_port_change_nothing() -> None:
    with publisher() as sender, subscribed(sender, "pose") as client:
        port = int(sender.endpoints[0].rsplit(":", 1)[1])
        for content in (os.urandom(100_000), b"GET / HTTP/1.1\r\n\r\n", b"\xff" + bytes(8) + b"\x7f" + bytes(60)):
            hostile = socket.create_connection(("127.0.0.1", port))
            with hostile, contextlib.suppress(ConnectionError):
                hostile.sendall(content)
        sender.pose(pose())
        assert poses(client, 1) == [0]


def test_heartbeats_and_their_rate(raw: Raw) -> None:
    with subscribed(raw) as client:  # type: ignore[arg-type]
        assert not client.frequency_ok
        for rate_hz, fine in ((10.0, True), (9.1, True), (8.0, False)):
            boot = os.urandom(16)
            for number in range(12):
                stamp = replace(STAMP, sequence=number, boot=boot, t_pub_ns=round(number * 1e9 / rate_hz))
                raw.send(pack(encode_heartbeat("RUN", 1), stamp))
            for _ in range(12):
                message = client.recv(WAIT_S)
                while message is not None and message.header.boot != boot:
                    message = client.recv(WAIT_S)
            assert client.frequency_ok is fine
    assert not client.alive


@pytest.mark.parametrize(("frames_hz", "expected"), [(60.0, 100), (10.0, 100), (25.0, 100), (4.0, 40)])
def test_pace_keeps_its_mean_rate(frames_hz: float, expected: int) -> None:
    pace = _Pace(10.0)
    passed = sum(pace.due(round(number * 1e9 / frames_hz)) for number in range(round(10 * frames_hz)))
    assert abs(passed - expected) <= 1
    assert pace.due(0)
    assert not pace.due(1)


def test_heatmaps_are_thinned_by_measurement_time() -> None:
    with publisher() as sender:
        sent = [bool(sender.heatmap(heatmap("vertical", t_ns=number * 16_666_667))) for number in range(60)]
        assert sum(sent) == 10
        assert sender.heatmap(heatmap("horizontal"))


def test_status_is_sent_at_once_when_it_changes() -> None:
    with publisher() as sender:
        assert sender.status(status())
        assert not sender.status(replace(status(), uptime_s=13.0))
        assert sender.status(replace(status(), reasons=()))
        assert sender.status(status())


def test_several_threads_may_publish() -> None:
    with publisher(replace(LOCAL, send_high_water_mark=100)) as sender, subscribed(sender, "pose") as client:
        threads = [threading.Thread(target=lambda: [sender.pose(pose()) for _ in range(4)]) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert poses(client, 16) == list(range(16))


def test_close_lets_the_last_message_out() -> None:
    sender = publisher()
    with subscribed(sender, "shape") as client:
        sender.shape(shape(16384))
        sender.close()
        assert isinstance(client.recv(WAIT_S), ShapeMessage)


def test_nobody_there_is_no_error_and_no_hang() -> None:
    with connect("tcp://127.0.0.1:1", timeout_s=0.01) as client:
        assert list(client) == []
        assert client.recv(0.0) is None
        assert not client.alive
        assert not client.frequency_ok
    assert client.recv(1.0) is None
    with pytest.raises(ConfigError, match="connect"):
        connect("carrier pigeon")


def test_small_encodings_travel() -> None:
    with publisher(replace(LOCAL, shape_encoding="i2")) as sender, subscribed(sender, "shape") as client:
        sender.shape(shape(16384))
        message = client.recv(WAIT_S)
        assert isinstance(message, ShapeMessage)
        np.testing.assert_allclose(message.fine_m, shape(16384).fine_m, atol=0.501e-3)


def test_importing_edge_loads_no_zeromq() -> None:
    code = "import edge, sys; assert 'zmq' not in sys.modules; edge.connect; assert 'zmq' in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_example_prints_shapes() -> None:
    example = Path(__file__).resolve().parents[2] / "examples" / "print_shapes.py"
    with publisher() as sender:
        process = subprocess.Popen(
            [sys.executable, str(example), sender.endpoints[0]], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        first, done = process.stdout.readline(), threading.Event()
        thread = threading.Thread(target=lambda: [sender.shape(shape()) for _ in iter(lambda: done.wait(0.05), True)])
        thread.start()
        line = process.stdout.readline()
        done.set()
        thread.join()
        process.terminate()
        process.communicate()
    assert "waiting for shapes" in first
    assert "object   5  car" in line
    assert "size 1.50 x 2.00 x 1.50 m" in line
    assert StatusMessage.__doc__
