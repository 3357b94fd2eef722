# SPDX-License-Identifier: Apache-2.0
"""What every peer of the benchmark is built on: the cascade's tables, the virtual row, peaks and detections, in NumPy.

No peer reads a cascade or two radars: each takes its raw words, its row and, at the end, our association from here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp import tables
from edge.dsp.imager import Imager
from edge.dsp.ring_tables import RingTables
from edge.frames import Complex64, Detections, Float32, Heatmap, RadarFrame

if TYPE_CHECKING:
    from edge.rig import Radar

Cells = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Angle and range indices of detections."""
SHORTEST_RANGE_M = 0.05


class Row:
    """From channels' range spectra to the virtual row: calibration, focusing, angle taper and mean of doubled elements.

    Args:
        imager: of a cascade; tells radar, settings, geometry and range axis.
        backwards: elements in falling order, for peers whose angle FFT turns the other way.
    """

    def __init__(self, imager: Imager, backwards: bool = False) -> None:
        radar, settings, geometry, range_m = imager.radar, imager.settings, imager.geometry, imager.range_m
        layout, calibration = radar.schedule.layout, radar.calibration
        taper = tables.taper(settings, "angle", geometry.count, (geometry.count - 1) / 2)
        weight = geometry.channel_weight(taper / taper.sum())
        a, b = geometry.transmit_m[:, None, None], geometry.receive_m[None, :, None]
        beyond_m = np.zeros((*weight.shape, len(range_m)))
        if settings.focus:
            baked_m = tables.curvature_m(calibration.reference_range_m, a, b)
            beyond_m = tables.curvature_m(np.maximum(range_m, SHORTEST_RANGE_M), a, b) - baked_m
        factor = weight[..., None] * np.exp(-2j * np.pi * beyond_m / radar.schedule.profile.wavelength_m)
        self.slot, self.receiver = np.nonzero(geometry.element >= 0)
        self.device, self.rx = self.receiver // layout.rx, self.receiver % layout.rx
        element = geometry.element[self.slot, self.receiver]
        element = geometry.count - 1 - element if backwards else element
        _, first = np.unique(element, return_index=True)
        second = np.setdiff1d(np.arange(len(element)), first)
        order = np.r_[first, second]
        self.slot, self.receiver, self.rx = self.slot[order], self.receiver[order], self.rx[order]
        self.device, self._doubled = self.device[order], element[second]
        self._factor = factor[self.slot, self.receiver].astype(np.complex64)
        self.count = geometry.count

    def fill(self, channel: Any) -> Any:
        """Row [element, range] of the channels' spectra [channel, range], in the order of ``slot`` and ``receiver``."""
        weighted = channel * self._factor
        row = weighted[: self.count]
        row[self._doubled] += weighted[self.count :]
        return row


class Peer(ABC):
    """One radar's chain from raw frame to detections, standing still.

    Args:
        radar, heatmap, antenna, cfar: as imager and detector take them.
    """

    name: str
    differences: str
    """What it computes otherwise than our chain."""

    def __init__(self, radar: Radar, heatmap: HeatmapSettings, antenna: AntennaSettings, cfar: CfarSettings) -> None:
        self.radar, self.heatmap, self.cfar = radar, heatmap, cfar
        imager = self.imager = Imager(radar, heatmap, antenna)
        silence = np.ones(radar.schedule.layout.shape, dtype=np.int16)
        ours = imager.process(RadarFrame(radar.radar, 0, 0, silence, radar.schedule.layout))
        self.range_m, self.cosine = ours.range_m.copy(), ours.direction_cosine.copy()
        self.bins, self.points = ours.power.shape
        self.first = int(np.searchsorted(self.range_m, cfar.min_range_m))
        self.tables = RingTables.of(cfar, self.points, self.first, ours.response)
        self._gain_db = np.zeros(self.bins) if ours.response is None else 10.0 * np.log10(ours.response.gain)

    @abstractmethod
    def image(self, frame: RadarFrame) -> Any:
        """Whatever the peer detects on, made from a raw frame."""

    @abstractmethod
    def cells(self, image: Any) -> tuple[Cells, Float32]:
        """Local maxima above the threshold and the received power [angle, range] or its like."""

    def detect(self, frame: RadarFrame) -> Detections:
        """Detections of one frame, in whole bins, strongest first."""
        (angle, cell), power = self.cells(self.image(frame))
        power_db = 10.0 * np.log10(power[angle, cell]) + self._gain_db[angle]
        order = np.argsort(-power_db, kind="stable")[: self.cfar.max_detections]
        angle, cell = angle[order], cell[order]
        unknown = np.full(len(order), np.nan, dtype=np.float32)
        return Detections(
            *(frame.radar, frame.number, frame.t_first_chirp_ns, self.range_m[cell], self.cosine[angle]),
            *(power_db[order].astype(np.float32), unknown, unknown),
        )


def samples(frame: RadarFrame) -> Complex64:
    """Loop sum of a cascade's frame, complex64 [device, slot, sample, rx], in the order of capture."""
    adc = frame.adc
    codes = adc[:, 0].astype(np.float32) if adc.shape[1] == 1 else adc.sum(axis=1, dtype=np.int32).astype(np.float32)
    return codes.view(np.complex64)[..., 0]


def peaks(decided: NDArray[np.bool_], power: Float32) -> Cells:
    """Decided cells whose power is larger than that of their eight neighbours; periodic in angle, no range edges."""
    angle, cell = np.nonzero(decided)
    inside = (cell > 0) & (cell < power.shape[1] - 1)
    angle, cell = angle[inside], cell[inside]
    here, peak = power[angle, cell], np.ones(len(angle), dtype=np.bool_)
    for da in (-1, 0, 1):
        for dr in (-1, 0, 1):
            if da or dr:
                peak &= here > power[(angle + da) % len(power), cell + dr]
    return angle[peak], cell[peak]


def covered(heatmap: Heatmap, found: Detections, other: Detections) -> int:
    """How many of the first detections have one of the others within a bin; bins are the heatmap's."""
    dr = float(heatmap.range_m[1] - heatmap.range_m[0]) * 1.5
    du = float(heatmap.direction_cosine[1] - heatmap.direction_cosine[0]) * 1.5
    near = (np.abs(found.range_m[:, None] - other.range_m) < dr) & (
        np.abs(found.direction_cosine[:, None] - other.direction_cosine) < du
    )
    return int(near.any(axis=1).sum())
