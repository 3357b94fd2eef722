# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct replay``: plays a recording or a capture folder through the whole pipeline, or recorded results."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path

from edge.commands import arguments, session
from edge.commands.open_source import add_rig_arguments, calibrated, open_capture, rig_of
from edge.commands.replay_results import replay_results
from edge.digest import ResultDigest
from edge.errors import ConfigError, ExitCode, RecordingError
from edge.recording.playback import Part, Playback
from edge.recording.reader import RecordingReader
from edge.rig import load_rig
from edge.sources.base import FrameSource


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.usage = "%(prog)s RECORDING [options]"
    parser.add_argument("recording", type=Path, help="MCAP recording, or a folder of one radar's capture files")
    add_rig_arguments(parser)
    session.add_arguments(parser, speed="1")
    parser.add_argument("--start", type=arguments.moment, default=0.0, metavar="S", help="begin so many seconds in")
    parser.add_argument("--end", type=arguments.moment, metavar="S", help="end so many seconds in")
    parser.add_argument(
        "--loop", type=arguments.passes, default=1, metavar="N", help="play N times, 0 = for ever; numbers go on rising"
    )
    parser.add_argument("--live", action="store_true", help="as the live service: threads, early shapes")
    parser.add_argument("--digest", action="store_true", help="SHA-256 over detections, points and shapes")


def run(args: argparse.Namespace) -> int:
    """Open, play, report; exit code 3 when frames were lost or the recording is cut or damaged.

    Ctrl-C and SIGTERM end the run in order: account printed, exit code 130 or 143.
    """
    path: Path = args.recording
    if args.live and (args.speed <= 0 or args.digest):
        raise ConfigError(
            "--live drops what it cannot follow: it needs a speed, and gives no digest",
            value="--digest" if args.digest else "--speed max",
            action="leave --live out",
        )
    part = Part(args.start, args.end, args.loop)
    if path.is_dir():
        if not part.whole or part.loops != 1:
            raise ConfigError("--start, --end and --loop need a recording", value=str(path), action="import it first")
        rig = rig_of(args)
        source, notes = open_capture(path, rig)
        with closing(source):
            run = session.Session(rig, args, "replay", f"{path.name}, rig {rig.name}", notes, live=args.live)
            return _play(run, source, args.digest)
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording", action="give an .mcap file or a capture folder")
    with RecordingReader(path) as reader:
        if reader.has_results and not reader.has_frames:
            return replay_results(reader, part, args)
        rig = calibrated(load_rig(args.rig) if args.rig else reader.read_rig(), args.calibration)
        notes = list(reader.notes)
        if reader.truncated:
            notes.append(f"{path}: its end is missing; played up to the last whole record")
        run = session.Session(rig, args, "replay", f"{path.name}, rig {rig.name}", notes, live=args.live)
        return _play(run, Playback(reader, part), args.digest, reader)


def _play(run: session.Session, source: FrameSource, digested: bool, reader: RecordingReader | None = None) -> int:
    digest = ResultDigest(run.rig.settings.stream.shape_encoding)
    if digested:
        run.pipeline.sinks.append(digest)
    run.run(source, source.total_frames)
    damaged = reader is not None and (reader.truncated or reader.report.bytes_lost > 0)
    if reader is not None and reader.report.damaged_chunks:
        run.notes.append(f"{reader.path}: damaged chunks left out: {reader.report.damaged_chunks}")
    accounts = [ledger.snapshot() for ledger in run.pipeline.ledgers.values()]
    nothing = not any(account.frames_in for account in accounts)
    if nothing:
        run.notes.append("there was not a single radar frame")
    run.report({"digest": digest.hexdigest()} if digested else None)
    lost = any(account.frames_lost for account in accounts)
    return run.exit_code(ExitCode.DEGRADED if lost or damaged or nothing else ExitCode.OK)
