# SPDX-License-Identifier: Apache-2.0
"""The model folder: manifest.json with hashes, golden.npz with a known answer of every model file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from edge.completion.confidence import ConfidenceModel
from edge.completion.manifest import SCHEMA, InputFrame
from edge.errors import ModelError
from edge.frames import Float32
from train.evaluate import OnnxModel
from train.network import CompletionModel

FULL, SMALL = "model.onnx", "model.int8.onnx"
FRAMES: dict[str, InputFrame] = {"sight": "line_of_sight", "box": "box"}
"""A network's frame -> the manifest's."""
MIN_POINTS, MAX_POINTS = 64, 2048
"""Of an input cloud, as the data sets draw them."""
_FINE_ROWS = 1024
_JITTER_M, _LARGEST_CHANGE_M = 1e-5, 0.1
_LEAST_TOLERANCE_M = {FULL: 1e-3, SMALL: 1e-2}
"""Other processors round otherwise; the last bit of an activation may fall into the next of 255 steps."""


def write_golden(path: Path, models: dict[str, OnnxModel], inputs: Sequence[Float32]) -> dict[str, float]:
    """Choose the steadiest input and store what every model answers.

    The file holds ``points`` float32 [n, 3]; ``fine_rows`` int64 [1024], rows of the fine cloud that are kept; and for
    every model file ``<file>:fine`` float32 [1024, 3], ``<file>:coarse`` float32 [1024, 3], metres, and
    ``<file>:class_probability`` float32 [classes].

    Args:
        path: file to write.
        models: file name -> model.
        inputs: candidates; what lies half-way between two choices (the nearest input point, the last query that is
            taken) may flip when another processor rounds otherwise, so the input whose answers change least under a
            jitter of 10 um is taken.
    Returns:
        File name -> tolerance in metres of the largest coordinate difference: four times that change, and at least
        1 mm (fp32) or 10 mm (int8).
    Raises:
        ModelError: even the steadiest answer moves so far that a comparison would say nothing.
    """
    rng = np.random.default_rng(0)
    best, change = inputs[0], dict.fromkeys(models, float("inf"))
    for points in inputs:
        found = {name: _sensitivity(model, points, rng) for name, model in models.items()}
        if sum(found.values()) < sum(change.values()):
            best, change = points, found
    worst = max(change.values())
    if not worst <= _LARGEST_CHANGE_M:
        raise ModelError(
            f"none of {len(inputs)} inputs has a steady answer",
            value=f"{worst:.3g} m under a jitter of {1e6 * _JITTER_M:.0f} um",
            allowed=f"at most {_LARGEST_CHANGE_M:g} m",
            action="train longer, or give drive-bys with --simulated: more inputs to choose from",
        )
    count = min(len(model(best)[0]) for model in models.values())
    rows = np.sort(rng.choice(count, min(count, _FINE_ROWS), replace=False))
    content: dict[str, Any] = {"points": best, "fine_rows": rows}
    for name, model in models.items():
        fine, coarse, probability = model(best)
        content |= {f"{name}:fine": fine[rows], f"{name}:coarse": coarse, f"{name}:class_probability": probability}
    np.savez_compressed(path, **content)
    return {name: round(max(_LEAST_TOLERANCE_M[name], 4 * value), 4) for name, value in change.items()}


def _sensitivity(model: OnnxModel, points: Float32, rng: np.random.Generator) -> float:
    """Largest change of a fine coordinate in metres under four jitters of the input."""
    reference = model(points)[0]
    largest = 0.0
    for _ in range(4):
        jitter = rng.uniform(-_JITTER_M, _JITTER_M, points.shape).astype(np.float32)
        largest = max(largest, float(np.abs(model(points + jitter)[0] - reference).max()))
    return largest


def write_manifest(
    folder: Path,
    name: str,
    default_file: str,
    network: CompletionModel,
    classes: Sequence[str],
    rigs: Sequence[str],
    tolerance_m: dict[str, float],
    confidence: ConfidenceModel | None,
    training: dict[str, Any],
) -> None:
    """Write manifest.json beside the model files.

    Args:
        folder: model folder with both model files and golden.npz.
        name: of the model.
        default_file: file that the runtime takes.
        network: that was exported: its frame and sizes.
        classes: that the graph gives; none: no classifier.
        rigs: rigs whose clouds the training data are like.
        tolerance_m: of ``write_golden``.
        confidence: calibrated; None: not yet.
        training: where the weights come from, and what was measured.
    """
    files = []
    for file, precision in ((FULL, "fp32"), (SMALL, "int8")):
        content = (folder / file).read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        files.append({"file": file, "sha256": digest, "precision": precision, "bytes": len(content)})
    manifest = {
        "schema": SCHEMA,
        "name": name,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "files": files,
        "default_file": default_file,
        "classes": list(classes),
        "input": {
            "min_points": MIN_POINTS,
            "max_points": MAX_POINTS,
            "columns": network.columns,
            "frame": FRAMES[network.frame],
        },
        "output": {"coarse": network.coarse_points, "fine": network.coarse_points * network.cells},
        "rigs": list(rigs),
        "golden": {"file": "golden.npz", "tolerance_m": tolerance_m},
        "confidence": None if confidence is None else confidence.to_dict(),
        "training": training,
    }
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")
