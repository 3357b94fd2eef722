# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct calibrate --align``: recordings of a reflector at several places to the two boards' mounting."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict

from edge.calibration import Calibration
from edge.calibration_temperature import temperature_notes
from edge.commands.open_source import calibrated
from edge.errors import ConfigError, ExitCode, RecordingError
from edge.frames import RADARS, RadarId
from edge.recording.reader import RecordingReader
from edge.reflector_stops import StopFinder, read_survey
from edge.rig import Rig, load_rig
from edge.rig_alignment import Alignment, align


def run(args: argparse.Namespace) -> int:
    """Find the stops, estimate, write the tables for ``rig.toml``."""
    survey = read_survey(args.positions) if args.positions is not None else []
    finder: StopFinder | None = None
    rig: Rig | None = None
    for path in args.capture:
        if not path.is_file():
            raise RecordingError(f"{path}: no such recording", action="--align takes .mcap files of both radars")
        with RecordingReader(path) as reader:
            if rig is None or finder is None:
                rig = calibrated(load_rig(args.rig) if args.rig else reader.read_rig(), args.calibration)
                _require_two(rig)
                finder = StopFinder(rig, survey)
            if not args.json:
                print(f"{path}: looking for stops", file=sys.stderr)
            finder.feed(reader)
    assert rig is not None
    assert finder is not None
    found = align(rig, finder.result())
    args.out.write_text(found.toml(), encoding="utf-8")
    calibrations: dict[str, Calibration] = {radar: rig.radars[radar].calibration for radar in RADARS}
    notes = temperature_notes(calibrations, args.temperature)
    notes += [f"{radar}: not calibrated" for radar, used in calibrations.items() if used.made_with is None]
    notes += _outlying(found)
    _report(args, found, finder, notes)
    return ExitCode.OK


def _require_two(rig: Rig) -> None:
    missing: list[RadarId] = [radar for radar in RADARS if radar not in rig.radars]
    if missing:
        raise ConfigError(f"rig {rig.name} has no {missing[0]} radar", action="--align needs a rig of two radars")


def _outlying(found: Alignment) -> list[str]:
    if found.residual_rms <= 2.0:
        return []
    text = f"the measurements fit {found.residual_rms:.1f} times worse than their errors: standard errors are widened"
    return [f"{text}; look for a stop on another echo"]


def _report(args: argparse.Namespace, found: Alignment, finder: StopFinder, notes: list[str]) -> None:
    if args.json:
        content = {
            "mounting": str(args.out),
            "stops": [asdict(stop.horizontal) | {"frames": stop.frames} for stop in finder.stops],
            "corrections": {e.name: {"value": e.value, "sigma": e.sigma} for e in found.estimates},
            "held": list(found.held),
            "power_offset_db": {"value": found.power_offset_db, "sigma": found.power_sigma_db},
            "residual_rms": found.residual_rms,
            "notes": notes,
        }
        print(json.dumps(content, indent=2, allow_nan=False))
        return
    print(f"{args.out}: {found.stops} stops, {finder.pairs} frame pairs, {finder.unclear} without a clear echo")
    for estimate in found.estimates:
        scale, unit = (1e3, "mm") if estimate.name.endswith("_m") else (57.29578, "deg")
        name = estimate.name.rpartition("_")[0].replace("_", " ")
        print(f"  {name:<28}{scale * estimate.value:+8.2f} +- {scale * estimate.sigma:.2f} {unit}")
    print(f"  {'vertical power offset':<28}{found.power_offset_db:+8.2f} +- {found.power_sigma_db:.2f} dB")
    print(f"  held at the rig's value: {', '.join(found.held) or 'nothing'}")
    for note in notes:
        print(f"note: {note}")
    print(found.toml(), end="")
