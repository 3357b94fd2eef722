# SPDX-License-Identifier: Apache-2.0
"""Effective number of independent cells of a CFAR ring from the autocorrelation of windowed noise.

Noise of a linear chain is complex Gaussian in every cell; its power is exponential with the correlation
c_ij = |rho_ij|^2 between two cells, rho_ij = rho_a(da) rho_r(dr) the normalised transforms of the noise power along
the tapers (``noise_correlation``). A statistic of N correlated cells scatters as that of N_e independent ones.

CA, GO, SO: the mean of N cells has the variance v = sum_ij c_ij / N^2, that of N_e independent ones 1 / N_e:

    N_e = N^2 / sum_ij c_ij.

False alarms come from low means, where the skewness counts: s = 2 tr(rho^3) / (N^3 v^(3/2)) is more than a gamma
distribution's 2 sqrt(v). With a the mean of a gamma distribution of n = 4 / s^2 degrees and the rest 1 - a constant,
all three moments agree when a^2 = n v, and exp(-T m) has the mean exp(-T (1 - a)) (1 + a T / n)^-n. N_e is refined so
that (1 + T / N_e)^-N_e, which the thresholds take, is the same at the factor T in use.

OS: the share of cells below x has the variance sum_ij C_ij(x) / N^2, that of N_e independent ones F (1 - F) / N_e,
F = 1 - exp(-x) the quantile. Two exponential powers of correlation c have the density exp(-x - y) sum_n c^n L_n(x)
L_n(y), L_n the Laguerre polynomials (Kibble 1941), hence

    C_ij = sum_{n >= 1} c_ij^n q_n^2,  q_n = exp(-x) (L_n(x) - L_{n-1}(x)),    N_e = N^2 F (1 - F) / sum_ij C_ij.

Every c^n is a product over both axes and a ring is a box less a box, so that no sum runs over pairs of cells.

The tested cell, of power X, shares noise with its ring as well: given X, the mean of a ring, and in first order every
quantile, is 1 - k + k X times its own, k = sum_j c_0j / N. X > T m (1 - k + k X) is X > T' m with T' = T (1 - k) /
(1 - T m k), so that a factor T' for independent cells becomes T = T' / (1 - k + T' m k), m = 1 or the quantile x.

Cells that hold the largest of several maps have another correlation C, and beta C / (1 - (1 - beta) C) in the place of
c, sum_n beta (1 - beta)^(n-1) C^n (edge/dsp/maximum.py); powers of C are products over both axes as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.frames import Float64

Complex128 = NDArray[np.complex128]
HALVINGS = 60
ORDERS = 128
"""Terms of the expansion; what is left of it beyond counts on the diagonal, where it converges slowest."""
REST = 1e-9


def noise_correlation(noise: Float64, bins: int) -> Complex128:
    """Correlation of the noise of two bins of an FFT, by their distance.

    Args:
        noise: [n] noise power at the input of the FFT, after the taper.
        bins: FFT length, at least n.
    Returns:
        complex128 [bins], periodic, sum_n noise_n exp(-2j pi n d / bins) / sum noise.
    """
    return np.asarray(np.fft.fft(noise, bins) / noise.sum())


@dataclass(frozen=True, slots=True)
class Ring:
    """Cells of a ring as a box less a guard box; each box is a product of two sets of offsets.

    Args:
        angle, guard_angle: [a] 0 or 1 for every angle offset.
        ranges, guard_ranges: [r] 0 or 1 for every range offset.
    """

    angle: Float64
    guard_angle: Float64
    ranges: Float64
    guard_ranges: Float64

    @property
    def cells(self) -> int:
        """Cells of the ring."""
        return round(float(self.angle.sum() * self.ranges.sum() - self.guard_angle.sum() * self.guard_ranges.sum()))

    def pair_sum(self, along: Complex128, across: Complex128, order: NDArray[np.int64]) -> Float64:
        """Sums of c_ij^n over all pairs of cells.

        Args:
            along, across: [lags] correlation of the noise in angle and in range.
            order: [n] the powers.
        Returns:
            float64 [n].
        """
        forms = []
        for correlation, box, guard in (
            (along, self.angle, self.guard_angle),
            (across, self.ranges, self.guard_ranges),
        ):
            lag = np.arange(1 - len(box), len(box)) % len(correlation)
            pairs = [np.correlate(one, other, "full") for one, other in ((box, box), (box, guard), (guard, guard))]
            forms.append(np.square(np.abs(correlation[lag])) ** order[:, None] @ np.stack(pairs, axis=1))
        return np.asarray((forms[0] * forms[1]) @ np.array([1.0, -2.0, 1.0]))

    def triple_sum(self, along: Complex128, across: Complex128) -> float:
        """Sum of rho_ij rho_jk rho_ki over all triples of cells, tr(rho^3)."""
        total = np.array([1.0, -3.0, 3.0, -1.0], dtype=np.complex128)
        for matrix, box, guard in (
            (_matrix(self.angle, along), self.angle, self.guard_angle),
            (_matrix(self.ranges, across), self.ranges, self.guard_ranges),
        ):
            in_box, in_guard = matrix * box, matrix * guard
            squares = in_box @ in_box, in_box @ in_guard, in_guard @ in_guard
            total *= [np.trace(squares[0] @ in_box), *(np.trace(square @ in_guard) for square in squares)]
        return float(total.sum().real)


def _matrix(offsets: Float64, correlation: Complex128) -> Complex128:
    """Correlation of every pair of offsets; ``correlation`` is periodic or longer than twice the ring."""
    offset = np.arange(len(offsets))
    return np.asarray(correlation[(offset[:, None] - offset[None, :]) % len(correlation)])


def mean_cells(ring: Ring, along: Complex128, across: Complex128, factor: float, share: float = 1.0) -> float:
    """N_e of the mean of a ring's cells for a threshold ``factor``; 0 for an empty ring; ``share``: beta above."""
    if ring.cells == 0:
        return 0.0
    variance = float(ring.pair_sum(along, across, np.array([1]))[0]) / ring.cells**2
    skewness = 2.0 * ring.triple_sum(along, across) / (ring.cells**3 * variance**1.5)
    degrees = 4.0 / skewness**2
    scale = math.sqrt(degrees * variance)
    exponent = factor * (1.0 - scale) + degrees * math.log1p(factor * scale / degrees)
    low, high = 0.0, 2.0 / variance
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if middle * math.log1p(factor / middle) < exponent:
            low = middle
        else:
            high = middle
    if share == 1.0:
        return high
    orders = _orders(share)
    return high * variance * ring.cells**2 / float(_geometric(share, orders) @ ring.pair_sum(along, across, orders))


def rank_cells(ring: Ring, along: Complex128, across: Complex128, quantile: float, share: float = 1.0) -> float:
    """N_e of the ordered statistic at ``quantile`` (between 0 and 1); 0 for an empty ring; ``share``: beta above."""
    if ring.cells == 0:
        return 0.0
    variance = quantile * (1.0 - quantile)
    weight = _thinned(_laguerre_weights(-math.log1p(-quantile)), share)
    total = float(weight @ ring.pair_sum(along, across, np.arange(1, ORDERS + 1)))
    rest = max(variance - float(weight.sum()), 0.0)
    return ring.cells**2 * variance / (total + rest * ring.cells)


def shared_noise(ring: Ring, along: Complex128, across: Complex128, share: float = 1.0) -> float:
    """k, the mean correlation of a ring's cells with the tested cell in its middle; 0 for an empty ring."""
    if ring.cells == 0:
        return 0.0
    orders = _orders(share)
    box = _from_middle(ring.angle, along, orders) * _from_middle(ring.ranges, across, orders)
    guard = _from_middle(ring.guard_angle, along, orders) * _from_middle(ring.guard_ranges, across, orders)
    return float(_geometric(share, orders) @ (box - guard)) / ring.cells


def _from_middle(box: Float64, correlation: Complex128, orders: NDArray[np.int64]) -> Float64:
    offset = np.arange(len(box)) - len(box) // 2
    return np.asarray(np.square(np.abs(correlation[offset % len(correlation)])) ** orders[:, None] @ box)


def _orders(share: float) -> NDArray[np.int64]:
    """Powers whose coefficients add up to 1 within ``REST``."""
    count = 1 if share == 1.0 else min(math.ceil(math.log(REST) / math.log1p(-share)), ORDERS)
    return np.arange(1, count + 1)


def _geometric(share: float, orders: NDArray[np.int64]) -> Float64:
    """Coefficients of beta c / (1 - (1 - beta) c); the last takes what is left, so that c = 1 stays 1."""
    weight = share * (1.0 - share) ** (orders - 1.0)
    weight[-1] += 1.0 - weight.sum()
    return np.asarray(weight)


def _thinned(weight: Float64, share: float) -> Float64:
    """Coefficients of sum_m w_m (beta c / (1 - (1 - beta) c))^m in powers of c: negative binomial.

    The coefficient of c^n in the m-th power is that of c^(n - 1) in the (m - 1)-th, times beta, plus that of c^(n - 1)
    in the m-th, times 1 - beta.
    """
    if share == 1.0:
        return weight
    row, thinned = np.zeros(len(weight) + 1), np.zeros(len(weight))
    row[0] = 1.0
    for n in range(len(weight)):
        row = np.concatenate(([0.0], share * row[:-1] + (1.0 - share) * row[1:]))
        thinned[n] = row[1:] @ weight
    return thinned


def effective_rank(rank: int, cells: int, effective: float) -> float:
    """Rank among ``effective`` cells at the same share, each share taken at the middle of its step: (k - 1/2) / N."""
    return 0.5 + (rank - 0.5) * effective / cells


def _laguerre_weights(x: float) -> Float64:
    """q_n^2 for n = 1..ORDERS by the recurrence (n + 1) L_{n+1} = (2 n + 1 - x) L_n - n L_{n-1}."""
    before, here, weights = 1.0, 1.0 - x, []
    for n in range(1, ORDERS + 1):
        weights.append((math.exp(-x) * (here - before)) ** 2)
        before, here = here, ((2 * n + 1 - x) * here - n * before) / (n + 1)
    return np.array(weights)
