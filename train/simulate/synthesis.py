# SPDX-License-Identifier: Apache-2.0
"""Point scatterers to one radar's raw samples: exact spherical paths of every channel by a non-uniform FFT.

The beat signal is that of docs/architecture.md: x(t) = sum over the scatterers of a exp(j 2 pi (f_c tau + S tau t)),
tau = (|p - A| + |p - B|) / c, t from the middle of the ADC window. Every chirp sees the scatterers where they are at
its start. Distances are float64; from their fractional wavelengths on, everything is float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.dsp.buffers import zeros
from edge.errors import RfconstructError
from edge.frames import Complex64, Float32, Float64, Int16, Layout, RadarFrame
from edge.reference.point_targets import element_positions_m
from edge.waveform import SPEED_OF_LIGHT_M_S
from train.simulate.kernels_synthesis import (
    BLOCK,
    CELLS,
    LANES,
    LEG_PLANES,
    RX,
    filter_amplitudes,
    receive_legs,
    spreader,
    transmit_legs,
)
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
BOW_M = 4e-6
"""Path by which a burst may bow out of one tangent; all receivers share it but for a few percent."""
APART = 80
"""Floats between the planes of the legs, so that they do not compete for the same lines of the cache."""


class RangeError(RfconstructError):
    """A scatterer whose beat frequency the receiver does not pass: it would appear at a false range."""


@dataclass(slots=True)
class _Work:
    """Buffers of one synthesis, for ``room`` scatterers at most; axes as the kernels name them."""

    room: int
    points: Float64
    velocity: Float64
    bend: Float64
    amplitude: Float32
    re: Float32
    im: Float32
    cell_out: Float32
    base_out: NDArray[np.int32]
    reach_out: Float64
    legs: Float32
    turn: Float32
    cell_back: Float32
    base_back: NDArray[np.int32]
    reach_back: Float64
    base: NDArray[np.int32]
    drift: Float32
    plan: Float32
    start: NDArray[np.int32]

    @classmethod
    def make(cls, room: int, slots: int, chips: int) -> _Work:
        """Zeroed buffers."""
        f4, f8 = np.float32, np.float64
        span = room * LANES + APART
        return cls(
            room=room,
            points=np.zeros((2, 3, room), f8),
            velocity=np.zeros((2, 3, room), f8),
            bend=np.zeros(room, f8),
            amplitude=np.zeros((2, room), f4),
            re=np.zeros((slots, room), f4),
            im=np.zeros((slots, room), f4),
            cell_out=np.zeros((slots, room), f4),
            base_out=np.zeros(room, np.int32),
            reach_out=np.zeros((2, room), f8),
            legs=zeros((chips, LEG_PLANES * span), f4),
            turn=zeros((chips, 2 * span), f4),
            cell_back=np.zeros((2, chips, room), f4),
            base_back=np.zeros(room, np.int32),
            reach_back=np.zeros((2, room), f8),
            base=np.zeros(room, np.int32),
            drift=np.zeros(room, f4),
            plan=np.zeros((4, room), f4),
            start=np.zeros(room, np.int32),
        )


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
        self._spread = {moving: spreader(width, shape, plane, moving) for moving in (False, True)}
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
        self._moving, self._tangents, self._slot_s = False, 1, profile.chirp_time_s
        self._path, self._scratch = zeros((2 * RX + 2, BLOCK), np.float64), zeros((4, RX, BLOCK))
        self._cosines = zeros((RX, BLOCK))
        self._work = _Work.make(FIRST_ROOM, layout.slots, chips)
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
            if loop == 0 or self._moving or front_end.per_chirp:
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
            self._work = _Work.make(1 << (k - 1).bit_length(), self._layout.slots, len(self._receivers_m))
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
        self._path[:] = 0.0
        self._moving, self._tangents = bool(scatterers.velocity_m_s.any()), 1
        if self._moving:
            away_m = work.points[1, :, :k] - self._centre_m[:, None]
            range_m = np.maximum(np.linalg.norm(away_m, axis=0), 1e-3)
            velocity = work.velocity[1, :, :k]
            radial = (velocity * away_m).sum(axis=0) / range_m
            speed2 = np.square(velocity).sum(axis=0)
            work.bend[:k] = 0.5 * (speed2 - np.square(radial)) / range_m
            half_s = 0.5 * self._layout.loops * self._layout.slots * self._slot_s
            if float((speed2 / range_m).max()) * half_s**2 > BOW_M:
                self._tangents = self._layout.loops

    def _grid_loop(self, k: int, loop: int, jitter_s: Float64 | None) -> None:
        """Spread the scatterers as one loop sees them; loops come in order.

        The receive legs are tangents of every loop, or of the whole burst when no path bows far from its own.
        """
        work, layout = self._work, self._layout
        slots, first = layout.slots, loop if self._tangents > 1 else 0
        time_s = (loop * slots + np.arange(slots)) * self._slot_s
        middle_s = (first * slots + 0.5 * (slots * (1 if self._tangents > 1 else layout.loops) - 1)) * self._slot_s
        out_scale = np.zeros(2 + slots)
        out_scale[:2] = self._cells_per_m, self._turns_per_m
        if jitter_s is not None:
            out_scale[2:] = jitter_s * self._jitter_turns_per_m_s
        transmit_legs(
            *(k, work.points[0], work.velocity[0], work.bend, work.amplitude, self._transmitters_m, time_s, middle_s),
            *(out_scale, work.re, work.im, work.cell_out, work.base_out, *work.reach_out, self._path[:1]),
        )
        if loop == first:
            timing = np.array([middle_s, time_s[0], self._slot_s if self._moving else 0.0])
            receive_legs(
                *(k, work.points[1], work.velocity[1], self._receivers_m),
                *(np.array([self._cells_per_m, self._turns_per_m, self._offset_m]), timing),
                *(np.float32(SHAPES[self.width]), np.float32(self.width - 2), self._factors, work.legs, work.turn),
                *(work.cell_back, work.base_back, *work.reach_back, self._path, self._cosines, self._scratch),
            )
        self._require_reach(k)
        self._grid[:] = 0.0
        work.base[:k] = work.base_out[:k] + work.base_back[:k] + MARGIN
        self._spread[self._moving](
            *(k, work.re, work.im, work.cell_out, work.cell_back, time_s - middle_s, work.base, work.legs, work.turn),
            *(work.drift, work.plan, work.start, self._grid),
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
    """Codes [chips, loops, slots, samples * rx * 2], I first, into the capture's own order."""
    parts = codes.reshape(*codes.shape[:3], layout.samples, RX, 2)
    parts = parts[..., ::-1] if layout.iq_order == "QI" else parts
    if layout.kind == "cascade":
        adc[:] = parts
        return
    halves = parts[0].reshape(layout.loops, layout.slots, layout.samples // 2, 2, RX, 2)
    adc.reshape(layout.loops, layout.slots, RX, layout.samples // 2, 2, 2)[:] = halves.transpose(0, 1, 4, 2, 5, 3)
