# SPDX-License-Identifier: Apache-2.0
"""Figures of simulated clouds for each class, and what the stages of a drive-by cost, as tables."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from train.objects.mesh import CLASSES, ClassName
from train.objects.reference import ObjectRef, library_refs
from train.simulate.cloud import DriveSpec, SimulatedCloud, Windows, make_drive, observe, run
from train.simulate.randomise import Ranges
from train.simulate.settings import SimulationSettings

PARAMETRIC_SHARE = 3
"""Every third object is parametric where there is a library."""
FIRST_SEED = 1000
HEAD = (
    "| class | drive-bys | whole, split, merged, missing | points | points a frame | frames without | within 10 cm "
    "| within 20 cm | coverage | spacing | CPU |\n|---|---|---|---|---|---|---|---|---|---|---|"
)


@dataclass(frozen=True, slots=True)
class Measured:
    """One drive-by.

    Args:
        cloud: what came of it.
        cpu_s: processor time of this thread, scene and statistics included.
        stages_ms: stage -> median wall-clock milliseconds of one call.
    """

    cloud: SimulatedCloud
    cpu_s: float
    stages_ms: dict[str, float]


def measure_drive(spec: DriveSpec) -> Measured:
    """Simulate a drive-by and take its time."""
    begin_s = time.thread_time()
    mesh = spec.object.mesh()
    drive, windows = make_drive(spec, mesh), Windows()
    pipeline = run(drive, [windows])
    cloud = observe(spec, mesh, drive, windows.results)
    cpu_s = time.thread_time() - begin_s
    summaries = {**drive.times.summary(), **pipeline.times.summary()}
    return Measured(cloud, cpu_s, {stage: summary.p50_us / 1e3 for stage, summary in summaries.items()})


def report_objects(name: ClassName, count: int) -> list[ObjectRef]:
    """Objects of a class: training objects of the library and parametric ones, without a library only these."""
    library = [ref for ref in library_refs() if ref.class_name == name and ref.split == "train"]
    made = count // PARAMETRIC_SHARE if library else count
    chosen = np.random.default_rng(CLASSES.index(name)).permutation(len(library))[: count - made]
    return [library[k] for k in chosen] + [ObjectRef(name, f"parametric_{3 * k:05d}") for k in range(made)]


def report(
    count: int,
    ranges: Ranges,
    rig: str,
    every: int,
    settings: SimulationSettings | None = None,
    say: Callable[[str], None] = print,
) -> list[Measured]:
    """Drive past ``count`` objects of every class and print medians of their figures and of the stages' times.

    The first drive-by of all is done twice, so that tables, compilation and the pool of neighbours count nowhere.
    """
    say(HEAD)
    every_one: list[Measured] = []
    for name in CLASSES:
        objects = report_objects(name, count)
        specs = [DriveSpec(ref, FIRST_SEED + k, ranges, rig, every, settings) for k, ref in enumerate(objects)]
        if not every_one:
            measure_drive(specs[0])
        measured = [measure_drive(spec) for spec in specs]
        say(_row(name, measured))
        every_one += measured
    say("")
    say(stage_table(every_one))
    return every_one


def _row(name: ClassName, measured: Sequence[Measured]) -> str:
    status = Counter(one.cloud.status for one in measured)
    seen = [one.cloud.statistics for one in measured if one.cloud.status != "missing"]

    def median(key: str) -> float:
        return float(np.median([getattr(figures, key) for figures in seen])) if seen else 0.0

    shares = [f"{100 * median(key):.0f} %" for key in ("empty_share", "within_10cm", "within_20cm", "coverage")]
    counts = ", ".join(str(status[kind]) for kind in ("whole", "split", "merged", "missing"))
    spread = [figures.points_per_frame for figures in seen] or [0.0]
    cells = [
        *(name, str(len(measured)), counts, f"{median('points'):.0f}"),
        f"{min(spread):.1f}..{max(spread):.1f}, median {median('points_per_frame'):.1f}",
        *shares,
        f"{100 * median('spacing_m'):.1f} cm",
        f"{np.median([one.cpu_s for one in measured]):.2f} s",
    ]
    return f"| {' | '.join(cells)} |"


def stage_table(measured: Sequence[Measured]) -> str:
    """Median time of one call of every stage over all drive-bys."""
    stages = list(dict.fromkeys(stage for one in measured for stage in one.stages_ms))
    rows = [
        f"| {stage} | {np.median([one.stages_ms[stage] for one in measured if stage in one.stages_ms]):.2f} ms |"
        for stage in stages
    ]
    return "\n".join(["| stage | one call, wall clock |", "|---|---|", *rows])
