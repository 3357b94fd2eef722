# SPDX-License-Identifier: Apache-2.0
"""Evaluation of exported models, baselines and the floor on held-out objects."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import onnxruntime

from edge.errors import ModelError
from edge.frames import Float32
from train.baselines import Bank, resampled
from train.dataset import CLASSES, CompletionDataset, Sample
from train.metrics import Summary, shape_metrics, summarize

FLOOR = "floor (truth sampled twice)"
MACRO = "macro"


class OnnxModel:
    """An exported model in ONNX Runtime, one thread.

    Args:
        path: .onnx file.
    Raises:
        ModelError: absent or not loadable.
    """

    def __init__(self, path: Path) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise ModelError(
                f"{path.name}: no loadable model ({type(error).__name__})", action="export again"
            ) from error

    def __call__(self, points_m: Float32) -> tuple[Float32, Float32, Float32]:
        """Fine [16384, 3] and coarse [1024, 3] points in metres and class probabilities of one cloud [n, 3]."""
        fine, coarse, probability = self.session.run(["fine", "coarse", "class_probability"], {"points": points_m})
        return fine, coarse, probability


@dataclass(slots=True)
class Scores:
    """Figures of one predictor, one entry a sample.

    Args:
        values: metric name -> values.
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

    def _rows(self, class_name: str) -> list[int]:
        return [row for row, label in enumerate(self.labels) if class_name in (MACRO, CLASSES[label])]

    def measured(self, metric: str, class_name: str = MACRO) -> bool:
        """Whether the figure exists for the class."""
        return any(np.isfinite(self.values[metric][row]) for row in self._rows(class_name))

    def summary(self, metric: str, class_name: str = MACRO) -> Summary:
        """A figure of one class or of the mean over classes; ConfigError when nothing was measured."""
        rows = self._rows(class_name)
        values = self.values[metric]
        return summarize([values[r] for r in rows], [self.objects[r] for r in rows], [self.labels[r] for r in rows])

    @property
    def classes(self) -> list[str]:
        """Classes that occur, in order."""
        return [name for label, name in enumerate(CLASSES) if label in self.labels]


def spread(length: int, count: int) -> list[int]:
    """At most ``count`` indices, evenly over 0..length - 1, each once."""
    return sorted(set(np.linspace(0, length - 1, min(count, length)).astype(int).tolist()))


def evaluate(
    models: dict[str, OnnxModel],
    dataset: CompletionDataset,
    samples: int,
    emd_samples: int,
    bank: Bank | None = None,
    threads: int = 1,
) -> dict[str, Scores]:
    """Compare models, baselines and the floor with the truth.

    Args:
        models: name -> model.
        dataset: held-out split.
        samples: samples used, evenly spread; ``emd_samples`` of them also get EMD.
        bank: training shapes for the baselines; None = no baselines.
        threads: metrics computed at once.
    Returns:
        Predictor -> scores: the metrics of ``shape_metrics``; models also ``class_right`` (0 or 1), ``time_ms`` and,
        when the fp32 model is among them, ``shift_cm``: rms displacement of the fine points against it.
    """
    indices = spread(len(dataset), samples)
    with_emd = {indices[i] for i in spread(len(indices), emd_samples)} if emd_samples else set()
    scores: dict[str, Scores] = {}

    def one(index: int) -> list[tuple[str, Sample, dict[str, float]]]:
        sample = dataset[index]
        results = _of_models(models, sample, index, index in with_emd)
        for name, predictor in (bank.predictors() if bank else {}).items():
            results[name] = shape_metrics(predictor(sample), sample.truth, index, index in with_emd)
        first, second = resampled(dataset, index, len(sample.truth))
        results[FLOOR] = shape_metrics(first, second, index, index in with_emd)
        return [(name, sample, metrics) for name, metrics in results.items()]

    with ThreadPoolExecutor(threads) as pool:
        for results in pool.map(one, indices):
            for name, sample, metrics in results:
                scores.setdefault(name, Scores()).add(sample, metrics)
    return scores


def _of_models(models: dict[str, OnnxModel], sample: Sample, seed: int, with_emd: bool) -> dict[str, dict[str, float]]:
    results: dict[str, dict[str, float]] = {}
    reference: Float32 | None = None
    for name, model in models.items():
        start = time.perf_counter()
        fine, _, probability = model(sample.partial)
        elapsed_ms = 1e3 * (time.perf_counter() - start)
        metrics = shape_metrics(fine, sample.truth, seed, with_emd)
        reference = fine if reference is None else reference
        shift_cm = 100 * float(np.sqrt(np.square(fine - reference).sum(axis=1).mean()))
        right = float(int(probability.argmax()) == sample.label)
        results[name] = metrics | {"class_right": right, "time_ms": elapsed_ms, "shift_cm": shift_cm}
    return results


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


def table(scores: dict[str, Scores], rows: Sequence[tuple[str, str, str]]) -> str:
    """A Markdown table of means.

    Args:
        scores: of ``evaluate``.
        rows: (label, predictor, class or "macro").
    """
    lines = ["| | " + " | ".join(title for _, title in TABLE) + " |", "|---" * (len(TABLE) + 1) + "|"]
    for label, predictor, class_name in rows:
        cells = []
        for metric, _ in TABLE:
            if not scores[predictor].measured(metric, class_name):
                cells.append("–")
                continue
            mean = scores[predictor].summary(metric, class_name).mean
            cells.append(f"{mean:.3f}" if metric.startswith("f_") else f"{mean:.2f}")
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
