# SPDX-License-Identifier: Apache-2.0
"""Detector: two-dimensional CFAR on a heatmap, local maxima, sub-bin positions, strongest first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.config import CfarSettings, require
from edge.dsp.buffers import plane, zeros
from edge.dsp.doppler import finish
from edge.dsp.interpolation import PARABOLA
from edge.dsp.kernels_cfar import (
    LINES,
    SPARE_ROWS,
    line_cells,
    mean_decisions,
    mean_peaks,
    ring_halves_kernel,
    ring_mean_kernel,
    whole,
)
from edge.dsp.kernels_detect import drop_sidelobes, refine, strongest
from edge.dsp.kernels_rank import SELECTED, rank_decisions_kernel, rank_noise_kernel, rank_peaks_kernel
from edge.dsp.maximum import Maximum
from edge.dsp.ring_tables import RingTables
from edge.frames import Detections, Float32, Float64, Heatmap, PointResponse

if TYPE_CHECKING:
    from edge.rig import Radar

NEVER = np.float32(1e25)
"""Threshold factor that no cell exceeds; its product with any power stays finite."""


class Detector:
    """CFAR detection, local maxima and sub-bin estimation for one radar.

    The noise around a cell comes from a ring in range and angle, wrapped in angle, cut at both ends of range and at
    ``min_range_m``; each remaining ring has its own factor for the same designed probability, by the effective number
    of its cells, which windows and zero padding correlate. Cells beyond ``max_range_m`` count in rings but hold no
    detections. Everything is decided, and maxima are sought and interpolated, on the power as received, before the
    compensation of the antenna pattern: that would tilt the noise of a ring and draw the peak of a wide lobe aside.

    Args:
        radar: which radar; only its identity is used, axes come with the heatmap.
        settings: ring, probability, kind, limits.
    """

    def __init__(self, radar: Radar, settings: CfarSettings) -> None:
        self.radar, self.settings = radar.radar, settings
        self.cut = 0
        """Detections of the last frame that were left out beyond ``max_detections``."""
        self.sidelobes = 0
        """Detections of the last frame that were left out as sidelobes of stronger ones."""
        self._ring = (settings.guard_angle, settings.train_angle, settings.guard_range, settings.train_range)
        self._shape = (0, 0)
        self._seen: tuple[Float32 | None, Float32 | None] = (None, None)
        self._bounds: tuple[Float32, ...] | None = None
        self._ends_m = (np.nan, np.nan)
        self._response: PointResponse | None = None
        self._maps: tuple[int, int] | None = None
        self._factors: dict[tuple[int, int], tuple[Float32, Float64 | None]] = {}
        self._axes = np.zeros(8)
        self._margin = 10.0 ** (0.1 * settings.sidelobe_margin_db)
        self._value = np.zeros(settings.max_detections, dtype=np.float32)
        self._index = np.zeros(settings.max_detections, dtype=np.int64)
        self._received = np.zeros(settings.max_detections, dtype=np.float32)
        self._places = np.zeros((4, settings.max_detections), dtype=np.int64)
        self._columns = np.zeros((4, settings.max_detections), dtype=np.float32)
        if settings.kind == "os":
            self._rank_peaks, self._rank_noise = rank_peaks_kernel(*self._ring), rank_noise_kernel(*self._ring)

    def process(self, heatmap: Heatmap) -> Detections:
        """Detections of one heatmap; the columns are the caller's to keep.

        Args:
            heatmap: power [angle, range]; its response improves the sub-bin estimates.
        Returns:
            Detections over the whole direction axis, strongest first, at most ``max_detections``; see ``cut``.
        Raises:
            ConfigError: the ring does not fit onto the angle axis.
        """
        self._prepare(heatmap)
        self._look_up(heatmap)
        count = self._find(heatmap.power)
        kept = strongest(heatmap.power, self._cells, count, self.settings.max_detections, self._value, self._index)
        self.cut = count - kept
        kept = self._keep_reflectors(heatmap, kept)
        self._estimate_ranks(heatmap, kept)
        self._refine(heatmap, kept)
        columns = self._columns[:, :kept].copy()
        doppler = finish(heatmap, self._cells[self._index[:kept]], columns[0], columns[1])
        return Detections(
            *(heatmap.radar, heatmap.number, heatmap.t_first_chirp_ns, columns[0], columns[1], columns[2]),
            *(doppler, columns[3]),
        )

    def decisions(self, heatmap: Heatmap) -> NDArray[np.bool_]:
        """CFAR decision of every cell [angle, range] before the local-maximum test; for analysis, not for the road."""
        self._prepare(heatmap)
        self._look_up(heatmap)
        decided = np.zeros(heatmap.power.shape, dtype=np.bool_)
        tables = self._tables
        if self.settings.kind == "os":
            kernel = rank_decisions_kernel(*self._ring)
            kernel(heatmap.power, self._pattern, tables.first, self._factor, tables.allowed, self._padded, decided)
        else:
            self._estimate(heatmap.power)
            mean_decisions(heatmap.power, self._pattern, self._noise, self._factor, tables.first, decided)
        return decided

    def noise(self, heatmap: Heatmap) -> Float32:
        """Received noise [angle, range] that the means' CFAR (CA, GO, SO) compares with; valid until the next call.

        Raises:
            ConfigError: of an ordered-statistic detector, which makes no map.
        """
        require(self.settings.kind != "os", "cfar.kind", self.settings.kind, "ca, go, so for a map of the noise")
        self._prepare(heatmap)
        self._look_up(heatmap)
        self._estimate(heatmap.power)
        angles, ranges = heatmap.power.shape
        return self._noise[:angles, :ranges]

    def _prepare(self, heatmap: Heatmap) -> None:
        """Axes; buffers and tables are made again only when they change."""
        range_m, cosine = heatmap.range_m, heatmap.direction_cosine
        if range_m is self._seen[0] and cosine is self._seen[1] and heatmap.power.shape == self._shape:
            return
        self._seen = range_m, cosine
        last = len(range_m) - 1
        self._axes[0], self._axes[1] = range_m[0], (float(range_m[last]) - float(range_m[0])) / last
        self._axes[2] = cosine[0]
        self._axes[3] = (float(cosine[-1]) - float(cosine[0])) / (len(cosine) - 1)
        ends_m = (float(range_m[0]), float(range_m[-1]))
        if heatmap.power.shape == self._shape and ends_m == self._ends_m:
            return
        angles, ranges = heatmap.power.shape
        train = self.settings.train_angle
        require(2 * train < angles, "cfar.train_angle", train, f"at most {(angles - 1) // 2} for {angles} angle bins")
        self._first = int(np.searchsorted(range_m, self.settings.min_range_m))
        self._tables, self._maps = self._tables_of(ranges), None
        self._factors.clear()
        self._reserve_means(angles, ranges)
        self._cells = np.zeros(angles * (ranges + 1) // 4 + 1, dtype=np.int64)
        self._estimates = np.zeros(len(self._cells), dtype=np.float32)
        self._padded = plane(angles + 2 * train, ranges + 2 * self.settings.train_range)
        self._padded[:] = -1.0
        self._mark, self._row = np.zeros(ranges, dtype=np.float32), np.zeros(ranges, dtype=np.int64)
        box = (2 * train + 1) * (2 * self.settings.train_range + 1)
        self._scratch = np.zeros(box + SELECTED, dtype=np.float32)
        self._bits = self._scratch.view(np.int32)
        self._pattern = np.ones(angles, dtype=np.float32)
        self._range_fit, self._angle_fit, self._response = PARABOLA, PARABOLA, None
        self._axes[4:], self._bounds = 0.0, None
        self._shape, self._ends_m = (angles, ranges), ends_m

    def _reserve_means(self, angles: int, ranges: int) -> None:
        """Kernel and buffers of the means' detectors."""
        settings = self.settings
        if settings.kind == "os":
            return
        if settings.kind == "ca":
            self._ring_noise = ring_mean_kernel(*self._ring, ranges)
        else:
            self._ring_noise = ring_halves_kernel(settings.kind == "go", *self._ring, ranges)
        self._received_plane = zeros((angles + 2 * settings.train_angle + SPARE_ROWS) * whole(ranges))
        self._line = zeros(LINES * line_cells(ranges, settings.train_range))
        self._noise = plane(angles + SPARE_ROWS, ranges)
        self._marks = zeros(whole(ranges), np.uint8)
        self._words = self._marks.view(np.int64)

    def _look_up(self, heatmap: Heatmap) -> None:
        """What points and noise look like, taken over only when it is something else than in the last heatmap."""
        if heatmap.response is not self._response:
            self._take_over(heatmap.response)
        maps = (heatmap.maps, id(heatmap.map_correlation))
        if maps == self._maps:
            return
        if maps not in self._factors:
            self._factors[maps] = self._factor_of(heatmap), heatmap.map_correlation
        self._factor, self._maps = self._factors[maps][0], maps

    def _factor_of(self, heatmap: Heatmap) -> Float32:
        """Factors for the largest of the heatmap's maps."""
        if heatmap.maps == 1:
            return self._tables.factor
        correlation, response = heatmap.map_correlation, heatmap.response
        if correlation is None:
            correlation = np.zeros((heatmap.maps, heatmap.power.shape[0]))
            correlation[0, 0] = 1.0
            if response is not None and response.angle_correlation is not None:
                correlation[0] = np.square(np.abs(response.angle_correlation))
        maximum = Maximum.of(correlation)
        return self._tables_of(self._shape[1], response, maximum).factor

    def _tables_of(
        self, ranges: int, response: PointResponse | None = None, maximum: Maximum | None = None
    ) -> RingTables:
        """Tables of the rings, with a factor beyond the largest range that nothing exceeds."""
        tables = RingTables.of(self.settings, ranges, self._first, response, maximum)
        farthest_m = self.settings.max_range_m or (np.inf if response is None else response.usable_range_m)
        tables.factor[self._axes[0] + self._axes[1] * np.arange(ranges) > farthest_m] = NEVER
        return tables

    def _take_over(self, response: PointResponse | None) -> None:
        self._pattern[:] = 1.0
        self._range_fit, self._angle_fit, self._response = PARABOLA, PARABOLA, response
        self._axes[4:], self._bounds = 0.0, None
        if response is not None:
            np.divide(1.0, response.gain, out=self._pattern)
            self._range_fit, self._angle_fit = response.range_fit, response.angle_fit
            self._axes[4:7] = response.range_bias_m2, response.cosine_bias_m, response.focus_inverse_m
            self._axes[7] = response.range_spread_bins
            self._look_up_sidelobes(response)
        self._tables, self._maps = self._tables_of(self._shape[1], response), None
        self._factors.clear()

    def _look_up_sidelobes(self, response: PointResponse) -> None:
        """Bounds of a point's power by distance in bins; off without them."""
        self._bounds = None
        if self.settings.sidelobe_guard and response.range_envelope is not None and response.angle_envelope is not None:
            envelopes = response.range_envelope, response.angle_envelope
            self._bounds = tuple(np.square(envelope).astype(np.float32) for envelope in envelopes)
            self._largest = max(float(bound.max(where=bound < 1.0, initial=0.0)) for bound in self._bounds)

    def _keep_reflectors(self, heatmap: Heatmap, count: int) -> int:
        """Close the gaps that sidelobes leave in ``_index``; returns what is left of ``count`` peaks."""
        self.sidelobes = 0
        if self._bounds is None:
            return count
        kept = drop_sidelobes(
            *(heatmap.power, self._pattern, self._cells, self._index, count, self._axes, self._margin),
            *(self._largest, self._bounds[0], self._bounds[1], self._received, self._places),
        )
        self.sidelobes = count - int(kept)
        return int(kept)

    def _estimate(self, power: Float32) -> None:
        tables = self._tables
        self._ring_noise(
            *(power, self._pattern, tables.first, tables.inverse_count, tables.floor),
            *(self._received_plane, self._line, self._noise),
        )

    def _find(self, power: Float32) -> int:
        """Local maxima above the threshold into ``_cells``, means of their rings into ``_estimates``."""
        tables = self._tables
        if self.settings.kind == "os":
            found = self._rank_peaks(
                *(power, self._pattern, tables.first, self._factor, tables.allowed, self._padded, self._mark),
                *(self._row, self._cells),
            )
        else:
            self._estimate(power)
            found = mean_peaks(
                *(power, self._pattern, self._noise, self._factor, tables.first, self._marks, self._words),
                *(self._cells, self._estimates),
            )
        return int(found)

    def _estimate_ranks(self, heatmap: Heatmap, count: int) -> None:
        """Ordered statistics around the first ``count`` of ``_index`` into ``_estimates``; means are there already."""
        if self.settings.kind == "os":
            self._rank_noise(
                *(self._padded, heatmap.power.shape[1], self._tables.allowed, self._cells, self._index, count),
                *(self._scratch, self._bits, self._estimates),
            )

    def _refine(self, heatmap: Heatmap, count: int) -> None:
        refine(
            *(heatmap.power, self._pattern, self._cells, self._index, self._estimates, count),
            *(self._range_fit, self._angle_fit, self._axes, self._columns),
        )
