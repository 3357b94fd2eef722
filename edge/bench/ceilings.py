# SPDX-License-Identifier: Apache-2.0
"""What this machine allows and what a stage asks of it: bytes against a copy, flops against a matrix product."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from edge.config import CfarSettings, HeatmapSettings
from edge.rig import Radar

CACHE_BYTES, MEMORY_BYTES = 256 * 2**10, 64 * 2**20
"""Size of the copied array: source and destination stay in a level-2 cache, or leave every cache."""
MATRIX = 512
REPETITIONS = 30


@dataclass(frozen=True, slots=True)
class Ceilings:
    """Of one core.

    Args:
        cache_gb_s, memory_gb_s: bytes read and written by a copy, per second.
        gflop_s: float32 matrix product of NumPy's BLAS, 512 x 512.
    """

    cache_gb_s: float
    memory_gb_s: float
    gflop_s: float


@dataclass(frozen=True, slots=True)
class Work:
    """Of one stage and frame.

    Args:
        bytes: read and written at least: every array once.
        flops: additions and multiplications; FFTs as 5 n log2 n, although the first angle stage is pruned.
    """

    bytes: int
    flops: int


def ceilings() -> Ceilings:
    """Best of some repetitions each; BLAS must have been limited to one thread before NumPy was imported."""
    a = np.ones((MATRIX, MATRIX), dtype=np.float32)
    out = np.zeros_like(a)
    flops = 2 * MATRIX**3
    return Ceilings(_copy_gb_s(CACHE_BYTES), _copy_gb_s(MEMORY_BYTES), flops / _best_s(lambda: np.dot(a, a, out)) / 1e9)


def _copy_gb_s(size: int) -> float:
    source, target = np.ones(size // 8), np.zeros(size // 8)
    return 2 * size / _best_s(lambda: np.copyto(target, source)) / 1e9


def _best_s(call: Callable[[], object]) -> float:
    call()
    best = math.inf
    for _ in range(REPETITIONS):
        start_ns = time.perf_counter_ns()
        call()
        best = min(best, time.perf_counter_ns() - start_ns)
    return best / 1e9


def heatmap_work(radar: Radar, settings: HeatmapSettings, points: int) -> Work:
    """Loop sum, window, range FFT, focusing, row, angle FFT and power of one burst without motion.

    Args:
        radar: a cascade.
        settings: angle bins.
        points: range bins.
    """
    layout, bins = radar.schedule.layout, settings.angle_bins
    position = np.asarray(radar.array.position)
    inside = position[position >= 0]
    count = int(inside.max() - inside.min()) + 1
    raw, spectra, row = layout.channels * layout.samples, layout.channels * points, len(inside) * points
    moved = 4 * raw * layout.loops + 8 * spectra * 2 + 8 * row * 2 + 8 * count * points * 2 + 4 * bins * points
    range_flops = raw * 2 * layout.loops + spectra * (6 + 5 * math.log2(points))
    angle_flops = points * bins * (5 * math.log2(bins) + 4)
    return Work(moved, round(range_flops + 14 * row + angle_flops))


def ring_work(settings: CfarSettings, bins: int, points: int) -> Work:
    """Ring mean of every cell by sums along range, then along angle, and the threshold."""
    along = 2 * settings.train_range + 1
    across = 2 * settings.train_angle + 1
    return Work(32 * bins * points, (along + across + 3) * bins * points)
