# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct calibrate``: a reflector capture to a calibration file; several stops of it to the boards' mounting."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from edge.calibration import save_calibration
from edge.calibration_capture import CaptureAverager, CaptureMean
from edge.calibration_checks import require_possible_range
from edge.calibration_make import DEFAULT_SEARCH_M, MadeCalibration, Reflector, make_calibration
from edge.calibration_quality import quality_lines
from edge.calibration_temperature import temperature_notes
from edge.commands import align_boards
from edge.commands.arguments import count
from edge.commands.open_source import add_rig_arguments, calibrated, open_capture
from edge.errors import ConfigError, ExitCode, RecordingError
from edge.frames import RADARS, RadarFrame, RadarId
from edge.recording.reader import RecordingReader
from edge.rig import Rig, load_rig
from edge.sources.base import FrameSource, Loss

DEFAULT_FRAMES = 64


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.usage = "%(prog)s CAPTURE... --out OUT [options]"
    help_text = "recording (.mcap) or folder of one radar's capture files; with --align recordings of both radars"
    parser.add_argument("capture", nargs="+", type=Path, help=help_text)
    add_rig_arguments(parser)
    parser.add_argument("--radar", choices=RADARS, help="which radar of the rig; needed when it has two")
    parser.add_argument("--range", type=float, metavar="METRES", help="reflector from the middle of the antenna row")
    help_text = "off boresight along the row, towards left or up (%(default)s)"
    parser.add_argument("--angle", type=float, default=0.0, metavar="DEG", help=help_text)
    help_text = "look for the echo this far to either side (%(default)s)"
    parser.add_argument("--search", type=float, default=DEFAULT_SEARCH_M, metavar="METRES", help=help_text)
    parser.add_argument("--background", type=Path, metavar="CAPTURE", help="the same place without the reflector")
    parser.add_argument("--amplitude", action="store_true", help="also make the channels equally strong")
    parser.add_argument("--frames", type=count, default=DEFAULT_FRAMES, help="average at most this many (%(default)s)")
    parser.add_argument("--board", default="", metavar="TEXT", help="identity of the board, kept in the file")
    parser.add_argument("--temperature", type=float, metavar="CELSIUS", help="of the board, kept in the file")
    parser.add_argument("--align", action="store_true", help="estimate how the two boards are mounted, from 3 stops up")
    help_text = "surveyed stops for --align, in order: x_m,y_m,z_m in the rig frame"
    parser.add_argument("--positions", type=Path, metavar="CSV", help=help_text)
    parser.add_argument("--plot", type=Path, metavar="DIR", help="write pictures there (extra 'plot')")
    parser.add_argument("--out", type=Path, required=True, help="file to make: .npz, with --align .toml")


def run(args: argparse.Namespace) -> int:
    """Calibrate one board, or align two."""
    if args.out.exists():
        raise ConfigError(f"{args.out} exists", action="choose another name: nothing is overwritten")
    if not args.out.parent.is_dir():
        raise ConfigError(f"{args.out.parent}: no such folder", action="make it, or choose another place")
    if args.plot is not None:
        from edge.plot.figure import prepare_folder

        prepare_folder(args.plot)
    if args.align:
        return align_boards.run(args)
    if args.range is None or len(args.capture) != 1:
        raise ConfigError(
            "calibrating a board needs one capture and the reflector's range",
            value=f"{len(args.capture)} captures, --range {args.range}",
            action="measure from the middle of the antenna row to the reflector's inner corner: --range METRES",
        )
    return _calibrate(args)


def _calibrate(args: argparse.Namespace) -> int:
    reflector = Reflector(args.range, args.angle, args.search)
    notes: list[str] = []
    with opened(args.capture[0], args) as (rig, source, found):
        radar = _radar(args, rig)
        require_possible_range(rig.radars[radar], reflector.range_m, reflector.search_m)
        notes += found
        mean = _average(source, rig, radar, reflector, args, notes)
    background = _background(args, rig, radar, reflector, notes)
    made = make_calibration(
        *(mean, rig.radars[radar], reflector, args.out),
        amplitude=args.amplitude,
        board=args.board,
        temperature_c=args.temperature,
        background=background,
    )
    save_calibration(args.out, made.calibration)
    notes += temperature_notes({radar: made.calibration}, args.temperature)
    pictures = _pictures(args, rig, radar, made, mean)
    _report(args, radar, made, notes, pictures)
    return ExitCode.OK


@contextmanager
def opened(path: Path, args: argparse.Namespace) -> Iterator[tuple[Rig, FrameSource, list[str]]]:
    """Rig, source and notes of a recording or of a capture folder, closed afterwards.

    Raises:
        RecordingError: there is no such thing.
        ConfigError: a folder without ``--rig``, or without ``--radar`` for a rig of two.
    """
    if path.is_file() and path.suffix != ".bin":
        with RecordingReader(path) as reader:
            notes = [f"{path}: its end is missing; read up to the last whole record"] if reader.truncated else []
            yield calibrated(load_rig(args.rig) if args.rig else reader.read_rig(), args.calibration), reader, notes
        return
    if not path.exists():
        raise RecordingError(f"{path}: no such recording", action="give an .mcap file or a capture folder")
    if args.rig is None:
        raise ConfigError("a capture folder does not say with which rig it was made", action="give it with --rig")
    rig = load_rig(args.rig)
    radar = _radar(args, rig)
    source, notes = open_capture(path, replace(rig, radars={radar: rig.radars[radar]}))
    try:
        yield calibrated(rig, args.calibration), source, notes
    finally:
        source.close()


def _radar(args: argparse.Namespace, rig: Rig) -> RadarId:
    if args.radar is None and len(rig.radars) > 1:
        raise ConfigError(f"rig {rig.name} has two radars", allowed=" or ".join(RADARS), action="say which: --radar")
    radar: RadarId = args.radar or next(iter(rig.radars))
    if radar not in rig.radars:
        raise ConfigError(f"rig {rig.name} has no such radar", value=radar, allowed=", ".join(rig.radars))
    return radar


def _average(
    source: FrameSource, rig: Rig, radar: RadarId, reflector: Reflector, args: argparse.Namespace, notes: list[str]
) -> CaptureMean:
    """Mean over at most ``--frames`` frames of one radar."""
    from tqdm import tqdm

    schedule = rig.radars[radar].schedule
    bin_m = schedule.profile.range_bin_m
    averager = CaptureAverager(schedule, reflector.range_m / bin_m, reflector.search_m / bin_m)
    lost = 0
    hidden = args.json or not sys.stderr.isatty()
    with tqdm(total=args.frames, unit="frame", desc="averaging", disable=hidden, leave=False) as bar:
        for item in source:
            if isinstance(item, Loss) and item.radar == radar:
                lost += item.count
            if isinstance(item, RadarFrame) and item.radar == radar:
                averager.add(item)
                bar.update()
            if averager.frames == args.frames:
                break
    if lost:
        notes.append(f"{lost} frames were lost and take no part")
    if averager.frames * schedule.loops == 1:
        notes.append("one loop of one frame: whether the reflector moved could not be checked")
    return averager.mean()


def _background(
    args: argparse.Namespace, rig: Rig, radar: RadarId, reflector: Reflector, notes: list[str]
) -> CaptureMean | None:
    if args.background is None:
        return None
    with opened(args.background, args) as (other, source, found):
        if other.radars[radar].schedule != rig.radars[radar].schedule:
            raise ConfigError(f"{args.background} was captured with another schedule than {args.capture[0]}")
        notes += [f"background: {note}" for note in found]
        return _average(source, rig, radar, reflector, args, notes)


def _pictures(
    args: argparse.Namespace, rig: Rig, radar: RadarId, made: MadeCalibration, mean: CaptureMean
) -> list[Path]:
    if args.plot is None:
        return []
    from edge.plot.calibration import calibration_picture

    subtitle = f"{args.capture[0].name}, rig {rig.name}, {radar} radar, {mean.frames} x {mean.loops} loops"
    return [calibration_picture(args.plot / "calibration.png", made, mean, rig, radar, subtitle)]


def _report(
    args: argparse.Namespace, radar: RadarId, made: MadeCalibration, notes: list[str], pictures: list[Path]
) -> None:
    calibration = made.calibration
    if args.json:
        content: dict[str, Any] = {
            "calibration": str(args.out),
            "radar": radar,
            "reference_range_m": calibration.reference_range_m,
            "temperature_c": calibration.temperature_c,
            "date": calibration.date,
            "quality": asdict(made.quality),
            "pictures": [str(picture) for picture in pictures],
            "notes": notes,
        }
        print(json.dumps(content, indent=2, allow_nan=False))
        return
    print(f"{args.out}: {radar} radar, reflector at {calibration.reference_range_m:g} m, made {calibration.date}")
    print("\n".join(quality_lines(made.quality)))
    for text in (*(f"note: {note}" for note in notes), *(f"picture: {picture}" for picture in pictures)):
        print(text)
