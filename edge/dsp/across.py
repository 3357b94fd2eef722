# SPDX-License-Identifier: Apache-2.0
"""Motion across a radar's own array: maps of several radial speeds, and the one that each cell is taken from.

A rig that moves at v across the array sees a static point come nearer at v u, u its direction cosine along the motion,
which this radar does not measure. Too few loops tell speeds apart, but not so the row itself: a target's power is
largest, and its lobes are lowest, in the map whose speed is its own. The speeds stand one step apart over the field of
view. Taking the strongest map cell by cell would keep every target's lobes from the map that fits it least; therefore a
cell which the lobes of stronger targets in its range bin explain is taken from their maps (kernels_across.py).
"""

from __future__ import annotations

import math

import numpy as np

from edge.dsp import tdm
from edge.dsp.kernels_across import give_to_owners, keep_strongest
from edge.dsp.row import RowGeometry
from edge.frames import Float32, Float64

LARGEST_ERROR_RAD = 0.072
"""Phase over the row, rms beside a displaced peak, that an unknown radial speed may leave: lobes of -24 dB (Hann)."""
MOST_STEPS = 16
"""Speeds to either side of standing still."""
MARGIN = 2.0
"""Power of lobes over the model's: wavefronts and channels are not perfect."""
LOBE_FLOOR = 10.0**-2.5
PROMINENT = 12.0
WEAKEST = 10.0**-2.2
TARGETS = 6


class AcrossMotion:
    """Radial speeds to try, and the map of each cell.

    Args:
        geometry: of the row.
        angle_taper: float64 [element], window over the row.
        transmit_time_s: float64 [slot], chirps after the first.
        wavelength_m: at the middle of the ADC window.
        rad_s_m: rms phase over the row that a radial speed of 1 m/s leaves beside a displaced peak.
        loop_time_s: from loop to loop.
        shape: of a map, (angle bins, range bins).
        gain: float32 [angle], factor of the power.
    """

    def __init__(
        self,
        geometry: RowGeometry,
        angle_taper: Float64,
        transmit_time_s: Float64,
        wavelength_m: float,
        rad_s_m: float,
        loop_time_s: float,
        shape: tuple[int, int],
        gain: Float32,
    ) -> None:
        self.step_m_s = 2.0 * LARGEST_ERROR_RAD / max(rad_s_m, 1e-9)
        self._noise = np.square(geometry.channel_weight(angle_taper))
        self._element, self._bins = geometry.element, shape[0]
        self._turns_per_step = 2.0 * self.step_m_s / wavelength_m
        self._time_s, self._loop_time_s = transmit_time_s, loop_time_s
        self._correlations: dict[tuple[int, int], Float64] = {}
        self._pattern = np.asarray(1.0 / gain, dtype=np.float32)
        self._response = self._responses(geometry, angle_taper, transmit_time_s / wavelength_m, shape[0])
        self._count = 0
        self._maps = np.zeros((0, *shape), dtype=np.float32)
        self._best, self._which = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.int8)
        self._sums, self._line = np.zeros((2, shape[1]), dtype=np.float32), np.zeros((3, shape[0]), dtype=np.float32)
        self._share, self._centre = np.zeros((TARGETS, 3), dtype=np.float32), np.zeros(TARGETS, dtype=np.int8)
        self._shown, self._owner = np.zeros(shape[0], dtype=np.int8), np.zeros(shape[0], dtype=np.int8)

    def _responses(self, geometry: RowGeometry, taper: Float64, time_wavelengths: Float64, bins: int) -> Float32:
        """Bounds of a point's amplitude [speed difference, angle difference], half a step and one bin about each."""
        weight = geometry.channel_weight(taper / taper.sum())
        inside = geometry.element >= 0
        half_steps = np.arange(-4 * MOST_STEPS - 1, 4 * MOST_STEPS + 2)
        turn = np.exp(2j * np.pi * self.step_m_s * np.outer(half_steps, time_wavelengths))
        row = np.zeros((len(half_steps), geometry.count), dtype=np.complex128)
        for slot, receiver in zip(*np.nonzero(inside), strict=True):
            row[:, geometry.element[slot, receiver]] += weight[slot, receiver] * turn[:, slot]
        power = np.square(np.abs(np.fft.ifft(row, bins, axis=1) * bins))
        power = np.maximum(power, np.maximum(np.roll(power, 1, axis=1), np.roll(power, -1, axis=1)))
        power = np.maximum(power[1:-1:2], np.maximum(power[:-2:2], power[2::2]))
        return np.tile(np.sqrt(MARGIN * np.maximum(power, LOBE_FLOOR)), 2).astype(np.float32)

    def speeds_m_s(self, across_m_s: float) -> Float64:
        """Closing speeds to try, in steps to either side of 0; only 0 where the phase stays within the limit."""
        most = abs(across_m_s) * tdm.FOV_COSINE / self.step_m_s
        steps = min(math.ceil(most), MOST_STEPS) if most > 0.5 else 0
        return np.asarray(np.arange(-steps, steps + 1) * self.step_m_s, dtype=np.float64)

    def every_speed_m_s(self) -> Float64:
        """Speeds across the array, float64 [MOST_STEPS], in the middle of those that lead to 3, 5, 7 ... maps."""
        return np.asarray((np.arange(1, MOST_STEPS + 1) - 0.25) * (self.step_m_s / tdm.FOV_COSINE))

    def correlation(self, maps: int, loops: int) -> Float64:
        """|rho|^2 of the noise of two cells, float64 [maps, angle], by difference of maps and of angle bins.

        rho(k, d) = sum_c n_c exp(j 2 pi (e_c d / bins + 2 k v t_c / lambda)) / sum_c n_c over channels and ``loops``,
        n_c the noise power after the window, v the step of speeds.
        """
        if (maps, loops) not in self._correlations:
            time_s = self._time_s + self._loop_time_s * np.arange(loops)[:, None]
            turn = np.exp(2j * np.pi * self._turns_per_step * np.arange(maps)[:, None, None] * time_s).mean(axis=1)
            row = np.zeros((maps, self._bins), dtype=np.complex128)
            for slot, receiver in zip(*np.nonzero(self._element >= 0), strict=True):
                row[:, self._element[slot, receiver]] += self._noise[slot, receiver] * turn[:, slot]
            rho = np.fft.ifft(row, axis=1) * self._bins / self._noise.sum()
            self._correlations[maps, loops] = np.square(np.abs(rho))
        return self._correlations[maps, loops]

    def keep(self, k: int, power: Float32) -> None:
        """Take over map ``k`` [angle, range]; map 0 first."""
        if k >= len(self._maps):
            grown = np.zeros((2 * k + 3, *power.shape), dtype=np.float32)
            grown[: len(self._maps)] = self._maps
            self._maps = grown
        self._count = k + 1
        keep_strongest(power, k, self._best, self._which, self._maps[k])

    def settle(self, power: Float32) -> None:
        """Fill ``power`` [angle, range] from the maps."""
        give_to_owners(
            *(self._maps[: self._count], self._best, self._which, self._pattern, self._response, PROMINENT, WEAKEST),
            *(self._sums, self._line, self._shown, self._owner, self._share, self._centre),
            power,
        )
