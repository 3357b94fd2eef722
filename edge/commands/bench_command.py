# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct bench``: stages and the whole two-radar frame beside their peers in the same process."""

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
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there, too")


def run(args: argparse.Namespace) -> int:
    """Measure and print tables, or JSON."""
    for variable in ONE_THREAD:
        os.environ.setdefault(variable, "1")
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
