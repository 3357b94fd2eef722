# SPDX-License-Identifier: Apache-2.0
"""Threshold factors of CFAR detectors from the designed false-alarm probability, on exponential power."""

from __future__ import annotations

import math

from edge.config import CfarKind, require

BISECTIONS = 200


def cfar_scale(kind: CfarKind, cells: int, p_fa: float, rank: int = 0) -> float:
    """Factor between the noise statistic and the threshold.

    Args:
        kind: "ca": factor on the mean of the cells; "os": factor on the ``rank``-th smallest of them.
        cells: independent training cells N.
        p_fa: designed probability.
        rank: k of the ordered statistic, 1..N; not used by "ca".
    Returns:
        CA: N (P^(-1/N) - 1), exact for the sum of N exponentials (gamma distribution).
        OS: the root alpha of P = prod_{i<k} (N - i) / (N - i + alpha).
    Raises:
        ConfigError: no cells, or a rank outside them.
    Source: Finn and Johnson 1968; Rohling 1983, eq. 17.
    """
    require(cells >= 1, "cfar training cells", cells, ">= 1", "enlarge cfar.train_range or cfar.train_angle")
    if kind == "ca":
        return cells * math.expm1(-math.log(p_fa) / cells)
    require(1 <= rank <= cells, "cfar rank", rank, f"1..{cells}")
    low, high = 0.0, 1.0
    while _log_p_fa_os(cells, rank, high) > math.log(p_fa):
        high *= 2.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        if _log_p_fa_os(cells, rank, middle) > math.log(p_fa):
            low = middle
        else:
            high = middle
    return high


def os_rank(cells: int, quantile: float) -> int:
    """Rank of the ordered statistic among ``cells``: the nearest to ``quantile`` of them, at least 1."""
    return min(cells, max(1, round(quantile * cells)))


def _log_p_fa_os(cells: int, rank: int, factor: float) -> float:
    return sum(math.log((cells - i) / (cells - i + factor)) for i in range(rank))
