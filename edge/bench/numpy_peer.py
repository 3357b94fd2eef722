# SPDX-License-Identifier: Apache-2.0
"""The peer of the benchmark: the same signal path in NumPy, float32, written as a good NumPy user would.

Tables are made once, FFTs are batched complex64, CFAR sums are running sums. It computes the same heatmap and the same
cell-averaging decisions as the kernels; ``tests/test_bench.py`` holds the two together.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp import tables
from edge.dsp.antenna import along_loss_db
from edge.dsp.imager import SHORTEST_RANGE_M, RowGeometry
from edge.dsp.threshold import cfar_scale
from edge.frames import Float32, RadarFrame

if TYPE_CHECKING:
    from edge.rig import Radar


class NumpyImager:
    """Heatmap of one cascade radar standing still, as ``edge.dsp.imager.Imager`` defines it.

    Args:
        radar, settings, antenna: as the imager takes them; ``settings.loops`` 0 sums all loops.
    """

    def __init__(self, radar: Radar, settings: HeatmapSettings, antenna: AntennaSettings) -> None:
        layout, profile, calibration = radar.schedule.layout, radar.schedule.profile, radar.calibration
        geometry = RowGeometry.of(radar)
        self._loops, self._bins = settings.loops or layout.loops, settings.angle_bins
        samples = layout.samples
        self._points = max(64, tables.next_power_of_two(samples))
        taper = tables.window(settings.range_window, samples, samples / 2)
        n = np.arange(samples)
        ramp = np.exp(-2j * np.pi * np.asarray(calibration.range_shift_bins)[..., None] * n / samples)
        window = np.asarray(calibration.gain)[..., None] * ramp * (taper / taper.sum()) / self._loops
        shape = (layout.slots, layout.devices, layout.rx, samples)
        self._window = np.ascontiguousarray(window.reshape(shape).transpose(1, 0, 3, 2), dtype=np.complex64)
        range_m = np.maximum(
            np.arange(self._points) * profile.range_bin_m * samples / self._points + radar.mounting.range_offset_m,
            SHORTEST_RANGE_M,
        )
        angle_taper = tables.window(settings.angle_window, geometry.count, (geometry.count - 1) / 2)
        weight = geometry.channel_weight(angle_taper / angle_taper.sum())
        a, b = geometry.transmit_m[:, None, None], geometry.receive_m[None, :, None]
        beyond_m = np.zeros((*weight.shape, self._points))
        if settings.focus:
            baked_m = tables.curvature_m(calibration.reference_range_m, a, b)
            beyond_m = tables.curvature_m(range_m, a, b) - baked_m
        focus = weight[..., None] * np.exp(-2j * np.pi * beyond_m / profile.wavelength_m)
        inside = geometry.element >= 0
        self._slot, self._receiver = np.nonzero(inside)
        self._focus = focus[inside].astype(np.complex64)
        self._element, self._count = geometry.element[inside], geometry.count
        cosine = (np.arange(self._bins) - self._bins // 2) / (self._bins * geometry.pitch)
        self._gain = (10.0 ** (0.2 * along_loss_db(antenna, cosine))).astype(np.float32)[:, None]

    def process(self, frame: RadarFrame) -> Float32:
        """Power float32 [angle, range]."""
        codes = frame.adc[:, : self._loops].sum(axis=1, dtype=np.int32).astype(np.float32)
        signal = codes.view(np.complex64)[..., 0] * self._window
        spectrum = np.fft.fft(signal, self._points, axis=2)
        channel = spectrum.transpose(1, 0, 3, 2).reshape(spectrum.shape[1], -1, self._points)
        weighted = channel[self._slot, self._receiver] * self._focus
        row = np.zeros((self._bins, self._points), dtype=np.complex64)
        np.add.at(row, self._element, weighted)
        beams = np.fft.fftshift(np.fft.ifft(row, axis=0, norm="forward"), axes=0)
        return np.asarray((beams.real**2 + beams.imag**2) * self._gain, dtype=np.float32)


def ca_decisions(power: Float32, first: int, settings: CfarSettings) -> NDArray[np.bool_]:
    """Cell-averaging decisions by running sums; periodic in angle, cut at both ends of range.

    Args:
        power: float32 [angle, range].
        first: range cells before it take no part.
        settings: ring and probability.
    Returns:
        bool [angle, range]; false before ``first``.
    """
    cells = power[:, first:]
    outer, outer_count = _box_sum(cells, settings.train_angle, settings.train_range)
    inner, inner_count = _box_sum(cells, settings.guard_angle, settings.guard_range)
    count = outer_count - inner_count
    factor = np.array([cfar_scale("ca", int(c), settings.p_fa, 0) for c in count], dtype=np.float32)
    decided = np.zeros(power.shape, dtype=np.bool_)
    decided[:, first:] = cells > (factor / count) * (outer - inner)
    return decided


def _box_sum(power: Float32, half_angle: int, half_range: int) -> tuple[Float32, NDArray[np.int64]]:
    """Sums over boxes and, for every range cell, how many cells its box holds."""
    wrapped = np.pad(power, ((half_angle + 1, half_angle), (0, 0)), mode="wrap")
    running = np.cumsum(wrapped, axis=0, dtype=np.float64)
    column = running[2 * half_angle + 1 :] - running[: -2 * half_angle - 1]
    along = np.cumsum(np.pad(column, ((0, 0), (1, 0))), axis=1)
    ranges = power.shape[1]
    low = np.maximum(np.arange(ranges) - half_range, 0)
    high = np.minimum(np.arange(ranges) + half_range + 1, ranges)
    count = (high - low) * (2 * half_angle + 1)
    return (along[:, high] - along[:, low]).astype(np.float32), count
