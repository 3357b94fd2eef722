# SPDX-License-Identifier: Apache-2.0
"""Tables of the CFAR by range cell: cells of the cut ring, threshold factors, shares."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.config import CfarSettings
from edge.dsp.effective_cells import Complex128, Ring, effective_rank, mean_cells, rank_cells, shared_noise
from edge.dsp.maximum import Maximum
from edge.dsp.threshold import cfar_scale, os_rank
from edge.frames import Float32, PointResponse

INDEPENDENT = np.array([1.0] + [0.0] * 128, dtype=np.complex128)
"""Correlation by distance of cells that share nothing; longer than twice any ring."""
ROUNDS = 4
"""Factor and effective number depend on each other; the number settles to 1e-4 within these."""
NO_HALF = np.float32(1e37)
"""Stands for the mean of a half without cells, so that it is never the smaller one."""


@dataclass(frozen=True, slots=True)
class RingTables:
    """What the CFAR needs for every range cell: the ring is cut at both ends of range.

    Args:
        first: first tested range cell; nearer ones take no part in any ring.
        cells: int64 [R], training cells of the whole ring.
        factor: float32 [R], threshold over the noise statistic.
        inverse_count: float32 [2, R]: 1 / cells of the whole ring ("ca", "os"; second row unused) or of the nearer and
            of the farther half ("go", "so"); 0 without cells.
        floor: float32 [2, R], added to the halves' means: 0, or more than any mean where "so" must not choose it.
        allowed: int64 [R], cells - rank.
    """

    first: int
    cells: NDArray[np.int64]
    factor: Float32
    inverse_count: Float32
    floor: Float32
    allowed: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        settings: CfarSettings,
        ranges: int,
        first: int,
        response: PointResponse | None = None,
        maximum: Maximum | None = None,
    ) -> RingTables:
        """Tables for ``ranges`` cells of which those below ``first`` do not count.

        Args:
            settings: ring, kind, probability.
            ranges, first: cells.
            response: gives the correlation of the cells; without one they count as independent.
            maximum: of the maps that every cell holds the largest of; none: one map.
        """
        along, across = INDEPENDENT, INDEPENDENT
        if settings.correlated and response is not None:
            along = INDEPENDENT if response.angle_correlation is None else response.angle_correlation
            if maximum is not None:
                along = np.sqrt(maximum.correlation).astype(np.complex128)
            across = INDEPENDENT if response.range_correlation is None else response.range_correlation
        factor, inverse = np.zeros(ranges, dtype=np.float32), np.zeros((2, ranges), dtype=np.float32)
        allowed, cells = np.zeros(ranges, dtype=np.int64), np.zeros(ranges, dtype=np.int64)
        cuts: dict[tuple[int, int], list[int]] = {}
        for r in range(ranges):
            cut = (max(first, r - settings.train_range) - r, min(ranges - 1, r + settings.train_range) - r)
            cuts.setdefault(cut, []).append(r)
        for cut, at in cuts.items():
            whole = _ring(settings, *cut)
            counted: tuple[Ring, ...] = (whole,)
            if settings.kind in ("go", "so"):
                counted = (_ring(settings, cut[0], min(cut[1], -1)), _ring(settings, max(cut[0], 1), cut[1]))
            cells[at], allowed[at] = whole.cells, whole.cells - os_rank(whole.cells, settings.os_quantile)
            for half, part in enumerate(counted):
                inverse[half, at] = 1.0 / part.cells if part.cells else 0.0
            factor[at] = _scale(settings, counted, along, across, maximum)
        floor = np.where((inverse == 0.0) & (settings.kind == "so"), NO_HALF, np.float32(0.0))
        return cls(first, cells, factor, inverse, floor, allowed)


def _ring(settings: CfarSettings, low: int, high: int) -> Ring:
    """The ring's cells at range offsets ``low``..``high`` from the tested cell."""
    angle = np.arange(-settings.train_angle, settings.train_angle + 1)
    ranges = np.arange(-settings.train_range, settings.train_range + 1)
    inside = (ranges >= low) & (ranges <= high)
    guarded = inside & (np.abs(ranges) <= settings.guard_range)
    beside = np.abs(angle) <= settings.guard_angle
    return Ring(np.ones(len(angle)), beside.astype(float), inside.astype(float), guarded.astype(float))


def _scale(
    settings: CfarSettings, counted: tuple[Ring, ...], along: Complex128, across: Complex128, maximum: Maximum | None
) -> float:
    """Threshold factor of one cut ring, infinite where nothing is left of it."""
    cells = sum(ring.cells for ring in counted)
    if cells == 0:
        return float("inf")
    share = 1.0 if maximum is None else maximum.share
    shared = [shared_noise(ring, along, across, share) for ring in counted if ring.cells]
    scale = cfar_scale if maximum is None else maximum.scale
    level = 1.0
    if settings.kind == "os":
        rank = os_rank(cells, settings.os_quantile)
        quantile = (rank - 0.5) / cells
        effective = rank_cells(counted[0], along, across, quantile, share)
        factor = scale("os", effective, settings.p_fa, effective_rank(rank, cells, effective))
        level = -math.log1p(-quantile) if maximum is None else maximum.quantile(quantile) / maximum.mean
    else:
        factor = -math.log(settings.p_fa)
        for _ in range(ROUNDS if maximum is None else 1):
            halves = [mean_cells(ring, along, across, factor, share) for ring in counted]
            factor = scale(settings.kind, halves[0], settings.p_fa, other=halves[-1])
    k = sum(shared) / len(shared)
    return factor / (1.0 - k + factor * level * k)
