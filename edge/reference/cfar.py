# SPDX-License-Identifier: Apache-2.0
"""CFAR from its definition in float64: every cell gathers its own ring."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from edge.config import CfarSettings
from edge.frames import Float64


def ring_values(power: Float64, a: int, r: int, settings: CfarSettings, first: int) -> Float64:
    """Training cells of cell (a, r): inside the training box, outside the guard box, periodic in angle.

    Args:
        power: [angle, range].
        a, r: cell under test.
        settings: half widths.
        first: range cells below take no part.
    Returns:
        float64 [cells].
    """
    angles, ranges = power.shape
    values = []
    for da in range(-settings.train_angle, settings.train_angle + 1):
        for dr in range(-settings.train_range, settings.train_range + 1):
            guarded = abs(da) <= settings.guard_angle and abs(dr) <= settings.guard_range
            if not guarded and first <= r + dr < ranges:
                values.append(power[(a + da) % angles, r + dr])
    return np.array(values, dtype=np.float64)


def statistic(values: Float64, settings: CfarSettings) -> float:
    """Mean (CA), or the ordered statistic of the rank nearest to the quantile (OS)."""
    if settings.kind == "ca":
        return float(values.mean())
    rank = min(len(values), max(1, round(settings.os_quantile * len(values))))
    return float(np.sort(values)[rank - 1])


def decisions(
    power: Float64, settings: CfarSettings, first: int, factor: Callable[[int], float], cells: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Decision of chosen cells.

    Args:
        power: [angle, range].
        settings: ring and kind.
        first: first range cell that counts.
        factor: threshold factor for a number of training cells.
        cells: [n, 2] pairs (angle, range), ranges not below ``first``.
    Returns:
        bool [n].
    """
    decided = []
    for a, r in cells.tolist():
        values = ring_values(power, a, r, settings, first)
        decided.append(power[a, r] > factor(len(values)) * statistic(values, settings))
    return np.array(decided, dtype=np.bool_)


def is_local_maximum(received: Float64, a: int, r: int) -> bool:
    """Whether a cell holds the largest of its 3 x 3 neighbourhood; of equal ones the first in raster order does.

    Args:
        received: [angle, range], periodic in angle, power before the compensation of the antenna pattern.
        a, r: the cell.
    """
    angles, ranges = received.shape
    rows, columns = [(a + d) % angles for d in (-1, 0, 1)], [c for c in (r - 1, r, r + 1) if 0 <= c < ranges]
    order = sorted((-received[row, c], row, c) for row in rows for c in columns)
    return order[0][1:] == (a, r)


def false_alarm_probability(kind: str, cells: int, rank: int, factor: float) -> float:
    """Probability that an exponential cell exceeds ``factor`` times the statistic of ``cells`` like it.

    Args:
        kind: "ca" or "os".
        cells: training cells N.
        rank: k of the ordered statistic.
        factor: threshold factor.
    Returns:
        CA: (1 + factor / N)^-N. OS: N! Gamma(N - k + 1 + factor) / ((N - k)! Gamma(N + 1 + factor)) as a product.
    Source: Finn and Johnson 1968; Rohling 1983.
    """
    if kind == "ca":
        return float((1.0 + factor / cells) ** -cells)
    remaining = np.arange(cells - rank + 1, cells + 1, dtype=np.float64)
    return float(np.prod(remaining / (remaining + factor)))
