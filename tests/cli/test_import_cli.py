# SPDX-License-Identifier: Apache-2.0
"""Import from the command line: a start on the poses' clock, poses of the vehicle, notes that reach the replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cli_run import rfconstruct

from edge.errors import ExitCode
from edge.frames import Pose, RadarFrame
from edge.recording.reader import RecordingReader
from edge.rig import load_rig

CORRIDOR = "cascade_corridor_svenningsson"
START_NS = 1_700_000_000_500_000_000


def test_vehicle_poses_on_another_clock(radar_data: Path, tmp_path: Path) -> None:
    poses, out = tmp_path / "car.tum", tmp_path / "a.mcap"
    poses.write_text("1700000000.4 1 2 0 0 0 0 1\n1700000000.6 3 2 0 0 0 0 1\n")
    options = ("--rig", "corridor", "--poses", poses, "--poses-of", "vehicle", "--start-ns", START_NS, "--out", out)
    outcome = rfconstruct("import", radar_data / CORRIDOR, *options)
    assert outcome.code == ExitCode.OK
    assert "124.65 ms between frames 6 and 7" in outcome.out
    with RecordingReader(out) as reader:
        before, frame, after = reader
    assert isinstance(before, Pose)
    assert isinstance(frame, RadarFrame)
    assert isinstance(after, Pose)
    assert frame.t_first_chirp_ns == START_NS
    np.testing.assert_allclose(after.position_m - before.position_m, [2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(before.position_m, np.add([1.0, 2.0, 0.0], load_rig("corridor").geometry.offset_m))


def test_notes_of_the_import_are_printed_by_the_replay(radar_data: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    assert rfconstruct("import", radar_data / CORRIDOR, "--rig", "corridor", "--out", out).code == ExitCode.OK
    quiet = ("--speed", "max", "--no-publish")
    for source in ((out,), (radar_data / CORRIDOR, "--rig", "corridor")):
        told = rfconstruct("replay", *source, *quiet).out
        assert "124.65 ms between frames 6 and 7" in told
        assert "re-packed from their published sum" in told
    assert "re-packed" in rfconstruct("info", out).out


def test_info_describes_a_capture_folder(radar_data: Path) -> None:
    content = rfconstruct("info", radar_data / CORRIDOR, "--json").json
    assert content["devices"] == ["master", "slave1", "slave2", "slave3"]
    assert content["gaps"][0]["after_frame"] == 6
    told = rfconstruct("info", radar_data / CORRIDOR)
    assert told.code == ExitCode.OK
    assert "124.65 ms between frames 6 and 7 (0 missing)" in told.out
    assert "frames                 8" in told.out


def test_info_describes_two_captures_in_one_folder(tmp_path: Path) -> None:
    for radar in ("horizontal", "vertical"):
        (tmp_path / radar).mkdir()
        (tmp_path / radar / "master_0000_data.bin").write_bytes(bytes(8))
    assert list(rfconstruct("info", tmp_path, "--json").json) == ["horizontal", "vertical"]
