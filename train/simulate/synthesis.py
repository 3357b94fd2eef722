# SPDX-License-Identifier: Apache-2.0
"""Point scatterers to one radar's raw samples: exact spherical paths of every channel by a non-uniform FFT.

The beat signal is that of docs/architecture.md: x(t) = sum over the scatterers of a exp(j 2 pi (f_c tau + S tau t)),
tau = (|p - A| + |p - B|) / c, t from the middle of the ADC window. Every chirp sees the scatterers where they are at
its start. Distances are float64; from their fractional wavelengths on, everything is float32.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.dsp.buffers import zeros
from edge.errors import RfconstructError
from edge.frames import Complex64, Float64, Int16, Layout, RadarFrame
from edge.reference.point_targets import element_positions_m
from edge.waveform import SPEED_OF_LIGHT_M_S
from train.simulate.burst import RESIDUE_RAD, Motion, Work, follow_motion
from train.simulate.kernels_legs import BLOCK, CELLS, RX, chip_legs, receive_legs, station_paths, transmit_legs
from train.simulate.kernels_synthesis import filter_amplitudes, spreader
from train.simulate.kernels_transform import PARTS, row_of_block, transformer, twiddles
from train.simulate.scatterers import GroundPlane, Scatterers

if TYPE_CHECKING:
    from edge.rig import Radar
    from train.simulate.front_end import FrontEnd

SHAPES = {4: 0.56, 6: 0.38}
"""By width: b of the weights exp(-b distance^2), balanced between cut tails and images, found by a sweep."""
GROUP_CELLS = 0.2
"""A group's receivers may lie this far from their middle, in grid cells of path."""
FEWEST_SAMPLES = 64
MARGIN = 16
"""Grid rows before the cell of range 0."""
FIRST_ROOM = 1024


class RangeError(RfconstructError):
    """A scatterer whose beat frequency the receiver does not pass: it would appear at a false range."""


class Synthesizer:
    """Raw bursts of one radar from point scatterers.

    Args:
        radar: board, schedule, mounting; its calibration is not used. What its range and power offsets take out again
            is in the samples.
        width: grid cells to either side of a scatterer: 4 (power of the error about -85 dB) or 6 (-105 dB and
            less).
    Raises:
        ConfigError: width out of range, fewer than 64 samples, or receivers of one chip too far apart for this
            bandwidth.
    """

    def __init__(self, radar: Radar, width: int = 4) -> None:
        require(width in SHAPES, "synthesis.width", width, ", ".join(map(str, SHAPES)))
        self.radar, self.width = radar, width
        layout, profile = radar.schedule.layout, radar.schedule.profile
        require(layout.samples >= FEWEST_SAMPLES, "samples", layout.samples, f">= {FEWEST_SAMPLES}")
        require(layout.rx == RX, "receivers of one chip", layout.rx, str(RX))
        self.reach_m = profile.usable_range_m
        """Largest half path, as measured by the radar, of a scatterer that is accepted."""
        self._layout: Layout = layout
        self._cells = cells = 1 << (2 * layout.samples - 1).bit_length()
        self._transmitters_m, receivers_m = element_positions_m(radar)
        self._receivers_m = np.ascontiguousarray(receivers_m.reshape(-1, RX, 3))
        self._centre_m = np.asarray(radar.mounting.position_m, dtype=np.float64)
        first = PARTS * (layout.samples // (2 * PARTS))
        lead_s = (first - layout.samples / 2) / profile.sample_rate_hz
        slope_per_m = profile.slope_hz_per_s_actual / SPEED_OF_LIGHT_M_S
        frequency_hz = profile.center_frequency_hz + profile.slope_hz_per_s_actual * lead_s
        self._cells_per_m = slope_per_m * cells / profile.sample_rate_hz
        self._turns_per_m, self._offset_m = frequency_hz / SPEED_OF_LIGHT_M_S, 2.0 * radar.mounting.range_offset_m
        self._jitter_turns_per_m_s = 2.0 * slope_per_m
        spread_m = np.linalg.norm(self._receivers_m - self._receivers_m.mean(axis=1, keepdims=True), axis=2).max()
        apart = float(spread_m * self._cells_per_m)
        require(apart <= GROUP_CELLS, "distance of one chip's receivers in cells", apart, f"<= {GROUP_CELLS}")
        chips, shape = len(self._receivers_m), SHAPES[width]
        plane = (cells + MARGIN) * RX
        self._spread = spreader(width, shape, plane)
        self._middles_m = np.ascontiguousarray(self._receivers_m.mean(axis=1))
        self._apart_m = float(spread_m)
        self._residue_m = RESIDUE_RAD[width] / (2.0 * np.pi * self._turns_per_m)
        self._transform = transformer(cells, layout.samples, MARGIN)
        self._twiddles, self._row_of = twiddles(cells), row_of_block(cells)
        self._factors = _lane_factors(shape, width)
        self._grid = zeros(chips * layout.slots * 2 * plane)
        self._columns = zeros(2 * cells * RX)
        self._signal = zeros((chips, layout.slots, layout.samples * RX), np.complex64)
        index = np.arange(layout.samples) - first
        inverse = np.sqrt(shape / np.pi) * np.exp(np.square(np.pi * index / cells) / shape)
        self._correction = np.repeat(inverse, RX).astype(np.float32)
        self._level = np.complex64(10.0 ** (-radar.mounting.power_offset_db / 20.0))
        self._unfiltered = self._response = np.full(cells + 1, self._level)
        self._filtered_by: FrontEnd | None = None
        self._motion, self._slot_s = Motion(), profile.chirp_time_s
        self._path, self._scratch = zeros((2 * RX + 2, BLOCK), np.float64), zeros((5, RX * BLOCK))
        self._apart, self._part, self._wave = zeros((2, RX * BLOCK), np.float64), zeros(BLOCK), zeros(2 * BLOCK)
        self._work = Work.make(FIRST_ROOM, layout.slots, chips)
        self._beat: Complex64 | None = None

    def beat(self, scatterers: Scatterers, ground: GroundPlane | None = None) -> Complex64:
        """Beat signal without noise and without the receiver's own faults.

        Args:
            scatterers: as this radar sees them in one burst.
            ground: mirrors the antennas of ground paths; needed when there are any.
        Returns:
            complex64 [loops, slots, receivers, samples], LSB: a buffer that the next call overwrites. When nothing
            moves it is a read-only view of one loop.
        Raises:
            RangeError: a scatterer beyond ``reach_m``, or nearer than the board's range offset.
            ConfigError: ground paths without a ground.
        """
        layout, chips = self._layout, len(self._receivers_m)
        loops = layout.loops if scatterers.velocity_m_s.any() else 1
        shape = (loops, layout.slots, chips * RX, layout.samples)
        if self._beat is None or len(self._beat) != loops:
            self._beat = np.empty(shape, dtype=np.complex64)
        self._place(scatterers, ground, self._unfiltered)
        ones, nothing = np.ones_like(self._signal), np.zeros_like(self._signal)
        for loop in range(loops):
            self._grid_loop(len(scatterers), loop, None)
            self._to_samples(ones, nothing, self._signal)
            samples = self._signal.reshape(chips, layout.slots, layout.samples, RX)
            self._beat[loop] = samples.transpose(1, 0, 3, 2).reshape(shape[1:])
        return self._beat if loops > 1 else np.broadcast_to(self._beat, (layout.loops, *shape[1:]))

    def frame(
        self,
        scatterers: Scatterers,
        front_end: FrontEnd,
        number: int,
        t_first_chirp_ns: int,
        ground: GroundPlane | None = None,
        out: Int16 | None = None,
    ) -> RadarFrame:
        """One burst as the board sends it.

        Args:
            scatterers: as this radar sees them in this burst.
            front_end: of the same radar; adds its faults and the noise of this frame.
            number, t_first_chirp_ns: of the frame.
            ground: as in ``beat``.
            out: int16 array of the capture's shape to write into; None: a new one.
        Raises:
            RangeError, ConfigError: as ``beat``.
        """
        layout, chips = self._layout, len(self._receivers_m)
        adc = np.empty(layout.shape, dtype=np.int16) if out is None else out
        direct = layout.kind == "cascade" and layout.iq_order == "IQ"
        shape = (chips, layout.loops, layout.slots, layout.samples * 2 * RX)
        codes = adc.reshape(shape) if direct else np.empty(shape, dtype=np.int16)
        if self._filtered_by is not front_end:
            self._filtered_by, self._response = front_end, self._level * front_end.if_response(self._cells)
        self._place(scatterers, ground, self._response)
        for loop in range(layout.loops):
            if loop == 0 or self._motion.run or front_end.per_chirp:
                self._grid_loop(len(scatterers), loop, front_end.jitter_s(number, loop))
                self._through(front_end, front_end.frequency_noise_hz(number, loop))
            front_end.digitise(self._signal, number, loop, codes)
        if not direct:
            _reorder(codes, layout, adc)
        return RadarFrame(self.radar.radar, number, t_first_chirp_ns, adc, layout)

    def _through(self, front_end: FrontEnd, frequency_hz: Float64 | None) -> None:
        """Grid to the samples that the ADC sees, but for their noise.

        With phase noise an echo is multiplied by 1 + j 2 pi tau nu; its delay tau is its cell on the grid.
        """
        if frequency_hz is None:
            self._to_samples(front_end.response, front_end.leakage, self._signal)
        else:
            profile, slots = self.radar.schedule.profile, self._layout.slots
            cell_s = profile.sample_rate_hz / (profile.slope_hz_per_s_actual * self._cells)
            delay_s = np.repeat((np.arange(self._cells + MARGIN) - MARGIN) * cell_s, RX).astype(np.float32)
            delayed = (self._grid.reshape(-1, len(delay_s)) * delay_s).ravel()
            self._to_samples(front_end.response, front_end.leakage, self._signal)
            self._grid[:] = delayed
            late = np.zeros_like(self._signal)
            self._to_samples(front_end.response, late, late)
            turn = (2j * np.pi * frequency_hz).astype(np.complex64).reshape(slots, -1)
            self._signal += np.repeat(turn, RX, axis=1) * late
        front_end.distort(self._signal)

    def _place(self, scatterers: Scatterers, ground: GroundPlane | None, response: Complex64) -> None:
        """Take over the scatterers: mirrored legs, curvature of moving paths, receiver's response."""
        k = len(scatterers)
        if k > self._work.room:
            self._work = Work.make(1 << (k - 1).bit_length(), self._layout.slots, len(self._receivers_m))
        work = self._work
        for leg, image in enumerate((scatterers.tx_image, scatterers.rx_image)):
            work.points[leg, :, :k] = scatterers.position_m.T
            work.velocity[leg, :, :k] = scatterers.velocity_m_s.T
            if image.any():
                require(ground is not None, "ground", None, "the plane that the ground paths are mirrored in")
                assert ground is not None
                work.points[leg, :, :k][:, image] = ground.mirrored(scatterers.position_m[image]).T
                along = scatterers.velocity_m_s[image] @ ground.normal
                mirrored = scatterers.velocity_m_s[image] - 2.0 * along[:, None] * ground.normal
                work.velocity[leg, :, :k][:, image] = mirrored.T
        filter_amplitudes(
            *(k, work.points, scatterers.amplitude, self._centre_m, self._cells_per_m, self._offset_m, response),
            work.amplitude,
        )
        work.bend[:k] = 0.0
        self._motion = Motion()
        if scatterers.velocity_m_s.any():
            burst = (self._layout.loops, self._layout.slots, self._slot_s)
            self._motion = follow_motion(work, k, self._centre_m, *burst, self._apart_m, self._residue_m)

    def _follow(self, k: int, loop: int) -> None:
        """Paths and receivers' phases from this loop on, for as many loops as the motion allows."""
        work, motion, slots, slot_s = self._work, self._motion, self._layout.slots, self._slot_s
        begin_s, late_s = loop * slots * slot_s, np.arange(slots) * slot_s
        whole_s = (motion.span * slots - 1) * slot_s if motion.run else 0.0
        still, scale = np.zeros(len(self._middles_m)), np.array([self._cells_per_m, self._turns_per_m, 0.0])
        station_paths(
            *(k, work.points[0], work.velocity[0], work.bend, self._transmitters_m),
            *(np.append(begin_s + late_s, (motion.span - 1) * slots * slot_s), np.square(late_s - 0.5 * late_s[-1])),
            *(scale, work.out, work.base_out, *work.reach_out, self._path),
        )
        scale[2] = self._offset_m
        station_paths(
            *(k, work.points[1], work.velocity[1], work.bend, self._middles_m, np.append(still + begin_s, whole_s)),
            *(still, scale, work.back, work.base_back, *work.reach_chip, self._path),
        )
        middle_s, run_s = begin_s + 0.5 * whole_s, motion.run * slot_s
        turns = motion.run and (motion.span > 1 or motion.run < slots)
        timing = np.array([middle_s, begin_s + 0.5 * (run_s - slot_s) if turns else middle_s, run_s if turns else 0.0])
        receive_legs(
            *(k, work.points[1], work.velocity[1], self._receivers_m, self._middles_m),
            *(scale, timing, np.float32(SHAPES[self.width])),
            *(np.float32(self.width - 2), self._factors, work.legs, work.turn, *work.reach_back, self._path),
            *(self._apart, self._scratch),
        )
        self._require_reach(k)

    def _grid_loop(self, k: int, loop: int, jitter_s: Float64 | None) -> None:
        """Spread the scatterers as one loop sees them; loops come in order."""
        work, motion, slots = self._work, self._motion, self._layout.slots
        if loop == 0 or (motion.run and loop % motion.span == 0):
            self._follow(k, loop)
        within = loop % motion.span if motion.run else 0
        scale = np.zeros(1 + slots, np.float32)
        scale[0] = self._cells_per_m / self._turns_per_m
        if jitter_s is not None:
            scale[1:] = jitter_s * self._jitter_turns_per_m_s / self._cells_per_m
        x, chirps = within / max(motion.span - 1, 1), max(motion.span * slots - 1, 1)
        transmit_legs(
            *(k, work.out, work.base_out, np.float32(x), work.amplitude, scale, work.re, work.im, work.cell_out),
            *(self._part, self._wave),
        )
        x, step = (within * slots + 0.5 * (slots - 1)) / chirps, 1.0 / chirps if motion.run else 0.0
        chip_legs(
            *(k, work.back, np.float32(x), np.float32(step), slots, scale[0], work.swing, work.swing_step),
            *(work.cell_back, self._part, self._wave),
        )
        work.base[:k] = work.base_out[:k] + work.base_back[:k] + MARGIN
        onward = within + 1 < motion.span
        self._spread(
            *(k, work.re, work.im, work.cell_out, work.cell_back, work.base, work.swing, work.swing_step, work.legs),
            *(work.turn, motion.run, onward, work.plan, work.start, self._grid),
        )

    def _to_samples(self, response: Complex64, leakage: Complex64, signal: Complex64) -> None:
        """Transform the grid, which is lost: complex64 [chips, slots, samples * rx] each."""
        flat = (array.reshape(-1).view(np.float32) for array in (response, leakage, signal))
        self._transform(self._grid, self._twiddles, self._row_of, self._columns, self._correction, *flat)

    def _require_reach(self, k: int) -> None:
        """Refuse scatterers whose beat lies outside of what the receiver passes."""
        work = self._work
        nearest_m = 0.5 * (work.reach_out[0, :k] + work.reach_back[0, :k] - self._offset_m)
        farthest_m = 0.5 * (work.reach_out[1, :k] + work.reach_back[1, :k] - self._offset_m)
        bad = ~((nearest_m >= 0.0) & (farthest_m <= self.reach_m))
        if bad.any():
            index = int(np.argmax(bad))
            place = ", ".join(f"{value:.3f}" for value in work.points[1, :, index])
            raise RangeError(
                f"{self.radar.radar} radar: scatterer {index} at ({place}) m lies outside of what the receiver passes",
                value=float(farthest_m[index]),
                allowed=f"half paths of 0 to {self.reach_m:.3f} m",
                action="leave scatterers beyond Synthesizer.reach_m out",
            )


def _lane_factors(shape: float, width: int) -> NDArray[np.float32]:
    """Constants of the four cells of a step: of the first step's weight, and of its ratio to the next [2, CELLS].

    Args:
        shape: of the weights exp(-shape distance^2).
        width: cells to either side of a scatterer, even.
    """
    offset = np.arange(CELLS) - 0.5 * (CELLS - 1)
    exponents = -shape * np.square(offset) + 2.0 * shape * (width - 2) * offset, -8.0 * shape * offset
    return np.asarray(np.exp(np.stack(exponents)), dtype=np.float32)


def _reorder(codes: Int16, layout: Layout, adc: Int16) -> None:
    """Codes [chips, loops, slots, samples * rx * 2], I first, into the capture's own order; a real mixer has I only."""
    parts = codes.reshape(*codes.shape[:3], layout.samples, RX, 2)
    if layout.kind == "dca1000_real":
        adc[:] = parts[0, ..., 0].transpose(0, 1, 3, 2)
        return
    parts = parts[..., ::-1] if layout.iq_order == "QI" else parts
    if layout.kind == "cascade":
        adc[:] = parts
        return
    halves = parts[0].reshape(layout.loops, layout.slots, layout.samples // 2, 2, RX, 2)
    adc.reshape(layout.loops, layout.slots, RX, layout.samples // 2, 2, 2)[:] = halves.transpose(0, 1, 4, 2, 5, 3)
