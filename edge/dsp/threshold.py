# SPDX-License-Identifier: Apache-2.0
"""Threshold factors of CFAR detectors from the designed false-alarm probability, on exponential power."""

from __future__ import annotations

import math
from collections.abc import Callable

from edge.config import CfarKind, require

BISECTIONS = 200
FRACTION_TERMS = 500
SMALLEST = 1e-300


def cfar_scale(kind: CfarKind, cells: float, p_fa: float, rank: float = 0.0, other: float = 0.0) -> float:
    """Factor between the noise statistic and the threshold.

    Args:
        kind: "ca": factor on the mean of the cells; "os": on the ``rank``-th smallest of them; "go", "so": on the
            greater or the smaller of the means of ``cells`` and of ``other`` cells.
        cells: independent training cells N; need not be whole (an effective number, edge/dsp/effective_cells.py).
        p_fa: designed probability.
        rank: k of the ordered statistic, more than 0, at most N + 1/2; only for "os".
        other: cells M of the other half; only for "go" and "so". A half of 0 cells takes no part.
    Returns:
        The root T of p_fa = P(T), with g(N) = (1 + T / N)^-N and I the regularised incomplete beta function:
        CA: g(N), exact for the sum of N exponentials (gamma distribution).
        SO: g(N) I(x; N, M) + g(M) I(y; M, N), x = (N + T) / (N + M + T), y = (M + T) / (N + M + T).
        GO: g(N) + g(M) - SO.
        OS: Gamma(N + 1) Gamma(N - k + 1 + T) / (Gamma(N - k + 1) Gamma(N + 1 + T)).
    Raises:
        ConfigError: no cells, or a rank outside them.
    Source: Finn and Johnson 1968; Rohling 1983, eq. 17. Halves: exp(-T m) of the smaller mean m is exp(-T m1) where
        m1 < m2; weighing the gamma density of m1 by exp(-T m1) leaves g(N) times a gamma density of rate N + T, and
        the probability that it stays below m2 is a beta distribution's. Whole, equal N: Weiss 1982.
    """
    if kind in ("go", "so") and min(cells, other) <= 0.0 < max(cells, other):
        kind, cells = "ca", max(cells, other)
    require(cells > 0.0, "cfar training cells", cells, "> 0", "enlarge cfar.train_range or cfar.train_angle")
    if kind == "ca":
        return cells * math.expm1(-math.log(p_fa) / cells)
    if kind == "os":
        require(0.0 < rank <= cells + 0.5, "cfar rank", rank, f"1..{cells:g}")
        return _root(lambda factor: _log_p_fa_os(cells, rank, factor), math.log(p_fa))
    return _root(lambda factor: _log_p_fa_halves(kind == "go", cells, other, factor), math.log(p_fa))


def os_rank(cells: int, quantile: float) -> int:
    """Rank of the ordered statistic among ``cells``: the nearest to ``quantile`` of them, at least 1."""
    return min(cells, max(1, round(quantile * cells)))


def incomplete_beta(a: float, b: float, x: float) -> float:
    """Regularised incomplete beta function I_x(a, b), a, b > 0, by its continued fraction (DLMF 8.17.22)."""
    if x <= 0.0 or x >= 1.0:
        return float(x >= 1.0)
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - incomplete_beta(b, a, 1.0 - x)
    log_front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    fraction, c, d = 1.0, 1.0, 0.0
    for n in range(FRACTION_TERMS):
        m = n // 2
        if n == 0:
            term = 1.0
        elif n % 2 == 0:
            term = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        else:
            term = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        d = 1.0 / _away_from_zero(1.0 + term * d)
        c = _away_from_zero(1.0 + term / c)
        fraction *= c * d
        if abs(c * d - 1.0) < 1e-15:
            break
    return math.exp(log_front) / a * (fraction - 1.0)


def _away_from_zero(value: float) -> float:
    return value if abs(value) > SMALLEST else SMALLEST


def _root(log_p_fa: Callable[[float], float], wanted: float) -> float:
    """Factor at which a falling log probability is the wanted one."""
    low, high = 0.0, 1.0
    while log_p_fa(high) > wanted:
        high *= 2.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        if log_p_fa(middle) > wanted:
            low = middle
        else:
            high = middle
    return high


def _log_p_fa_os(cells: float, rank: float, factor: float) -> float:
    above = cells - rank + 1.0
    return (math.lgamma(cells + 1.0) - math.lgamma(cells + 1.0 + factor)) - (
        math.lgamma(above) - math.lgamma(above + factor)
    )


def _log_p_fa_halves(greatest: bool, n: float, m: float, factor: float) -> float:
    """GO swaps every incomplete beta function for its complement: g(N) (1 - I) + g(M) (1 - I)."""
    total = 0.0
    for a, b in ((n, m), (m, n)):
        x = (a + factor) / (a + b + factor)
        share = incomplete_beta(b, a, b / (a + b + factor)) if greatest else incomplete_beta(a, b, x)
        total += share * math.exp(-a * math.log1p(factor / a))
    return math.log(max(total, SMALLEST))
