# SPDX-License-Identifier: Apache-2.0
"""The showcase: exact account, files, Ctrl-C, and a closing table that says who was found, split, merged or missed."""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.accounting import FrameLedger
from edge.errors import ConfigError, DependencyError
from edge.frames import RADARS, Float32, LossCause, ObjectCloud, Pose, Shape
from edge.recording.reader import RecordingReader
from edge.rig import load_rig
from edge.stream.client import connect
from edge.stream.messages import StatusMessage
from train.objects.reference import ObjectRef
from train.simulate import street_command, street_stream
from train.simulate.street import Street, StreetSettings, make_street
from train.simulate.street_report import ShapeLog, as_dict, busy_note, chamfer_m, find, lines, verdicts

PEDESTRIAN = ObjectRef("pedestrian", "parametric_00017")
MOTORCYCLE = ObjectRef("motorcycle", "parametric_00008")
SHORT = StreetSettings((PEDESTRIAN,), length_m=2.5)
SHIFT_NS = 777_000_000_000
FRAMES = 100


def options(*words: object) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    street_command.add_verb(parser.add_subparsers())
    return parser.parse_args(["street", "--rig", "cascade_demo", *map(str, words)])


def test_every_frame_is_accounted_for_and_files_are_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "object_9_car.png").touch()
    words = ("--pace", "0", "--out", tmp_path, "--endpoint", f"ipc://{tmp_path}/stream", "--json")
    assert street_command.run(options(*words), SHORT) == 0
    report = json.loads(capsys.readouterr().out)
    for radar in RADARS:
        account = report["frames"][radar]
        assert account["frames_in"] == FRAMES
        assert account["frames_ok"] + account["frames_lost"] == FRAMES
        assert account["frames_lost"] == sum(account["lost"].values())
    assert report["stages"]["to_points"]["count"] == report["frames"]["vertical"]["frames_ok"] == FRAMES
    assert any("pedestrian" in one["users"] for one in report["objects"])
    assert report["users"][0].startswith("pedestrian: ")
    assert set(report["files"]) == {str(path) for path in tmp_path.iterdir() if path.suffix in (".png", ".ply")}
    assert not (tmp_path / "object_9_car.png").exists(), "of an earlier run"
    assert len(list(tmp_path.glob("object_*.png"))) == len(report["objects"])
    with RecordingReader(Path(report["recording"])) as reader:
        assert reader.has_results


def test_frames_are_made_ahead_where_the_simulator_is_slow() -> None:
    """1200 frames of 10 ms, 20 ms each beside the pipeline: at the end of 24 s of work the clock shows 12 s."""
    pair_s = 0.02 * street_command.BESIDE_PIPELINE
    assert street_command.pairs_ahead(1200, pair_s, 0.01, 10_000) == 600
    assert street_command.pairs_ahead(1200, pair_s, 0.01, 100) == 100, "memory"
    assert street_command.pairs_ahead(1200, pair_s / 2, 0.01, 10_000) == 0, "fast enough"


def test_a_part_of_the_drive_says_who_was_not_passed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--pace", "0", "--out", tmp_path, "--no-publish", "--no-plot", "--seconds", "0.1")
    code = street_command.run(options(*words), SHORT)
    out = capsys.readouterr().out
    assert code == 3, "no shape"
    assert "no object gave a shape" in out
    assert "pedestrian: not passed: the drive ended at 0.1 m" in out
    assert "horizontal           6       6       0" in out


def test_ctrl_c_prints_the_account(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/stream"
    words = ["street", "--rig", "cascade_demo", "--out", str(tmp_path), "--endpoint", endpoint, "--json"]
    with connect(endpoint, ("status",), timeout_s=60.0) as client:
        process = subprocess.Popen(
            [sys.executable, "-m", "train.cli", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        states = list[str]()
        for message in client:
            assert isinstance(message, StatusMessage)
            ok = [radar.frames_ok for radar in message.status.radars.values()]
            if "told" not in states and ok and min(ok) > 0:
                process.send_signal(signal.SIGINT)
                states.append("told")
            states.append(message.status.state)
            if states[-1] == "STOP":
                break
        out, err = process.communicate(timeout=60.0)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    report = json.loads(out)
    assert states[0] == "INIT"
    for account in report["frames"].values():
        assert 0 < account["frames_in"] == account["frames_ok"] + account["frames_lost"] < 800
    assert any("SIGINT" in note for note in report["notes"])
    assert "no pictures of an interrupted run" in report["notes"]


def test_what_cannot_be_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="--pace"):
        street_command.run(options("--pace", "-1", "--out", tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DependencyError, match="viser"):
        street_stream.Viewer("ipc:///nowhere", quiet=True)


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(load_rig("cascade_demo"), StreetSettings((MOTORCYCLE, PEDESTRIAN), length_m=8.0), seed=1)


def surface(street: Street, user: int, cloud: ObjectCloud, count: int) -> Float32:
    """Points of the true surface in the object's frame; independent of those that the report draws."""
    thing = street.users[user]
    own = (thing.points_m(count, np.random.default_rng(99)) - thing.placed.position_m) @ thing.placed.rotation
    rotation, translation_m = street.truth_in_frame(user, cloud, cloud.pose)
    return np.asarray(own @ rotation.T + translation_m, dtype=np.float32)


def seen(street: Street, identity: int, *users: int, off_m: float = 0.0) -> Shape:
    """A final shape whose points and fine points lie on the users' surfaces, moved by ``off_m`` along the street."""
    begin_ns, end_ns = street.drive.span_ns
    place_m = np.append(np.asarray(street.users[users[0]].placed.position_m)[:2], 0.0)
    pose = Pose(end_ns, place_m, np.array([0.0, 0.0, 0.0, 1.0]))
    points = np.zeros((0, 3), np.float32)
    cloud = ObjectCloud(
        *(identity, points, np.zeros(0, np.float32), pose, begin_ns, end_ns, 3.0, 120, True, np.zeros(3)),
        age_s=1.5,
        final=True,
    )
    parts = [surface(street, user, cloud, 8192) + np.float32([off_m, 0.0, 0.0]) for user in users]
    fine = np.concatenate(parts)
    cloud = replace(cloud, xyz_m=fine[::16], power_db=np.zeros(len(fine[::16]), np.float32))
    cloud = replace(cloud, t_start_ns=begin_ns + SHIFT_NS, t_end_ns=end_ns + SHIFT_NS)
    return Shape(identity, "pedestrian", {"pedestrian": 1.0, "unknown": 0.0}, 0.9, fine, fine[::16], cloud, "0" * 16)


def log_of(*shapes: Shape) -> ShapeLog:
    log = ShapeLog()
    for shape in shapes:
        log.shape(replace(shape, input=replace(shape.input, final=False, age_s=0.5)))
        log.shape(shape)
    return log


def test_a_shape_on_the_true_surface_is_as_near_as_two_samplings_of_it(street: Street) -> None:
    one, moved = find(street, log_of(seen(street, 4, 1), seen(street, 5, 1, off_m=0.3)), SHIFT_NS)
    assert (one.users, one.nearest, one.shapes, one.seen_s) == ((1,), 1, 2, 1.5)
    assert one.away_m < 0.02
    assert one.shape_cm < 2.0 < one.input_cm < 5.0
    assert 3.0 < moved.shape_cm < 30.0, "no point of a rigid body moved by 30 cm can be farther from it than that"


def test_users_are_found_split_merged_missed_or_not_passed(street: Street) -> None:
    def say(*shapes: Shape, x_m: float = 8.0) -> list[str]:
        return verdicts(street, find(street, log_of(*shapes), SHIFT_NS), x_m)

    found = [seen(street, 0, 0), seen(street, 1, 1)]
    assert say(*found) == ["motorcycle: found as object 0", "pedestrian: found as object 1"]
    assert say(*found, seen(street, 2, 1, off_m=0.1))[1] == "pedestrian: SPLIT into objects 1 and 2"
    assert say(seen(street, 3, 0, 1)) == [
        "motorcycle: MERGED with pedestrian in object 3",
        "pedestrian: MERGED with motorcycle in object 3",
    ]
    assert say(found[0])[1] == "pedestrian: MISSED"
    assert say(found[0], x_m=3.0)[1] == "pedestrian: not passed: the drive ended at 3.0 m"


def test_an_object_far_from_everybody_is_a_ghost(street: Street) -> None:
    findings = find(street, log_of(seen(street, 7, 1, off_m=9.0)), SHIFT_NS)
    assert findings[0].users == ()
    text = lines(street, findings, 8.0)
    assert "nobody (ghost)" in text[1]
    assert text[-1].startswith("object 7 is nobody: 8.")
    assert as_dict(street, findings, 8.0)["users"] == ["motorcycle: MISSED", "pedestrian: MISSED"]


def test_a_busy_machine_is_named() -> None:
    ledgers = [FrameLedger(radar) for radar in RADARS]
    for ledger in ledgers:
        ledger.frame_in(100)
        ledger.lost(LossCause.GAP, 100)
    assert busy_note([ledger.snapshot() for ledger in ledgers], 0.01) == ""
    for ledger in ledgers:
        ledger.frame_in(100)
        ledger.lost(LossCause.SHED, 40)
        ledger.lost(LossCause.OVERFLOW, 60)
    assert "200 of 400 frames" in busy_note([ledger.snapshot() for ledger in ledgers], 0.01)


def test_chamfer_is_the_mean_of_both_directions() -> None:
    a = np.float32([[0, 0, 0], [1, 0, 0]])
    b = np.float32([[0, 0, 3.0]])
    assert chamfer_m(a, b) == pytest.approx(0.5 * (0.5 * (3.0 + 10.0**0.5) + 3.0), rel=1e-6)
