# SPDX-License-Identifier: Apache-2.0
"""CFAR from its definition in float64: every cell gathers its own ring."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from edge.config import CfarSettings
from edge.frames import Float64


def ring_values(power: Float64, a: int, r: int, settings: CfarSettings, first: int, side: int = 0) -> Float64:
    """Training cells of cell (a, r): inside the training box, outside the guard box, periodic in angle.

    Args:
        power: [angle, range], as received: without the compensation of the antenna pattern.
        a, r: cell under test.
        settings: half widths.
        first: range cells below take no part.
        side: -1: only cells nearer than r, 1: only farther ones, 0: all.
    Returns:
        float64 [cells].
    """
    angles, ranges = power.shape
    values = []
    for da in range(-settings.train_angle, settings.train_angle + 1):
        for dr in range(-settings.train_range, settings.train_range + 1):
            guarded = abs(da) <= settings.guard_angle and abs(dr) <= settings.guard_range
            if not guarded and first <= r + dr < ranges and (side == 0 or side * dr > 0):
                values.append(power[(a + da) % angles, r + dr])
    return np.array(values, dtype=np.float64)


def statistic(power: Float64, a: int, r: int, settings: CfarSettings, first: int) -> float:
    """Noise around a cell: the ring's mean (CA), the ordered statistic of the rank nearest to the quantile (OS), the
    greater (GO) or smaller (SO) mean of its nearer and farther half; arguments as for ``ring_values``.
    """
    if settings.kind in ("go", "so"):
        halves = [ring_values(power, a, r, settings, first, side) for side in (-1, 1)]
        means = [float(half.mean()) for half in halves if len(half) > 0]
        return max(means) if settings.kind == "go" else min(means)
    values = ring_values(power, a, r, settings, first)
    if settings.kind == "ca":
        return float(values.mean())
    rank = min(len(values), max(1, round(settings.os_quantile * len(values))))
    return float(np.sort(values)[rank - 1])


def decisions(
    power: Float64, settings: CfarSettings, first: int, factor: Callable[[int], float], cells: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Decision of chosen cells.

    Args:
        power: [angle, range], as received.
        settings: ring and kind.
        first: first range cell that counts.
        factor: threshold factor at a range cell.
        cells: [n, 2] pairs (angle, range), ranges not below ``first``.
    Returns:
        bool [n].
    """
    decided = []
    for a, r in cells.tolist():
        decided.append(power[a, r] > factor(r) * statistic(power, a, r, settings, first))
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


def false_alarm_probability(kind: str, cells: int, rank: int, factor: float, other: int = 0) -> float:
    """Probability that an exponential cell exceeds ``factor`` times the statistic of ``cells`` like it.

    Args:
        kind: "ca", "os", "go" or "so".
        cells: training cells N.
        rank: k of the ordered statistic.
        factor: threshold factor.
        other: cells of the other half ("go", "so").
    Returns:
        CA: (1 + factor / N)^-N. OS: N! Gamma(N - k + 1 + factor) / ((N - k)! Gamma(N + 1 + factor)) as a product.
        GO, SO: integral of exp(-factor m) over the density of the greater or smaller of two gamma distributed means.
    Source: Finn and Johnson 1968; Rohling 1983; Weiss 1982.
    """
    if kind in ("go", "so"):
        return _halves_probability(kind == "go", cells, other, factor)
    if kind == "ca":
        return float((1.0 + factor / cells) ** -cells)
    remaining = np.arange(cells - rank + 1, cells + 1, dtype=np.float64)
    return float(np.prod(remaining / (remaining + factor)))


def _halves_probability(greatest: bool, cells: int, other: int, factor: float) -> float:
    """By the trapezoidal rule on a logarithmic axis, in 200,000 steps."""
    log_m = np.linspace(-25.0, 5.0, 200_001)
    step, m = log_m[1] - log_m[0], np.exp(log_m)
    density, below = [], []
    for n in (cells, other):
        log_density = n * math.log(n) + n * log_m - n * m - math.lgamma(n)
        density.append(np.exp(log_density))
        steps = 0.5 * step * (density[-1][1:] + density[-1][:-1])
        below.append(np.concatenate(((0.0,), np.cumsum(steps))))
    if not greatest:
        below = [1.0 - share for share in below]
    total = np.exp(-factor * m) * (density[0] * below[1] + density[1] * below[0])
    return float(total.sum() * step)
