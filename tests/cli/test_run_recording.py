# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct run --record``: the run is on the disk, and a disk that is slow or full does not touch the run."""

from __future__ import annotations

import argparse
import json
import re
import resource
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from cli_run import RIG, drive_by, rfconstruct
from virtual_boards import virtual_boards

from edge.commands import run_command, run_recording
from edge.commands.run_recording import BOTH, RAW, RESULTS, RunRecording
from edge.commands.session import Session
from edge.errors import ConfigError, ExitCode, RecordingError
from edge.frames import Pose, RadarFrame
from edge.recording.reader import RecordingReader
from edge.recording.recorder import Recorder
from edge.recording.writer import RecordingWriter
from edge.service.live import LivePipeline
from edge.service.metrics_text import exposition
from edge.service.observer import Observer
from edge.service.serve import Item
from edge.service.states import Code, Facts, StateMachine

FRAMES = [item for item in drive_by() if isinstance(item, RadarFrame)]
BYTES = FRAMES[0].layout.nbytes


@contextmanager
def file_limit(size_bytes: int) -> Iterator[None]:
    """A limit of files acts as a disk that becomes full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


class Played(Session):
    """A live run whose source is taken and counted, without the kernels."""

    def _warm_up(self, prepare: object) -> None:
        pass

    def _serve(self, source: Iterable[Item], total: int | None, pipeline: LivePipeline, observer: Observer) -> None:
        self.taken = 0
        for item in source:
            self.taken += 1
            if isinstance(item, Pose) and self._publishing is not None:
                self._publishing._send(self._publishing._publisher.pose, item)
        end_s = time.monotonic() + 20.0
        while self._recording is not None and self._recording.figures().waiting_bytes and time.monotonic() < end_s:
            time.sleep(0.002)
        observer.live()
        self.verdict = observer.tick()
        self.metrics = exposition(observer.snapshot())


def played(folder: Path, *options: object) -> Played:
    """Frames and poses of a short drive, recorded to ``run.mcap``."""
    parser = argparse.ArgumentParser()
    run_command.add_arguments(parser)
    parser.add_argument("--json", action="store_true")
    words = ("--rig", RIG.name, "--endpoint", f"ipc://{folder}/pub", "--record", folder / "run.mcap", *options)
    run = Played(RIG, parser.parse_args([str(word) for word in words]), "live", "a run", live=True)
    run.run(drive_by(), None)
    return run


def test_raw_and_results_can_be_read_and_recovered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run.mcap"
    run = played(tmp_path, "--record-what", BOTH, "--json")
    run.report()
    account = json.loads(capsys.readouterr().out)["recording"]
    assert (account["dropped"], account["ended"], account["recording"]) == ({}, None, str(out))
    assert run.exit_code(ExitCode.OK) == ExitCode.OK
    assert {f"/radar/{radar}/raw": account["written"][f"/radar/{radar}/raw"] for radar in RIG.radars} == {
        f"/radar/{radar}/raw": len(FRAMES) // 2 for radar in RIG.radars
    }
    assert {"/pose", "/rig_pose", "/heartbeat", "/status"} <= set(account["written"])
    with RecordingReader(out) as reader:
        assert (reader.has_frames, reader.has_results, reader.truncated) == (True, True, False)
        assert reader.read_rig().config_hash == RIG.config_hash
        assert len(list(reader)) == run.taken == len(drive_by())
    assert rfconstruct("info", out, "--json").json["whole"]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(out.read_bytes()[: out.stat().st_size * 2 // 3])
    assert rfconstruct("recover", cut, tmp_path / "good.mcap").code == ExitCode.DEGRADED
    assert rfconstruct("info", tmp_path / "good.mcap", "--json").json["whole"]


def test_a_full_disk_ends_the_recording_and_the_run_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the closing table, in state and metrics, in the exit code; what was written before is readable."""
    with file_limit(5 * BYTES):
        run = played(tmp_path, "--no-publish")
    run.report()
    text = capsys.readouterr().out
    assert run.taken == len(drive_by())
    assert run.exit_code(ExitCode.OK) == ExitCode.DEGRADED
    assert re.search(r"the recording ended early: .*recording stopped.*File too large.*free space", text)
    rows = re.findall(r"^/radar/\w+/raw +(\d+) +(\d+)$", text, re.MULTILINE)
    counts = [(int(written), int(dropped)) for written, dropped in rows]
    assert [sum(pair) for pair in counts] == [len(FRAMES) // 2] * 2
    with RecordingReader(tmp_path / "run.mcap") as reader:
        found = sum(isinstance(item, RadarFrame) for item in reader)
    assert 0 < found == sum(written for written, _ in counts) < 5
    assert rfconstruct("recover", tmp_path / "run.mcap", tmp_path / "good.mcap").code in (0, ExitCode.DEGRADED)


@pytest.mark.slow
def test_against_virtual_boards(tmp_path: Path) -> None:
    """The verb itself, and the pipeline run again on what it recorded."""
    out = tmp_path / "run.mcap"
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        words = ("--boards", virtual.boards, "--frames", 40, "--record", out, "--no-publish", "--json")
        outcome = rfconstruct("run", "--rig", "awr1843_pair", *words)
    account = outcome.json["recording"]
    came = {radar: frames["frames_in"] for radar, frames in outcome.json["frames"].items()}
    assert {radar: account["written"][f"/radar/{radar}/raw"] for radar in came} == came
    again = rfconstruct("replay", out, "--speed", "max", "--no-publish", "--json")
    assert {radar: frames["frames_in"] for radar, frames in again.json["frames"].items()} == came


def test_a_disk_that_stands_still_holds_nothing_up_and_costs_counted_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()

    class Held(RecordingWriter):
        def frame(self, frame: RadarFrame) -> None:
            assert released.wait(60)
            super().frame(frame)

    frames, room = FRAMES, 2 * BYTES
    monkeypatch.setattr(run_recording, "RecordingWriter", Held)
    monkeypatch.setattr(run_recording, "Recorder", partial(Recorder, queue_bytes=room))
    recording = RunRecording(tmp_path / "a.mcap", RAW, RIG)
    recording.open()
    assert len(list(recording.tee(frames))) == len(frames), "everything passed while nothing could be written"
    assert recording.dropped() == len(frames) - 2
    assert recording.figures().waiting_bytes == room
    released.set()
    recording.close()
    assert recording.incomplete
    assert sum(recording.figures().written.values()) == 2
    assert any(re.fullmatch(r"/radar/\w+/raw +\d+ +[1-9]\d*", line) for line in recording.lines())


def test_what_the_frames_buffers_hold_later_is_not_recorded(tmp_path: Path) -> None:
    frames = FRAMES[:4]
    recording, truth = RunRecording(tmp_path / "a.mcap", RAW, RIG), [frame.adc.copy() for frame in frames]
    recording.open()
    for frame in recording.tee([replace(frame, adc=frame.adc.copy()) for frame in frames]):
        assert isinstance(frame, RadarFrame)
        frame.adc[:] = -1
    recording.close()
    with RecordingReader(recording.path) as reader:
        kept = [item.adc for item in reader if isinstance(item, RadarFrame)]
    assert all(np.array_equal(a, b) for a, b in zip(kept, truth, strict=True))


def test_names(tmp_path: Path) -> None:
    """A folder: every start has a file of its own, so that a service can be restarted."""
    for _ in range(2):
        recording = RunRecording(tmp_path, RAW, RIG)
        recording.open()
        list(recording.tee(drive_by()[:2]))
        recording.close()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 2
    assert all(re.fullmatch(rf"{RIG.name}-\d{{8}}T\d{{6}}Z(-2)?\.mcap", name) for name in names)
    with pytest.raises(ConfigError, match=r"end in \.mcap"):
        RunRecording(tmp_path / "run.bag", RAW, RIG)


def test_nothing_is_overwritten_and_nothing_empty_is_left(tmp_path: Path) -> None:
    out = tmp_path / "run.mcap"
    out.write_bytes(b"precious")
    with pytest.raises(RecordingError, match="never overwritten"):
        played(tmp_path, "--no-publish")
    assert out.read_bytes() == b"precious"
    empty = RunRecording(tmp_path / "empty.mcap", RAW, RIG)
    empty.open()
    empty.close()
    assert not empty.path.exists()
    assert "nothing came: no file was kept" in empty.lines()


def test_results_need_a_publisher(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="as they are published"):
        played(tmp_path, "--record-what", RESULTS, "--no-publish")
    assert not (tmp_path / "run.mcap").exists()


def test_state_and_metrics_say_what_became_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_recording, "RecordingWriter", Full)
    run = played(tmp_path, "--no-publish", "--json")
    assert Code.RECORDING_ENDED in {reason.code for reason in run.verdict.reasons}
    assert "rfconstruct_recording 0\n" in run.metrics
    assert re.search(r'rfconstruct_recording_dropped_total\{topic="/radar/vertical/raw"\} [1-9]', run.metrics)


class Full(RecordingWriter):
    """A disk without room for a frame."""

    def frame(self, frame: RadarFrame) -> None:
        raise RecordingError("no room")


def test_the_state_says_that_the_recording_ended() -> None:
    machine, reason = StateMachine(), "run.mcap: recording stopped"
    verdict = machine.update(1, Facts(recording_ended=reason))
    assert verdict.state == "DEGRADED"
    assert [(r.code, r.detail) for r in verdict.reasons] == [(Code.RECORDING_ENDED, reason)]
