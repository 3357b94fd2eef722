# SPDX-License-Identifier: Apache-2.0
"""The recording that ``run --record`` makes beside the pipeline, which never waits for it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from edge.errors import ConfigError, RecordingError
from edge.frames import Pose, RadarFrame
from edge.recording.recorder import Recorder
from edge.recording.writer import RecordingWriter
from edge.rig import Rig
from edge.service.snapshot import RecordingFigures
from edge.sources.base import Loss

RAW, RESULTS, BOTH = "raw", "results", "both"
SIGNS_OF_LIFE = {"/heartbeat", "/status"}
"""A recording of these alone is none: no board gave anything."""
SUFFIX = ".mcap"
CLOSE_S = 5.0
"""What waits for the disk when the run is over gets so long: the service manager kills after fifteen seconds."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Where to, and what."""
    parser.add_argument("--record", type=Path, metavar="FILE", help="record the run; a folder: under a name of its own")
    parser.add_argument(
        "--record-what", choices=(RAW, RESULTS, BOTH), default=RAW, help="frames, what is published (default: raw)"
    )


class RunRecording:
    """A recording beside a run: bounded queue, own thread, every message written or counted as dropped.

    A disk that is full or fails ends the recording, with a reason, and not the run.

    Args:
        path: ``*.mcap`` that does not exist, or a folder.
        what: "raw": frames and poses; "results": what is published, byte for byte; "both".
        rig: of the run; stored with it.
    Attributes:
        ended: why the recording ended before the run; empty: it did not.
    Raises:
        ConfigError: another ending than .mcap.
    """

    def __init__(self, path: Path, what: str, rig: Rig) -> None:
        if path.suffix != SUFFIX and not path.is_dir():
            raise ConfigError("recordings end in .mcap", value=str(path), action="choose such a name, or a folder")
        self.path, self._what, self._rig = path, what, rig
        self.ended = ""
        self._recorder: Recorder | None = None
        self._closed = False

    @classmethod
    def of(cls, args: argparse.Namespace, rig: Rig) -> RunRecording | None:
        """The one that the options ask for; None: none.

        Raises:
            ConfigError: results shall be recorded and nothing is published, or the name is none.
        """
        path: Path | None = getattr(args, "record", None)
        if path is None:
            return None
        if args.record_what != RAW and args.no_publish:
            raise ConfigError(
                "results are recorded as they are published",
                value=f"--record-what {args.record_what} with --no-publish",
                action="leave --no-publish out; ipc:// or loopback addresses are reached from this machine only",
            )
        return cls(path, args.record_what, rig)

    def open(self) -> None:
        """Make the file; RecordingError when it exists or cannot be made."""
        if self.path.is_dir():
            self.path = _free_name(self.path, self._rig.name)
        self._recorder = Recorder(RecordingWriter(self.path, self._rig, [f"{self._what} of a live run"]))

    def tee(self, source: Iterable[RadarFrame | Pose | Loss]) -> Iterator[RadarFrame | Pose | Loss]:
        """Everything that passes goes on at once; raw data are recorded, if they are wanted."""
        for item in source:
            if self._recorder is not None and self._what != RESULTS and not self._closed:
                self._recorder.put(item)
            yield item

    def published(self, frames: Sequence[bytes]) -> None:
        """Take a message as it was published, if results are wanted."""
        if self._recorder is not None and self._what != RAW and not self._closed:
            self._recorder.published(frames)

    def figures(self) -> RecordingFigures:
        """At this instant; any thread."""
        recorder = self._recorder
        if recorder is None:
            return RecordingFigures(ended=self.ended)
        if recorder.failure is not None and not self.ended:
            self.ended = str(recorder.failure)
        written, dropped = dict(recorder.written), dict(recorder.dropped)
        return RecordingFigures(written, dropped, recorder.bytes_written, recorder.waiting_bytes, self.ended)

    def dropped(self) -> int:
        """Messages that did not fit while the recording went on."""
        figures = self.figures()
        return 0 if figures.ended else sum(figures.dropped.values())

    def close(self) -> None:
        """Write what waits and close; a failure is kept in ``ended``. A file with signs of life alone is removed."""
        self._closed = True
        if self._recorder is None:
            return
        try:
            self._recorder.close(CLOSE_S)
        except RecordingError as error:
            self.ended = self.ended or str(error)
        if self._recorder.written.keys() <= SIGNS_OF_LIFE:
            self.path.unlink(missing_ok=True)

    @property
    def incomplete(self) -> bool:
        """Whether something is missing in it."""
        figures = self.figures()
        return bool(figures.ended or sum(figures.dropped.values()))

    def as_dict(self) -> dict[str, Any]:
        """For the report for machines."""
        figures = self.figures()
        return {
            "recording": str(self.path),
            "what": self._what,
            "bytes": figures.bytes_written,
            "written": dict(figures.written),
            "dropped": dict(figures.dropped),
            "ended": figures.ended or None,
        }

    def lines(self) -> list[str]:
        """For the report for people."""
        figures = self.figures()
        topics = sorted(set(figures.written) | set(figures.dropped))
        text = [f"recording {self.path} ({self._what}): {figures.bytes_written / 1e6:.1f} MB"]
        text += [f"{'topic':<25}{'written':>10}{'dropped':>10}"] if topics else []
        text += [f"{t:<25}{figures.written.get(t, 0):>10}{figures.dropped.get(t, 0):>10}" for t in topics]
        if figures.written.keys() <= SIGNS_OF_LIFE:
            text.append("nothing came: no file was kept")
        return [*text, f"the recording ended early: {figures.ended}"] if figures.ended else text


def _free_name(folder: Path, rig: str) -> Path:
    """Rig and UTC of the start; a number follows when there is such a file."""
    name = f"{rig}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
    path, copy = folder / f"{name}{SUFFIX}", 1
    while path.exists():
        copy += 1
        path = folder / f"{name}-{copy}{SUFFIX}"
    return path
