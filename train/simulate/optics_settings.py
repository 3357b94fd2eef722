# SPDX-License-Identifier: Apache-2.0
"""Settings of what the objects send back: steps, limits, ground."""

from __future__ import annotations

from dataclasses import dataclass, field

from edge.config import require
from train.simulate.ground import GroundSettings


@dataclass(frozen=True, slots=True)
class OpticsSettings:
    """What of the objects becomes scatterers.

    Args:
        visibility_step_m: z-buffers are made for the nearest point of a grid of this step.
        weight_step_m: physical-optics amplitudes too; ranges, pattern and ground are exact in every frame.
        picture: columns and rows of an object's z-buffer.
        keep_db: entries weaker by more than the object's strongest are left out.
        floor_db: entries weaker than the noise of one sample by more are left out (a frame integrates 43 dB).
        max_scatterers: strongest kept of all objects, clutter not counted.
        lobe_end: sqrt(q_t^2 A) beyond which a flat patch sends nothing: 14 is 10 degrees off for patches of 3.5 cm,
            where the lobe is 30 dB down.
        lobe_most_deg: angle off the normal beyond which no patch sends anything.
        ground: ground paths and clutter.
    """

    visibility_step_m: float = 0.10
    weight_step_m: float = 0.06
    picture: tuple[int, int] = (320, 160)
    keep_db: float = 30.0
    floor_db: float = -40.0
    max_scatterers: int = 1500
    lobe_end: float = 14.0
    lobe_most_deg: float = 25.0
    ground: GroundSettings = field(default_factory=GroundSettings)

    def __post_init__(self) -> None:
        require(0.001 <= self.weight_step_m <= 1.0, "optics.weight_step_m", self.weight_step_m, "0.001..1 m")
        step_m = self.visibility_step_m
        require(self.weight_step_m <= step_m <= 5.0, "optics.visibility_step_m", step_m, "weight_step_m..5 m")
        fits = all(16 <= side <= 8192 for side in self.picture)
        require(fits, "optics.picture", self.picture, "16..8192 columns and rows")
        require(3.0 <= self.keep_db <= 120.0, "optics.keep_db", self.keep_db, "3..120 dB")
        require(-200.0 <= self.floor_db <= 40.0, "optics.floor_db", self.floor_db, "-200..40 dB")
        require(1 <= self.max_scatterers <= 1_000_000, "optics.max_scatterers", self.max_scatterers, "1..1000000")
        require(1.0 <= self.lobe_end <= 1e6, "optics.lobe_end", self.lobe_end, ">= 1")
        require(1.0 <= self.lobe_most_deg <= 90.0, "optics.lobe_most_deg", self.lobe_most_deg, "1..90")
