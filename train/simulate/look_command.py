# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train montage`` and ``clouds``: pictures and figures of simulated drive-bys."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.errors import ExitCode
from train.output import add_json, emit

if TYPE_CHECKING:
    from train.simulate.cloud import SimulatedCloud


def add_verbs(verbs: Any) -> None:
    """Add the verbs to ``rfconstruct-train``'s parser."""
    montage = verbs.add_parser("montage", help="one picture of a simulated drive-by for every class")
    montage.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the PNG files")
    montage.add_argument("--object", action="append", default=[], help="car/parametric_00000 or the like; repeatable")
    montage.add_argument("--seed", type=int, default=0, help="of the drive-bys")
    montage.set_defaults(run=_montage)
    clouds = verbs.add_parser("clouds", help="figures of simulated clouds and times of the stages, for every class")
    clouds.add_argument("--objects", type=int, default=6, help="drive-bys of every class")
    clouds.add_argument("--without-ground", action="store_true", help="no ground paths and no ground clutter")
    clouds.set_defaults(run=_clouds)
    for verb in (montage, clouds):
        verb.add_argument("--rig", default="cascade_demo", help="name or folder of a rig with two radars")
        verb.add_argument("--every", type=int, default=3, help="only each n-th frame")
        verb.add_argument("--settings", type=Path, metavar="TOML", help="settings, instead of drawn ones")
        add_json(verb)


def _montage(options: argparse.Namespace) -> int:
    from train.simulate.montage import write_montages
    from train.simulate.settings import read_settings

    settings = read_settings(options.settings) if options.settings else None
    all_made = []
    for made in write_montages(options.out, options.object, options.seed, options.rig, options.every, settings):
        figures = made.statistics
        all_made.append(_as_dict(made))
        if options.json:
            continue
        print(
            f"{made.spec.object}: {made.status}, {figures.points} points in {made.frames} frames, "
            f"{100 * figures.within_10cm:.0f} % within 10 cm, {100 * figures.within_20cm:.0f} % within 20 cm of the "
            f"surface, {100 * figures.coverage:.0f} % of the visible surface covered"
        )
    emit(options, {"drive_bys": all_made}, ())
    return int(ExitCode.OK)


def _clouds(options: argparse.Namespace) -> int:
    from train.simulate.cloud_report import report
    from train.simulate.randomise import Ranges
    from train.simulate.settings import read_settings

    ranges = Ranges(ground_share=0.0) if options.without_ground else Ranges()
    settings = read_settings(options.settings) if options.settings else None
    say: Callable[[str], None] = (lambda _: None) if options.json else print
    found = report(options.objects, ranges, options.rig, options.every, settings, say)
    drives = [_as_dict(one.cloud) | {"cpu_s": one.cpu_s, "stages_ms": one.stages_ms} for one in found]
    emit(options, {"drive_bys": drives}, ())
    return int(ExitCode.OK)


def _as_dict(made: SimulatedCloud) -> dict[str, Any]:
    """A drive-by's figures, without its points."""
    facts = {"object": made.spec.object.to_text(), "seed": made.spec.seed, "status": str(made.status)}
    return {**facts, "window_frames": made.frames, "travel_m": made.travel_m, **asdict(made.statistics)}
