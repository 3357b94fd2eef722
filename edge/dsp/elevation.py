# SPDX-License-Identifier: Apache-2.0
"""Beams of the rows beside the filled one: the phase between them tells a height above the array's plane."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.frames import Complex64, Float32, Float64

if TYPE_CHECKING:
    from edge.rig import Radar

Complex128 = NDArray[np.complex128]


class ElevationRows:
    """One beam per elevation row of a board, for single cells of the last frame.

    A row at elevation h (in design half wavelengths d) sees a point at direction cosine w across the array, towards the
    side on which the row stands, with the phase 2 pi h d w / lambda less than the filled row: the beams' phases tell w.
    The 7 elements of the cascade's elevation aperture resolve 18 degrees, and w repeats by 1 / 0.51 = 1.95.

    Args:
        radar: board and mounting.
        blocks: (slot, device) of every block of the spectra.
        phasor: complex128 [slots, receivers, points], focusing phasors with range bins in memory order.
        rows: int64 [points], first value of each range bin in a block's plane.
        along_m: float64 [slots, receivers], channels' positions along the rig axis.
        time_s: float64 [slots], chirps after the first.
        wavelength_m: at the middle of the ADC window.
    """

    def __init__(
        self,
        radar: Radar,
        blocks: list[tuple[int, int]],
        phasor: Complex128,
        rows: NDArray[np.int64],
        along_m: Float64,
        time_s: Float64,
        wavelength_m: float,
    ) -> None:
        array, rx = radar.array, radar.schedule.layout.rx
        elevation = array.tx_elevation[:, None] + array.rx_elevation
        slot = np.array([s for s, _ in blocks])
        receiver = np.array([d * rx for _, d in blocks])[:, None] + np.arange(rx)
        nearer = radar.mounting.array_sign * (1.0 if radar.radar == "horizontal" else -1.0)
        self.elevation, self._which = np.unique(elevation[slot[:, None], receiver], return_inverse=True)
        """Elevations of the rows, design half wavelengths, ascending, as the board counts them."""
        self._which = self._which.reshape(receiver.shape)
        self._slot, self._receiver, self._rows, self._rx = slot, receiver, rows, rx
        self._phasor, self._along_m, self._time_s = phasor, along_m, time_s
        self._wavelength_m = wavelength_m
        self._count = np.bincount(self._which.ravel())
        self.turns_per_cosine = -nearer * array.unit_m * self.elevation / wavelength_m
        """Phase of each row per direction cosine across the array along the other rig axis, in turns."""

    def beams(self, spectra: Float32, range_bin: int, direction_cosine: float, closing_m_s: float = 0.0) -> Complex64:
        """Beam of every row towards one cell.

        Args:
            spectra: float32 [block, 2 * points * rx], as the range kernel leaves them.
            range_bin: of the heatmap.
            direction_cosine: along the array.
            closing_m_s: speed at which a static point in this direction comes nearer.
        Returns:
            complex64 [rows], means over each row's channels: |.| is the amplitude of a point in the middle of a cell.
        """
        first, half = int(self._rows[range_bin]), spectra.shape[1] // 2
        value = spectra[:, first : first + self._rx] + 1j * spectra[:, half + first : half + first + self._rx]
        slot = self._slot[:, None]
        path_m = self._along_m[slot, self._receiver] * direction_cosine + 2.0 * closing_m_s * self._time_s[slot]
        turned = value * np.exp(2j * np.pi / self._wavelength_m * path_m)
        turned *= self._phasor[slot, self._receiver, first // self._rx]
        parts = [np.bincount(self._which.ravel(), part.ravel()) for part in (turned.real, turned.imag)]
        return np.asarray((parts[0] + 1j * parts[1]) / self._count, dtype=np.complex64)
