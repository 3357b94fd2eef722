# SPDX-License-Identifier: Apache-2.0
"""Imager: raw frame of one radar to range-angle power."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.config import AntennaSettings, HeatmapSettings, require
from edge.dsp import tables, tdm
from edge.dsp.antenna import along_loss_db
from edge.dsp.checks import FrameReport, dead_names, reject_all_zero, reject_saturated
from edge.dsp.effective_cells import noise_correlation
from edge.dsp.interpolation import fit_response
from edge.dsp.kernels_checks import all_zero, dead_channels
from edge.dsp.kernels_heatmap import angle_kernel, range_kernel, row_kernel, set_phasors
from edge.errors import CaptureError
from edge.frames import Complex64, Float32, Float64, Heatmap, PointResponse, RadarFrame

if TYPE_CHECKING:
    from edge.rig import Radar

SPEED_OF_LIGHT_M_S = 299_792_458.0
SHORTEST_RANGE_M = 0.05
ANGLE_LANES = 32
MOST_SECTORS = 9
LARGEST_MOTION_ERROR_RAD = 0.15


@dataclass(frozen=True, slots=True)
class RowGeometry:
    """Where every channel stands in the virtual row of one radar.

    Args:
        element: int64 [slots, receivers], index in the row, ascending along the rig axis; -1: not in the row.
        count: elements of the row.
        multiplicity: int64 [count], channels of each element.
        transmit_m, receive_m: [slots], [receivers] offsets from the phase centre along the rig axis.
        pitch: element spacing in wavelengths, two-way phase 2 pi pitch u per element.
    """

    element: NDArray[np.int64]
    count: int
    multiplicity: NDArray[np.int64]
    transmit_m: Float64
    receive_m: Float64
    pitch: float

    @classmethod
    def of(cls, radar: Radar) -> RowGeometry:
        """Geometry of ``radar``'s row, turned into the rig axis by the mounting's array sign."""
        position = np.asarray(radar.array.position, dtype=np.int64)
        inside = position >= 0
        element = position - position[inside].min()
        count = int(element[inside].max()) + 1
        sign = radar.mounting.array_sign
        element = np.where(inside, element if sign > 0 else count - 1 - element, -1)
        transmit_m, receive_m = (
            sign * np.asarray(offset, dtype=np.float64) for offset in radar.array.element_offsets_m()
        )
        multiplicity = np.bincount(element[inside], minlength=count)
        pitch = float(radar.array.pitch_wavelengths(radar.schedule.profile.center_frequency_hz))
        return cls(element, count, multiplicity, transmit_m, receive_m, pitch)

    def channel_weight(self, taper: Float64) -> Float64:
        """Weight of every channel [slots, receivers]: the element's taper shared by its channels; 0 outside the row."""
        per_element = taper / np.maximum(self.multiplicity, 1)
        return np.where(self.element >= 0, per_element[self.element], 0.0)


class Imager:
    """Loop sum, range FFT, TDM and near-field compensation, angle FFT, power of one radar.

    Power is LSB^2 per complex sample: a point target of amplitude a LSB in the middle of a cell gives a^2, divided by
    the two-way antenna gain along the array. Elements of the virtual row that are missing are zeros; doubled ones are
    averaged. The rig's motion turns slot s by 4 pi (v . d) t_s / lambda, which differs from direction d to direction:
    the field of view is divided into as many sectors as keep the error at a sector's edge below 0.15 rad rms over the
    row (one up to 0.5 m/s along the array, six at 3 m/s, at most nine), each with its own compensation and angle FFT.

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
        self.points = max(64, tables.next_power_of_two(layout.samples))
        self.geometry = RowGeometry.of(radar)
        require(self.points <= 1024, "profile.samples", layout.samples, "at most 1024")
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
        self._make_axes(antenna)
        self._make_blocks()
        self._make_windows()
        self._make_buffers()

    def _make_axes(self, antenna: AntennaSettings) -> None:
        bins = self.settings.angle_bins
        cosine = (np.arange(bins) - bins // 2) / (bins * self.geometry.pitch)
        bin_m = SPEED_OF_LIGHT_M_S * self._profile.sample_rate_hz / (2.0 * self._profile.slope_hz_per_s_actual)
        range_m = np.arange(self.points) * bin_m / self.points + self.radar.mounting.range_offset_m
        self.range_m = range_m.astype(np.float32)
        self.direction_cosine = cosine.astype(np.float32)
        self._gain = (10.0 ** (0.2 * along_loss_db(antenna, cosine))).astype(np.float32)
        self._sectors = tuple(tdm.divide(cosine, count) for count in range(1, MOST_SECTORS + 1))
        self._focus_range_m = np.maximum(range_m, SHORTEST_RANGE_M)

    def _make_blocks(self) -> None:
        """A block is one slot of one device; those without a channel in the row are left out."""
        layout, element = self.layout, self.geometry.element
        by_block = element.reshape(layout.slots, layout.devices, layout.rx)
        pairs = [(s, d) for d in range(layout.devices) for s in range(layout.slots) if (by_block[s, d] >= 0).any()]
        chirp = layout.samples * layout.rx
        self._loop_stride = layout.slots * chirp
        starts = [d * layout.loops * self._loop_stride + s * chirp for s, d in pairs]
        self._block_start = np.array(starts, dtype=np.int64)
        self._block_slot = np.array([s for s, _ in pairs], dtype=np.int64)
        self._block_element = np.ascontiguousarray([by_block[s, d] for s, d in pairs], dtype=np.int64)
        self._pairs = pairs
        interleaved = layout.kind == "cascade"
        slot, receiver = np.indices((layout.slots, layout.devices * layout.rx))
        device, rx = receiver // layout.rx, receiver % layout.rx
        first = device * layout.loops * self._loop_stride + slot * chirp + rx * (1 if interleaved else layout.samples)
        self._channel_start = np.ascontiguousarray(first, dtype=np.int64)
        self._channel_step = layout.rx if interleaved else 2
        self._channel_word = 1 if interleaved else 2

    def _make_windows(self) -> None:
        """Complex windows before and focusing phasors after the range FFT, [block, (re, im), points * rx]."""
        layout, calibration, geometry = self.layout, self.radar.calibration, self.geometry
        samples, rx = layout.samples, layout.rx
        taper = tables.taper(self.settings, "range", samples, samples / 2)
        n = np.arange(samples)
        shift = np.asarray(calibration.range_shift_bins, dtype=np.float64)
        ramp = np.exp(-2j * np.pi * shift[..., None] * n / samples)
        channel = np.asarray(calibration.gain)[..., None] * ramp * (taper / taper.sum())
        angle_taper = tables.taper(self.settings, "angle", geometry.count, (geometry.count - 1) / 2)
        weight = geometry.channel_weight(angle_taper / angle_taper.sum())
        frequency = tables.frequency_of_row(self.points)
        phase = np.zeros((*weight.shape, self.points))
        if self.settings.focus:
            a, b = geometry.transmit_m[:, None, None], geometry.receive_m[None, :, None]
            baked = tables.curvature_m(calibration.reference_range_m, a, b)
            phase = -2.0 * np.pi / self._wavelength_m * (tables.curvature_m(self._focus_range_m, a, b) - baked)
        focus = weight[..., None] * np.exp(1j * phase[..., frequency])
        self._window = np.zeros((len(self._pairs), 2, self.points * rx), dtype=np.float32)
        self._focus = np.zeros_like(self._window)
        for block, (s, d) in enumerate(self._pairs):
            for table, source in ((self._window, channel), (self._focus, focus)):
                values = source[s, d * rx : (d + 1) * rx].T.reshape(-1)
                table[block, 0, : len(values)] = values.real
                table[block, 1, : len(values)] = values.imag
        self._make_response(taper, angle_taper, weight)

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
            range_fit=fit_response(taper, self.points, weight[inside], p[inside] / (2.0 * bin_m)),
            angle_fit=fit_response(angle_taper, self.settings.angle_bins, np.ones(1), np.zeros(1)),
            gain=self._gain,
            range_bias_m2=float(0.25 * mean_q),
            cosine_bias_m=float(slope_q),
            focus_inverse_m=focus_inverse_m,
            range_correlation=noise_correlation(taper**2, self.points),
            angle_correlation=noise_correlation(noise, self.settings.angle_bins),
            range_envelope=tables.response_envelope(taper, self.points),
            angle_envelope=tables.defocused_envelopes(
                *(weight, self.geometry.element, (q - mean_q - slope_q * p) / self._wavelength_m, angle_taper),
                bins=self.settings.angle_bins,
            ),
            range_spread_bins=float(np.abs(p[inside]).max() / (2.0 * bin_m)),
        )

    def _make_buffers(self) -> None:
        layout, bins, plane = self.layout, self.settings.angle_bins, self.points * self.layout.rx
        self._range_kernel = range_kernel(layout.kind == "cascade", layout.iq_order == "QI", self.points, layout.rx)
        self._row_kernel = row_kernel(self.points, layout.rx)
        self._angle_kernel = angle_kernel(bins, self.points, ANGLE_LANES)
        self._range_twiddle = tables.twiddles(self.points, -1, layout.rx)
        self._angle_twiddle = tables.twiddles(bins, +1, 0)
        frequency = tables.frequency_of_row(self.points)
        self._rows = np.argsort(frequency).astype(np.int64) * layout.rx
        self._target = (tables.frequency_of_row(bins) + bins // 2) % bins
        self._phasor = np.ones(layout.slots, dtype=np.complex64)
        self._spectra = np.zeros((len(self._pairs), 2 * plane), dtype=np.float32)
        self._sums = np.zeros(2 * plane, dtype=np.float32)
        self._row_work = np.zeros(2 * plane, dtype=np.float32)
        self._angle_work = np.zeros(2 * bins * ANGLE_LANES, dtype=np.float32)
        self._row = np.zeros((2, self.geometry.count, self.points), dtype=np.float32)
        self._power = np.zeros((bins, self.points), dtype=np.float32)
        self._aligned = np.zeros(layout.int16_count // 2, dtype=np.int32)
        self._dead = np.zeros((layout.slots, layout.devices * layout.rx), dtype=np.uint8)

    def loops_for(self, velocity_rig_m_s: Float64 | None) -> int:
        """Loops summed coherently at this velocity; none given counts as standing still."""
        most = min(self.settings.loops, self.layout.loops) if self.settings.loops else self.layout.loops
        speed_m_s = 0.0 if velocity_rig_m_s is None else tdm.radial_speed_in_fov_m_s(velocity_rig_m_s)
        return tdm.coherent_loops(speed_m_s, self._wavelength_m, self._loop_time_s, most)

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
        """
        if frame.radar != self.radar.radar or frame.layout != self.layout:
            raise CaptureError(
                f"{frame.radar} frame {frame.number} has another layout than the {self.radar.radar} radar's schedule",
                value=frame.layout,
                allowed=str(self.layout),
                action="use the rig that the capture was made with",
            )
        adc = self._packed(frame)
        if all_zero(adc):
            raise reject_all_zero(frame)
        loops = self.loops_for(velocity_rig_m_s)
        self._report(adc, loops, self._run_range(adc, loops))
        if self.last_report.saturated_share > self.settings.max_saturated_share:
            raise reject_saturated(frame, self.last_report.saturated_share, self.settings.max_saturated_share)
        if slot_phasors is not None:
            np.divide(slot_phasors, loops, out=self._phasor, casting="same_kind")
            self._run_angle(self._sectors[0][0])
        else:
            self._run_sectors(velocity_rig_m_s, loops)
        return Heatmap(
            *(frame.radar, frame.number, frame.t_first_chirp_ns, self._power, self.direction_cosine, self.range_m),
            response=self._response,
        )

    def _run_range(self, adc: NDArray[np.int32], loops: int) -> int:
        """Fill ``_spectra`` from the raw words; returns the codes at the rails."""
        rails = self._range_kernel(
            *(adc, loops, self._loop_stride, self._block_start, self.layout.samples, self._window),
            *(self._range_twiddle, self._sums, self._spectra),
        )
        return int(rails)

    def _run_sectors(self, velocity: Float64 | None, loops: int) -> None:
        """Undo the motion and fill ``_power``, sector by sector."""
        forward_m_s = 0.0 if velocity is None else float(velocity[0])
        along_m_s = 0.0 if velocity is None else float(velocity[tdm.array_axis(self.radar.radar)])
        for sector in self._sectors[self._sector_count(along_m_s) - 1]:
            closing_m_s = forward_m_s * math.sqrt(1.0 - sector.centre**2) + along_m_s * sector.centre
            set_phasors(self._phasor, -closing_m_s, self._transmit_time_s, self._wavelength_m, float(loops))
            self._run_angle(sector)

    def _sector_count(self, along_m_s: float) -> int:
        error_rad = self._motion_rad_s_m * abs(along_m_s) * tdm.FOV_COSINE
        return min(max(1, math.ceil(error_rad / LARGEST_MOTION_ERROR_RAD)), MOST_SECTORS)

    def _run_angle(self, sector: tdm.Sector) -> None:
        """Fill the sector's rows of ``_power`` from ``_spectra`` and ``_phasor``."""
        self._row_kernel(
            *(self._spectra, self._block_slot, self._block_element, self._focus, self._rows, self._phasor),
            *(self._row_work, self._row),
        )
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

    def _report(self, adc: NDArray[np.int32], loops: int, rails: int) -> None:
        layout = self.layout
        share = rails / (2 * loops * len(self._pairs) * layout.samples * layout.rx)
        dead = dead_channels(
            adc, self._channel_start, layout.samples, self._channel_step, self._channel_word, self._dead
        )
        names = dead_names(self._dead, self.radar.schedule.transmitters) if dead else ()
        self.last_report = FrameReport(loops, share, names)

    @property
    def row(self) -> Float32:
        """Calibrated, focused, tapered spectra [(re, im), element, range] of the last frame's last sector."""
        return self._row
