# SPDX-License-Identifier: Apache-2.0
"""Noise of cells that hold the largest of several maps' powers: its distribution, correlation and threshold factors.

Noise is complex Gaussian in every cell of every map. c_k(d) = |rho|^2 between two cells d angle bins and k maps apart
says everything; powers have the mean 1 and q = exp(-x).

Distribution at one cell. Two powers of correlation c both exceed x with the probability

    q (1 / pi) int_0^pi exp(-x (1 - c) / (1 + c + 2 sqrt(c) cos t)) dt

(Marcum's Q functions of the bivariate Rayleigh distribution as a Poisson integral). With G_k = P(both below x) and
F_1 = 1 - q, the maps in order of speed are taken as a Markov chain, ln F = (K - 1) ln G_1 - (K - 2) ln F_1: independent
maps give F_1^K, dense ones Rice's rate of crossings (1944) with Vanmarcke's correction (1975). Maps beyond the first
minimum of c_k, which the chain takes as independent, add ln(G_k / F_1^2) for each pair of independent stretches: a
stretch is K / n maps long, n = ln F / ln F_1.

Correlation of two cells. The largest power is somewhere among the maps, at the ends with the odds 1/2 each, in between
with u a step, u = P(a map exceeds x and the next does not) / q; these are the weights a_i. In first order the maxima of
two cells correlate as sum_ij a_i a_j |rho_ij|^2, C = this over its value at d = 0: much farther than one map's cells,
because another speed moves a noise peak to another angle. That order has the share beta = mean^2 / (n_e variance) of
the variance (scaling of the Gaussian vector, n_e = K^2 / sum_ij c_ij its degrees of freedom), H_n^2 / (n sum 1/j^2) for
n independent maps; higher orders are taken to fall geometrically, so that the maxima correlate by beta C / (1 - (1 -
beta) C), within 0.015 for up to 8 independent maps.

Threshold. The mean of N_e cells (edge/dsp/effective_cells.py) is gamma distributed with the variance of the maximum
over N_e, an ordered statistic's share is beta distributed; p = E[1 - F(T S)] is integrated over them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edge.config import CfarKind
from edge.frames import Float64

LARGEST, POINTS = 60.0, 1200
"""Levels up to ``LARGEST`` times one map's mean at which the distribution is known."""
COSINES = np.cos(np.pi * (np.arange(96) + 0.5) / 96)
"""Midpoints of the integral above, which these give to 1e-5 for correlations up to 0.98."""
FEW_COSINES = np.cos(np.pi * (np.arange(16) + 0.5) / 16)
"""Up to a correlation of 1/2."""
STATISTIC_POINTS = 400
ROUNDS = 12
TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Maximum:
    """The largest of several exponential powers of mean 1, and how those of two cells correlate.

    Args:
        level: float64 [n], powers.
        below: float64 [n], ln F.
        above: float64 [n], -ln(1 - F).
        mean: of the maximum.
        relative_variance: its variance over mean^2.
        share: beta.
        correlation: float64 [angle], C by the distance in angle bins.
    """

    level: Float64
    below: Float64
    above: Float64
    mean: float
    relative_variance: float
    share: float
    correlation: Float64

    @classmethod
    def of(cls, by_map: Float64) -> Maximum:
        """From float64 [maps, angle], |rho|^2 by the difference of maps (at least two) and of angle bins, both up."""
        maps, step = len(by_map), LARGEST / POINTS
        level = step * np.arange(0.5, POINTS)
        below = np.minimum(_log_below(by_map[:, 0], level), np.log1p(-np.exp(-level)))
        beyond = -np.expm1(below)
        mean = float(beyond.sum() * step)
        relative_variance = 2.0 * float((level * beyond).sum() * step) / mean**2 - 1.0
        leaves = 1.0 - float(both_above(np.array([mean]), float(by_map[1, 0]))[0]) * math.exp(mean)
        place = np.full(maps, leaves)
        place[[0, -1]] = 0.5 * (1.0 + leaves)
        pairs = np.correlate(place, place, "full")[maps - 1 :]
        other_way = np.roll(by_map[:, ::-1], 1, axis=1)
        first_order = pairs[0] * by_map[0] + pairs[1:] @ (by_map[1:] + other_way[1:])
        each = np.arange(maps, 0, -1) * np.where(np.arange(maps), 2.0, 1.0)
        freedom = maps**2 / float(each @ by_map[:, 0])
        share = min(1.0, 1.0 / (freedom * relative_variance))
        return cls(level, below, -np.log(beyond), mean, relative_variance, share, first_order / first_order[0])

    def quantile(self, share: float) -> float:
        """Level that ``share`` of the noise stays below."""
        return float(np.interp(math.log(share), self.below, self.level))

    def scale(self, kind: CfarKind, cells: float, p_fa: float, rank: float = 0.0, other: float = 0.0) -> float:
        """Factor between the noise statistic of such cells and the threshold; arguments as ``cfar_scale`` takes them.

        Returns:
            T of p_fa = E[1 - F(T S)], S the mean of ``cells`` or its greater or smaller half, or the quantile.
        """
        statistic, weight = self._of_rank(cells, rank) if kind == "os" else self._of_means(kind, cells, other)

        def log_p_fa(factor: float) -> float:
            return math.log(float(weight @ np.exp(-np.interp(factor * statistic, self.level, self.above))))

        wanted = math.log(p_fa)
        before = float(np.interp(-wanted, self.above, self.level)) / float(weight @ statistic)
        at_before = log_p_fa(before)
        factor = before * wanted / at_before
        for _ in range(ROUNDS):
            at_factor = log_p_fa(factor)
            if abs(at_factor - wanted) < TOLERANCE:
                break
            step = (wanted - at_factor) * (factor - before) / (at_factor - at_before)
            before, at_before, factor = factor, at_factor, max(factor + step, 0.5 * factor)
        return factor

    def _of_means(self, kind: CfarKind, cells: float, other: float) -> tuple[Float64, Float64]:
        """Values and probabilities of the mean or of the greater or smaller half."""
        halves = [count / self.relative_variance for count in (cells, other) if count > 0.0]
        reach = 8.0 / math.sqrt(min(halves))
        log = np.linspace(-reach, 0.7 * reach, STATISTIC_POINTS)
        density = [_normalised(n * (log - np.exp(log))) for n in halves]
        weight = density[0]
        if kind in ("go", "so") and len(density) == 2:
            lower = [np.cumsum(part) - 0.5 * part for part in density]
            if kind == "so":
                lower = [1.0 - part for part in lower]
            weight = density[0] * lower[1] + density[1] * lower[0]
        return self.mean * np.exp(log), weight / weight.sum()

    def _of_rank(self, cells: float, rank: float) -> tuple[Float64, Float64]:
        """Values and probabilities of the ordered statistic: F of it is beta distributed."""
        above = cells - rank + 1.0
        reach = 8.0 * math.sqrt(1.0 / rank + 1.0 / above)
        odds = math.log(rank / above) + np.linspace(-reach, reach, STATISTIC_POINTS)
        log_share, log_rest = -np.logaddexp(0.0, -odds), -np.logaddexp(0.0, odds)
        return np.interp(log_share, self.below, self.level), _normalised(rank * log_share + above * log_rest)


def both_above(level: Float64, correlation: float) -> Float64:
    """Probability that two exponential powers of this correlation both exceed ``level``."""
    if correlation >= 1.0:
        return np.exp(-level)
    cosines = COSINES if correlation > 0.5 else FEW_COSINES
    slope = (1.0 - correlation) / (1.0 + correlation + 2.0 * math.sqrt(correlation) * cosines)
    return np.asarray(np.exp(-level) * np.exp(-np.outer(level, slope)).mean(axis=1))


def _log_below(correlation: Float64, level: Float64) -> Float64:
    """ln F of the largest of maps whose powers have this correlation by their difference."""
    maps, one = len(correlation), np.log1p(-np.exp(-level))

    def pair(k: int) -> Float64:
        return np.asarray(np.log1p(both_above(level, float(correlation[k])) - 2.0 * np.exp(-level)))

    chain = (maps - 1) * pair(1) - (maps - 2) * one
    rising = np.flatnonzero(np.diff(correlation) > 0.0)
    if len(rising) == 0:
        return np.asarray(chain)
    stretches = chain / one / maps
    far = [(maps - k) * (pair(k) - 2.0 * one) for k in range(int(rising[0]) + 1, maps)]
    return np.asarray(chain + np.square(stretches) * np.sum(far, axis=0))


def _normalised(log: Float64) -> Float64:
    weight = np.exp(log - log.max())
    return np.asarray(weight / weight.sum())
