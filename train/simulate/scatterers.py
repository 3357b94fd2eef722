# SPDX-License-Identifier: Apache-2.0
"""Point scatterers as one radar sees them in one burst, and the ground plane that mirrors its antennas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.frames import Complex64, Float64

Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Scatterers:
    """Columns of equal length k, rig frame.

    Args:
        position_m: float64 [k, 3], true places at the first chirp of the radar's burst, never mirrored.
        velocity_m_s: float64 [k, 3], relative to the rig in rig axes; of a static scene minus the rig's velocity.
        amplitude: complex64 [k], LSB per complex sample: all but the propagation phase (link budget, R^-2, antenna
            pattern, reflection, the scatterer's own phase).
        tx_image, rx_image: bool [k], the path from the transmitter, or to the receiver, goes by way of the ground:
            that antenna is mirrored in the ground plane.
    Raises:
        ConfigError: wrong type or shape, or numbers that are not finite.
    """

    position_m: Float64
    velocity_m_s: Float64
    amplitude: Complex64
    tx_image: Bool
    rx_image: Bool

    def __post_init__(self) -> None:
        k = len(self.amplitude)
        for name, dtype, shape in (
            ("position_m", np.float64, (k, 3)),
            ("velocity_m_s", np.float64, (k, 3)),
            ("amplitude", np.complex64, (k,)),
            ("tx_image", np.bool_, (k,)),
            ("rx_image", np.bool_, (k,)),
        ):
            array = getattr(self, name)
            found = f"{array.dtype}{list(array.shape)}"
            right = array.dtype == dtype and array.shape == shape
            require(right, f"scatterers.{name}", found, f"{np.dtype(dtype)}{list(shape)}")
            require(bool(np.isfinite(array).all()), f"scatterers.{name}", "NaN or infinity", "finite numbers")

    def __len__(self) -> int:
        return len(self.amplitude)

    @classmethod
    def direct(
        cls, position_m: Float64, amplitude: Complex64 | complex, velocity_m_s: Float64 | tuple[float, ...] = (0, 0, 0)
    ) -> Scatterers:
        """Scatterers without ground paths; amplitude and velocity may be one for all.

        Args:
            position_m: [k, 3] or [3].
            amplitude: [k] or one.
            velocity_m_s: [k, 3] or [3].
        """
        position = np.array(position_m, dtype=np.float64).reshape(-1, 3)
        k = len(position)
        velocity = np.array(np.broadcast_to(np.asarray(velocity_m_s, dtype=np.float64), (k, 3)))
        level = np.array(np.broadcast_to(np.asarray(amplitude, dtype=np.complex64), (k,)))
        return cls(position, velocity, level, np.zeros(k, dtype=np.bool_), np.zeros(k, dtype=np.bool_))

    def take(self, index: NDArray[np.int64] | Bool) -> Scatterers:
        """The scatterers that ``index`` (numbers or a mask) selects."""
        return Scatterers(
            self.position_m[index],
            self.velocity_m_s[index],
            self.amplitude[index],
            self.tx_image[index],
            self.rx_image[index],
        )


@dataclass(frozen=True, slots=True)
class GroundPlane:
    """The ground in the rig frame: all p with normal . p + offset_m = 0.

    Args:
        normal: float64 [3], unit, away from the ground.
        offset_m: height of the rig's origin above the ground.
    Raises:
        ConfigError: the normal is no unit vector.
    """

    normal: Float64
    offset_m: float

    def __post_init__(self) -> None:
        unit = self.normal.shape == (3,) and abs(float(np.linalg.norm(self.normal)) - 1.0) < 1e-6
        require(unit, "ground.normal", self.normal, "a unit vector [3]")

    def mirrored(self, points_m: Float64) -> Float64:
        """Mirror images of points [..., 3] in the plane."""
        height_m = points_m @ self.normal + self.offset_m
        return np.asarray(points_m - 2.0 * height_m[..., None] * self.normal)
