# SPDX-License-Identifier: Apache-2.0
"""Doppler FFT over loops: a map per Doppler bin, compensated between slots, speeds unfolded by doubled elements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.config import HeatmapSettings
from edge.dsp import tables
from edge.dsp.buffers import zeros
from edge.dsp.kernels_doppler import doppler_fft, doppler_row, keep_larger, resolve_folds
from edge.dsp.kernels_heatmap import ANGLE_LANES, angle_kernel
from edge.dsp.row import RowChannels, RowGeometry
from edge.frames import DopplerMaps, Float32, Heatmap

LEAST_RANGE_M = 0.1


class DopplerFft:
    """Range-angle power of every Doppler bin of one radar, and the strongest of them.

    Bin k of L holds the radial speed lambda k / (2 slots Tc L), positive away, plus m times the interval
    lambda / (2 slots Tc). m is the multiple with which the doubled elements agree best, for every Doppler and range bin
    on its own: up to lambda / (4 Tc). Without doubled elements m is 0.

    Args:
        geometry, channels: of the row.
        settings: angle bins.
        loops: captured and used; padded to a power of two.
        slots: chirps of one loop.
        loop_time_s: slots times chirp time.
        wavelength_m: at the middle of the ADC window.
        points: range bins.
        gain: float32 [angle], factor of the power.
    """

    def __init__(
        self,
        geometry: RowGeometry,
        channels: RowChannels,
        settings: HeatmapSettings,
        loops: int,
        slots: int,
        loop_time_s: float,
        wavelength_m: float,
        points: int,
        gain: Float32,
    ) -> None:
        self.loops, self.size = loops, tables.next_power_of_two(loops)
        bins, size = settings.angle_bins, self.size
        self._channels, self._gain = channels, gain
        interval_m_s = wavelength_m / (2.0 * loop_time_s)
        k = np.arange(size) - size // 2
        most = slots // 2 if len(channels.pairs) else 0
        self._folds = np.arange(-most, most + 1)
        turns = (k[:, None] + self._folds * size) / (slots * size)
        self._hypothesis = np.exp(-2j * np.pi * turns[..., None] * channels.distance).astype(np.complex64)
        undo = np.exp(-2j * np.pi * turns[..., None] * np.arange(slots)) / loops
        self._turns = np.ascontiguousarray(np.stack((undo.real, undo.imag), axis=-1), dtype=np.float32)
        n = np.exp(-2j * np.pi * np.arange(size // 2) / size)
        self._loop_twiddle = np.ascontiguousarray(np.stack((n.real, n.imag)), dtype=np.float32)
        digits = size.bit_length() - 1
        self._place = [int(format(i % size, f"0{digits}b")[::-1], 2) if digits else 0 for i in k.tolist()]
        distances = max(1, len(channels.distance))
        self._work = zeros((distances, 2, points))
        self._score = zeros(points)
        self._turn = zeros((slots, 2, points))
        self._row = zeros((2, geometry.count, points))
        self._angle_kernel = angle_kernel(bins, points, ANGLE_LANES)
        self._twiddle = tables.twiddles(bins, +1, 0)
        self._target = tables.centred_rows(bins)
        self._angle_work = zeros(2 * bins * ANGLE_LANES)
        maps = zeros((size, bins, points))
        index = np.zeros((size, points), dtype=np.int8)
        delay_s = 0.5 * (loops - 1) * loop_time_s + 0.5 * loop_time_s * (slots - 1) / slots
        self.maps = DopplerMaps(maps, index, k * interval_m_s / size, interval_m_s, most, delay_s)

    def run(self, cube: Float32, power: Float32) -> None:
        """Fill ``maps`` and ``power`` [angle, range] from ``cube`` [channel, size, (re, im), range], which is used up.

        Loops of ``cube`` from ``loops`` on are overwritten with zeros.
        """
        cube[:, self.loops :] = 0.0
        doppler_fft(cube, self._loop_twiddle)
        channels = self._channels
        for d in range(self.size):
            place, fold = self._place[d], self.maps.fold[d]
            if len(channels.pairs):
                resolve_folds(
                    *(cube, place, channels.pairs, len(channels.distance), self._hypothesis[d]),
                    *(self._work, self._score, fold),
                )
            doppler_row(
                *(cube, place, channels.slot, channels.element, self._turns[d], fold, self._turn, self._row),
            )
            self._angle_kernel(
                *(self._row, self._twiddle, self._target, self._gain, 0, len(power), self._angle_work),
                self.maps.power[d],
            )
            keep_larger(self.maps.power[d], float(d > 0), power)


def speeds_m_s(maps: DopplerMaps, angle: NDArray[np.int64], range_bin: NDArray[np.int64]) -> Float32:
    """Radial speed of cells of a heatmap: the strongest bin, between bins by the larger neighbour's amplitude.

    p = A / (A0 + A) bins towards the larger neighbour of amplitude A: exact for one target and loops without a window.

    Args:
        maps: of the heatmap.
        angle, range_bin: int64 [n], cells.
    Returns:
        float32 [n] m/s, positive away.
    """
    size = len(maps.power)
    amplitude = np.sqrt(maps.power[:, angle, range_bin])
    best = amplitude.argmax(axis=0)
    n = np.arange(len(angle))
    after, before = amplitude[(best + 1) % size, n], amplitude[(best - 1) % size, n]
    larger = np.maximum(after, before)
    offset = np.where(after > before, 1.0, -1.0) * larger / np.maximum(amplitude[best, n] + larger, 1e-30)
    fold = maps.fold[best, range_bin].astype(np.int64) - maps.most_folds
    speed = maps.speed_m_s[best] + fold * maps.interval_m_s + offset * maps.interval_m_s / size
    return np.asarray(speed, dtype=np.float32)


def finish(
    heatmap: Heatmap,
    cells: NDArray[np.int64],
    range_m: Float32,
    direction_cosine: Float32,
) -> Float32:
    """Doppler of detected cells, and their places moved back from the middle of the burst to its first chirp.

    A static point at (r, u) closes in by c = v_x sqrt(1 - u^2) + v_along u and turns by du/dt = (c u - v_along) / r.

    Args:
        heatmap: in which they were detected.
        cells: int64 [n], their flat indices.
        range_m, direction_cosine: float32 [n], corrected in place.
    Returns:
        float32 [n] radial speed, positive away; NaN where it was not measured.
    """
    if heatmap.motion is not None:
        motion, u = heatmap.motion, direction_cosine
        closing_m_s = motion.forward_m_s * np.sqrt(np.maximum(1.0 - u * u, 0.0)) + motion.along_m_s * u
        u -= motion.delay_s * (closing_m_s * u - motion.along_m_s) / np.maximum(range_m, LEAST_RANGE_M)
        range_m += motion.delay_s * closing_m_s
    if heatmap.doppler is None:
        return np.full(len(cells), np.nan, dtype=np.float32)
    speed_m_s = speeds_m_s(heatmap.doppler, *np.divmod(cells, heatmap.power.shape[1]))
    range_m -= np.float32(heatmap.doppler.delay_s) * speed_m_s
    return speed_m_s
