# SPDX-License-Identifier: Apache-2.0
"""How far a completed shape can be trusted: calibrated probabilities from what is known without the truth.

Three logistic models share one set of measures: the shape is within ``shape_limit_m`` of the truth, the class is right,
and the cloud is a road user at all. ``train.confidence`` fits them on held-out data; they travel in the manifest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from edge.errors import ModelError
from edge.frames import FULL_WINDOW_FRAMES, Float32, Float64

HEADS = ("shape", "class", "known")
NEAR_M, SEEN_M = 0.10, 0.30
_INPUT_ROWS, _SURFACE_ROWS = 256, 2048
_CUT = 4.0
"""Standardised measures are cut here: nothing is extrapolated far beyond the fit."""
_ODDS_LIMIT = 6.0
AMOUNTS = ("points", "frames")
"""How much was seen. "known" does not depend on it, so that less is never trusted more."""
_FAR_M, _LEAST_M = 1.0, 0.02


class Trust(NamedTuple):
    """Probabilities, each 0..1.

    Args:
        shape: a road user whose completed surface has a Chamfer distance below the limit.
        class_right: a road user of the most probable class.
        known: a road user, and not a wall, a bush, a pole.
    """

    shape: float
    class_right: float
    known: float


def measures(
    points_m: Float32,
    fine_m: Float32,
    probability: Sequence[float] | Float32 | None,
    frames: int,
    sigma_m: float | None = None,
) -> dict[str, float]:
    """What is known of an answer without the truth; half a millisecond, the same numbers for any heading.

    Args:
        points_m: float32 [n, 3], n >= 1, what the network saw; z up, ground 0, metres.
        fine_m: float32 [m, 3], m >= 1, its answer in the same frame.
        probability: of the classes, in the manifest's order; None or empty: the network has no classifier.
        frames: of the window.
        sigma_m: the network's own mean uncertainty of a point, where it gives one.
    Returns:
        Name -> number: ``points`` and ``frames`` (log2 against 256 points and a full window, the latter at most 0),
        ``odds`` (log-odds of the most probable class), ``p0``, ``p1`` .. (class probabilities), ``near`` (share of
        input points within 10 cm of the answer), ``seen`` (share of the answer within 30 cm of an input point),
        ``below`` (share of the input 10 cm or more below the ground), and as log2 of metres, at least 2 cm: ``away``
        (mean distance of input points from the answer, each at most 1 m), ``long``, ``wide`` (standard deviations of
        the input along its horizontal principal axes), ``high`` (95 % quantile of its heights), ``answer_long``,
        ``answer_high`` (the same of the answer), ``sigma`` where given.
    """
    rows, surface = _some(points_m, _INPUT_ROWS), _some(fine_m, _SURFACE_ROWS)
    squared = _squared_distances(rows, surface)
    forth = np.sqrt(np.maximum(squared.min(axis=1), 0))
    back = np.sqrt(np.maximum(squared.min(axis=0), 0))
    long_m, wide_m = _axes(points_m)
    result = {
        "points": math.log2(len(points_m) / 256),
        "frames": math.log2(min(max(frames, 1), FULL_WINDOW_FRAMES) / FULL_WINDOW_FRAMES),
        **({} if probability is None or len(probability) == 0 else _of_classes(np.asarray(probability, np.float64))),
        "near": float((forth < NEAR_M).mean()),
        "seen": float((back < SEEN_M).mean()),
        "below": float((points_m[:, 2] < -NEAR_M).mean()),
        "away": _log(float(np.minimum(forth, _FAR_M).mean())),
        "long": _log(long_m),
        "wide": _log(wide_m),
        "high": _log(float(np.quantile(points_m[:, 2], 0.95))),
        "answer_long": _log(_axes(surface)[0]),
        "answer_high": _log(float(np.quantile(surface[:, 2], 0.95))),
    }
    return result if sigma_m is None else result | {"sigma": _log(sigma_m)}


def _log(length_m: float) -> float:
    return math.log2(max(length_m, _LEAST_M))


def _of_classes(probability: Float64) -> dict[str, float]:
    top = float(np.clip(probability.max(), 1e-6, 1 - 1e-6))
    each = {f"p{number}": float(value) for number, value in enumerate(probability)}
    return {"odds": min(_ODDS_LIMIT, math.log(top / (1 - top)))} | each


def _some(cloud: Float32, most: int) -> Float32:
    """At most ``most`` rows, evenly over the cloud, about no origin in particular."""
    step = -(-len(cloud) // most)
    return cloud[::step]


def _squared_distances(first: Float32, second: Float32) -> Float32:
    """All squared distances [n, m], float32; both clouds are centred first, so that rounding stays below 1 mm."""
    middle = second.mean(axis=0)
    a, b = first - middle, second - middle
    ones = np.ones((len(a), 1), np.float32), np.ones((len(b), 1), np.float32)
    left = np.concatenate([a, (a * a).sum(axis=1, keepdims=True), ones[0]], axis=1)
    right = np.concatenate([-2 * b, ones[1], (b * b).sum(axis=1, keepdims=True)], axis=1)
    result: Float32 = left @ right.T
    return result


def _axes(cloud: Float32) -> tuple[float, float]:
    """Standard deviations along the horizontal principal axes, the longer first."""
    flat = cloud[:, :2].astype(np.float64)
    flat -= flat.mean(axis=0)
    narrow, wide = np.sqrt(np.maximum(np.linalg.eigvalsh(flat.T @ flat / len(flat)), 0))
    return float(wide), float(narrow)


@dataclass(frozen=True, slots=True)
class ConfidenceModel:
    """Three logistic models over standardised measures z, each cut at 4 standard deviations.

    Shape and class are linear in z, and never fall with the amount of points and frames. "known" leaves these two out
    and has all products of two others, because what is odd is the combination: as narrow as a pole and yet a
    pedestrian.

    Args:
        names: measures that are used, in order.
        mean, scale: of each over the data of the fit.
        heads: "shape", "class" -> a constant and one weight for every z; "known" -> the same for every z that is no
            amount, and one weight for every product z_i z_j of these, i <= j, in the order of ``quadratic``.
        unknown_below: below this probability of the right class the class is "unknown".
        shape_limit_m: what "shape" promises.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    heads: dict[str, tuple[float, ...]]
    unknown_below: float
    shape_limit_m: float

    def trust(self, measured: Mapping[str, float]) -> Trust:
        """Probabilities for one answer.

        Args:
            measured: of ``measures``.
        Raises:
            ModelError: a measure is missing or not finite.
        """
        values = np.array([measured.get(name, math.nan) for name in self.names])
        if not np.isfinite(values).all():
            missing = [name for name, value in zip(self.names, values, strict=True) if not math.isfinite(value)]
            raise ModelError(f"confidence: no value of {', '.join(missing)}", action="use the model's own manifest")
        z = standardised(values[None], np.array(self.mean), np.array(self.scale))
        linear, products = (terms[0] for terms in head_terms(self.names, z))
        terms = {"shape": linear, "class": linear, "known": products}
        shape, right, known = (_logistic(float(terms[head] @ np.array(self.heads[head]))) for head in HEADS)
        return Trust(known * shape, known * right, known)

    def is_unknown(self, trust: Trust) -> bool:
        """Whether the class is better not named."""
        return trust.class_right < self.unknown_below

    def to_dict(self) -> dict[str, Any]:
        """Plain values for the manifest."""
        return asdict(self)

    @classmethod
    def from_dict(cls, content: Any) -> ConfidenceModel:
        """The model of a manifest.

        Raises:
            ModelError: keys, types or lengths are wrong, or a number is not finite.
        """
        try:
            model = cls(
                tuple(str(name) for name in content["names"]),
                tuple(float(value) for value in content["mean"]),
                tuple(float(value) for value in content["scale"]),
                {str(head): tuple(float(v) for v in weights) for head, weights in content["heads"].items()},
                float(content["unknown_below"]),
                float(content["shape_limit_m"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise _refused(f"{type(error).__name__}: {error}") from error
        count = len(model.names)
        weights = [value for head in model.heads.values() for value in head]
        numbers = [*model.mean, *model.scale, *weights, model.unknown_below, model.shape_limit_m]
        linear, product = (terms.shape[1] for terms in head_terms(model.names, np.zeros((1, count))))
        lengths = {"shape": linear, "class": linear, "known": product}
        rules = (
            (set(content) == set(cls.__slots__), f"keys {sorted(content)}"),
            (count > 0 and len(model.mean) == len(model.scale) == count, f"{count} measures"),
            ({head: len(each) for head, each in model.heads.items()} == lengths, f"number of weights, not {lengths}"),
            (all(map(math.isfinite, numbers)), "a number that is not finite"),
            (all(value > 0 for value in (*model.scale, model.shape_limit_m)), "a scale that is not positive"),
            (0 <= model.unknown_below <= 1, f"unknown_below {model.unknown_below}"),
        )
        for holds, what in rules:
            if not holds:
                raise _refused(what)
        return model


def standardised(values: Float64, mean: Float64, scale: Float64) -> Float64:
    """Measures [n, k] in standard deviations, cut at 4."""
    z: Float64 = np.clip((values - mean) / scale, -_CUT, _CUT)
    return z


def head_terms(names: Sequence[str], z: Float64) -> tuple[Float64, Float64]:
    """Terms [n, ..] of the linear heads and of "known", from standardised measures z [n, k] called ``names``."""
    kind = [column for column, name in enumerate(names) if name not in AMOUNTS]
    return np.concatenate([np.ones((len(z), 1)), z], axis=1), quadratic(z[:, kind])


def quadratic(z: Float64) -> Float64:
    """Terms [n, 1 + k + k (k + 1) / 2] of measures [n, k]: one, z_i, and z_i z_j with i <= j, row by row."""
    first, second = np.triu_indices(z.shape[1])
    return np.concatenate([np.ones((len(z), 1)), z, z[:, first] * z[:, second]], axis=1)


def _logistic(value: float) -> float:
    return 1 / (1 + math.exp(-min(max(value, -30.0), 30.0)))


def _refused(what: str) -> ModelError:
    return ModelError(
        "wrong confidence section of a manifest",
        value=what,
        allowed="names, mean, scale, heads (shape, class, known), unknown_below, shape_limit_m",
        action="install the model again",
    )
