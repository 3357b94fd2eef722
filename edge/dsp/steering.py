# SPDX-License-Identifier: Apache-2.0
"""Steering by odometry: loops and slots summed towards every direction with the rig's motion inside the burst undone.

A static point in direction u closes in by c(u) = v_x sqrt(1 - u^2) + v_along u. Within a sector around u_g, c is taken
as c_g + c'_g (u - u_g), the tangent moved to the middle of the curve's bow: the constant turns each chirp's phase, the
slope moves each transmitter by 2 c'_g t along the array. The moved elements stand on no grid any more; they are spread
on it (non-uniform FFT, Dutt and Rokhlin 1993) with weights that make up for their density, for one loop with weights
of level lobes (beam_weights.py). Only v_x bends c(u), so travel along the array needs one sector at any speed.

Level lobes of a new speed are solved for one sector a frame, the others keep the weights by density until it is their
turn: no frame waits for more than one, and what comes out depends on the frames alone, not on any clock.
"""

from __future__ import annotations

import math

import numpy as np

from edge.config import HeatmapSettings
from edge.dsp import tables, tdm
from edge.dsp.beam_weights import BeamWeights, sector_closing_m_s
from edge.dsp.buffers import zeros
from edge.dsp.kernels_doppler import FINE, FRACTIONS, ROUNDS, SPREAD_SHAPE, TAPS, plan_spreading, set_turns, spread
from edge.dsp.kernels_heatmap import ANGLE_LANES, angle_kernel
from edge.dsp.row import RowChannels, RowGeometry
from edge.frames import BurstMotion, Float32, Float64

BEND_RAD, ONE_LOOP_BEND_RAD = 0.15, 0.08
"""Phase of the first and last chirp by which c(u) may bow out of its tangent within a sector; half of it remains."""
MOST_SECTORS = 16
MARGIN = TAPS + 2
"""Grid cells beyond the outermost elements."""
DENSITY_REACH = 4
DENSITY_SHARE = 0.75
"""Density counts by sinc^2(0.75 x), whose spectrum ends at 3/4 of the grid's period: the field of view."""
SOLVES_A_FRAME = 1
"""Sectors whose level lobes one frame may solve for: 0.5 to 1.8 ms."""
STILL_CELLS = 0.02
"""Elements that move by less stay on the grid, which is exact in every direction."""


class Steering:
    """Range-angle power of one radar from the cube of its channels, with the rig's motion undone.

    Args:
        geometry, channels: of the row.
        settings: angle window and bins.
        time_s: float64 [loop, slot] of every chirp after the first.
        wavelength_m: at the middle of the ADC window.
        points: range bins.
        gain: float32 [angle], factor of the power.
        direction_cosine: [angle].
    """

    def __init__(
        self,
        geometry: RowGeometry,
        channels: RowChannels,
        settings: HeatmapSettings,
        time_s: Float64,
        wavelength_m: float,
        points: int,
        gain: Float32,
        direction_cosine: Float64,
    ) -> None:
        bins, self._slot, self._time_s, self._wavelength_m = settings.angle_bins, channels.slot, time_s, wavelength_m
        self.count, self.bins = geometry.count, bins
        self._unit_m = geometry.pitch * wavelength_m
        self._cells = float(bins - geometry.count - 2 * MARGIN)
        self._position = np.asarray(channels.element - 0.5 * (geometry.count - 1), dtype=np.float64)
        self._used = np.unique(channels.slot)
        self._sectors = tuple(tdm.divide(direction_cosine, count) for count in range(1, MOST_SECTORS + 1))
        fine = np.arange(-DENSITY_REACH * FINE, DENSITY_REACH * FINE + 1) / FINE
        self._density = np.square(np.sinc(DENSITY_SHARE * fine))
        steps = 16 * geometry.count
        self._taper = tables.taper(settings, "angle", steps, 0.5 * (steps - 1))
        fraction = (np.arange(FRACTIONS) + 0.5) / FRACTIONS
        away = fraction[:, None] + (TAPS // 2 - 1) - np.arange(TAPS)
        self._shape = np.exp(SPREAD_SHAPE * (np.sqrt(np.maximum(1.0 - np.square(2.0 * away / TAPS), 0.0)) - 1.0))
        some = slice(None, None, FRACTIONS // 128)
        turns = np.outer((np.arange(bins) - bins // 2) / bins, away[some])
        spectrum = np.cos(2.0 * np.pi * turns) @ self._shape[some].ravel() / 128
        self._gain, self._still_gain = (gain / np.square(spectrum)).astype(np.float32), gain
        self._still_shape = np.zeros((1, TAPS))
        self._still_shape[0, TAPS // 2 - 1] = 1.0
        loops, slots = time_s.shape
        self._fine = np.zeros((2, (bins + 2 * MARGIN) * FINE + len(self._density)))
        self._weight = np.zeros(loops * len(self._slot))
        window, slot_s = tables.taper(settings, "angle", self.count, 0.5 * (self.count - 1)), float(time_s[0, -1])
        self.beam_weights = BeamWeights(
            *(channels.element, channels.slot, slot_s / max(slots - 1, 1), window, geometry.pitch, wavelength_m)
        )
        self._first = np.zeros((loops, len(self._slot)), dtype=np.int64)
        self._taps = zeros((loops, len(self._slot), TAPS))
        self._centred_s = np.zeros((loops, slots))
        self._turn = np.zeros((loops, slots), dtype=np.complex64)
        self._line = zeros((2, points))
        self._rows = [zeros((2, cells, points)) for cells in (bins // 2, bins)]
        self._angle_kernels = [angle_kernel(bins, points, ANGLE_LANES, whole) for whole in (False, True)]
        self._twiddle = tables.twiddles(bins, +1, 0)
        self._target = tables.centred_rows(bins)
        self._work = zeros(2 * bins * ANGLE_LANES)

    def loops_that_fit(self, forward_m_s: float, along_m_s: float, most: int) -> int:
        """Loops whose moved elements stay within the angle FFT's length."""
        drift_m_s = 2.0 * (abs(along_m_s) + abs(forward_m_s))
        loop_s = float(self._time_s[1, 0]) if len(self._time_s) > 1 else 0.0
        if drift_m_s * loop_s * most <= self._cells * self._unit_m:
            return most
        return max(1, int(self._cells * self._unit_m / (drift_m_s * loop_s)))

    def run(
        self,
        cube: Float32,
        forward_m_s: float,
        along_m_s: float,
        loops: int,
        power: Float32,
        extra_m_s: float = 0.0,
        solves: int = 0,
    ) -> BurstMotion:
        """Fill ``power`` [angle, range] from ``loops`` of ``cube`` [channel, loop, (re, im), range].

        Args:
            cube, power: as said.
            forward_m_s, along_m_s, loops: the motion, and the loops used.
            extra_m_s: speed at which points in every direction come nearer besides.
            solves: sectors whose level lobes may be solved for in this call.
        Returns:
            The motion, with the instant whose scene ``power`` shows.
        """
        first_s, last_s = float(self._time_s[0, self._used[0]]), float(self._time_s[loops - 1, self._used[-1]])
        middle_s = 0.5 * (first_s + last_s)
        np.subtract(self._time_s, middle_s, out=self._centred_s)
        for sector in self.sectors(forward_m_s, loops):
            across = math.sqrt(1.0 - sector.centre**2)
            slope_m_s = along_m_s - forward_m_s * sector.centre / across
            closing_m_s = sector_closing_m_s(sector, sector.centre, forward_m_s, along_m_s) + extra_m_s
            weight = self.beam_weights.known(sector, forward_m_s, along_m_s) if loops == 1 else None
            if loops == 1 and weight is None and solves > 0:
                weight, solves = self.beam_weights.of(sector, forward_m_s, along_m_s), solves - 1
            self._run_sector(cube, sector, closing_m_s, slope_m_s, loops, weight, power)
        return BurstMotion(middle_s, forward_m_s, along_m_s)

    def sectors(self, forward_m_s: float, loops: int) -> tuple[tdm.Sector, ...]:
        """Sectors in which the tangent departs from sqrt(1 - u^2), bent by 1.54 at u = 1/2, by the limit."""
        first_s, last_s = float(self._time_s[0, self._used[0]]), float(self._time_s[loops - 1, self._used[-1]])
        half_s = 0.5 * (last_s - first_s)
        bend_rad = 4.0 * math.pi / self._wavelength_m * 1.54 * abs(forward_m_s) * half_s
        most_rad = ONE_LOOP_BEND_RAD if loops == 1 else BEND_RAD
        if bend_rad * tdm.FOV_COSINE**2 <= 2.0 * most_rad:
            return self._sectors[0]
        count = min(math.ceil(tdm.FOV_COSINE / math.sqrt(2.0 * most_rad / bend_rad)), MOST_SECTORS)
        return self._sectors[count - 1]

    def _run_sector(
        self,
        cube: Float32,
        sector: tdm.Sector,
        closing_m_s: float,
        slope_m_s: float,
        loops: int,
        weight: Float64 | None,
        power: Float32,
    ) -> None:
        span_s = float(self._centred_s[loops - 1, self._used[-1]] - self._centred_s[0, self._used[0]])
        most = self._cells / max(span_s, 1e-9)
        drift = min(max(2.0 * slope_m_s / self._unit_m, -most), most)
        travel = abs(drift) * span_s
        whole = self.count + travel + 2 * MARGIN > self.bins // 2
        row = self._rows[whole]
        middle, shape, gain = float(row.shape[1] // 2), self._shape, self._gain
        if travel < STILL_CELLS:
            middle, shape, gain, drift = middle - 0.5 * (1 - self.count % 2), self._still_shape, self._still_gain, 0.0
        rounds = ROUNDS if weight is None else 0
        if weight is not None:
            self._weight[: len(weight)] = weight
        plan_spreading(
            *(self._position, self._slot, self._centred_s, drift, middle, loops, rounds),
            *(self._density, self._taper, shape, self._fine, self._weight, self._first, self._taps),
        )
        set_turns(self._turn, self._centred_s, closing_m_s - slope_m_s * sector.centre, self._wavelength_m)
        spread(cube, self._slot, loops, self._turn, self._first, self._taps, self._line, row)
        self._angle_kernels[whole](
            *(row, self._twiddle, self._target, gain, sector.first, sector.last, self._work, power)
        )
