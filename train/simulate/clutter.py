# SPDX-License-Identifier: Apache-2.0
"""The ground's own echo: random points that are fixed to the world and repeat in a square larger than the range."""

from __future__ import annotations

import numpy as np

from edge.frames import Complex64, Float32, Float64
from train.simulate.ground import GroundSettings
from train.simulate.points import board_factors


class GroundClutter:
    """Points of the ground around the radar.

    A point stands in every square of the pattern; the one nearest to the radar is used, so that a point moves by a
    whole square only where it is half a square away.

    Args:
        settings: how many, how strong.
        imbalance_db: standard deviation of the power between the boards.
        rng: of places, strengths (exponential power) and phases.
    """

    def __init__(self, settings: GroundSettings, imbalance_db: float, rng: np.random.Generator) -> None:
        count = settings.clutter_points if settings.enabled else 0
        self._span_m = settings.clutter_span_m
        self._place_m = rng.uniform(0.0, self._span_m, (count, 2))
        sigma_m2 = 10 ** (settings.clutter_db / 10) * self._span_m**2 / max(count, 1)
        phase = np.exp(2j * np.pi * rng.random(count))
        self.weight: Complex64 = (np.sqrt(sigma_m2 * rng.exponential(1.0, count)) * phase).astype(np.complex64)
        """sqrt(sigma) exp(j phase), m, complex64 [c]."""
        self.board: Float32 = board_factors(rng.normal(0.0, imbalance_db, count))
        """Amplitude factors of the boards, float32 [c, 2]."""

    def around(self, position_m: Float64) -> Float32:
        """Points relative to a place in the world, world axes, float32 [c, 3]."""
        relative = self._place_m - position_m[:2]
        relative -= self._span_m * np.rint(relative / self._span_m)
        return np.column_stack([relative, np.full(len(relative), -position_m[2])]).astype(np.float32)
