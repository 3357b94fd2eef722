# SPDX-License-Identifier: Apache-2.0
"""Evaluation of predictors, baselines and the floor on held-out objects: one list of figures for each."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from edge.completion.model import UNKNOWN
from edge.completion.network import Network
from edge.errors import ModelError
from edge.frames import Float32
from train.baselines import FLOOR, Bank, floor
from train.batches import collate
from train.dataset import CLASSES, CompletionDataset, Sample
from train.held_out import Case, HeldOut, spread
from train.metrics import Summary, shape_metrics, summarize
from train.network import Frame
from train.predictors import Answer, Predictor, box_unit

__all__ = [
    "BIKE",
    "FLOOR",
    "MACRO",
    "PAPER",
    "OnnxModel",
    "Scores",
    "evaluate",
    "int8_is_faster",
    "int8_is_good",
    "measure",
    "spread",
]

MACRO = "macro"
BIKE = "bike"
"""Bicycles and motorcycles as one class, as in the paper's tables."""
PAPER = "macro of car, bike, pedestrian"
_BIKES = {CLASSES.index("bicycle"), CLASSES.index("motorcycle")}


class OnnxModel:
    """An exported model in ONNX Runtime, one thread.

    Args:
        path: .onnx file.
        frame: of its input; "box": clouds are divided by the object's diagonal.
    Raises:
        ModelError: absent or not loadable.
    """

    def __init__(self, path: Path, frame: Frame = "sight") -> None:
        self.frame = frame
        try:
            self.network = Network(path.read_bytes(), path.name)
        except OSError as error:
            raise ModelError(f"{path.name}: no loadable model ({error})", action="export again") from error

    def __call__(self, points_m: Float32) -> tuple[Float32, Float32, Float32]:
        """Fine [fine, 3] and coarse [coarse, 3] points in metres and class probabilities of one cloud [n, 3]."""
        answer = self.network.run(points_m)
        return answer.fine_m, answer.coarse_m, answer.probability

    @property
    def columns(self) -> int:
        """Of an input point."""
        return self.network.signature["points"][1][1] or 3

    @property
    def has_classes(self) -> bool:
        """Whether the graph has a classifier."""
        return "class_probability" in self.network.signature

    def of(self, sample: Sample) -> Answer:
        """The answer to a sample, metres."""
        points = collate([sample], self.frame, self.columns).points_m.numpy()
        fine, coarse, probability = self(points)
        if self.frame == "box":
            unit_m, origin_m = box_unit(sample)
            fine, coarse = fine * unit_m + origin_m, coarse * unit_m + origin_m
        return Answer(fine, coarse, probability if self.has_classes else None)


@dataclass(slots=True)
class Scores:
    """Figures of one predictor, one entry a sample.

    Args:
        values: metric name -> values; NaN where a sample has none.
        objects, labels: of each sample.
    """

    values: dict[str, list[float]] = field(default_factory=dict)
    objects: list[str] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)

    def add(self, sample: Sample, metrics: dict[str, float]) -> None:
        """One more sample."""
        for name, value in metrics.items():
            self.values.setdefault(name, []).append(value)
        self.objects.append(sample.object_id)
        self.labels.append(sample.label)

    def _rows(self, class_name: str) -> tuple[list[int], list[int]]:
        """Samples that belong to a class or mean, and the classes that are averaged."""
        labels = [min(_BIKES) if class_name in (BIKE, PAPER) and n in _BIKES else n for n in self.labels]
        if class_name in (MACRO, PAPER):
            return list(range(len(labels))), labels
        wanted = min(_BIKES) if class_name == BIKE else CLASSES.index(class_name)
        return [row for row, label in enumerate(labels) if label == wanted], labels

    def measured(self, metric: str, class_name: str = MACRO) -> bool:
        """Whether the figure exists for the class."""
        values = self.values.get(metric)
        return values is not None and any(np.isfinite(values[row]) for row in self._rows(class_name)[0])

    def summary(self, metric: str, class_name: str = MACRO) -> Summary:
        """A figure of one class, of ``BIKE``, or of a mean over classes; ConfigError when nothing was measured."""
        rows, labels = self._rows(class_name)
        values = self.values[metric]
        return summarize([values[r] for r in rows], [self.objects[r] for r in rows], [labels[r] for r in rows])

    @property
    def classes(self) -> list[str]:
        """Classes that occur, in order."""
        return [name for label, name in enumerate(CLASSES) if label in self.labels]

    def worst(self, count: int = 10, metric: str = "cd_cm") -> list[int]:
        """Samples with the largest figure, the worst first."""
        values = np.array(self.values[metric])
        order = np.argsort(-np.where(np.isfinite(values), values, -np.inf), kind="stable")
        return [int(row) for row in order[:count]]


def figures(case: Case, answer: Answer, with_emd: bool) -> dict[str, float]:
    """All figures of one answer.

    Returns:
        Those of ``shape_metrics``, and with class probabilities ``class_right`` (0 or 1), ``paper_class_right`` (same,
        with bicycle and motorcycle as one class), ``probability`` (of the most probable class); with a confidence
        ``confidence`` and ``named`` (1: not "unknown").
    """
    sample = case.sample
    result = shape_metrics(answer.fine_m, sample.truth, case.number, with_emd, case.diagonal_m)
    if answer.probability is not None:
        best = int(np.argmax(answer.probability))
        same = best == sample.label or {best, sample.label} <= _BIKES
        result |= {"class_right": float(best == sample.label), "paper_class_right": float(same)}
        result |= {"probability": float(answer.probability[best])}
    if answer.confidence is not None:
        result |= {"confidence": answer.confidence, "named": float(answer.class_name != UNKNOWN)}
    return result


def measure(
    predictors: Mapping[str, Predictor], cases: Sequence[Case], emd_cases: int = 0, threads: int = 1
) -> dict[str, Scores]:
    """Ask every predictor every case.

    Args:
        predictors: name -> predictor.
        cases: held-out samples.
        emd_cases: of these, evenly spread, how many also get EMD.
        threads: cases at once.
    Returns:
        Name -> scores: ``figures`` and ``time_ms``.
    """
    with_emd = set(spread(len(cases), emd_cases)) if emd_cases else set()
    scores = {name: Scores() for name in predictors}

    def one(position: int) -> tuple[Sample, dict[str, dict[str, float]]]:
        case = cases[position]
        results = {}
        for name, predictor in predictors.items():
            start = time.perf_counter()
            answer = predictor(case)
            seconds = time.perf_counter() - start if answer.seconds is None else answer.seconds
            results[name] = figures(case, answer, position in with_emd) | {"time_ms": 1e3 * seconds}
        return case.sample, results

    with ThreadPoolExecutor(threads) as pool:
        for sample, results in pool.map(one, range(len(cases))):
            for name, metrics in results.items():
                scores[name].add(sample, metrics)
    return scores


def evaluate(
    models: dict[str, OnnxModel],
    dataset: CompletionDataset,
    samples: int,
    emd_samples: int,
    bank: Bank | None = None,
    threads: int = 1,
) -> dict[str, Scores]:
    """Compare exported models, baselines and the floor with the truth.

    Args:
        models: name -> model, the reference of ``shift_cm`` first.
        dataset: held-out split.
        samples: samples used, evenly spread; ``emd_samples`` of them also get EMD.
        bank: training shapes for the baselines; None = no baselines.
        threads: metrics computed at once.
    Returns:
        Predictor -> scores as in ``measure``; models also have ``shift_cm``, the rms displacement of the fine points
        against the first model's.
    """
    cases = HeldOut(dataset).spread(samples)
    predictors: dict[str, Predictor] = {name: _bare(model) for name, model in models.items()}
    scores = measure(
        predictors | (bank.predictors() if bank else {}) | {FLOOR: floor},
        cases,
        min(emd_samples, len(cases)),
        threads,
    )
    for name, shifts in _shifts(models, dataset, cases.indices).items():
        scores[name].values["shift_cm"] = shifts
    return scores


def _bare(model: OnnxModel) -> Predictor:
    return lambda case: model.of(case.sample)


def _shifts(models: dict[str, OnnxModel], dataset: CompletionDataset, indices: list[int]) -> dict[str, list[float]]:
    """Rms displacement in cm of every model's fine points against the first model's."""
    shifts: dict[str, list[float]] = {name: [] for name in models}
    for index in indices if models else []:
        answers = {name: model.of(dataset[index]).fine_m for name, model in models.items()}
        reference = next(iter(answers.values()))
        for name, fine in answers.items():
            shifts[name].append(100 * float(np.sqrt(np.square(fine - reference).sum(axis=1).mean())))
    return shifts


def int8_is_faster(scores: dict[str, Scores], full: str, small: str, share: float = 0.9) -> bool:
    """True when the small model's median time is at most ``share`` of the full one's; else its error buys nothing."""
    before, after = (float(np.median(scores[name].values["time_ms"])) for name in (full, small))
    return after <= share * before


def int8_is_good(scores: dict[str, Scores], full: str, small: str, limit: float = 0.01) -> bool:
    """True when the small model's Chamfer distance is at most ``limit`` worse than the full one's in every class."""
    pairs = [
        (scores[full].summary("cd_cm", name).mean, scores[small].summary("cd_cm", name).mean)
        for name in scores[full].classes
    ]
    return all(after <= before * (1 + limit) for before, after in pairs)


TABLE: Sequence[tuple[str, str]] = (
    ("cd_cm", "CD cm"),
    ("accuracy_cm", "accuracy cm"),
    ("completeness_cm", "completeness cm"),
    ("emd_cm", "EMD@2048 cm"),
    ("f_5cm", "F@5 cm"),
    ("f_10cm", "F@10 cm"),
    ("f_1pct", "F@1 %"),
)


def table(
    scores: Mapping[str, Scores], rows: Sequence[tuple[str, str, str]], columns: Sequence[tuple[str, str]] = TABLE
) -> str:
    """A Markdown table of means.

    Args:
        scores: of ``measure``.
        rows: (label, predictor, class or mean).
        columns: (metric, title); shares with three digits, others with two.
    """
    lines = ["| | " + " | ".join(title for _, title in columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for label, predictor, class_name in rows:
        cells = []
        for metric, _ in columns:
            if not scores[predictor].measured(metric, class_name):
                cells.append("–")
                continue
            mean = scores[predictor].summary(metric, class_name).mean
            cells.append(f"{mean:.2f}" if metric.endswith(("_cm", "_cm2")) else f"{mean:.3f}")
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
