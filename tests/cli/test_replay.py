# SPDX-License-Identifier: Apache-2.0
"""A recording through the command gives what the same frames give directly; cut and damaged ones say so."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from cli_run import RIG, SCENE, drive_by, rfconstruct, write_recording

from edge.commands.report import Tally
from edge.errors import ExitCode
from edge.frames import Pose
from edge.pipeline import Pipeline
from edge.recording.writer import RecordingWriter
from edge.stream.client import connect

QUIET = ("--speed", "max", "--no-publish")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("recording") / "drive.mcap")


@pytest.fixture(scope="module")
def tally() -> Tally:
    tally = Tally()
    pipeline = Pipeline(RIG, None, [tally])
    for item in drive_by():
        pipeline.feed(item)
    pipeline.finish()
    return tally


def test_the_recording_gives_what_its_frames_give(recording: Path, tally: Tally) -> None:
    first, second = (
        rfconstruct("replay", recording, "--json", *QUIET),
        rfconstruct("replay", recording, "--json", *QUIET),
    )
    assert (first.code, first.err) == (ExitCode.OK, "")
    content = first.json
    assert content["detections"] == tally.detections
    assert content["points"] == tally.points > 0
    assert content["windows"] == tally.windows == 1
    assert {r: (f["frames_in"], f["frames_ok"], f["lost"]) for r, f in content["frames"].items()} == {
        radar: (SCENE.frames, SCENE.frames, {}) for radar in RIG.radars
    }
    assert second.json["shapes"] == content["shapes"]


def test_the_report_for_people_has_the_same_numbers(recording: Path, tally: Tally) -> None:
    outcome = rfconstruct("replay", recording, *QUIET)
    counts = ", ".join(f"{radar} {count}" for radar, count in tally.detections.items())
    assert f"detections: {counts}; associated points: {tally.points}" in outcome.out
    assert "publishing" not in outcome.out


def test_a_recording_cut_in_half_is_played_up_to_its_last_whole_record(recording: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[: os.path.getsize(recording) // 2])
    outcome = rfconstruct("replay", cut, "--json", *QUIET)
    assert outcome.code == ExitCode.DEGRADED
    content = outcome.json
    assert any("its end is missing" in note for note in content["notes"])
    assert 0 < content["frames"]["horizontal"]["frames_ok"] < SCENE.frames


def test_a_damaged_recording_loses_the_damaged_frame_only(recording: Path, tmp_path: Path) -> None:
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    outcome = rfconstruct("replay", damaged, "--json", *QUIET)
    assert outcome.code == ExitCode.DEGRADED
    content = outcome.json
    assert any("damaged chunks left out: 1" in note for note in content["notes"])
    assert content["frames"]["horizontal"]["frames_ok"] == SCENE.frames - 1
    assert all(account["frames_pending"] == 0 for account in content["frames"].values())


def test_pictures_and_a_waiting_subscriber(recording: Path, tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/stream"
    with connect(endpoint, ("det", "cloud"), timeout_s=0.5) as client:
        outcome = rfconstruct("replay", recording, "--json", "--speed", "max", "--endpoint", endpoint,
                              "--plot", tmp_path / "new" / "pictures")  # fmt: skip
        received = [message.header.topic for message in client]
    assert outcome.code == ExitCode.OK
    assert received.count("1/det/") == SCENE.frames
    assert received.count("1/cloud/") == 1
    pictures = [Path(picture) for picture in outcome.json["pictures"]]
    assert {"heatmaps.png", "fused_cloud.png"} <= {picture.name for picture in pictures}
    for picture in pictures:
        data = picture.read_bytes()
        assert data.startswith(b"\x89PNG\r\n\x1a\n")
        assert 20_000 < len(data) < 2_000_000


def test_a_recording_without_frames_is_no_success(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "poses.mcap", RIG) as writer:
        for item in drive_by():
            if isinstance(item, Pose):
                writer.pose(item)
    outcome = rfconstruct("replay", tmp_path / "poses.mcap", *QUIET)
    assert outcome.code == ExitCode.DEGRADED
    assert "not a single radar frame" in outcome.out
    assert "detections: none" in outcome.out


def test_a_recording_of_another_rig_is_refused(recording: Path) -> None:
    outcome = rfconstruct("replay", recording, "--rig", "awr1843_pair", *QUIET)
    assert outcome.code == ExitCode.FAILURE
    assert "use the rig that the capture was made with" in outcome.err


def test_info_describes_it(recording: Path) -> None:
    content = rfconstruct("info", recording, "--json").json
    assert content["rig"] == "cascade_demo"
    assert content["topics"]["/radar/vertical/raw"] == SCENE.frames
    assert "/radar/vertical/raw" in rfconstruct("info", recording).out
