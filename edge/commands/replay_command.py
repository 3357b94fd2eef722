# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct replay``: plays a recording or a capture folder through the whole pipeline."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

from edge.commands import session
from edge.commands.open_source import add_rig_arguments, calibrated, open_capture, rig_of
from edge.errors import ExitCode, RecordingError
from edge.recording.reader import RecordingReader
from edge.rig import load_rig
from edge.sources.base import FrameSource


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("recording", type=Path, help="MCAP recording, or a folder of one radar's capture files")
    add_rig_arguments(parser)
    session.add_arguments(parser, speed="1")


def run(args: argparse.Namespace) -> int:
    """Open, play, report; exit code 3 when frames were lost or the recording is cut or damaged.

    Ctrl-C and SIGTERM end the run in order: account printed, exit code 130 or 143.
    """
    path: Path = args.recording
    if path.is_dir():
        rig = rig_of(args)
        source, notes = open_capture(path, rig)
        with closing(source):
            return _play(session.Session(rig, args, "replay", f"{path.name}, rig {rig.name}", notes), source)
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording", action="give an .mcap file or a capture folder")
    with RecordingReader(path) as reader:
        rig = calibrated(load_rig(args.rig) if args.rig else reader.read_rig(), args.calibration)
        notes = list(reader.notes)
        if reader.truncated:
            notes.append(f"{path}: its end is missing; played up to the last whole record")
        return _play(session.Session(rig, args, "replay", f"{path.name}, rig {rig.name}", notes), reader)


def _play(run: session.Session, source: FrameSource) -> int:
    run.run(source, source.total_frames)
    damaged = isinstance(source, RecordingReader) and (source.truncated or source.report.bytes_lost > 0)
    if isinstance(source, RecordingReader) and source.report.damaged_chunks:
        run.notes.append(f"{source.path}: damaged chunks left out: {source.report.damaged_chunks}")
    accounts = [ledger.snapshot() for ledger in run.pipeline.ledgers.values()]
    nothing = not any(account.frames_in for account in accounts)
    if nothing:
        run.notes.append("there was not a single radar frame")
    run.report()
    lost = any(account.frames_lost for account in accounts)
    return run.exit_code(ExitCode.DEGRADED if lost or damaged or nothing else ExitCode.OK)
