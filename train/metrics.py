# SPDX-License-Identifier: Apache-2.0
"""How far a completed shape is from the truth: Chamfer distance, EMD, F-score, with bootstrap intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.config import require
from edge.errors import DependencyError
from edge.frames import Float32, Float64
from train.auction import assign
from train.nearest import nearest_distance

EMD_POINTS = 2048
"""Points of both clouds that are matched; EMD depends on it, so it belongs to the figure."""
EMD_TOLERANCE = 0.01
F_DISTANCES_M = (0.05, 0.10)
F_UNIT_SHARE = 0.01
"""F@1 %: threshold as a share of the truth's bounding-box diagonal (the unit frame of the published tables)."""


def shape_metrics(
    prediction_m: Float32,
    truth_m: Float32,
    seed: int = 0,
    with_emd: bool = True,
    diagonal_m: float | None = None,
) -> dict[str, float]:
    """Compare one cloud with its truth, both at true scale.

    Args:
        prediction_m: float32 [p, 3], metres.
        truth_m: float32 [t, 3], metres, uniform by area.
        seed: of the points drawn for EMD.
        with_emd: compute EMD as well (some tenths of a second).
        diagonal_m: of the object's own bounding box, the unit of the unit frame; None: of the box of ``truth_m`` along
            the axes of the frame, which is larger for an object that stands askew.
    Returns:
        ``cd_cm``: mean of both mean nearest distances (unsquared), the head figure. ``cd_sum_cm``: their sum.
        ``cd_squared_cm2``: sum of both mean squared distances (the paper's equation). ``accuracy_cm``: prediction to
        truth. ``completeness_cm``: truth to prediction. ``f_5cm``, ``f_10cm``: harmonic mean of precision and recall.
        ``f_1pct``: the same at 1 % of the diagonal. ``emd_cm``, ``emd_squared_cm2``: mean distance and mean squared
        distance under the assignment of 2048 points that minimises the mean distance (within 1 %); NaN without EMD.
        ``cd_unit_cm``, ``emd_unit_cm``: ``cd_cm`` and ``emd_cm`` after scaling the object to a diagonal of 1 m (the
        frame of the paper's version with box priors).
    Raises:
        ConfigError: an empty cloud or values that are not finite.
    """
    for name, cloud in (("prediction", prediction_m), ("truth", truth_m)):
        require(
            cloud.ndim == 2 and cloud.shape[1] == 3 and len(cloud) > 0 and bool(np.isfinite(cloud).all()),
            f"metrics.{name}",
            cloud.shape,
            "[n >= 1, 3], finite",
        )
    forth, back = nearest_distance(prediction_m, truth_m), nearest_distance(truth_m, prediction_m)
    if diagonal_m is None:
        diagonal_m = float(np.linalg.norm(truth_m.max(axis=0) - truth_m.min(axis=0)))
    result = {
        "cd_cm": 50 * (forth.mean() + back.mean()),
        "cd_sum_cm": 100 * (forth.mean() + back.mean()),
        "cd_squared_cm2": 1e4 * (np.square(forth).mean() + np.square(back).mean()),
        "accuracy_cm": 100 * forth.mean(),
        "completeness_cm": 100 * back.mean(),
        "f_5cm": f_score(forth, back, F_DISTANCES_M[0]),
        "f_10cm": f_score(forth, back, F_DISTANCES_M[1]),
        "f_1pct": f_score(forth, back, F_UNIT_SHARE * diagonal_m),
    }
    distance_m = emd_distances(prediction_m, truth_m, seed) if with_emd else np.array([np.nan])
    result |= {"emd_cm": 100 * distance_m.mean(), "emd_squared_cm2": 1e4 * np.square(distance_m).mean()}
    unit_m = max(diagonal_m, 1e-9)
    result |= {"cd_unit_cm": result["cd_cm"] / unit_m, "emd_unit_cm": result["emd_cm"] / unit_m}
    return {name: float(value) for name, value in result.items()}


def f_score(forth_m: Float64, back_m: Float64, threshold_m: float) -> float:
    """Harmonic mean of the shares of distances below a threshold; 0 when both shares are 0."""
    precision, recall = float((forth_m < threshold_m).mean()), float((back_m < threshold_m).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def emd_distances(prediction_m: Float32, truth_m: Float32, seed: int, points: int = EMD_POINTS) -> Float64:
    """Distances of matched pairs between random points of both clouds.

    A cloud with fewer points than ``points`` is repeated until it has enough.

    Returns:
        float64 [points], metres.
    """
    rng = np.random.default_rng(seed)
    first, second = _draw(prediction_m, points, rng), _draw(truth_m, points, rng)
    partner = assign(first, second, EMD_TOLERANCE)
    distance: Float64 = np.linalg.norm(first.astype(np.float64) - second[partner], axis=1)
    return distance


def emd_excess(first_m: Float32, second_m: Float32, seed: int = 0, points: int = EMD_POINTS) -> float:
    """How far the auction's EMD lies above the exact one (scipy's assignment), as a share; some seconds.

    Args:
        first_m, second_m: as in ``emd_distances``, which draws the same points.
        seed, points: see there.
    Raises:
        DependencyError: no scipy.
    """
    try:
        from scipy.optimize import linear_sum_assignment
    except ImportError as error:
        raise DependencyError("the exact assignment needs scipy", action="pip install 'rfconstruct[train]'") from error
    rng = np.random.default_rng(seed)
    first, second = (_draw(cloud, points, rng).astype(np.float64) for cloud in (first_m, second_m))
    cost = np.linalg.norm(first[:, None] - second[None], axis=2)
    exact = float(cost[linear_sum_assignment(cost)].mean())
    found = float(emd_distances(first_m, second_m, seed, points).mean())
    return found / exact - 1 if exact > 0 else 0.0


def _draw(cloud: Float32, points: int, rng: np.random.Generator) -> Float32:
    order = np.concatenate([rng.permutation(len(cloud)) for _ in range(-(-points // len(cloud)))])
    return np.ascontiguousarray(cloud[order[:points]])


@dataclass(frozen=True, slots=True)
class Summary:
    """One figure over many samples.

    Args:
        mean, median: over the samples that have the figure.
        low, high: bootstrap 95 % interval of the mean, whole objects drawn.
        count: samples.
    """

    mean: float
    median: float
    low: float
    high: float
    count: int


def summarize(values: Sequence[float], objects: Sequence[str], labels: Sequence[int], seed: int = 0) -> Summary:
    """Macro mean over classes of one figure, with its interval.

    Args:
        values: one a sample; NaN = not measured.
        objects: object of each sample; views of one object are not independent, so objects are drawn, not samples.
        labels: class of each sample.
        seed: of the bootstrap (1000 draws).
    Returns:
        Mean of the class means (of one class: its mean) and the median of all.
    Raises:
        ConfigError: no value.
    """
    value, label = np.asarray(values, dtype=float), np.asarray(labels)
    valid = np.isfinite(value)
    require(bool(valid.any()), "values", len(value), "at least one finite")
    rng = np.random.default_rng(seed)
    means, draws = [], []
    for one in np.unique(label[valid]):
        chosen = valid & (label == one)
        _, of_object = np.unique(np.asarray(objects)[chosen], return_inverse=True)
        total, count = np.bincount(of_object, value[chosen]), np.bincount(of_object)
        pick = rng.integers(len(total), size=(1000, len(total)))
        draws.append(total[pick].sum(axis=1) / count[pick].sum(axis=1))
        means.append(float(value[chosen].mean()))
    low, high = np.percentile(np.mean(draws, axis=0), [2.5, 97.5])
    return Summary(float(np.mean(means)), float(np.median(value[valid])), float(low), float(high), int(valid.sum()))
