# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM end a run in order: account, STOP on the stream, the exit code of a shell."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from cli_run import rfconstruct, write_recording

from edge.commands.interrupts import Interrupts
from edge.errors import ExitCode
from edge.plot.collector import PictureCollector
from edge.stream.client import connect
from edge.stream.messages import StatusMessage

QUIET = ("--speed", "max", "--no-publish")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("recording") / "drive.mcap")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_ends_in_order(number: signal.Signals, code: int, recording: Path, tmp_path: Path) -> None:
    endpoint, states = f"ipc://{tmp_path}/pub", []
    command = [sys.executable, "-m", "edge", "replay", str(recording), "--speed", "0.01", "--endpoint", endpoint]
    command += ["--plot", str(tmp_path)]
    with connect(endpoint, ("status",), timeout_s=60.0) as client:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("kernels ready"):
                break
        for message in client:
            assert isinstance(message, StatusMessage)
            states.append(message.status.state)
            if states[-1] == "RUN":
                process.send_signal(number)
            if states[-1] == "STOP":
                break
        out, err = process.communicate(timeout=60.0)
    assert process.returncode == code, err
    assert states[0] == "INIT"
    assert "frames in" in out
    assert f"ended by {number.name}" in out
    assert "no pictures of an interrupted run" in out
    assert "Traceback" not in err


def test_the_second_signal_ends_at_once_and_handlers_come_back() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with Interrupts() as interrupts:
        assert (interrupts.asked(), interrupts.exit_code) == (False, 0)
        signal.raise_signal(signal.SIGTERM)
        assert (interrupts.asked(), interrupts.exit_code) == (True, 143)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_other_threads_leave_signals_alone() -> None:
    codes: list[int] = []

    def run() -> None:
        with Interrupts() as interrupts:
            codes.append(interrupts.exit_code)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert codes == [0]


def test_a_picture_that_fails_costs_no_figures(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: PictureCollector) -> list[Path]:
        raise ValueError("no font")

    monkeypatch.setattr(PictureCollector, "write", fail)
    told = rfconstruct("replay", recording, "--plot", tmp_path, *QUIET)
    assert told.code == ExitCode.DEGRADED
    assert told.out.index("frames in") < told.out.index("pictures could not be drawn (ValueError: no font)")
    as_json = rfconstruct("replay", recording, "--plot", tmp_path, "--json", *QUIET)
    assert as_json.code == ExitCode.DEGRADED
    assert as_json.json["pictures"] == []
    assert "no font" in as_json.json["notes"][-1]


def test_a_file_name_is_drawn_as_it_is(recording: Path, tmp_path: Path) -> None:
    strange = tmp_path / "caf\udce9 $x_{1} 漢\n.mcap"
    strange.symlink_to(recording)
    told = rfconstruct("replay", strange, "--plot", tmp_path / "pictures", *QUIET)
    assert (told.code, told.err) == (ExitCode.OK, "")
    assert (tmp_path / "pictures" / "heatmaps.png").is_file()
