# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct view`` on the command line: what it refuses, how it ends, and that it needs no pipeline to look."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from view_samples import block, drive

sys.path.append(str(Path(__file__).resolve().parents[1] / "cli"))

from cli_run import rfconstruct

from edge.errors import ExitCode
from edge.recording import schema
from edge.recording.writer import RecordingWriter

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "drive.mcap"
    with RecordingWriter(path, None) as writer:
        for draft in drive(0.5):
            writer.message(schema.result_topic(draft.topic.encode()), block(draft), draft.t_ns)
    return path


def test_help_fits_a_screen() -> None:
    outcome = rfconstruct("view", "--help")
    assert (outcome.code, outcome.out.count("\n") < 30) == (ExitCode.OK, True)


def test_another_host_is_refused_before_anything_is_opened() -> None:
    outcome = rfconstruct("view", "--host", "0.0.0.0", "--port", "8123")
    assert outcome.code == ExitCode.BAD_CONFIG
    assert "ssh -L 8123:127.0.0.1:8123" in outcome.err


@pytest.mark.parametrize("port", ["x", "-1", "65536", "8080.0"])
def test_a_port_that_is_none_is_a_usage_error(port: str) -> None:
    assert rfconstruct("view", "--port", port).code == ExitCode.USAGE


def test_a_recording_that_is_not_there(tmp_path: Path) -> None:
    outcome = rfconstruct("view", tmp_path / "none.mcap")
    assert outcome.code == ExitCode.FAILURE
    assert "no such recording" in outcome.err


def test_an_empty_recording_says_so(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "empty.mcap", None):
        pass
    assert "neither results nor raw frames" in rfconstruct("view", tmp_path / "empty.mcap").err


def test_it_shows_a_recording_and_ends(recording: Path) -> None:
    pytest.importorskip("viser", reason="the viewer needs viser: pip install 'rfconstruct[view]'")
    outcome = rfconstruct("view", recording, "--port", "0", "--duration", "1.5", "--json")
    assert outcome.code == ExitCode.OK, outcome.err
    assert outcome.json["url"] == f"http://127.0.0.1:{outcome.json['port']}"


def test_it_waits_for_a_publisher_and_ends() -> None:
    pytest.importorskip("viser", reason="the viewer needs viser: pip install 'rfconstruct[view]'")
    outcome = rfconstruct("view", "--endpoint", "tcp://127.0.0.1:1", "--port", "0", "--duration", "0.5")
    assert outcome.code == ExitCode.OK, outcome.err
    assert outcome.out.startswith("viewer: http://127.0.0.1:")


def test_without_viser_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    outcome = rfconstruct("view", "--port", "0")
    assert outcome.code == ExitCode.USAGE
    assert "rfconstruct[view]" in outcome.err


def test_a_live_view_loads_no_pipeline_and_no_viser_before_it_is_needed() -> None:
    code = "import sys, edge.commands.view_command as v; print(sorted({'numba', 'viser', 'PIL'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=ROOT)
    assert done.stdout.strip() == "[]", done.stderr
