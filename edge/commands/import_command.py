# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct import``: captures of the boards' own tools to a recording; TI's calibration file to ours.

Poses must be on the clock of the frames. That clock starts where ``--start-ns`` says; without it one radar's TI capture
keeps its board's clock, and every other capture starts at 0.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge.calibration import save_calibration
from edge.commands.open_source import add_rig_arguments, named_path, rig_of
from edge.errors import ConfigError, ExitCode
from edge.frames import Pose, RadarId
from edge.odometry.vehicle import rig_poses
from edge.recording.importing import ImportReport, import_capture, import_poses
from edge.rig import Rig

LATEST_START_NS = 2**62


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument(
        "capture",
        nargs="+",
        metavar="[RADAR=]PATH",
        help="TI capture folder, adc_data.bin, TI calibration (.mat); one a radar",
    )
    add_rig_arguments(parser)
    parser.add_argument(
        "--poses", type=Path, metavar="FILE", help="on the frames' clock: CSV, JSON lines, TUM (.tum, .txt)"
    )
    parser.add_argument(
        "--poses-of",
        choices=("rig", "vehicle"),
        default="rig",
        metavar="WHOSE",
        help="rig, or vehicle (base_link): apply the rig's geometry (default: rig)",
    )
    parser.add_argument(
        "--start-ns",
        type=start_ns,
        metavar="NS",
        help="first chirp on poses' clock; default: one radar's TI capture has the board's clock, others begin at 0",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="file to make; must not exist")


def run(args: argparse.Namespace) -> int:
    """Import; exit code 3 when frames of the capture were lost."""
    rig = rig_of(args)
    inputs = dict(named_path(text, rig) for text in args.capture)
    if len(inputs) < len(args.capture):
        raise ConfigError("two captures of one radar", value=args.capture, allowed="one for each radar")
    if args.out.exists():
        raise ConfigError(f"{args.out} exists", action="choose another name: nothing is overwritten")
    if any(path.suffix == ".mat" for path in inputs.values()):
        return _import_calibration(args, rig, inputs)
    poses: Iterable[Pose] = import_poses(args.poses) if args.poses is not None else []
    if args.poses_of == "vehicle":
        poses = rig_poses(poses, rig.geometry)
    with _bar(args.json) as bar:
        report = import_capture(
            *(inputs, rig, args.out, poses), lambda done, total: _advance(bar, done, total), args.start_ns
        )
    print(json.dumps(_as_dict(report, args.out), indent=2) if args.json else "\n".join(_lines(report, args.out)))
    return ExitCode.DEGRADED if any(report.lost[radar] for radar in report.lost) else ExitCode.OK


def start_ns(text: str) -> int:
    """Nanoseconds; argparse.ArgumentTypeError when they are not whole or cannot be recorded."""
    if not (text.isascii() and text.isdigit() and len(text) <= 19 and int(text) <= LATEST_START_NS):
        raise argparse.ArgumentTypeError(f"got {text!r}; allowed: 0..{LATEST_START_NS} ns")
    return int(text)


def _import_calibration(args: argparse.Namespace, rig: Rig, inputs: dict[RadarId, Path]) -> int:
    """TI's matrices to our file, with what was repaired."""
    if len(inputs) != 1:
        raise ConfigError("import one calibration at a time", value=list(map(str, inputs.values())), allowed="one file")
    radar, path = next(iter(inputs.items()))
    calibration = rig.with_calibration(radar, path).radars[radar].calibration
    save_calibration(args.out, calibration)
    content = {
        "calibration": str(args.out),
        "radar": radar,
        "reference_range_m": calibration.reference_range_m,
        "date": calibration.date,
        "repaired": list(calibration.repaired),
    }
    if args.json:
        print(json.dumps(content, indent=2))
    else:
        print(f"{args.out}: {radar}, made {calibration.date} with a reflector at {calibration.reference_range_m:.3f} m")
        print(f"repaired channels: {', '.join(calibration.repaired) or 'none'}")
    return ExitCode.OK


def _bar(hidden: bool) -> Any:
    from tqdm import tqdm

    return tqdm(unit="frame", desc="importing", disable=hidden or not sys.stderr.isatty(), leave=False)


def _advance(bar: Any, done: int, total: int) -> None:
    bar.total = total
    bar.update(done - bar.n)


def _as_dict(report: ImportReport, out: Path) -> dict[str, Any]:
    return {"recording": str(out), **asdict(report)}


def _lines(report: ImportReport, out: Path) -> list[str]:
    lines = [f"{out}: {out.stat().st_size / 1e6:.1f} MB, {report.poses} poses"]
    for radar, count in report.frames_in.items():
        causes = ", ".join(f"{cause.value} {number}" for cause, number in report.lost[radar].items())
        lines.append(f"{radar}: {count} frames in the capture, {report.frames_ok[radar]} recorded, lost: {causes or 0}")
    return lines + [f"note: {note}" for note in report.notes]
