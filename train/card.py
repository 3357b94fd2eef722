# SPDX-License-Identifier: Apache-2.0
"""The model card: written from measured results only, the command beside every figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from edge.completion.confidence import ConfidenceModel
from train.evaluate import BIKE, FLOOR, MACRO, Scores, table

_FRAMES = {
    "sight": "Input and output are in the line-of-sight frame: x horizontal and away from the sensor's mean position, "
    "z up from the ground.",
    "box": "Input and output are in the object's own frame: the middle of its box at 0, lengths in box diagonals.",
}

_POINTNET = "Cascaded PointNet encoder, coarse decoder, folding with local features (the paper's shape completion)."
_KINDS = {
    "narrow": _POINTNET,
    "paper": _POINTNET,
    "pcn": "PointNet encoder, coarse decoder, folding (Point Completion Network).",
    "queries": "Transformer over neighbourhoods of the input; its queries are points of the input, their mirror images "
    "about the estimated plane of symmetry, and predicted points (after AdaPoinTr).",
}

_LIMITS = """## Limits

- Trained and measured on simulated data only: no radar recording was used. Figures on real radar clouds are unknown
  and must be expected to be worse. The table above is of perturbed depth scans; drive-bys: docs/results.md.
- Four classes; the probabilities of the classes are not calibrated, the confidence is (where the manifest has one).
- Posture, wheels and mirrors come from the training shapes, not from measurement.
- Neither speed nor motion of the object is modelled.
- Published tables of other networks use other data and other conventions: do not compare.
"""


def write_card(
    path: Path,
    name: str,
    scores: dict[str, Scores],
    files: dict[str, str],
    training: dict[str, Any],
    commands: dict[str, str],
    confidence: ConfidenceModel | None = None,
) -> None:
    """Write card.md.

    Args:
        path: file to write.
        name: of the model.
        scores: of ``evaluate`` on the held-out split.
        files: precision -> predictor name in ``scores``, the default one first.
        training: as in the manifest.
        commands: "fit" and "export": how the weights and the figures were made.
        confidence: of the manifest.
    """
    shown = next(iter(files.values()))
    rows = [(f"**{class_name}**", shown, class_name) for class_name in [*scores[shown].classes, BIKE, MACRO]]
    others = [(predictor, predictor, MACRO) for predictor in scores]
    head = scores[shown].summary("cd_cm")
    parts = [
        f"# Model card: {name}",
        "Completes a sparse, noisy, partial cloud of a road user to 16,384 points at true scale, and names its class.\n"
        f"{_KINDS[training['network']]}\n{_FRAMES[training['frame']]}",
        "## Training",
        f"{training['samples']} samples in {training['seconds']} s on {training['device']}, seed {training['seed']}; "
        f"{_before(training)}{training['parameters']} parameters.\n{training['dataset']}.",
        f"```\n{commands['fit']}\n```",
        "## Held-out objects",
        f"Mean Chamfer distance **{head.mean:.2f} cm** (macro over classes; bootstrap 95 % interval over objects "
        f"{head.low:.2f}–{head.high:.2f}; median sample {head.median:.2f}; {head.count} samples of "
        f"{len(set(scores[shown].objects))} objects that training never saw), file `{shown}`.\n"
        "CD is the mean of both directions, unsquared, at true scale; EMD matches 2048 points; F-scores are shares.",
        f"```\n{commands['export']}\n```",
        table(scores, rows),
        "All predictors, macro mean:",
        table(scores, others),
        f'The row "{FLOOR}" is what a perfect answer scores: two samplings of one surface differ.\n'
        '"class mean shape" is told the true class; "retrieval" takes the training shape nearest to the partial input; '
        '"posed oracle" takes the one nearest to the TRUTH, with the true place and heading: a reference, no rival.',
        "## Precision",
        "The int8 file is the default when it is a tenth faster, and its CD at most 1 % above that of the fp32 file in "
        "every class of the validation split; the fp32 file is the portable one.",
        _precision(scores, files),
        "## Confidence",
        _confidence(confidence),
        _LIMITS,
    ]
    path.write_text("<!-- SPDX-License-Identifier: Apache-2.0 -->\n\n" + "\n\n".join(parts))


def _before(training: dict[str, Any]) -> str:
    """What the weights had seen when the run began."""
    count = training.get("samples_before", 0)
    return f"the weights it began with had seen {count} samples; " if count else ""


def _confidence(confidence: ConfidenceModel | None) -> str:
    if confidence is None:
        return (
            "None was fitted: the runtime publishes class probability times what points and frames allow, "
            "which orders shapes and is no rate of being right."
        )
    return (
        f"Chance that the shape is within {100 * confidence.shape_limit_m:.0f} cm (CD) of the truth, from "
        f"{len(confidence.names)} measures ({', '.join(confidence.names)}); fitted on the validation split, on these "
        f"clouds worsened, and on clutter.\nThe class is published as `unknown` where the chance that it is right is "
        f"below {confidence.unknown_below:g}. Figures of the test split, and what it does on clutter: docs/results.md."
    )


def _precision(scores: dict[str, Scores], files: dict[str, str]) -> str:
    lines = [
        "| file | precision | CD cm | class accuracy | rms shift against fp32 cm | median ms, one thread |",
        "|---|---|---|---|---|---|",
    ]
    for precision, file in files.items():
        one = scores[file]
        accuracy, shift = one.summary("class_right").mean, float(np.mean(one.values["shift_cm"]))
        lines.append(
            f"| `{file}` | {precision} | {one.summary('cd_cm').mean:.3f} | {accuracy:.3f} | {shift:.2f} | "
            f"{float(np.median(one.values['time_ms'])):.0f} |"
        )
    lines.append(
        "\nThe shift compares points of the same number. Where rounding makes a network choose other points of the "
        "input to build about, other points bear a number, on the same surface: the CD tells."
    )
    return "\n".join(lines)
