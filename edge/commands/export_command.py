# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct export``: results of a recording as PLY, PCD, NPZ, or an MCAP file for Foxglove and Lichtblick."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from edge.commands import arguments
from edge.commands.session import load_model
from edge.computed_results import computed_messages, recorded_messages
from edge.errors import ConfigError, ExitCode, RecordingError, WireError
from edge.pipeline import Pipeline
from edge.recording.exporting import WHATS, ExportReport, What, export_points
from edge.recording.foxglove_export import export_foxglove
from edge.recording.placing import FRAME_NAMES, Placer, require_frame
from edge.recording.playback import Part, Playback
from edge.recording.point_files import SUFFIXES
from edge.recording.reader import RecordingReader
from edge.rig import Rig, load_rig
from edge.stream.messages import Message

FORMATS = tuple(suffix[1:] for suffix in (*SUFFIXES, ".mcap"))
MCAP = ".mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.usage = "%(prog)s RECORDING OUT [options]"
    parser.add_argument("recording", type=Path, help="of results, or of raw frames (computed first)")
    parser.add_argument("out", type=Path, help="file (.ply, .pcd, .npz, .mcap), or folder")
    parser.add_argument("--what", choices=(*WHATS, "all"), help="default: shapes; for MCAP all")
    parser.add_argument("--frame", choices=FRAME_NAMES, default="odometry", help="default: odometry")
    parser.add_argument("--format", choices=FORMATS, help="of the files in a folder (default: ply)")
    parser.add_argument("--all", action="store_true", help="every shape of an object, not the best one")
    parser.add_argument("--rig", metavar="NAME", help="when the recording does not bring it")
    parser.add_argument("--start", type=arguments.moment, default=0.0, metavar="S", help="begin so many seconds in")
    parser.add_argument("--end", type=arguments.moment, metavar="S", help="end so many seconds in")


def run(args: argparse.Namespace) -> int:
    """Export; exit code 3 when the recording is cut or damaged, or something was left out."""
    suffix, what = _format(args), args.what or ("all" if args.out.suffix == MCAP else "shapes")
    if suffix == MCAP and args.frame != "odometry":
        raise ConfigError("an MCAP scene stands in the odometry frame", value=args.frame, allowed="--frame odometry",
                          action="the panel's display frame can be rig or base_link")  # fmt: skip
    if suffix != MCAP and what == "all":
        raise ConfigError("point files hold one kind of results", value=what, allowed=", ".join(WHATS))
    require_frame(what, args.frame)
    if not args.recording.is_file():
        raise RecordingError(f"{args.recording}: no such recording", action="give an .mcap file")
    faults: list[WireError] = []
    with RecordingReader(args.recording) as reader:
        rig = _rig(args, reader)
        geometry = None if rig is None else rig.geometry
        messages = _messages(args, reader, rig, faults)
        placed = Placer(args.frame, geometry).place(messages)
        if suffix == MCAP:
            report = export_foxglove(placed, args.out, WHATS if what == "all" else (cast(What, what),), geometry)
        else:
            report = export_points(placed, args.out, suffix, cast(What, what), args.frame, args.all)
        damaged = reader.truncated or reader.report.bytes_lost > 0
    _tell(args, report, damaged, len(faults))
    return ExitCode.DEGRADED if damaged or report.unplaced or faults else ExitCode.OK


def _format(args: argparse.Namespace) -> str:
    """Suffix of the files to write; ConfigError when name and ``--format`` do not agree."""
    own = args.out.suffix if args.out.suffix in (*SUFFIXES, MCAP) else ""
    asked = f".{args.format}" if args.format else own or ".ply"
    if asked == MCAP and own != MCAP:
        raise ConfigError("MCAP is one file", value=str(args.out), allowed="a name that ends in .mcap")
    if own and own != asked:
        raise ConfigError("name and --format do not agree", value=(str(args.out), args.format), action="leave one out")
    if own and args.out.resolve() == args.recording.resolve():
        raise ConfigError("the recording itself", value=str(args.out), action="choose another name")
    return asked


def _rig(args: argparse.Namespace, reader: RecordingReader) -> Rig | None:
    if args.rig:
        return load_rig(args.rig)
    return reader.read_rig() if reader.rig_name or reader.has_frames else None


def _messages(
    args: argparse.Namespace, reader: RecordingReader, rig: Rig | None, faults: list[WireError]
) -> Iterator[Message]:
    part = Part(args.start, args.end)
    if not reader.has_frames or rig is None:
        span_ns = None if part.whole else part.span_ns(reader.span_ns)
        return recorded_messages(reader, span_ns, faults.append)
    model, notes = load_model(rig)
    if not args.json:
        print(f"raw frames: the pipeline of rig {rig.name} runs", *notes, sep="\n", flush=True)
    playback = Playback(reader, part)
    return computed_messages(_with_bar(playback, args.json), Pipeline(rig, model), faults.append)


def _with_bar(playback: Playback, quiet: bool) -> Iterator[Any]:
    from tqdm import tqdm

    hidden = quiet or sys.stderr is None or not sys.stderr.isatty()
    yield from tqdm(playback, unit="item", desc="computing", disable=hidden, leave=False)


def _tell(args: argparse.Namespace, report: ExportReport, damaged: bool, faults: int) -> None:
    notes = [f"left out, since their pose is not known: {report.unplaced}"] if report.unplaced else []
    notes += [f"{args.recording} is cut or damaged: what could be read was exported"] if damaged else []
    notes += [f"messages that do not follow the wire format: {faults}"] if faults else []
    if args.json:
        content = {"files": [str(path) for path in report.files], "items": dict(report.items), "points": report.points}
        print(json.dumps({**content, "unplaced": report.unplaced, "notes": notes}, indent=2))
        return
    counts = ", ".join(f"{what} {count}" for what, count in report.items.items())
    where = report.files[0] if len(report.files) == 1 else f"{args.out}: {len(report.files)} files"
    print("\n".join([f"{where}: {counts}, {report.points} points", *(f"note: {note}" for note in notes)]))
