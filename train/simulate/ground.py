# SPDX-License-Identifier: Apache-2.0
"""The ground as a mirror: settings and the reflection coefficient of a rough dielectric half-space."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from numba import njit

from edge.config import require
from edge.frames import RadarId

Polarization = Literal["H", "V"]


@dataclass(frozen=True, slots=True)
class GroundSettings:
    """Flat ground z = 0.

    Args:
        enabled: paths by way of the ground exist.
        permittivity: real relative permittivity (asphalt and concrete 3..5).
        roughness_m: rms height; lowers the mirror's amplitude by exp(-2 (2 pi s sin(psi) / lambda)^2).
        horizontal_board: polarisation of the board with the horizontal array; the other one, turned by 90 degrees, has
            the other. H lies in the ground's plane. No data sheet names it.
        clutter_points: world-fixed random points of the ground itself in every clutter_span_m squared; 0 = none.
            Eight a square metre: fewer would stand out one by one, as no ground does.
        clutter_db: their mean radar cross-section for each square metre, dB.
        clutter_span_m: side of the square in which the points repeat; points stand at most half of it away.
    """

    enabled: bool = True
    permittivity: float = 4.0
    roughness_m: float = 1e-3
    horizontal_board: Polarization = "V"
    clutter_points: int = 8192
    clutter_db: float = -28.0
    clutter_span_m: float = 32.0

    def __post_init__(self) -> None:
        require(1.0 < self.permittivity <= 100.0, "ground.permittivity", self.permittivity, "1..100")
        require(0.0 <= self.roughness_m <= 0.1, "ground.roughness_m", self.roughness_m, "0..0.1 m")
        require(self.horizontal_board in ("H", "V"), "ground.horizontal_board", self.horizontal_board, "H, V")
        require(0 <= self.clutter_points <= 100_000, "ground.clutter_points", self.clutter_points, "0..100000")
        require(-80.0 <= self.clutter_db <= 10.0, "ground.clutter_db", self.clutter_db, "-80..10 dB")
        require(1.0 <= self.clutter_span_m <= 500.0, "ground.clutter_span_m", self.clutter_span_m, "1..500 m")

    def polarization(self, radar: RadarId) -> Polarization:
        """Of one board."""
        if radar == "horizontal":
            return self.horizontal_board
        return "H" if self.horizontal_board == "V" else "V"


@njit(cache=True, nogil=True, error_model="numpy")
def mirror(
    sine: float, permittivity: float, horizontal: bool, roughness: float
) -> float:  # pragma: no cover - compiled
    """``ground_reflection`` for kernels; ``roughness``: (2 pi s / lambda)^2."""
    root = math.sqrt(permittivity - 1.0 + sine * sine)
    numerator = sine if horizontal else permittivity * sine
    return (numerator - root) / (numerator + root) * math.exp(-2.0 * roughness * sine * sine)


def ground_reflection(
    sine: float, permittivity: float, polarization: Polarization, roughness_m: float, wavelength_m: float
) -> float:
    """Amplitude reflection coefficient of the ground; negative: turned by 180 degrees.

    Args:
        sine: of the grazing angle.
        permittivity: relative, real.
        polarization: H: field in the ground's plane; V: in the plane of incidence.
        roughness_m: rms height.
        wavelength_m: of the radar.
    Returns:
        -1 at grazing incidence for both polarisations.
    Source: Fresnel equations; Ament's roughness factor exp(-2 (2 pi s sin(psi) / lambda)^2).
    """
    return float(mirror(sine, permittivity, polarization == "H", (2.0 * math.pi * roughness_m / wavelength_m) ** 2))
