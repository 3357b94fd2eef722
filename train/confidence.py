# SPDX-License-Identifier: Apache-2.0
"""Fits the confidence of a model on held-out answers: good ones, answers to worsened clouds, and clutter."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from edge.completion.confidence import ConfidenceModel, Trust, head_terms, measures, standardised
from edge.completion.model import UNKNOWN
from edge.config import require
from edge.frames import Float64
from train.dataset import CLASSES
from train.degrade import clutter_cases, worsened
from train.held_out import Case
from train.metrics import shape_metrics
from train.predictors import Answer, Predictor

SHAPE_LIMIT_M = 0.15
"""The paper's Chamfer distance without box priors; a better shape counts as right."""
CLUTTER_SHARE = 0.1
"""Share of clutter among segments, as the fit of "known" weighs it."""
WORSENED_WEIGHT = 0.25
"""Of a worsened cloud in the fit, beside 1 of a cloud as it is: they teach the signs, not how often all goes well."""
RISING = frozenset({"points", "frames", "odds", "near"})
FALLING = frozenset({"below", "away", "sigma"})
"""Measures that can only speak for, or only against, a right shape and class. A fit free to choose found that fewer
frames are better, because the validation split has few such clouds."""
_RIDGE = 1.0
_NEWTON_STEPS = 30
_UNKNOWN_RANGE = (0.5, 0.8)
_CLUTTER_NAMED = 0.05


@dataclass(frozen=True, slots=True)
class Observations:
    """Answers and what became of them.

    Args:
        measured: of ``edge.completion.confidence.measures``, one an answer.
        cd_m: Chamfer distance in metres; NaN: clutter.
        right: whether the class was; False for clutter.
        known: whether it was a road user.
        weight: of each in the fit; None: 1. Clutter is weighed by its share instead.
    """

    measured: list[dict[str, float]]
    cd_m: Float64
    right: np.ndarray
    known: np.ndarray
    weight: Float64 | None = None


def observe(
    predictor: Predictor, cases: Sequence[Case], clutter: Sequence[Case] = (), threads: int = 1
) -> Observations:
    """Ask a predictor and compare with the truth.

    Args:
        predictor: a network; None of its answers may be empty.
        cases: with truth. clutter: without (``degrade.clutter_cases``).
        threads: cases at once.
    """

    def one(case: Case) -> tuple[dict[str, float], Answer]:
        answer = predictor(case)
        return measured(case, answer), answer

    def with_truth(case: Case) -> tuple[dict[str, float], float, bool]:
        found, answer = one(case)
        cd_cm = shape_metrics(answer.fine_m, case.sample.truth, with_emd=False)["cd_cm"]
        right = answer.probability is not None and int(np.argmax(answer.probability)) == case.sample.label
        return found, cd_cm / 100, right

    with ThreadPoolExecutor(threads) as pool:
        objects = list(pool.map(with_truth, (cases[n] for n in range(len(cases)))))
        others = [found for found, _ in pool.map(one, clutter)]
    return Observations(
        [found for found, _, _ in objects] + others,
        np.array([cd for _, cd, _ in objects] + [np.nan] * len(others)),
        np.array([right for _, _, right in objects] + [False] * len(others)),
        np.arange(len(objects) + len(others)) < len(objects),
    )


def measured(case: Case, answer: Answer) -> dict[str, float]:
    """What the edge would know of this answer."""
    return measures(case.sample.partial, answer.fine_m, answer.probability, case.frames, answer.sigma_m)


def fit_confidence(seen: Observations, limit_m: float = SHAPE_LIMIT_M) -> ConfidenceModel:
    """Three ridge logistic regressions: shape and class on road users, known on all.

    Args:
        seen: of held-out objects that the network was not trained on, with some clutter.
        limit_m: Chamfer distance that still counts as right.
    Returns:
        The model; ``unknown_below`` lets at most 5 % of the clutter be named, but stays within 0.5..0.8.
    Raises:
        ConfigError: fewer than 20 road users, or no clutter.
    """
    objects, others = int(seen.known.sum()), int((~seen.known).sum())
    require(objects >= 20 and others >= 1, "confidence.samples", (objects, others), ">= 20 road users, some clutter")
    names = tuple(seen.measured[0])
    values = np.array([[one[name] for name in names] for one in seen.measured])
    mean, scale = values.mean(axis=0), values.std(axis=0)
    scale = np.where(scale > 1e-9, scale, 1.0)
    linear, products = head_terms(names, standardised(values, mean, scale))
    signs = np.array([0, *((name in RISING) - (name in FALLING) for name in names)])
    given = np.ones(len(values)) if seen.weight is None else seen.weight
    own = given[seen.known]
    weight = np.where(seen.known, given, CLUTTER_SHARE / (1 - CLUTTER_SHARE) * own.sum() / others)
    heads = {
        "shape": signed_fit(linear[seen.known], seen.cd_m[seen.known] < limit_m, signs, own),
        "class": signed_fit(linear[seen.known], seen.right[seen.known], signs, own),
        "known": logistic_fit(products, seen.known, weight),
    }
    rounded = {head: tuple(float(f"{value:.6g}") for value in weights) for head, weights in heads.items()}
    middle, width = (tuple(float(f"{value:.6g}") for value in column) for column in (mean, scale))
    model = ConfidenceModel(names, middle, width, rounded, 0.0, limit_m)
    named = [model.trust(one).class_right for one, known in zip(seen.measured, seen.known, strict=True) if not known]
    below = float(np.clip(np.quantile(named, 1 - _CLUTTER_NAMED), *_UNKNOWN_RANGE))
    return replace(model, unknown_below=round(below, 3))


def signed_fit(terms: Float64, event: np.ndarray, signs: np.ndarray, weight: Float64 | None = None) -> Float64:
    """As ``logistic_fit``, where a weight that comes out against its sign is held at 0 and the others are fitted again.

    Args:
        terms, event, weight: as there. signs: [k], 1: not negative, -1: not positive, 0: free.
    """
    kept = np.ones(terms.shape[1], dtype=bool)
    while True:
        beta = np.zeros(terms.shape[1])
        beta[kept] = logistic_fit(terms[:, kept], event, weight)
        wrong = beta * signs < 0
        if not wrong.any():
            return beta
        kept &= ~wrong


def logistic_fit(terms: Float64, event: np.ndarray, weight: Float64 | None = None) -> Float64:
    """Weights of a logistic model with a ridge penalty on all but the constant, by Newton's method with halved steps.

    Args:
        terms: [n, k], the first column ones.
        event: [n] bool.
        weight: [n], of each sample.
    """
    event = event.astype(float)
    weight = np.ones(len(terms)) if weight is None else weight
    penalty = np.full(terms.shape[1], _RIDGE)
    penalty[0] = 1e-3  # events that always or never happen would send the constant to infinity

    def loss(beta: Float64) -> float:
        z = terms @ beta
        return float((weight * (np.logaddexp(0, z) - event * z)).sum() + 0.5 * (penalty * beta * beta).sum())

    beta = np.zeros(terms.shape[1])
    for _ in range(_NEWTON_STEPS):
        chance = 1 / (1 + np.exp(-np.clip(terms @ beta, -30, 30)))
        gradient = terms.T @ (weight * (chance - event)) + penalty * beta
        curvature = (terms * (weight * chance * (1 - chance))[:, None]).T @ terms + np.diag(penalty)
        step = np.linalg.solve(curvature, gradient)
        length = 1.0
        while loss(beta - length * step) > loss(beta) and length > 1e-6:
            length /= 2
        beta = beta - length * step
        if np.abs(length * step).max() < 1e-8:
            break
    return beta


def training_cases(cases: Sequence[Case], seed: int = 0) -> list[Case]:
    """Every case as it is and twice worsened at random."""
    known = [cases[position] for position in range(len(cases))]
    rng = np.random.default_rng(seed)
    return known + [worsened(case, rng, known) for case in [*known, *known]]


def confidence_for(
    predictor: Predictor, cases: Sequence[Case], clutter: int = 240, seed: int = 0, threads: int = 1
) -> ConfidenceModel:
    """The confidence model of a network: what an export needs.

    Args:
        predictor: the network. cases: of the validation split. clutter: how many clouds of it.
        seed: of chance. threads: cases at once.
    """
    known = training_cases(cases, seed)
    seen = observe(predictor, known, clutter_cases(known, clutter, seed), threads)
    weight = np.full(len(seen.measured), WORSENED_WEIGHT)
    weight[: len(cases)] = 1.0
    return fit_confidence(replace(seen, weight=weight))


class Trusting:
    """A predictor whose confidence and class come from a confidence model.

    Args:
        predictor: gives shape and class probabilities. model: the confidence.
    """

    def __init__(self, predictor: Predictor, model: ConfidenceModel) -> None:
        self.predictor, self.model = predictor, model

    def __call__(self, case: Case) -> Answer:
        """The same answer, otherwise trusted."""
        answer = self.predictor(case)
        trust = self.trust(case, answer)
        unknown = answer.probability is None or self.model.is_unknown(trust)
        name = UNKNOWN if unknown or answer.probability is None else CLASSES[int(np.argmax(answer.probability))]
        return answer._replace(confidence=trust.shape, class_name=name)

    def trust(self, case: Case, answer: Answer) -> Trust:
        """Probabilities of one answer."""
        return self.model.trust(measured(case, answer))
