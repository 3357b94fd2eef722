# SPDX-License-Identifier: Apache-2.0
"""The demo from nothing but what is shipped: makes its recording once, pictures, and figures against the truth."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from cli_run import rfconstruct

from edge.commands import demo_command, demo_scene
from edge.errors import ExitCode
from edge.reference.drive_by import DriveBy
from edge.rig import load_rig

SHORT = DriveBy(frames=30, frame_period_s=0.2, scatterers=300)
"""Half the frames over the same travel."""


def test_the_demo_runs_twice_and_makes_its_recording_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_scene, "SCENE", SHORT)
    monkeypatch.setattr(demo_command, "SCENE", SHORT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("RFCONSTRUCT_DATA", str(tmp_path))
    first = rfconstruct("demo", "--speed", "max", "--no-publish", "--plot", tmp_path / "pictures")
    assert first.code == ExitCode.OK
    assert "parametric sedan" in first.out
    assert "shape to truth chamfer" in first.out
    names = sorted(picture.name for picture in (tmp_path / "pictures").iterdir())
    assert names[:2] == ["fused_cloud.png", "heatmaps.png"]
    assert names[2].startswith("shape_")
    (cached,) = (tmp_path / "cache" / "rfconstruct").iterdir()
    written_ns = cached.stat().st_mtime_ns

    second = rfconstruct("demo", "--speed", "max", "--no-publish", "--json")
    assert (second.code, second.err) == (ExitCode.OK, "")
    content = second.json
    assert cached.stat().st_mtime_ns == written_ns
    assert content["simulated"] is True
    assert 0 < content["shape_to_truth_chamfer_cm"] < 100
    assert 0 < content["radar_points_to_truth_chamfer_cm"] < 200
    assert content["frames"]["vertical"]["frames_ok"] == SHORT.frames
    assert f"associated points: {content['points']};" in first.out


def test_the_cache_keeps_a_few_recordings_and_all_of_other_objects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(demo_scene, "_record", lambda path, rig, thing, scene: path.write_bytes(b"recording"))
    rig, thing = load_rig("cascade_demo"), demo_scene.demo_object()
    other = demo_scene.demo_recording(rig, replace(thing, credit="another object"), SHORT)
    os.utime(other, ns=(1, 1))
    made = []
    for number in range(demo_scene.KEPT_RECORDINGS + 2):
        made.append(demo_scene.demo_recording(rig, thing, replace(SHORT, scatterers=100 + number)))
        os.utime(made[-1], ns=(number + 2, number + 2))
    assert other.is_file()
    assert [path.is_file() for path in made] == [False] * 2 + [True] * demo_scene.KEPT_RECORDINGS


def test_a_cache_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("RFCONSTRUCT_DATA", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    outcome = rfconstruct("demo", "--no-publish")
    assert outcome.code == ExitCode.FAILURE
    assert "set XDG_CACHE_HOME" in outcome.err
