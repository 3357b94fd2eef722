# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct-train simulate``: build, go on with, check or pack a data set of simulated clouds."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from edge.errors import ExitCode
from train.output import add_json, emit

if TYPE_CHECKING:
    from train.simulate.pool import Pool
    from train.simulate.work import Plan

INTERRUPTED = 130
"""Exit code after Ctrl-C or SIGTERM, as shells have it."""
_SIZES = ("objects", "drive_bys", "perturbed")


def add_verb(verbs: Any) -> None:
    """Add the verb to ``rfconstruct-train``'s parser."""
    verb = verbs.add_parser(
        "simulate",
        help="make a data set: objects driven past by simulated radars, and perturbed scans of them",
        description="Make a data set, or go on with one: what a folder holds already is kept. "
        "With --out alone a folder is finished by the recipe it was begun with.",
    )
    verb.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the data set")
    verb.add_argument("--recipe", help="name of a recipe, or a .toml file (default: reference)")
    verb.add_argument("--objects", type=int, help="how many objects, instead of the recipe's number")
    verb.add_argument("--drive-bys", type=int, help="simulated clouds of every object")
    verb.add_argument("--perturbed", type=int, help="perturbed scans of every object")
    verb.add_argument("--seed", type=int, help="of everything that is drawn (default 0)")
    verb.add_argument("--workers", type=int, default=0, help="processes, one thread each (default: every core)")
    verb.add_argument("--address", help="work on this Ray cluster instead: auto, host:6379, or local for one here")
    only = verb.add_mutually_exclusive_group()
    only.add_argument("--check", action="store_true", help="only read the folder, compare with its plan, show figures")
    only.add_argument("--clouds-only", type=Path, metavar="FILE", help="only pack the folder's radar clouds into FILE")
    add_json(verb)
    verb.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """The verb; returns the exit code."""
    if options.check:
        return _check(options)
    if options.clouds_only:
        return _pack(options, options.clouds_only)
    return _build(options)


def _check(options: argparse.Namespace) -> int:
    from train.simulate.check import check, show

    report = check(options.out)
    if options.json:
        faults = {"faults": report.faults, "failed": [cloud.error for cloud in report.failed]}
        emit(options, {"folder": str(options.out), "good": report.good, "clouds": len(report.clouds), **faults}, ())
    else:
        show(report, sys.stdout)
    return int(ExitCode.OK if report.good else ExitCode.FAILURE)


def _pack(options: argparse.Namespace, file: Path) -> int:
    from train.simulate.build import export_clouds

    count, size = export_clouds(options.out, file), file.stat().st_size
    emit(
        options,
        {"file": str(file), "clouds": count, "bytes": size},
        [f"{file}: {count} clouds, {size / 1e6:.2f} MB"],
    )
    return int(ExitCode.OK)


def _build(options: argparse.Namespace) -> int:
    from train.simulate.build import build
    from train.simulate.progress import Progress
    from train.simulate.work import class_counts

    plan = _plan(options)
    counts = ", ".join(f"{count} {name}" for name, count in class_counts(plan).items())
    if not options.json:
        print(f"{len(plan.objects)} objects ({counts}), {plan.per_object} clouds each, seed {plan.seed}", flush=True)
    with _pool(options) as pool:
        try:
            with _stoppable():
                built = build(plan, options.out, pool, progress=Progress(sys.stderr))
        except KeyboardInterrupt:
            print(f"stopped; to go on: rfconstruct-train simulate --out {options.out}", file=sys.stderr)
            return INTERRUPTED
    kept = f", {built.kept} shards were there" if built.kept else ""
    remade = f", {built.damaged} damaged ones were remade" if built.damaged else ""
    text = f"{built.clouds} clouds, {built.failed} failed{kept}{remade}: {options.out}"
    emit(options, {"folder": str(options.out), "objects": len(plan.objects), **asdict(built)}, [text])
    return int(ExitCode.DEGRADED if built.failed else ExitCode.OK)


def _plan(options: argparse.Namespace) -> Plan:
    """The plan that the options name; without any, that of the folder."""
    from train.simulate.build import INDEX, read_plan
    from train.simulate.recipe import load_recipe
    from train.simulate.work import Plan

    sizes = {name: getattr(options, name) for name in _SIZES}
    said = options.recipe is not None or options.seed is not None or any(v is not None for v in sizes.values())
    if not said and (options.out / INDEX).is_file():
        there = read_plan(options.out)
        return Plan.make(there.recipe, there.seed)
    return Plan.make(load_recipe(options.recipe or "reference").resized(**sizes), options.seed or 0)


@contextmanager
def _pool(options: argparse.Namespace) -> Iterator[Pool]:
    """Where the work is done."""
    if not options.address:
        from train.simulate.pool import LocalPool

        yield LocalPool(options.workers)
        return
    from train.simulate.on_ray import RayPool

    cluster = RayPool(options.address, options.workers or None)
    try:
        yield cluster
    finally:
        cluster.close()


@contextmanager
def _stoppable() -> Iterator[None]:
    """SIGTERM ends the run as Ctrl-C does: the workers first, then the index."""

    def stop(_: int, __: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
