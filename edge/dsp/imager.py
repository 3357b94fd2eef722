# SPDX-License-Identifier: Apache-2.0
"""Imager: raw frame of one radar to range-angle power."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.calibration import Calibration
from edge.config import AntennaSettings, HeatmapSettings, require
from edge.dsp import tables, tdm
from edge.dsp.across import MOST_STEPS, AcrossMotion
from edge.dsp.antenna import along_loss_db
from edge.dsp.blocks import Blocks
from edge.dsp.buffers import aligned, zeros
from edge.dsp.checks import FrameReport, dead_names, reject_all_zero, reject_saturated
from edge.dsp.doppler import DopplerFft
from edge.dsp.effective_cells import noise_correlation
from edge.dsp.elevation import ElevationRows
from edge.dsp.interpolation import fit_response
from edge.dsp.kernels_checks import all_zero, dead_channels
from edge.dsp.kernels_doppler import PADDING, channel_kernel
from edge.dsp.kernels_heatmap import ANGLE_LANES, angle_kernel, range_kernel, row_kernel, set_phasors
from edge.dsp.row import RowGeometry
from edge.dsp.steering import SOLVES_A_FRAME, Steering
from edge.errors import CaptureError
from edge.frames import BurstMotion, Complex64, Float32, Float64, Heatmap, PointResponse, RadarFrame
from edge.waveform import SPEED_OF_LIGHT_M_S

if TYPE_CHECKING:
    from edge.rig import Radar

SHORTEST_RANGE_M = 0.05
STILL = np.zeros(1)
LARGEST_MOTION_ERROR_RAD = 0.01
"""Motion's phase error over the row, rms at the edge of the field of view, that is left alone."""


class Imager:
    """Loop sum, range FFT, TDM and near-field compensation, angle FFT, power of one radar.

    Power is LSB^2 per complex sample: a point target of amplitude a LSB in the middle of a cell gives a^2, divided by
    the two-way antenna gain along the array. Real samples count twice, so that a cos(...) gives a^2 too, and the half
    of their spectrum with positive frequencies is kept. Missing elements of the virtual row are zeros, doubled ones
    are averaged. The rig's motion turns the chirp at time t by 4 pi (v . d) t / lambda, which differs from direction
    to direction: one compensation serves while its error at the edge of the field of view stays below 0.01 rad rms over
    the row, beyond that the transmitters' positions are corrected (edge/dsp/steering.py). What becomes of the loops is
    chosen frame by frame; ``last_report`` says what and why.

    Args:
        radar: board, mounting, schedule, calibration.
        settings: windows, bins, focusing, loops.
        antenna: element pattern.
    Raises:
        ConfigError: ``angle_bins`` is less than twice the elements, or the chirp is longer than 1024 samples.
    """

    def __init__(self, radar: Radar, settings: HeatmapSettings, antenna: AntennaSettings) -> None:
        layout = radar.schedule.layout
        self.radar, self.settings, self.layout = radar, settings, layout
        real = layout.kind == "dca1000_real"
        self._length = max(128 if real else 64, tables.next_power_of_two(layout.samples))
        self.points = self._length // 2 if real else self._length
        self.geometry = RowGeometry.of(radar)
        require(self._length <= 1024, "profile.samples", layout.samples, "at most 1024")
        require(
            settings.angle_bins >= 2 * self.geometry.count,
            "heatmap.angle_bins",
            settings.angle_bins,
            f"at least {2 * self.geometry.count}, twice the {self.geometry.count} elements of the row",
        )
        self.last_report = FrameReport()
        self._profile = radar.schedule.profile
        self._wavelength_m = float(self._profile.wavelength_m)
        self._transmit_time_s = np.asarray(radar.schedule.transmit_time_s, dtype=np.float64)
        self._loop_time_s = layout.slots * float(self._profile.chirp_time_s)
        self._most_loops = min(settings.loops, layout.loops) if settings.loops else layout.loops
        self._make_axes(antenna)
        self._blocks = Blocks.of(layout, self.geometry, settings.read_elevation)
        self._channels = self.geometry.channels()
        self._make_windows()
        self._make_buffers()

    def _make_axes(self, antenna: AntennaSettings) -> None:
        bins = self.settings.angle_bins
        cosine = (np.arange(bins) - bins // 2) / (bins * self.geometry.pitch)
        bin_m = SPEED_OF_LIGHT_M_S * self._profile.sample_rate_hz / (2.0 * self._profile.slope_hz_per_s_actual)
        range_m = np.arange(self.points) * bin_m / self._length + self.radar.mounting.range_offset_m
        self.range_m = range_m.astype(np.float32)
        self.direction_cosine = cosine.astype(np.float32)
        self._gain = (10.0 ** (0.2 * along_loss_db(antenna, cosine))).astype(np.float32)
        (self._sector,) = tdm.divide(cosine, 1)
        self._focus_range_m = np.maximum(range_m, SHORTEST_RANGE_M)

    def _make_windows(self) -> None:
        """Complex windows before and focusing phasors after the range FFT, [block, (re, im), points * rx]."""
        layout, calibration, geometry = self.layout, self.radar.calibration, self.geometry
        samples, rx = layout.samples, layout.rx
        taper = tables.taper(self.settings, "range", samples, samples / 2)
        self._range_taper = (2 // layout.parts) * taper / taper.sum()
        angle_taper = tables.taper(self.settings, "angle", geometry.count, (geometry.count - 1) / 2)
        weight = geometry.channel_weight(angle_taper / angle_taper.sum())
        self._rows = np.arange(self.points, dtype=np.int64) * rx
        phase = np.zeros((*weight.shape, self.points))
        if self.settings.focus:
            a, b = geometry.transmit_m[:, None, None], geometry.receive_m[None, :, None]
            baked = tables.curvature_m(calibration.reference_range_m, a, b)
            phase = -2.0 * np.pi / self._wavelength_m * (tables.curvature_m(self._focus_range_m, a, b) - baked)
        phasor = np.exp(1j * phase)
        self._window = zeros((len(self._blocks.pairs), 2, self._length * rx))
        self._tabulate_calibration()
        self._focus, self._phasors = (zeros((self._blocks.row, 2, self.points * rx)) for _ in range(2))
        self._blocks.tabulate(weight[..., None] * phasor, self._focus)
        self._blocks.tabulate(phasor, self._phasors)
        self._elevation = ElevationRows(
            *(self.radar, self._blocks.pairs, phasor, self._rows, geometry.transmit_m[:, None] + geometry.receive_m),
            *(self._transmit_time_s, self._wavelength_m),
        )
        self._make_response(taper, angle_taper, weight)
        self._across = AcrossMotion(
            *(geometry, angle_taper, self._transmit_time_s, self._wavelength_m, self._motion_rad_s_m),
            *(self._loop_time_s, (self.settings.angle_bins, self.points), self._gain),
        )

    def _tabulate_calibration(self) -> None:
        """Range taper, gain and range shift of every channel into ``_window``."""
        calibration, samples = self.radar.calibration, self.layout.samples
        shift = np.asarray(calibration.range_shift_bins, dtype=np.float64)
        ramp = np.exp(-2j * np.pi * shift[..., None] * np.arange(samples) / samples)
        self._blocks.tabulate(np.asarray(calibration.gain)[..., None] * ramp * self._range_taper, self._window)

    def _make_response(self, taper: Float64, angle_taper: Float64, weight: Float64) -> None:
        """What motion and the spherical wavefront do to a target's peak: weighted least squares over the row.

        With p = a + b the position and q = a^2 + b^2 of a channel, the two-way path of a target at (r, u) is
        2 r - p u + q (1 - u^2) / (2 r) to second order, and a channel's time t adds -2 v u t along the array.
        """
        a, b = self.geometry.transmit_m[:, None], self.geometry.receive_m[None, :]
        p, q = a + b, a * a + b * b
        mean_q = (weight * q).sum() / weight.sum()
        p = p - (weight * p).sum() / weight.sum()
        slope = weight * p / (weight * p * p).sum()
        moved = 2.0 * (self._transmit_time_s[:, None] - p * (slope * self._transmit_time_s[:, None]).sum())
        moved = moved - (weight * moved).sum() / weight.sum()
        mean_square = (weight * moved * moved).sum() / weight.sum()
        self._motion_rad_s_m = float(2.0 * np.pi / self._wavelength_m * np.sqrt(mean_square))
        focus_inverse_m = -1.0 if self.settings.focus else 0.5 / self.radar.calibration.reference_range_m
        inside = weight > 0.0
        bin_m = float(self.range_m[1] - self.range_m[0])
        noise = angle_taper**2 / np.where(self.geometry.multiplicity > 0, self.geometry.multiplicity, np.inf)
        slope_q = (slope * q).sum()
        self._response = PointResponse(
            range_fit=fit_response(taper, self._length, weight[inside], p[inside] / (2.0 * bin_m)),
            angle_fit=fit_response(angle_taper, self.settings.angle_bins, np.ones(1), np.zeros(1)),
            gain=self._gain,
            range_bias_m2=float(0.25 * mean_q),
            cosine_bias_m=float(slope_q),
            focus_inverse_m=focus_inverse_m,
            range_correlation=noise_correlation(taper**2, self._length),
            angle_correlation=noise_correlation(noise, self.settings.angle_bins),
            range_envelope=tables.response_envelope(taper, self._length),
            angle_envelope=tables.defocused_envelopes(
                *(weight, self.geometry.element, (q - mean_q - slope_q * p) / self._wavelength_m, angle_taper),
                bins=self.settings.angle_bins,
            ),
            range_spread_bins=float(np.abs(p[inside]).max() / (2.0 * bin_m)),
            usable_range_m=self.radar.schedule.profile.usable_range_m,
        )

    def _make_buffers(self) -> None:
        layout, bins, plane = self.layout, self.settings.angle_bins, self._length * self.layout.rx
        self._range_kernel = range_kernel(layout.kind, layout.iq_order == "QI", self._length)
        self._channel_kernel = channel_kernel(self.points, layout.rx)
        self._row_kernel = row_kernel(self.points)
        self._angle_kernel = angle_kernel(bins, self.points, ANGLE_LANES)
        self._range_twiddle = aligned(tables.twiddles(self._length, -1, layout.rx))
        self._range_order = tables.last_stage_order(self._length)
        self._angle_twiddle = tables.twiddles(bins, +1, 0)
        self._target = tables.centred_rows(bins)
        self._phasor = np.ones(layout.slots, dtype=np.complex64)
        self._whole, self._sums = zeros((len(self._blocks.pairs), 2 * plane)), zeros(2 * plane)
        self._whole_rows, self._spectra = self._whole.view(np.complex128), self._whole
        if self.points < self._length:
            self._spectra = zeros((len(self._blocks.pairs), 2 * self.points * layout.rx))
        self._range_work, self._row_work = zeros(2 * plane), zeros(2 * self.points * layout.rx)
        self._range_rows = self._range_work.view(np.complex128)
        self._row, self._angle_work = zeros((2, self.geometry.count, self.points)), zeros(2 * bins * ANGLE_LANES)
        self._power = zeros((bins, self.points))
        self._aligned = np.zeros(layout.int16_count // 2, dtype=np.int32)
        self._dead = np.zeros((layout.slots, layout.devices * layout.rx), dtype=np.uint8)
        loops = tables.next_power_of_two(self._most_loops)
        self._cube = zeros((len(self._channels.slot), loops, 2, self.points + PADDING))
        time_s = self._transmit_time_s + self._loop_time_s * np.arange(self._most_loops)[:, None]
        self._steering = Steering(
            *(self.geometry, self._channels, self.settings, time_s, self._wavelength_m, self.points, self._gain),
            self.direction_cosine.astype(np.float64),
        )
        self._still = self.choice(None)

    def choice(self, velocity_rig_m_s: Float64 | None) -> tdm.Choice:
        """What becomes of a burst's loops at this velocity; none given counts as standing still."""
        most = self._most_loops
        forward_m_s, along_m_s, across_m_s = tdm.motion_m_s(velocity_rig_m_s, self.radar.radar)
        speed_m_s = 0.0 if velocity_rig_m_s is None else tdm.radial_speed_in_fov_m_s(velocity_rig_m_s)
        coherent = tdm.coherent_loops(speed_m_s, self._wavelength_m, self._loop_time_s, most)
        steerable = most
        if speed_m_s > 0.0 and coherent < most:
            bin_m = float(self.range_m[1] - self.range_m[0]) * self._length / self.layout.samples
            in_bin = int(bin_m / (speed_m_s * self._loop_time_s))
            steerable = min(most, max(1, in_bin), self._steering.loops_that_fit(forward_m_s, along_m_s, most))
        tried, of_partner = (len(self._across.speeds_m_s(speed)) for speed in (across_m_s, along_m_s))
        unfolded = len(self._channels.pairs) > 0 or 4.0 * speed_m_s * self._loop_time_s < self._wavelength_m
        at_m_s, sideways = None if velocity_rig_m_s is None else speed_m_s, unfolded and max(tried, of_partner) > 1
        return tdm.choose(self.settings.doppler, most, coherent, steerable, at_m_s, tried, sideways)

    def recalibrate(self, calibration: Calibration) -> None:
        """Use another calibration of the same board from the next frame on, as an imager newly made with it would.

        Raises:
            ConfigError: another reference range, on which the focusing tables depend.
        """
        made_m, reference_m = self.radar.calibration.reference_range_m, calibration.reference_range_m
        require(reference_m == made_m, "calibration.reference_range_m", reference_m, str(made_m), "make a new imager")
        self.radar = replace(self.radar, calibration=calibration)
        self._tabulate_calibration()
        self._steering.beam_weights.forget()

    def velocities_to_rehearse(self, fastest_m_s: float) -> list[Float64]:
        """Velocities float64 [3] across the array, one for every number of maps up to this speed."""
        velocities = np.zeros((MOST_STEPS, 3))
        velocities[:, 3 - tdm.array_axis(self.radar.radar)] = self._across.every_speed_m_s()
        return list(velocities[np.abs(velocities).max(axis=1) <= fastest_m_s])

    @cached_property
    def _doppler(self) -> DopplerFft:
        return DopplerFft(
            *(self.geometry, self._channels, self.settings, self._most_loops, self.layout.slots, self._loop_time_s),
            *(self._wavelength_m, self.points, self._gain),
        )

    def process(
        self,
        frame: RadarFrame,
        velocity_rig_m_s: Float64 | None = None,
        slot_phasors: Complex64 | None = None,
    ) -> Heatmap:
        """Heatmap of one frame; its arrays are this imager's buffers and valid until the next call.

        Args:
            frame: raw samples in the layout of the radar's schedule.
            velocity_rig_m_s: float64 [3], rig over ground in rig axes; none: standing still.
            slot_phasors: complex64 [slots] that replace the boresight compensation, for example those of a Doppler bin
                (``tdm.doppler_phasors``).
        Raises:
            CaptureError: another radar's frame, or another layout than the schedule's.
            FrameRejected: all samples zero, or too many at the rails.
            PoseError: the velocity is no number.
        """
        if frame.radar != self.radar.radar or (frame.layout is not self.layout and frame.layout != self.layout):
            raise CaptureError(
                f"{frame.radar} frame {frame.number} has another layout than the {self.radar.radar} radar's schedule",
                value=frame.layout,
                allowed=str(self.layout),
                action="use the rig that the capture was made with",
            )
        adc = self._packed(frame)
        if all_zero(adc):
            raise reject_all_zero(frame)
        choice = self._still if velocity_rig_m_s is None else self.choice(velocity_rig_m_s)
        by_loop = choice.name in ("steer", "fft")
        rails = self._run_loops(adc, choice) if by_loop else self._run_range(adc, choice.loops)
        self._report(adc, choice, rails)
        if self.last_report.saturated_share > self.settings.max_saturated_share:
            raise reject_saturated(frame, self.last_report.saturated_share, self.settings.max_saturated_share)
        heatmap = Heatmap(
            *(frame.radar, frame.number, frame.t_first_chirp_ns, self._power, self.direction_cosine, self.range_m),
            response=self._response,
        )
        if choice.name == "fft":
            self._doppler.run(self._cube, self._power)
            return replace(heatmap, doppler=self._doppler.maps, maps=choice.loops)
        if slot_phasors is not None:
            np.divide(slot_phasors, choice.loops, out=self._phasor, casting="same_kind")
            self._run_angle(self._sector)
            return heatmap
        forward_m_s, along_m_s, across_m_s = tdm.motion_m_s(velocity_rig_m_s, self.radar.radar)
        speeds_m_s = self._across.speeds_m_s(across_m_s) if across_m_s else STILL
        motion = self._undo_motion(choice, forward_m_s, along_m_s, float(speeds_m_s[0]), True)
        if len(speeds_m_s) == 1:
            return heatmap if motion is None else replace(heatmap, motion=motion)
        self._across.keep(0, self._power)
        for k, speed_m_s in enumerate(speeds_m_s[1:].tolist(), 1):
            self._undo_motion(choice, forward_m_s, along_m_s, speed_m_s, False)
            self._across.keep(k, self._power)
        self._across.settle(self._power)
        correlation = self._across.correlation(len(speeds_m_s), choice.loops if choice.name == "steer" else 1)
        return replace(heatmap, motion=motion, maps=len(speeds_m_s), map_correlation=correlation)

    def _run_range(self, adc: NDArray[np.int32], loops: int, blocks: int | None = None) -> int:
        """Fill ``_spectra`` from the raw words, summed over loops; returns the codes at the rails."""
        rails = self._range_kernel(
            *(adc, loops, self._blocks.loop_stride, self._blocks.start[:blocks], self.layout.samples, self._window),
            *(self._range_twiddle, self._range_order, self._sums, self._range_work, self._range_rows),
            *(self._whole, self._whole_rows),
        )
        if self.points < self._length:
            planes = len(self._whole), 2, -1
            np.copyto(self._spectra.reshape(planes), self._whole.reshape(planes)[:, :, : self.points * self.layout.rx])
        return int(rails)

    def _run_loops(self, adc: NDArray[np.int32], choice: tdm.Choice) -> int:
        """Fill ``_cube`` loop by loop, transmitters beside the row in the last loop; returns the codes at the rails."""
        focus, rails = self._focus if choice.name == "fft" else self._phasors, 0
        for loop in range(choice.loops):
            blocks = self._blocks.row if loop + 1 < choice.loops else len(self._blocks.pairs)
            rails += self._run_range(adc[loop * self._blocks.loop_stride :], 1, blocks)
            self._order_channels(focus, loop)
        return rails

    def _order_channels(self, focus: Float32, loop: int) -> None:
        """Focus ``_spectra`` into one loop of ``_cube``."""
        self._channel_kernel(
            *(self._spectra, focus, self._rows, self._blocks.channel, self._row_work, loop, self._cube),
        )

    def _undo_motion(
        self, choice: tdm.Choice, forward_m_s: float, along_m_s: float, extra_m_s: float, first: bool
    ) -> BurstMotion | None:
        """Fill ``_power`` with the motion undone: by one phase per slot while that is enough, else by steering.

        Points come nearer by ``extra_m_s`` besides; ``first`` call for this frame, later ones differ in that only.
        """
        slowest_m_s, fastest_m_s = tdm.closing_range_m_s(forward_m_s, along_m_s)
        summed = choice.name != "steer"
        if summed and self._motion_rad_s_m * 0.5 * (fastest_m_s - slowest_m_s) <= LARGEST_MOTION_ERROR_RAD:
            closing_m_s = 0.5 * (slowest_m_s + fastest_m_s) + extra_m_s
            set_phasors(self._phasor, -closing_m_s, self._transmit_time_s, self._wavelength_m, float(choice.loops))
            self._run_angle(self._sector)
            return None
        if summed and first:
            self._order_channels(self._phasors, 0)
        loops = 1 if summed else choice.loops
        motion = self._steering.run(
            *(self._cube, forward_m_s, along_m_s, loops, self._power, extra_m_s, SOLVES_A_FRAME if first else 0)
        )
        if summed and choice.loops > 1:
            self._power *= np.float32(1.0 / choice.loops**2)
        return motion

    def _run_angle(self, sector: tdm.Sector) -> None:
        """Fill the sector's rows of ``_power`` from ``_spectra`` and ``_phasor``."""
        blocks = (self._spectra, self._blocks.slot, self._blocks.element, self._focus)
        self._row_kernel(*blocks, self._phasor, self._row_work, self._row)
        self._angle_kernel(
            *(self._row, self._angle_twiddle, self._target, self._gain, sector.first, sector.last),
            *(self._angle_work, self._power),
        )

    def _packed(self, frame: RadarFrame) -> NDArray[np.int32]:
        """The frame as int32 words; copied only when its memory is not aligned to them."""
        words = frame.adc.reshape(-1).view(np.int32)
        if words.flags.aligned:
            return words
        np.copyto(self._aligned, words)
        return self._aligned

    def _report(self, adc: NDArray[np.int32], choice: tdm.Choice, rails: int) -> None:
        layout = self.layout
        beside = len(self._blocks.pairs) - self._blocks.row
        blocks = choice.loops * self._blocks.row + beside * (1 if choice.name in ("steer", "fft") else choice.loops)
        share = rails / (layout.parts * blocks * layout.samples * layout.rx)
        channels = (self._blocks.channel_start, self._blocks.channel_samples, self._blocks.channel_step)
        dead = dead_channels(adc, *channels, self._blocks.channel_word, self._dead)
        names = dead_names(self._dead, self.radar.schedule.transmitters) if dead else ()
        self.last_report = FrameReport(choice.loops, share, names, choice.name, choice.reason)

    def elevation_beams(
        self, range_bin: int, direction_cosine: float, closing_m_s: float = 0.0
    ) -> tuple[Float64, Complex64]:
        """Beams of all rows of the board towards one cell of the last frame (its last loop, or the loops' sum).

        Args:
            range_bin, direction_cosine: of the cell.
            closing_m_s: speed at which a static point there comes nearer.
        Returns:
            float64 [rows], phase of each row in turns per direction cosine across the array (rig axis z for the
            horizontal radar, y for the vertical one), and complex64 [rows], the beams.
        Raises:
            ConfigError: ``heatmap.read_elevation`` is off.
        """
        require(self.settings.read_elevation, "heatmap.read_elevation", False, "true for beams of the elevation rows")
        beams = self._elevation.beams(self._spectra, range_bin, direction_cosine, closing_m_s)
        return self._elevation.turns_per_cosine, beams
