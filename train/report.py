# SPDX-License-Identifier: Apache-2.0
"""The report of an evaluation: Markdown for people, JSON for programs, sections of a document kept up to date."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from edge.config import require
from edge.errors import ConfigError
from train.calibration import Reliability, RiskCoverage, reliability, risk_coverage
from train.evaluate import BIKE, MACRO, PAPER, Scores, table
from train.robustness import Level, robustness_table

LIMIT_CM = 15.0
WORST = 10
_FULL = (
    ("cd_cm", "CD cm"),
    ("cd_sum_cm", "CD sum cm"),
    ("cd_squared_cm2", "CD-L2 cm²"),
    ("accuracy_cm", "accuracy cm"),
    ("completeness_cm", "completeness cm"),
    ("emd_cm", "EMD@2048 cm"),
    ("f_5cm", "F@5 cm"),
    ("f_10cm", "F@10 cm"),
    ("f_1pct", "F@1 %"),
    ("class_right", "class right"),
    ("paper_class_right", "car/bike/person right"),
)
_UNIT = (("cd_unit_cm", "CD cm, diagonal 1 m"), ("emd_unit_cm", "EMD@2048 cm, diagonal 1 m"), *_FULL)


@dataclass(slots=True)
class Part:
    """Results of one setting and one source of samples.

    Args:
        setting: "nobbox" or "bbox". source: "scans", "drive-bys" or "both". split: of the samples.
        main: the predictor the report is about; ``models``: all that are no baseline, it first.
        scores: of ``evaluate.measure``, baselines and floor included.
        emd_excess: how far the auction's EMD lies above the exact one, shares, of some samples.
        levels, clutter: of ``robustness``, where it was run.
        pictures: (caption, file).
    """

    setting: str
    source: str
    split: str
    main: str
    models: Sequence[str]
    scores: Mapping[str, Scores]
    emd_excess: Sequence[float] = ()
    levels: Sequence[Level] = ()
    clutter: Mapping[str, tuple[int, float, float]] = field(default_factory=dict)
    pictures: list[tuple[str, Path]] = field(default_factory=list)

    @property
    def head(self) -> tuple[str, str]:
        """Metrics of the first columns: metres without box, the unit frame with it."""
        return ("cd_unit_cm", "emd_unit_cm") if self.setting == "bbox" else ("cd_cm", "emd_cm")


def calibrations(scores: Scores) -> tuple[dict[str, Reliability], dict[str, RiskCoverage]]:
    """Reliability of "CD below 15 cm" and "class right", and risk-coverage of the Chamfer distance, where measured."""
    cd_cm = np.array(scores.values["cd_cm"])
    diagrams, curves = {}, {}
    if scores.measured("confidence"):
        confidence = scores.values["confidence"]
        diagrams[f"CD below {LIMIT_CM:g} cm"] = reliability(confidence, cd_cm < LIMIT_CM)
        curves["by confidence"] = risk_coverage(confidence, cd_cm)
    if scores.measured("probability"):
        diagrams["class right"] = reliability(scores.values["probability"], scores.values["class_right"])
        curves["by class probability"] = risk_coverage(scores.values["probability"], cd_cm)
    return diagrams, curves


def markdown(part: Part, command: str, folder: Path | None = None) -> str:
    """The whole report of a part.

    Args:
        part: results.
        command: that made them.
        folder: links to pictures are relative to it.
    """
    main = part.scores[part.main]
    head = main.summary(part.head[0])
    columns = _UNIT if part.setting == "bbox" else _FULL
    groups = [*main.classes, *([BIKE] if {"bicycle", "motorcycle"} & set(main.classes) else []), MACRO, PAPER]
    unit = " in the unit frame" if part.setting == "bbox" else ""
    text = [
        f"`{part.main}`, {part.setting}, {part.source}, split {part.split}: mean Chamfer distance "
        f"**{head.mean:.2f} cm**{unit} (macro over classes; bootstrap 95 % interval over objects "
        f"{head.low:.2f}–{head.high:.2f}; median sample {head.median:.2f}; {head.count} samples of "
        f"{len(set(main.objects))} objects).",
        f"```\n{command}\n```",
        table(part.scores, [(group, part.main, group) for group in groups], columns),
        "All predictors, macro mean:",
        _all(part),
        table(part.scores, [(name, name, MACRO) for name in part.scores], columns),
        "All predictors by class:",
        _by_class(part, groups),
        _notes(part),
        *_calibration(main),
        *_worst(main),
    ]
    if part.levels:
        text += ["Worsened clouds (the same cases before and after):", robustness_table(part.levels)]
    if part.clutter:
        text.append(_clutter(part.clutter))
    for caption, path in part.pictures:
        shown = os.path.relpath(path, folder) if folder else str(path)
        text.append(f"![{caption}]({Path(shown).as_posix()})\n\n{caption}")
    return "\n\n".join(text)


def _all(part: Part) -> str:
    """Intervals, medians, ratios and times."""
    first, second = part.head
    main = part.scores[part.main]
    lines = [
        f"| | CD cm | 95 % interval | median | EMD@2048 cm | {part.main} / this, CD | EMD | median ms |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, scores in part.scores.items():
        cd = scores.summary(first)
        cells = [f"{cd.mean:.2f}", f"{cd.low:.2f}–{cd.high:.2f}", f"{cd.median:.2f}"]
        with_emd = scores.measured(second) and main.measured(second)
        cells.append(f"{scores.summary(second).mean:.2f}" if with_emd else "–")
        cells.append(_ratio(main, scores, first))
        cells.append(_ratio(main, scores, second) if with_emd else "–")
        model = name in part.models and "time_ms" in scores.values
        cells.append(f"{float(np.median(scores.values['time_ms'])):.0f}" if model else "–")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _by_class(part: Part, groups: Sequence[str]) -> str:
    """Both head metrics of every predictor in every class."""
    names = dict(_UNIT)
    lines = []
    for metric in part.head:
        chosen = {name: scores for name, scores in part.scores.items() if scores.measured(metric)}
        if not chosen:
            continue
        lines += ["", f"| {names[metric]} | " + " | ".join(groups) + " |", "|---" * (len(groups) + 1) + "|"]
        for name, scores in chosen.items():
            cells = [f"{scores.summary(metric, g).mean:.2f}" if scores.measured(metric, g) else "–" for g in groups]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines[1:])


def _ratio(main: Scores, other: Scores, metric: str) -> str:
    below = other.summary(metric).mean
    return f"{main.summary(metric).mean / below:.2f}" if below > 0 else "–"


def _notes(part: Part) -> str:
    lines = [
        "CD: mean of both directions, unsquared, at true scale (sum: of both; CD-L2: sum of the mean squares). "
        "EMD: best assignment of 2048 points of each cloud. F: harmonic mean of precision and recall. A perfect answer "
        "scores the floor: two samplings of one surface differ. The class mean is told the true class, the posed "
        "oracle the truth: it takes the training shape nearest to it, with the true place and heading. Retrieval sees "
        "what the networks see."
    ]
    if part.emd_excess:
        lines.append(
            f"The auction's EMD lies {100 * float(np.mean(part.emd_excess)):.2f} % above scipy's exact one (mean of "
            f"{len(part.emd_excess)} samples, worst {100 * max(part.emd_excess):.2f} %)."
        )
    return "\n".join(lines)


def _calibration(scores: Scores) -> list[str]:
    diagrams, curves = calibrations(scores)
    if not diagrams:
        return []
    lines = ["| promise | mean promised | kept | expected calibration error | Brier |", "|---|---|---|---|---|"]
    for name, one in diagrams.items():
        share = one.count / one.count.sum()
        lines.append(
            f"| {name} | {float(share @ one.promised):.2f} | {float(share @ one.kept):.2f} | {one.error:.3f} | "
            f"{one.brier:.3f} |"
        )
    risks = ["| kept, most trusted first | 50 % | 80 % | 90 % | 100 % | area | best order |", "|---" * 7 + "|"]
    for name, curve in curves.items():
        cells = [*(curve.at(share) for share in (0.5, 0.8, 0.9, 1.0)), curve.area, curve.best]
        risks.append(f"| CD cm {name} | " + " | ".join(f"{value:.1f}" for value in cells) + " |")
    named = ""
    if scores.measured("named"):
        named = f"A class is named for {np.mean(scores.values['named']):.0%} of the samples"
    if named and scores.measured("class_right"):
        chosen = [r for r, n in zip(scores.values["class_right"], scores.values["named"], strict=True) if n]
        named += f"; {float(np.mean(chosen)):.1%} of these are right." if chosen else "."
    return ["Calibration:", "\n".join(lines), "\n".join(risks), *([named] if named else [])]


def _worst(scores: Scores) -> list[str]:
    rows = scores.worst(WORST)
    lines = ["| worst | CD cm | completeness cm | confidence |", "|---|---|---|---|"]
    for row in rows:
        confidence = scores.values["confidence"][row] if scores.measured("confidence") else float("nan")
        lines.append(
            f"| {scores.objects[row]} | {scores.values['cd_cm'][row]:.1f} | "
            f"{scores.values['completeness_cm'][row]:.1f} | {confidence:.2f} |"
        )
    return ["\n".join(lines)]


def _clutter(found: Mapping[str, tuple[int, float, float]]) -> str:
    lines = ["| clutter | clouds | unknown | mean confidence |", "|---|---|---|---|"]
    lines += [f"| {kind} | {n} | {1 - named:.0%} | {trust:.2f} |" for kind, (n, named, trust) in found.items()]
    total = sum(n for n, _, _ in found.values())
    unknown = sum(n * (1 - named) for n, named, _ in found.values()) / total
    return "\n".join([*lines, f"| all | {total} | {unknown:.0%} | |"])


def plain(part: Part, command: str) -> dict[str, Any]:
    """The same for JSON: summaries by predictor, metric and class, and every sample's figures."""
    summaries = {
        name: {
            metric: {
                group: asdict(scores.summary(metric, group))
                for group in [*scores.classes, BIKE, MACRO, PAPER]
                if scores.measured(metric, group)
            }
            for metric in scores.values
        }
        for name, scores in part.scores.items()
    }
    diagrams, curves = calibrations(part.scores[part.main])
    return {
        "command": command,
        "setting": part.setting,
        "source": part.source,
        "split": part.split,
        "main": part.main,
        "summaries": summaries,
        "samples": {name: asdict(scores) for name, scores in part.scores.items()},
        "calibration": {
            name: {"error": one.error, "brier": one.brier, "promised": one.promised.tolist(), "kept": one.kept.tolist()}
            for name, one in diagrams.items()
        },
        "risk_coverage": {name: {"area": one.area, "best": one.best} for name, one in curves.items()},
        "robustness": [asdict(level) for level in part.levels],
        "clutter": {kind: list(figures) for kind, figures in part.clutter.items()},
        "emd_excess": list(part.emd_excess),
    }


def update_section(path: Path, name: str, text: str) -> None:
    """Replace what stands between ``<!-- begin name -->`` and ``<!-- end name -->``, or add it at the end.

    Args:
        path: document; made when absent. name: letters, digits, ``-``, ``_`` and ``.``. text: the new content.
    Raises:
        ConfigError: a name of another form, or a document in which the section begins but does not end once.
    """
    require(bool(re.fullmatch(r"[\w.-]+", name)), "section", name, "letters, digits, - _ .")
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    old = path.read_text(encoding="utf-8") if path.is_file() else "<!-- SPDX-License-Identifier: Apache-2.0 -->\n"
    counts = old.count(begin), old.count(end)
    block = f"{begin}\n{text.strip()}\n{end}"
    if counts == (0, 0):
        new = old.rstrip() + f"\n\n{block}\n"
    elif counts == (1, 1) and old.index(begin) < old.index(end):
        new = old[: old.index(begin)] + block + old[old.index(end) + len(end) :]
    else:
        raise ConfigError(f"{path}: section {name} is damaged", value=counts, allowed="one begin and one end marker")
    path.write_text(new, encoding="utf-8")
