# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train bench``: how fast and how exact the simulator is, beside HawkEye's method."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from edge.errors import ConfigError, ExitCode

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Read by NumPy's libraries when they are loaded."""


def add_verb(verbs: Any) -> None:
    """Add the verb to ``rfconstruct-train``'s parser."""
    verb = verbs.add_parser("bench", help="speed and error of the simulator, beside HawkEye's method")
    verb.add_argument("--rig", default="cascade_pair", help="rig with two cascades (default: %(default)s)")
    verb.add_argument("--seconds", type=float, default=10.0, help="time to spend measuring (default: %(default)s)")
    verb.add_argument("--json", action="store_true", help="print all figures as JSON")
    verb.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there, too")
    verb.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Measure and print tables, or JSON."""
    for variable in ONE_THREAD:
        os.environ.setdefault(variable, "1")
    from edge.frames import RADARS
    from edge.rig import load_rig
    from train.simulate.bench import run_suite
    from train.simulate.bench_drive import drive_cases, drive_report
    from train.simulate.bench_report import document, lines

    if not options.seconds > 0:
        raise ConfigError("--seconds cannot work", value=options.seconds, allowed="above 0")
    rig = load_rig(options.rig)
    kinds = {rig.radars[radar].schedule.layout.kind for radar in RADARS if radar in rig.radars}
    if len(rig.radars) != len(RADARS) or kinds != {"cascade"}:
        raise ConfigError(f"rig {rig.name} cannot be benched", allowed="two cascades", action="--rig cascade_pair")
    result = run_suite(rig, options.seconds, (drive_cases,)) | {"drive": drive_report(rig)}
    print(json.dumps(result, indent=2) if options.json else "\n".join(lines(result)))
    if options.markdown is not None:
        command = f"rfconstruct-train bench --rig {rig.name} --seconds {options.seconds:g}"
        text = document(result, f"{command} --markdown {options.markdown}")
        options.markdown.write_text(text, encoding="utf-8")
    return int(ExitCode.OK)
