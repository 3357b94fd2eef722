# SPDX-License-Identifier: Apache-2.0
"""What the surfaces of each class reflect at 77 GHz: ranges that every component of an object is drawn from.

Amplitude reflection at normal incidence from refractive indices (OpenMATERIAL, 77 GHz): metal 0.95, glass 0.43,
concrete and asphalt 0.32, acrylic glass 0.23, plastic 0.19; skin about 0.6, less through cloth. The meshes hold no
materials, so a component's value is drawn. No measurement has confirmed the ranges; ``rcs.py`` shows what follows.
"""

from __future__ import annotations

from dataclasses import dataclass

from edge.config import require
from train.objects.mesh import CLASSES, ClassName


@dataclass(frozen=True, slots=True)
class Material:
    """Ranges (low, high) of one class of objects.

    Args:
        reflection: amplitude reflection coefficient of a component, uniform.
        largest_reflection: the same of the component with the largest area (a car's body is metal).
        roughness_m: rms height s of a component, log-uniform; its coherent part is exp(-(4 pi s cos / lambda)^2 / 2).
        diffuse: share rho of the incident power that is scattered diffusely, log-uniform (sigma = 4 rho A cos^2).
        edge: strength D of crease edges, uniform (sqrt(sigma) = l D / sqrt(pi)).
        point_dbsm: radar cross-section of a persistent point, uniform in dB.
        points: how many persistent points (wheels, lamps, concave corners), uniform.
        imbalance_db: standard deviation of a scatterer's power on the horizontal over that on the vertical board.
    """

    reflection: tuple[float, float]
    largest_reflection: tuple[float, float]
    roughness_m: tuple[float, float]
    diffuse: tuple[float, float]
    edge: tuple[float, float]
    point_dbsm: tuple[float, float]
    points: tuple[int, int]
    imbalance_db: float

    def __post_init__(self) -> None:
        for name, low, high in (
            ("reflection", 0.0, 1.0),
            ("largest_reflection", 0.0, 1.0),
            ("roughness_m", 1e-7, 0.05),
            ("diffuse", 1e-7, 1.0),
            ("edge", 0.0, 2.0),
            ("point_dbsm", -80.0, 40.0),
            ("points", 0, 200),
        ):
            first, last = getattr(self, name)
            require(low <= first <= last <= high, f"material.{name}", (first, last), f"{low} <= low <= high <= {high}")
        require(0.0 <= self.imbalance_db <= 20.0, "material.imbalance_db", self.imbalance_db, "0..20")


CAR = Material((0.3, 1.0), (0.8, 1.0), (5e-6, 3e-5), (1e-3, 1e-2), (0.2, 0.6), (-20.0, 3.0), (6, 18), 2.0)
BICYCLE = Material((0.3, 1.0), (0.3, 1.0), (5e-6, 1e-4), (2e-2, 1e-1), (0.2, 0.6), (-30.0, -12.0), (3, 8), 4.0)
MOTORCYCLE = Material((0.3, 1.0), (0.3, 1.0), (5e-6, 1e-4), (1e-2, 5e-2), (0.2, 0.6), (-25.0, -5.0), (4, 10), 3.0)
PEDESTRIAN = Material((0.2, 0.5), (0.2, 0.5), (1e-3, 5e-3), (5e-2, 1.5e-1), (0.0, 0.2), (-35.0, -20.0), (2, 5), 2.0)
WALL = Material((0.25, 0.4), (0.25, 0.4), (3e-4, 1e-3), (1e-2, 5e-2), (0.0, 0.2), (-40.0, -30.0), (0, 0), 1.0)
"""Concrete or plaster; give it to the class that the wall's mesh bears."""

BY_CLASS: dict[ClassName, Material] = dict(zip(CLASSES, (CAR, BICYCLE, MOTORCYCLE, PEDESTRIAN), strict=True))
