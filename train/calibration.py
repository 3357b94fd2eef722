# SPDX-License-Identifier: Apache-2.0
"""Whether probabilities keep their word: reliability, expected calibration error, risk against coverage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edge.config import require
from edge.frames import Float64

BINS = 10


@dataclass(frozen=True, slots=True)
class Reliability:
    """Promised against kept, in bins of equal width over 0..1; bins without samples are left out.

    Args:
        promised: float64 [b], mean probability of each bin.
        kept: float64 [b], share of events in it.
        count: int64 [b], samples in it.
        error: expected calibration error: mean of |promised - kept| over samples (Naeini et al. 2015).
        brier: mean squared difference of probability and event.
    """

    promised: Float64
    kept: Float64
    count: np.ndarray
    error: float
    brier: float


def reliability(probability: ArrayLike, event: ArrayLike, bins: int = BINS) -> Reliability:
    """Compare probabilities with what happened.

    Args:
        probability: [n], 0..1.
        event: [n], 0 or 1.
        bins: over 0..1.
    Raises:
        ConfigError: no sample, or a value outside its range.
    """
    chance, happened = np.asarray(probability, dtype=float), np.asarray(event, dtype=float)
    inside = chance.shape == happened.shape and chance.size > 0 and bool(((chance >= 0) & (chance <= 1)).all())
    require(
        inside and set(np.unique(happened)) <= {0.0, 1.0}, "reliability", chance.shape, "[n >= 1] of 0..1, events 0/1"
    )
    which = np.minimum((chance * bins).astype(int), bins - 1)
    count = np.bincount(which, minlength=bins)
    full = count > 0
    promised = np.bincount(which, chance, bins)[full] / count[full]
    kept = np.bincount(which, happened, bins)[full] / count[full]
    error = float((np.abs(promised - kept) * count[full]).sum() / count.sum())
    return Reliability(promised, kept, count[full], error, float(np.square(chance - happened).mean()))


@dataclass(frozen=True, slots=True)
class RiskCoverage:
    """Mean loss of the samples that are kept when the least trusted are refused first.

    Args:
        coverage: float64 [n], 1/n .. 1.
        risk: float64 [n], mean loss of that share.
        area: mean risk over coverage (AURC); the random order scores ``risk[-1]``.
        best: area of the order that knows the losses.
    """

    coverage: Float64
    risk: Float64
    area: float
    best: float

    def at(self, coverage: float) -> float:
        """Risk of the most trusted share."""
        return float(self.risk[max(round(coverage * len(self.risk)), 1) - 1])


def risk_coverage(confidence: ArrayLike, loss: ArrayLike) -> RiskCoverage:
    """Order samples by confidence and follow the mean loss (Geifman and El-Yaniv 2017).

    Args:
        confidence: [n], any scale, higher is more trusted.
        loss: [n], finite.
    Raises:
        ConfigError: no sample, or values that are not finite.
    """
    trust, cost = np.asarray(confidence, dtype=float), np.asarray(loss, dtype=float)
    valid = trust.shape == cost.shape and trust.size > 0 and bool(np.isfinite(trust).all() and np.isfinite(cost).all())
    require(valid, "risk_coverage", trust.shape, "[n >= 1], finite")
    coverage = np.arange(1, len(cost) + 1) / len(cost)
    risk = np.cumsum(cost[np.argsort(-trust, kind="stable")]) / np.arange(1, len(cost) + 1)
    best = np.cumsum(np.sort(cost)) / np.arange(1, len(cost) + 1)
    return RiskCoverage(coverage, risk, float(risk.mean()), float(best.mean()))
