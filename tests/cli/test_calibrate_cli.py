# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct calibrate``: recordings and folders to files, refusals with their exit code, commands of the manual."""

from __future__ import annotations

import shlex
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_scenes import AMPLITUDE, at, capture, mismatch
from calibration_scenes import RIG as SINGLE_LOOP
from cli_run import rfconstruct

from edge.calibration import load_calibration
from edge.dsp.antenna import across_loss_db, along_loss_db
from edge.errors import ExitCode
from edge.frames import RADARS
from edge.recording.writer import RecordingWriter
from edge.rig import Rig

MANUAL = Path(__file__).resolve().parents[2] / "docs" / "calibration.md"
STOPS = [(5.0, 0.0, 0.0), (5.0, 2.5, 0.5), (5.0, -2.5, -0.4), (4.0, 0.0, 1.6), (4.0, 1.0, -0.7), (6.0, -2.0, 1.5)]
MOVED_M, OFFSET_M, POWER_DB = (0.02, -0.015), 0.01, 1.2


def record(path: Path, frames: list[Any], rig: Rig = SINGLE_LOOP) -> Path:
    with RecordingWriter(path, rig) as writer:
        for number, frame in enumerate(frames):
            writer.frame(replace(frame, number=number // 2, t_first_chirp_ns=8_000_000 * number))
    return path


@pytest.fixture(scope="module")
def reflector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of each radar, the reflector 5 m ahead of each."""
    gain, shift = mismatch(21)
    frames = []
    for number in range(4):
        for radar in RADARS:
            board = SINGLE_LOOP.radars[radar]
            frames.append(capture(board, at(board, 5.0), AMPLITUDE, number, channel_gain=gain, shift_bins=shift))
    return record(tmp_path_factory.mktemp("reflector") / "reflector.mcap", frames)


@pytest.fixture(scope="module")
def stops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One recording with six stops of five frames; the vertical board is not where the rig says."""
    boards = dict(SINGLE_LOOP.radars)
    mounting = boards["vertical"].mounting
    y, z = mounting.position_m[1] + MOVED_M[0], mounting.position_m[2] + MOVED_M[1]
    moved = replace(mounting, position_m=(mounting.position_m[0], y, z), range_offset_m=OFFSET_M)
    boards["vertical"] = replace(boards["vertical"], mounting=moved)
    frames = []
    for place in np.array(STOPS):
        shown = []
        for radar, board in boards.items():
            sight = (place - board.mounting.position_m) / np.linalg.norm(place - board.mounting.position_m)
            own, other = (sight[1], sight[2]) if radar == "horizontal" else (sight[2], sight[1])
            antenna = SINGLE_LOOP.settings.antenna
            loss_db = 2 * float(along_loss_db(antenna, own) + across_loss_db(antenna, other))
            loss_db += POWER_DB if radar == "vertical" else 0.0
            shown.append(capture(board, place, 2000.0 * 10 ** (-loss_db / 20), 7))
        frames += 5 * shown
    return record(tmp_path_factory.mktemp("stops") / "stops.mcap", frames)


def test_recording_becomes_a_calibration(reflector: Path, tmp_path: Path) -> None:
    out = tmp_path / "c.npz"
    outcome = rfconstruct("calibrate", reflector, "--radar", "vertical", "--range", 5, "--out", out, "--board", "V2",
                          "--temperature", 38, "--plot", tmp_path, "--json")  # fmt: skip
    assert outcome.code == ExitCode.OK
    content = outcome.json
    assert content["radar"] == "vertical"
    assert (content["quality"]["frames"], content["temperature_c"], content["notes"]) == (4, 38.0, [])
    assert content["quality"]["separability_rms_deg"] < 0.2
    assert (tmp_path / "calibration.png").read_bytes().startswith(b"\x89PNG")
    loaded = load_calibration(out, SINGLE_LOOP.radars["vertical"].schedule)
    assert (loaded.board, loaded.temperature_c, loaded.reference_range_m) == ("V2", 38.0, 5.0)
    again = rfconstruct("calibrate", reflector, "--radar", "vertical", "--range", 5, "--out", out, "--json")
    assert again.code == ExitCode.BAD_CONFIG
    assert "nothing is overwritten" in again.json["error"]["action"]


def test_report_for_people_names_what_matters(reflector: Path, tmp_path: Path) -> None:
    outcome = rfconstruct("calibrate", reflector, "--radar", "horizontal", "--range", 5, "--frames", 1, "--out",
                          tmp_path / "c.npz")  # fmt: skip
    assert outcome.code == ExitCode.OK
    for text in ("departure from TX + RX", "error sidelobe", "repaired channels: none", "could not be checked"):
        assert text in outcome.out


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (("--range", 5), "has two radars"),
        (("--radar", "vertical"), "reflector's range"),
        (("--radar", "vertical", "--range", 8), "no reflector"),
        (("--radar", "vertical", "--range", 0.2), "too near"),
        (("--radar", "vertical", "--range", 5, "--angle", 80), "impossible reflector angle"),
        (("--radar", "vertical", "--range", 5, "--rig", "cascade_pair"), "another layout"),
    ],
)
def test_refusals_leave_no_file(reflector: Path, tmp_path: Path, options: tuple[Any, ...], what: str) -> None:
    out = tmp_path / "c.npz"
    outcome = rfconstruct("calibrate", reflector, *options, "--out", out)
    assert outcome.code == ExitCode.BAD_CONFIG
    assert what in outcome.err
    assert not out.exists()


def test_absent_recording_and_folder_are_refused(tmp_path: Path) -> None:
    outcome = rfconstruct("calibrate", tmp_path / "no.mcap", "--range", 5, "--out", tmp_path / "c.npz")
    assert "no such recording" in outcome.err
    outcome = rfconstruct("calibrate", tmp_path, "--range", 5, "--out", tmp_path / "c.npz")
    assert "--rig" in outcome.err
    outcome = rfconstruct("calibrate", tmp_path, "--range", 5, "--out", tmp_path / "no" / "c.npz")
    assert "no such folder" in outcome.err


def test_stops_become_the_mounting(stops: Path, tmp_path: Path) -> None:
    """Simulated captures through imager and detector: 5 mm and 0.2 dB."""
    out = tmp_path / "mounting.toml"
    outcome = rfconstruct("calibrate", "--align", stops, "--out", out, "--json")
    assert outcome.code == ExitCode.OK, outcome.out
    content = outcome.json
    assert [stop["frames"] for stop in content["stops"]] == [5] * len(STOPS)
    corrections = {name: found["value"] for name, found in content["corrections"].items()}
    assert corrections["vertical y_m"] == pytest.approx(MOVED_M[0], abs=0.005)
    assert corrections["vertical z_m"] == pytest.approx(MOVED_M[1], abs=0.005)
    assert corrections["vertical range_offset_m"] == pytest.approx(OFFSET_M, abs=0.005)
    assert content["power_offset_db"]["value"] == pytest.approx(POWER_DB, abs=0.2)
    assert content["held"] == ["vertical x_m"]
    table = tomllib.loads(out.read_text())["radars"]["vertical"]["mounting"]
    assert table["position_m"][1] == pytest.approx(MOVED_M[0], abs=0.005)


def test_alignment_refusals(stops: Path, reflector: Path, tmp_path: Path) -> None:
    survey = tmp_path / "survey.csv"
    survey.write_text("5,0,0\n5,2.5,0.5\n")
    out = ("--out", tmp_path / "m.toml")
    assert "number of stops" in rfconstruct("calibrate", "--align", stops, "--positions", survey, *out).err
    assert "no stop" in rfconstruct("calibrate", "--align", reflector, *out).err
    assert "no such recording" in rfconstruct("calibrate", "--align", tmp_path / "x.mcap", *out).err
    assert not (tmp_path / "m.toml").exists()


def test_commands_of_the_manual_run(
    reflector: Path, stops: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every line of the manual that begins with rfconstruct, in a folder with files of these names."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "reflector.mcap").symlink_to(reflector)
    (tmp_path / "stops.mcap").symlink_to(stops)
    (tmp_path / "survey.csv").write_text("\n".join(",".join(map(str, place)) for place in STOPS))
    lines = [line.strip() for line in MANUAL.read_text().replace("\\\n", " ").splitlines()]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("rfconstruct calibrate")]
    assert len(commands) >= 4
    for command in commands:
        if "corridor" not in command:
            outcome = rfconstruct(*command)
            assert outcome.code == ExitCode.OK, (command, outcome.err)


def test_corridor_folder_through_the_command(radar_data: Path, tmp_path: Path) -> None:
    out = tmp_path / "c.npz"
    outcome = rfconstruct("calibrate", radar_data / "cascade_corridor_svenningsson", "--rig", "corridor", "--range",
                          5.0, "--out", out, "--json")  # fmt: skip
    assert outcome.code == ExitCode.OK
    assert any("re-packed" in note for note in outcome.json["notes"])
    assert outcome.json["quality"]["repaired"] == []
    assert out.is_file()
