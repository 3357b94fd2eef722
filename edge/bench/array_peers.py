# SPDX-License-Identifier: Apache-2.0
"""The signal path as a good user of NumPy and of SciPy would write it: float32, batched FFTs, tables made once."""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge.bench.peer import Cells, Peer, Row, peaks, samples
from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp import tables
from edge.errors import DependencyError
from edge.frames import Float32, RadarFrame

if TYPE_CHECKING:
    from edge.rig import Radar


class NumpyPeer(Peer):
    """``numpy.fft`` and running sums."""

    name = "numpy float32"
    differences = "whole bins; powers as received"

    def __init__(self, radar: Radar, heatmap: HeatmapSettings, antenna: AntennaSettings, cfar: CfarSettings) -> None:
        super().__init__(radar, heatmap, antenna, cfar)
        self._fft: ModuleType | Any = np.fft
        self._more: dict[str, Any] = {}
        self._row = Row(self.imager)
        layout, calibration = radar.schedule.layout, radar.calibration
        taper = tables.taper(heatmap, "range", layout.samples, layout.samples / 2)
        ramp = np.exp(
            -2j * np.pi * np.asarray(calibration.range_shift_bins)[..., None] * np.arange(len(taper)) / len(taper)
        )
        window = np.asarray(calibration.gain)[..., None] * ramp * (taper / taper.sum()) / layout.loops
        shape = (layout.slots, layout.devices, layout.rx, layout.samples)
        self._window = np.ascontiguousarray(window.reshape(shape).transpose(1, 0, 3, 2), dtype=np.complex64)

    def image(self, frame: RadarFrame) -> Float32:
        """Received power float32 [angle, range]; all transmitters are transformed, those beside the row too."""
        signal = samples(frame)
        signal *= self._window
        spectrum = self._fft.fft(signal, self.points, axis=2, **self._more)
        row = self._row.fill(spectrum[self._row.device, self._row.slot, :, self._row.rx])
        beams = self._fft.ifft(row, self.bins, axis=0, norm="forward", **self._more)
        power = beams.real**2
        power += beams.imag**2
        return np.fft.fftshift(power, axes=0)

    def cells(self, image: Float32) -> tuple[Cells, Float32]:
        """Cells above the factor of their ring's mean."""
        return peaks(self.decided(image), image), image

    def decided(self, power: Float32) -> NDArray[np.bool_]:
        """Decision of every cell [angle, range]; false before the shortest range."""
        cells, first, cfar = power[:, self.first :], self.first, self.cfar
        ring = self.box(cells, cfar.train_angle, cfar.train_range) - self.box(cells, cfar.guard_angle, cfar.guard_range)
        scale = (self.tables.factor[first:] / self.tables.cells[first:]).astype(np.float32)
        decided = np.zeros(power.shape, dtype=np.bool_)
        decided[:, first:] = cells > scale * ring
        return decided

    def box(self, power: Float32, half_angle: int, half_range: int) -> Float32:
        """Sums over boxes, periodic in angle, cut in range; float64 within, or strong cells drown the others."""
        wrapped = np.pad(power, ((half_angle + 1, half_angle), (0, 0)), mode="wrap")
        running = np.cumsum(wrapped, axis=0, dtype=np.float64)
        column = running[2 * half_angle + 1 :] - running[: -2 * half_angle - 1]
        along = np.cumsum(np.pad(column, ((0, 0), (1, 0))), axis=1)
        ranges = np.arange(power.shape[1])
        low, high = np.maximum(ranges - half_range, 0), np.minimum(ranges + half_range + 1, len(ranges))
        return (along[:, high] - along[:, low]).astype(np.float32)


class ScipyPeer(NumpyPeer):
    """``scipy.fft`` and ``scipy.ndimage.uniform_filter``.

    Raises:
        DependencyError: SciPy is not installed.
    """

    name = "numpy + scipy float32"
    differences = "whole bins; powers as received; sums of boxes in float32"

    def __init__(self, radar: Radar, heatmap: HeatmapSettings, antenna: AntennaSettings, cfar: CfarSettings) -> None:
        super().__init__(radar, heatmap, antenna, cfar)
        try:
            from scipy import fft, ndimage
        except ImportError as error:
            raise DependencyError("this peer needs scipy", action="pip install 'rfconstruct[bench]'") from error
        self._fft, self._ndimage, self._more = fft, ndimage, {"overwrite_x": True}

    def box(self, power: Float32, half_angle: int, half_range: int) -> Float32:
        """Means of boxes times their size."""
        size = (2 * half_angle + 1, 2 * half_range + 1)
        mean: Float32 = self._ndimage.uniform_filter(power, size, mode=("wrap", "constant"))
        mean *= np.float32(size[0] * size[1])
        return mean


class ScipyRankPeer(ScipyPeer):
    """``scipy.ndimage.rank_filter`` over the ring, exact away from the ends of range."""

    name = "numpy + scipy float32"
    differences = "whole bins; powers as received; the ring is mirrored at the ends of range"

    def decided(self, power: Float32) -> NDArray[np.bool_]:
        """Cells above the factor of their ring's ordered statistic."""
        cfar, first = self.cfar, self.first
        ring = np.ones((2 * cfar.train_angle + 1, 2 * cfar.train_range + 1), dtype=np.bool_)
        angle, cell = (slice(t - g, t + g + 1) for t, g in self._half_widths())
        ring[angle, cell] = False
        middle = self.points // 2
        rank = int(self.tables.cells[middle] - self.tables.allowed[middle]) - 1
        wrapped = np.pad(power[:, first:], ((cfar.train_angle, cfar.train_angle), (0, 0)), mode="wrap")
        statistic = self._ndimage.rank_filter(wrapped, rank, footprint=ring)[cfar.train_angle : -cfar.train_angle]
        decided = np.zeros(power.shape, dtype=np.bool_)
        decided[:, first:] = power[:, first:] > self.tables.factor[first:] * statistic
        return decided

    def _half_widths(self) -> tuple[tuple[int, int], tuple[int, int]]:
        cfar = self.cfar
        return (cfar.train_angle, cfar.guard_angle), (cfar.train_range, cfar.guard_range)
