# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct bench``: stages and the whole frame beside their peers in one process; ``--soak``: endurance."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from edge.commands.arguments import seconds
from edge.errors import ConfigError, ExitCode

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")
"""Read by the peers' libraries when they are loaded."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("--rig", default="cascade_demo", help="rig with two cascades (default: %(default)s)")
    parser.add_argument("--seconds", type=seconds, default=20.0, help="time to spend measuring (default: %(default)s)")
    parser.add_argument("--cold", action="store_true", help="also measure a start that compiles all kernels (20 s)")
    parser.add_argument(
        "--soak", type=seconds, metavar="S", help="instead: so long through the live pipeline, in real time"
    )
    parser.add_argument("--recording", type=Path, metavar="FILE", help="drive to play with --soak (default: simulated)")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there, too")


def run(args: argparse.Namespace) -> int:
    """Measure and print tables, or JSON."""
    for variable in ONE_THREAD:
        os.environ.setdefault(variable, "1")
    if args.soak is not None:
        return _soak(args)
    from edge.bench.report import document, lines
    from edge.bench.suite import run_suite
    from edge.frames import RADARS
    from edge.rig import load_rig

    rig = load_rig(args.rig)
    kinds = {rig.radars[radar].schedule.layout.kind for radar in RADARS if radar in rig.radars}
    if len(rig.radars) != len(RADARS) or kinds != {"cascade"}:
        raise ConfigError(
            f"rig {rig.name} cannot be benched", allowed="two cascade radars", action="--rig cascade_pair"
        )
    result = run_suite(rig, args.seconds, args.cold)
    print(json.dumps(result, indent=2) if args.json else "\n".join(lines(result)))
    if args.markdown is not None:
        cold = " --cold" if args.cold else ""
        command = f"rfconstruct bench --rig {rig.name} --seconds {args.seconds:g}{cold} --markdown {args.markdown}"
        args.markdown.write_text(document(result, command), encoding="utf-8")
    return ExitCode.OK


def _soak(args: argparse.Namespace) -> int:
    """A drive again and again; exit code 3 when a figure is beyond its limit."""
    from edge.bench.soak import lines, missed, soak
    from edge.bench.soak_drive import soak_recording
    from edge.commands.interrupts import Interrupts
    from edge.commands.session import load_model
    from edge.recording.reader import RecordingReader
    from edge.rig import load_rig

    if args.recording is not None:
        path = args.recording
        with RecordingReader(path) as reader:
            rig = reader.read_rig()
    else:
        rig = load_rig(args.rig)
        path = soak_recording(rig)
    model, notes = load_model(rig)
    interrupts = Interrupts()
    with interrupts:
        result = soak(rig, path, args.soak, model, "; ".join(notes), interrupts.asked)
    print(json.dumps(result, indent=2) if args.json else "\n".join(lines(result)))
    if interrupts.asked():
        return interrupts.exit_code
    return ExitCode.DEGRADED if missed(result) else ExitCode.OK
