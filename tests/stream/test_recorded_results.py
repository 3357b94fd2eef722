# SPDX-License-Identifier: Apache-2.0
"""Results are recorded byte for byte and published again: same content, source "replay", numbers and times rising."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stream_samples import BOOT, STAMP, detections, fused_cloud, heatmap, point_cloud, pose, shape, status
from stream_sockets import LOCAL, WAIT_S, Raw, publisher

from edge.cli import main
from edge.digest import ResultDigest
from edge.errors import ExitCode, RecordingError, WireError
from edge.recording.playback import Part
from edge.recording.reader import RecordingReader
from edge.recording.recorder import Recorder
from edge.recording.republish import Republisher, ResultsPlayback
from edge.recording.stored_results import parse, shifted
from edge.recording.subscribing import RecordingClient
from edge.recording.writer import RecordingWriter
from edge.stream import convert
from edge.stream.client import connect
from edge.stream.messages import CloudMessage, DetectionsMessage, HeartbeatMessage, Message, ShapeMessage, StatusMessage
from edge.stream.publisher import Publisher
from edge.stream.wire import FLAG_REPEATED, Draft, join, pack, split

S = 10**9


def drafts(number: int) -> list[Draft]:
    """One frame's messages at second ``number`` of the measurement."""
    t_ns = number * S
    found = (replace(detections(radar), number=number, t_first_chirp_ns=t_ns) for radar in ("horizontal", "vertical"))
    cloud = replace(fused_cloud(), t_start_ns=t_ns - 5, t_end_ns=t_ns, reference=pose(t_ns))
    thing = replace(shape(), input=replace(shape().input, t_end_ns=t_ns, pose=pose(t_ns)))
    return [
        convert.encode_detections(*found, replace(point_cloud(), number=number, t_ns=t_ns)),
        convert.encode_pose(pose(t_ns)),
        convert.encode_cloud(cloud),
        convert.encode_shape(thing),
        convert.encode_status(status(), t_ns),
        convert.encode_heartbeat("DEGRADED", t_ns),
    ]


def write_results(path: Path, numbers: range) -> list[Draft]:
    every = []
    with RecordingWriter(path, None) as writer:
        for number in numbers:
            for draft in drafts(number):
                writer.published(pack(draft, replace(STAMP, sequence=number)), number * S)
                every.append(draft)
    return every


def wait_for(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


@pytest.fixture
def sender() -> Iterator[Publisher]:
    with publisher() as made:
        yield made


def record_until(client: RecordingClient, sender: Publisher | Raw, recorder: Recorder) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not client.alive and time.monotonic() < deadline_s:
        sender.heartbeat()
        client.recv(0.005)
    client.record_to(recorder)


def test_every_message_is_stored_as_it_was_sent(tmp_path: Path, sender: Publisher) -> None:
    client = RecordingClient(sender.endpoints[0])
    with client, Recorder(RecordingWriter(tmp_path / "a.mcap", None)) as recorder:
        record_until(client, sender, recorder)
        sent = [sender.shape(shape()), sender.cloud(fused_cloud()), sender.heatmap(heatmap()), sender.pose(pose()),
                sender.detections(detections("horizontal"), detections("vertical"), point_cloud()),
                sender.status(status())]  # fmt: skip
        seen: list[Message] = []
        while len(seen) < len(sent):
            received = client.recv(WAIT_S)
            assert received is not None
            if not isinstance(received, HeartbeatMessage):
                seen.append(received)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        stored = [message for message in reader.results() if message.topic != "/heartbeat"]
        assert [split(message.payload) for message in stored] == sent
        topics = ["/shape", "/cloud", "/heatmap", "/rig_pose", "/detections", "/status"]
        assert [message.topic for message in stored] == topics
        assert reader.has_results
        assert not reader.has_frames


def test_topics_are_chosen_and_unknown_types_kept(tmp_path: Path) -> None:
    sender = Raw()
    client = RecordingClient(sender.endpoints[0], ("pose", "gravity"))
    with client, Recorder(RecordingWriter(tmp_path / "a.mcap", None)) as recorder:
        record_until(client, sender, recorder)
        future = pack(Draft("1/gravity/", "gravity", 5, fields={"m_s2": 9.81}), STAMP)
        sender.send(future)
        sender.send([b"1/pose/", b"no header"])
        sender.pose(3)
        sender.pose(5)
        wait_for(lambda: client.recv(0.01) is None and client.lost)
    sender.close()
    assert (client.malformed, client.lost, client.recorded) == (1, {"1/pose/": 1}, 3)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        stored = list(reader.results())
    assert [message.topic for message in stored] == ["/other", "/rig_pose", "/rig_pose"]
    assert split(stored[0].payload) == future


class Listener:
    """Takes everything from an address in a thread of its own."""

    def __init__(self, endpoint: str) -> None:
        self.messages: list[Message] = []
        self.client = connect(endpoint)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def _work(self) -> None:
        while not self._done.is_set():
            message = self.client.recv(0.2)
            if message is not None:
                self.messages.append(message)

    def stop(self) -> None:
        self._done.set()
        self._thread.join()
        self.client.close()


def republish(path: Path, part: Part, speed: float = 0.0) -> tuple[ResultsPlayback, Listener]:
    with RecordingReader(path) as reader, Republisher(replace(LOCAL, send_high_water_mark=1000)) as sender:
        listener = Listener(sender.endpoints[0])
        wait_for(lambda: sender.live() or listener.messages)
        playback = ResultsPlayback(reader, part, sender)
        playback.run(speed, lambda: False)
        sender.end("1.2.3")
        wait_for(lambda: any(isinstance(m, StatusMessage) and m.status.state == "STOP" for m in listener.messages))
        listener.stop()
    return playback, listener


def test_a_subscriber_gets_what_was_published(tmp_path: Path) -> None:
    write_results(tmp_path / "a.mcap", range(1, 4))
    playback, listener = republish(tmp_path / "a.mcap", Part())
    assert playback.sent == {"det": 3, "pose": 3, "cloud": 3, "shape": 3, "status": 3, "hb": 3}
    assert (playback.unreadable, listener.client.lost, listener.client.malformed) == (0, {}, 0)
    for message in listener.messages:
        assert message.header.source == "replay"
        assert message.header.boot != BOOT
    shapes = [m for m in listener.messages if isinstance(m, ShapeMessage)]
    assert [m.header.t_ns for m in shapes] == [S, 2 * S, 3 * S]
    np.testing.assert_array_equal(shapes[0].fine_m, shape().fine_m)
    assert (shapes[0].header.config_hash, shapes[0].header.calibration_hash) == (b"configur", b"calibrat")
    states = [m.state for m in listener.messages if isinstance(m, HeartbeatMessage)]
    assert states[0] == "INIT"


def test_loops_go_on_rising(tmp_path: Path) -> None:
    write_results(tmp_path / "a.mcap", range(10, 13))
    playback, listener = republish(tmp_path / "a.mcap", Part(loops=3))
    assert playback.passes == 3
    found = [m for m in listener.messages if isinstance(m, DetectionsMessage)]
    assert [m.number for m in found] == list(range(10, 19))
    times = [m.header.t_ns for m in found]
    assert times == [t * S for t in (10, 11, 12, 13, 14, 15, 16, 17, 18)]
    assert all(m.horizontal is not None and m.horizontal.t_first_chirp_ns == m.header.t_ns for m in found)
    clouds = [m for m in listener.messages if isinstance(m, CloudMessage)]
    assert [int(m.cloud.frame_number[0]) for m in clouds] == [0, 0, 0, 3, 3, 3, 6, 6, 6]
    assert [m.cloud.reference.t_ns for m in clouds] == times
    assert listener.client.lost == {}
    assert listener.client.restarts == 0


def test_a_part_of_results(tmp_path: Path) -> None:
    write_results(tmp_path / "a.mcap", range(10, 20))
    with RecordingReader(tmp_path / "a.mcap") as reader:
        playback = ResultsPlayback(reader, Part(2.0, 4.5), None)
        playback.run(0.0, lambda: False)
        assert playback.sent["det"] == 3, "12, 13 and 14"
        with pytest.raises(RecordingError, match="ends before the start"):
            ResultsPlayback(reader, Part(9.5), None)


def test_an_endless_replay_ends_when_it_is_asked_to(tmp_path: Path) -> None:
    write_results(tmp_path / "a.mcap", range(3))
    with RecordingReader(tmp_path / "a.mcap") as reader:
        playback = ResultsPlayback(reader, Part(loops=0), None)
        playback.run(0.0, lambda: playback.passes >= 5)
        assert playback.passes == 5


def test_what_is_no_message_is_counted_and_left_out(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", None) as writer:
        writer.message("/shape", b"no block", 1)
        writer.published(pack(convert.encode_pose(pose()), STAMP), 2)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        playback = ResultsPlayback(reader, Part(), None)
        playback.run(0.0, lambda: False)
    assert (dict(playback.sent), playback.unreadable) == ({"pose": 1}, 1)


def test_a_repeated_message_is_no_repetition_any_more() -> None:
    draft = replace(convert.encode_shape(shape()), flags=FLAG_REPEATED | 2)
    assert parse(join(pack(draft, STAMP))).draft.flags == 2
    moved = shifted(convert.encode_status(status(), 5), 7, 1)
    assert moved.t_ns == 12
    assert (moved.fields["reasons"][0]["first_ns"], moved.fields["reasons"][0]["count"]) == (17, 2)


def test_the_digest_of_recorded_results_is_that_of_the_run(tmp_path: Path) -> None:
    every, run = write_results(tmp_path / "a.mcap", range(4)), ResultDigest()
    for draft in every:
        run.add(draft)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        again = ResultDigest()
        ResultsPlayback(reader, Part(), None, again).run(0.0, lambda: False)
    assert again.hexdigest() == run.hexdigest()
    assert again.messages == 12
    other = ResultDigest()
    for draft in every[:-6]:
        other.add(draft)
    assert other.hexdigest() != run.hexdigest()
    late = ResultDigest()
    for draft in every:
        late.add(replace(draft, fields={**draft.fields, "lat_us": {"nn": 8000}}) if draft.type == "shape" else draft)
    assert late.hexdigest() == run.hexdigest(), "how long something took is no result"


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_results(tmp_path / "a.mcap", range(3))
    assert main(["replay", str(tmp_path / "a.mcap"), "--speed", "max", "--no-publish", "--digest", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["messages"]["shape"] == 3
    assert len(content["digest"]) == 64
    assert main(["replay", str(tmp_path / "a.mcap"), "--plot", str(tmp_path)]) == ExitCode.BAD_CONFIG
    assert main(["record", str(tmp_path / "b.mcap"), "--from", str(tmp_path / "a.mcap"), "--end", "1"]) == 0
    assert "written: /detections 2" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "a.mcap"), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["whole"], content["publishers"], content["lost_before_recording"]) == (True, 1, {})
    assert content["streams"]["/shape"]["messages"] == 3
    assert main(["record", str(tmp_path / "c"), "--results"]) == ExitCode.BAD_CONFIG
    silent = f"ipc://{tmp_path}/nobody"
    code = main(["record", str(tmp_path / "d.mcap"), "--results", "--endpoint", silent, "--timeout", "0.1"])
    assert code == ExitCode.DEGRADED
    assert not (tmp_path / "d.mcap").exists(), "nothing came: its name stays free"


def good_block() -> bytearray:
    return bytearray(join(pack(convert.encode_cloud(fused_cloud(3)), STAMP)))


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=80), st.lists(st.tuples(st.integers(0, 1 << 16), st.integers(0, 255)), max_size=4))
def test_any_bytes_are_a_message_or_refused(garbage: bytes, flips: list[tuple[int, int]]) -> None:
    block = good_block()
    for position, mask in flips:
        block[position % len(block)] ^= mask
    for data in (garbage, bytes(block)):
        with contextlib.suppress(WireError):
            ResultDigest().add(shifted(parse(data).draft, 5, 2))
