# SPDX-License-Identifier: Apache-2.0
"""The public corridor frame through the commands: replay, import, calibration; refused with any other rig."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_run import rfconstruct

from edge.errors import ExitCode

QUIET = ("--speed", "max", "--no-publish")


@pytest.fixture
def corridor(radar_data: Path) -> Path:
    return radar_data / "cascade_corridor_svenningsson"


def test_replay_of_the_folder(corridor: Path, tmp_path: Path) -> None:
    calibration = corridor / "calibration.mat"
    outcome = rfconstruct("replay", corridor, "--rig", "corridor", "--calibration", calibration, "--plot", tmp_path,
                          "--json", *QUIET)  # fmt: skip
    assert outcome.code == ExitCode.OK
    content = outcome.json
    assert [Path(picture).name for picture in content["pictures"]] == ["heatmaps.png"]
    assert (tmp_path / "heatmaps.png").read_bytes().startswith(b"\x89PNG")
    assert any("one radar alone" in note for note in content["notes"])
    assert any("re-packed" in note for note in content["notes"])
    assert content["detections"]["horizontal"] > 20
    assert (content["points"], content["windows"], content["shapes"]) == (0, 0, [])


def test_import_and_replay_give_the_same(corridor: Path, tmp_path: Path) -> None:
    recording, calibration = tmp_path / "corridor.mcap", tmp_path / "calibration.npz"
    assert rfconstruct("import", corridor / "calibration.mat", "--rig", "corridor", "--out", calibration).code == 0
    imported = rfconstruct("import", corridor, "--rig", "corridor", "--calibration", calibration, "--out", recording)
    assert imported.code == ExitCode.OK
    assert "1 frames in the capture, 1 recorded" in imported.out
    assert "note: horizontal: the loops were re-packed" in imported.out
    direct = rfconstruct("replay", corridor, "--rig", "corridor", "--calibration", calibration, "--json", *QUIET)
    recorded = rfconstruct("replay", recording, "--json", *QUIET)
    assert direct.json["detections"] == recorded.json["detections"]
    plain = rfconstruct("replay", corridor, "--rig", "corridor", "--json", *QUIET)
    assert plain.json["detections"] != direct.json["detections"]

    again = rfconstruct("import", corridor, "--rig", "corridor", "--out", recording, "--json")
    assert again.code == ExitCode.BAD_CONFIG
    assert "nothing is overwritten" in again.json["error"]["action"]


@pytest.mark.parametrize(("rig", "what"), [("cascade_pair", "has 2"), ("nowhere", "no rig nowhere")])
def test_another_rig_is_refused(corridor: Path, rig: str, what: str) -> None:
    outcome = rfconstruct("replay", corridor, "--rig", rig, *QUIET)
    assert outcome.code in (ExitCode.FAILURE, ExitCode.BAD_CONFIG)
    assert what in outcome.err


def test_a_calibration_of_another_waveform_is_refused(corridor: Path, tmp_path: Path) -> None:
    calibration = tmp_path / "calibration.npz"
    rfconstruct("import", corridor / "calibration.mat", "--rig", "corridor", "--out", calibration)
    outcome = rfconstruct("import", calibration.with_suffix(".mat"), "--rig", "corridor", "--out", tmp_path / "x.npz")
    assert outcome.code == ExitCode.BAD_CONFIG
    assert "no such calibration file" in outcome.err
    foreign = rfconstruct("import", f"horizontal={corridor / 'calibration.mat'}", "--rig", "awr1843_pair", "--out",
                          tmp_path / "y.npz")  # fmt: skip
    assert foreign.code == ExitCode.BAD_CONFIG
    assert not (tmp_path / "y.npz").exists()
