# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct record``: of a publisher, killed, interrupted, on a full disk; of boards; of a part of a recording."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cli_run import SCENE, rfconstruct, write_recording
from virtual_boards import virtual_boards

from edge.config import StreamSettings
from edge.errors import ExitCode
from edge.frames import Pose, RadarFrame
from edge.recording.reader import RecordingReader
from edge.recording.salvage import recover
from edge.stream.publisher import Publisher

WAIT_S = 120.0
QUIET = ("--speed", "max", "--no-publish", "--json")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("record") / "drive.mcap")


def start(out: Path, endpoint: str, *words: str, limit: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "edge", "record", str(out), "--results", "--endpoint", endpoint, *words]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment, preexec_fn=limit)


def publish_until(sender: Publisher, done: Callable[[], bool]) -> int:
    """Poses, a hundred a second, until ``done``; how many."""
    count, end_s = 0, time.monotonic() + WAIT_S
    while not done():
        assert time.monotonic() < end_s
        sender.pose(Pose(count, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
        sender.heartbeat()
        count += 1
        time.sleep(0.01)
    return count


def recorded_poses(path: Path) -> list[int]:
    """How many; 0 before the file is there."""
    if not path.exists() or path.stat().st_size < 8:
        return []
    with RecordingReader(path) as reader:
        return [message.t_ns for message in reader.results() if message.topic == "/rig_pose"]


def publisher(tmp_path: Path) -> Publisher:
    return Publisher(StreamSettings((f"ipc://{tmp_path}/stream",)), b"configuration", b"calibration", "sim")


def test_kill_9_costs_at_most_the_last_second(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    with publisher(tmp_path) as sender, start(out, sender.endpoints[0]) as child:
        publish_until(sender, lambda: len(recorded_poses(out)) > 150)
        killed_ns = time.monotonic_ns()
        child.kill()
        assert child.wait(WAIT_S) == -signal.SIGKILL
    times = recorded_poses(out)
    assert killed_ns - times[-1] < 10**9 or times[-1] > killed_ns
    with RecordingReader(out) as reader:
        assert reader.truncated
    recover(out, tmp_path / "b.mcap")
    assert recorded_poses(tmp_path / "b.mcap") == times


def test_an_interrupt_is_the_usual_end(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    with publisher(tmp_path) as sender, start(out, sender.endpoints[0]) as child:
        publish_until(sender, lambda: len(recorded_poses(out)) > 20)
        child.send_signal(signal.SIGINT)
        told, errors = child.communicate(timeout=WAIT_S)
    assert child.returncode == ExitCode.OK, errors
    assert "written: " in told
    assert rfconstruct("info", out, "--json").json["whole"] is True


def test_a_full_disk_is_named_and_the_file_stays_readable(tmp_path: Path) -> None:
    out, limit = tmp_path / "a.mcap", 60_000
    with (
        publisher(tmp_path) as sender,
        start(
            out, sender.endpoints[0], limit=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        ) as child,
    ):
        publish_until(sender, lambda: child.poll() is not None)
        _, errors = child.communicate(timeout=WAIT_S)
    assert child.returncode == ExitCode.FAILURE
    assert "recording stopped" in errors
    assert "free space" in errors
    assert len(recorded_poses(out)) > 20


def test_seconds_end_it(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    with (
        publisher(tmp_path) as sender,
        start(out, sender.endpoints[0], "--seconds", "0.5", "--topics", "pose") as child,
    ):
        publish_until(sender, lambda: child.poll() is not None)
        child.communicate(timeout=WAIT_S)
    assert child.returncode == ExitCode.OK
    with RecordingReader(out) as reader:
        assert {message.topic for message in reader.results()} == {"/rig_pose"}
        assert (reader.span_ns[1] - reader.span_ns[0]) / 1e9 < 60


def test_a_copy_has_the_same_digest(recording: Path, tmp_path: Path) -> None:
    outcome = rfconstruct("record", tmp_path / "copy.mcap", "--from", recording, "--note", "once more", "--json")
    assert outcome.code == ExitCode.OK
    assert outcome.json["written"]["/radar/vertical/raw"] == SCENE.frames
    first = rfconstruct("replay", recording, "--digest", *QUIET).json
    again = rfconstruct("replay", tmp_path / "copy.mcap", "--digest", *QUIET).json
    assert first["digest"] == again["digest"]
    assert "once more" in again["notes"]
    part = rfconstruct("replay", recording, "--digest", "--start", 0.25, "--end", 0.65, *QUIET)
    assert part.code == ExitCode.OK, part.out
    counts = {account["frames_ok"] for account in part.json["frames"].values()}
    assert counts == {4}, "one frame every 0.1 s"
    assert part.json["digest"] != first["digest"]


def test_options_that_cannot_be(recording: Path, tmp_path: Path) -> None:
    assert rfconstruct("record", tmp_path / "a.mcap").code == ExitCode.USAGE
    assert rfconstruct("record", tmp_path / "a.bag", "--results").code == ExitCode.BAD_CONFIG
    again = rfconstruct("record", recording, "--from", recording)
    assert again.code == ExitCode.FAILURE
    assert "never overwritten" in again.err
    assert rfconstruct("replay", recording, "--start", 5, "--end", 2, *QUIET).code == ExitCode.BAD_CONFIG
    assert rfconstruct("replay", recording, "--start", 500, *QUIET).code == ExitCode.FAILURE


def test_raw_frames_of_boards(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        outcome = rfconstruct(
            "record", out, "--rig", "awr1843_pair", "--boards", virtual.boards, "--seconds", 1, "--json"
        )
        assert virtual.violations == []
        assert not virtual.parts.radars["horizontal"].streaming
    assert outcome.code in (ExitCode.OK, ExitCode.DEGRADED), outcome.err
    written = outcome.json["written"]
    assert written["/radar/horizontal/raw"] > 0
    assert written["/pose"] > 0
    assert outcome.json["dropped"] == {}
    with RecordingReader(out) as reader:
        frames = [item for item in reader if isinstance(item, RadarFrame)]
        assert not reader.truncated
        assert reader.read_rig().name == "awr1843_pair"
    assert len(frames) == written["/radar/horizontal/raw"] + written["/radar/vertical/raw"]
