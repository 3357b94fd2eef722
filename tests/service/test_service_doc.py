# SPDX-License-Identifier: Apache-2.0
"""Commands and figures of docs/service.md: keys in order, names of metrics, exposure, options that exist."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import time
import tomllib
from pathlib import Path

import pytest

from edge.cli import main
from edge.config import StreamSettings
from edge.service.metrics_text import exposition
from edge.service.snapshot import RecordingFigures, Snapshot
from edge.stream.messages import PoseStatus, RadarStatus, Reason, Status
from edge.timing import StageTimes

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "service.md").read_text(encoding="utf-8")


def blocks(kind: str) -> list[str]:
    return re.findall(rf"^```{kind}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


def test_commands_about_keys_run_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("rfconstruct keys")]
    assert len(lines) == 6
    for line in lines:
        assert main(shlex.split(line)[1:]) == 0, line


def test_settings_are_settings() -> None:
    (block,) = blocks("toml")
    stream = tomllib.loads(block)["stream"]
    StreamSettings(**{key: tuple(value) if isinstance(value, list) else value for key, value in stream.items()})


def test_every_metric_has_its_line_and_every_line_its_metric() -> None:
    times = StageTimes()
    times.record("a", 1.0)
    status = Status(
        "RUN", 0, (Reason("A", 1, 1, 1),), {"h": RadarStatus(1, 0, {"gap": 1})}, pose=PoseStatus(1, 1, 1, "x")
    )
    one, recording = {"car": 1}, RecordingFigures({"/pose": 1}, {"/pose": 1})
    snapshot = Snapshot(status, times.histograms(), one, one, queues={"a": 1}, temperature_c=1.0, recording=recording)
    text = exposition(snapshot)
    given = set(re.findall(r"^# TYPE rfconstruct_(\w+)", text, re.MULTILINE))
    table = TEXT.split("| metric (`rfconstruct_…`)")[1].split("\n\n")[0]
    named = {name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[1])}
    assert named == given


def test_the_exposure_that_is_stated() -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze here: apt-get install systemd")
    (line,) = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("systemd-analyze")]
    answer = subprocess.run(
        [*shlex.split(line), "--no-pager"], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    found = re.search(r"exposure level for \S+: (\d\.\d)", answer.stdout)
    stated = re.search(r"says \*\*(\d\.\d)\*\*", TEXT)
    assert found
    assert stated
    assert found[1] == stated[1]


def test_other_commands_name_what_exists(capsys: pytest.CaptureFixture[str]) -> None:
    lines = [line.removeprefix("sudo ") for block in blocks("sh") for line in block.splitlines()]
    for line in lines:
        words = shlex.split(line)
        if words[0] == "packaging/build_deb.sh":
            assert (ROOT / words[0]).stat().st_mode & 0o100
        if words[:2] == ["python", "-m"]:
            assert (ROOT / (words[2].replace(".", "/") + ".py")).is_file()
    for verb, option in (("run", "--metrics-port"), ("doctor", "--hardware"), ("listen", "--endpoint")):
        with pytest.raises(SystemExit):
            main([verb, "--help"])
        assert option in capsys.readouterr().out


def test_old_recordings_go_by_the_stated_line_and_no_others(tmp_path: Path) -> None:
    if shutil.which("systemd-tmpfiles") is None:
        pytest.skip("no systemd-tmpfiles here: apt-get install systemd")
    (line,) = re.findall(r"^```\n(e /\S+ .*)\n```$", TEXT, re.MULTILINE)
    folder = line.split()[1]
    assert f"--record {folder}`" in TEXT
    assert f"d       {folder} " in (ROOT / "systemd/tmpfiles/rfconstruct.conf").read_text(encoding="utf-8")
    place, rules = tmp_path / folder.lstrip("/"), tmp_path / "etc/tmpfiles.d/rfconstruct-recordings.conf"
    for parent in (place, rules.parent):
        parent.mkdir(parents=True)
    rules.write_text(line + "\n")
    for name, days in (("old", 15.5), ("kept", 15.5), ("recent", 12.5), ("running", 0.0)):
        path = place / f"{name}.mcap"
        path.touch()
        then_s = time.time() - 86400 * days
        os.utime(path, (then_s, then_s))
    (place / "kept.mcap").chmod(0o1600)
    (find,) = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("find ")]
    listed = subprocess.run(
        shlex.split(find.replace(folder, str(place))), capture_output=True, text=True, timeout=10, check=True
    )
    assert listed.stdout.split() == [str(place / "old.mcap")]
    clean = ["systemd-tmpfiles", "--clean", f"--root={tmp_path}", rules.name]
    subprocess.run(clean, timeout=60, check=True)
    assert sorted(path.stem for path in place.iterdir()) == ["kept", "recent", "running"]
