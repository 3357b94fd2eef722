# SPDX-License-Identifier: Apache-2.0
"""A recording through the live pipeline by the command: exact account, states for subscribers; the endurance run."""

from __future__ import annotations

import threading
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from cli_run import RIG, SCENE, rfconstruct, write_recording

from edge.bench.endless import EndlessDrive
from edge.bench.soak import LIMITS
from edge.errors import ExitCode, RecordingError
from edge.frames import RADARS, Pose, RadarFrame
from edge.recording.writer import RecordingWriter
from edge.stream.client import connect
from edge.stream.messages import HeartbeatMessage, StatusMessage


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("live") / "drive.mcap")


def test_every_frame_is_accounted_for_and_subscribers_hear_the_states(recording: Path, tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/stream"
    states, last = list[str](), list[StatusMessage]()

    def listen() -> None:
        with connect(endpoint, ("hb", "status"), timeout_s=60.0) as client:
            for message in client:
                if isinstance(message, HeartbeatMessage):
                    states.append(message.state)
                elif isinstance(message, StatusMessage):
                    last.append(message)
                    if message.status.state == "STOP":
                        return

    listener = threading.Thread(target=listen)
    listener.start()
    outcome = rfconstruct("replay", recording, "--live", "--json", "--endpoint", endpoint)
    listener.join(120.0)
    assert not listener.is_alive()
    assert outcome.code in (ExitCode.OK, ExitCode.DEGRADED), outcome.err
    for account in outcome.json["frames"].values():
        assert account["frames_in"] == SCENE.frames
        assert account["frames_ok"] + account["frames_lost"] == SCENE.frames
        assert account["frames_pending"] == 0
    assert outcome.json["stages"]["to_points"]["count"] == outcome.json["frames"]["vertical"]["frames_ok"]
    assert states[0] == "INIT"
    assert "RUN" in states or "DEGRADED" in states
    final = last[-1].status
    assert {radar: final.radars[radar].frames_in for radar in RADARS} == dict.fromkeys(RADARS, SCENE.frames)
    assert final.system["rss_mb"] > 0


@pytest.mark.parametrize("words", [("--speed", "max"), ("--digest",)])
def test_live_has_a_pace_and_no_digest(recording: Path, words: tuple[str, ...]) -> None:
    outcome = rfconstruct("replay", recording, "--live", "--no-publish", *words)
    assert outcome.code == ExitCode.BAD_CONFIG
    assert "--live" in outcome.err


def test_endurance_prints_an_exact_account(recording: Path) -> None:
    outcome = rfconstruct("bench", "--soak", "2.5", "--recording", recording, "--json")
    assert outcome.code in (ExitCode.OK, ExitCode.DEGRADED), outcome.err
    figures = outcome.json["figures"]
    assert figures["unaccounted frames"] == 0
    assert figures["passes"] == 3
    for account in outcome.json["accounts"].values():
        assert account["frames_in"] == account["frames_ok"] + account["frames_lost"] > SCENE.frames
    assert set(LIMITS) - set(figures) <= {"asked to shape p99, ms"}, "too few points for a shape, else all are there"
    lines = rfconstruct("bench", "--soak", "0.5", "--recording", recording).out.splitlines()
    assert lines[0].split() == ["radar", "frames", "in", "ok", "lost", "causes"]


def test_a_drive_without_end_goes_on_in_number_time_and_place(recording: Path) -> None:
    drive = EndlessDrive(recording, 3.0)
    items = list(drive)
    assert drive.passes == 3
    period_ns = round(1e9 * SCENE.frame_period_s)
    for radar in RADARS:
        frames = [item for item in items if isinstance(item, RadarFrame) and item.radar == radar]
        assert [frame.number for frame in frames] == list(range(len(frames)))
        steps = [b.t_first_chirp_ns - a.t_first_chirp_ns for a, b in pairwise(frames)]
        np.testing.assert_allclose(steps, period_ns, atol=5)
        assert len(frames) >= 29
    poses = [item for item in items if isinstance(item, Pose)]
    for a, b in pairwise(poses):
        assert b.t_ns > a.t_ns
        speed = np.linalg.norm(b.position_m - a.position_m) / (b.t_ns - a.t_ns) * 1e9
        assert speed == pytest.approx(SCENE.speed_m_s, rel=1e-3)


def test_what_is_no_drive_is_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "empty.mcap", RIG):
        pass
    with pytest.raises(RecordingError, match="a drive needs"):
        list(EndlessDrive(tmp_path / "empty.mcap", 1.0))
