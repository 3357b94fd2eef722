# SPDX-License-Identifier: Apache-2.0
"""How a network takes worse clouds than it was asked for, and clutter: error and confidence, level by level."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from edge.completion.model import UNKNOWN
from train.degrade import CLUTTER, DEGRADATIONS, Degradation, clutter_cases
from train.held_out import Case
from train.metrics import shape_metrics
from train.predictors import Answer, Predictor


@dataclass(frozen=True, slots=True)
class Level:
    """One line of the table.

    Args:
        name, unit, level: of the degradation.
        cases: to which it applies; 0: none has the frames or points for it, and the figures are NaN.
        untouched_cm, cd_cm: mean Chamfer distance of these cases before and after.
        untouched_confidence, confidence: the same of the confidence; NaN where the predictor gives none.
        named: share whose class is not "unknown".
    """

    name: str
    unit: str
    level: float
    cases: int
    untouched_cm: float
    cd_cm: float
    untouched_confidence: float
    confidence: float
    named: float


def robustness(predictor: Predictor, cases: Sequence[Case], seed: int = 0, threads: int = 1) -> list[Level]:
    """Every degradation at every level on the same cases.

    Args:
        predictor: with confidence, if it has one.
        cases: some held-out samples; each is asked some forty times.
        seed: of chance; a case meets the same draws at every level.
        threads: cases at once.
    """
    known = [cases[position] for position in range(len(cases))]

    def ask(case: Case) -> tuple[float, float, float]:
        answer = predictor(case)
        confidence = np.nan if answer.confidence is None else answer.confidence
        cd_cm = shape_metrics(answer.fine_m, case.sample.truth, with_emd=False)["cd_cm"]
        return cd_cm, confidence, float(answer.class_name not in ("", UNKNOWN))

    with ThreadPoolExecutor(threads) as pool:
        before = list(pool.map(ask, known))
        lines = []
        for degradation in DEGRADATIONS:
            for level in degradation.levels:
                changed = [_changed(degradation, level, case, known, seed) for case in known]
                rows = [row for row, case in enumerate(changed) if case is not None]
                after = list(pool.map(ask, [case for case in changed if case is not None]))
                lines.append(_line(degradation, level, [before[row] for row in rows], after))
    return lines


def _changed(degradation: Degradation, level: float, case: Case, known: Sequence[Case], seed: int) -> Case | None:
    return degradation.change(case, level, np.random.default_rng([seed, case.number]), known)


def _line(
    degradation: Degradation,
    level: float,
    before: Sequence[tuple[float, float, float]],
    after: Sequence[tuple[float, float, float]],
) -> Level:
    if not after:
        return Level(degradation.name, degradation.unit, level, 0, *[float("nan")] * 5)
    untouched, changed = np.array(before).mean(axis=0), np.array(after).mean(axis=0)
    figures = (float(v) for v in (untouched[0], changed[0], untouched[1], changed[1], changed[2]))
    return Level(degradation.name, degradation.unit, level, len(after), *figures)


def clutter_named(
    predictor: Predictor, cases: Sequence[Case], count: int = 100, seed: int = 1
) -> Mapping[str, tuple[int, float, float]]:
    """Kind of clutter -> clouds, share that gets a class, mean confidence; ``seed`` not that of the fit."""
    models = [cases[position] for position in range(min(len(cases), 8))]
    answers: dict[str, list[Answer]] = {}
    for number, case in enumerate(clutter_cases(models, count, seed)):
        answers.setdefault(CLUTTER[number % len(CLUTTER)], []).append(predictor(case))
    return {
        kind: (
            len(found),
            float(np.mean([answer.class_name not in ("", UNKNOWN) for answer in found])),
            float(np.mean([np.nan if a.confidence is None else a.confidence for a in found])),
        )
        for kind, found in answers.items()
    }


def robustness_table(levels: Sequence[Level]) -> str:
    """The lines as Markdown."""
    lines = [
        "| what | level | cases | CD cm before → after | confidence before → after | class named |",
        "|---|---|---|---|---|---|",
    ]
    for one in levels:
        level = f"{one.level:.0%}" if one.unit == "share" else f"{one.level:g} {one.unit}"
        if not one.cases:
            lines.append(f"| {one.name} | {level} | 0 | – | – | – |")
            continue
        lines.append(
            f"| {one.name} | {level} | {one.cases} | {one.untouched_cm:.1f} → {one.cd_cm:.1f} | "
            f"{one.untouched_confidence:.2f} → {one.confidence:.2f} | {one.named:.0%} |"
        )
    return "\n".join(lines)
