# SPDX-License-Identifier: Apache-2.0
"""What the drive-bys of one process share: synthesizers, imagers and detectors, whose tables take longer than a drive.

Rigs that differ only in calibration, height or name use the same ones.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from edge.calibration import Calibration
from edge.config import AntennaSettings, HeatmapSettings, require
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.frames import RadarId
from edge.rig import Radar, Rig
from train.simulate.synthesis import Synthesizer

T = TypeVar("T")
KEPT = 24
"""Imagers, detectors and synthesizers that are kept, those used last."""


class CalibratedImager(Imager):
    """An imager that takes another calibration of the same board between two frames; all other tables stay.

    Args:
        radar: its calibration sets the reference range only.
        settings, antenna: as of ``Imager``.
    """

    def __init__(self, radar: Radar, settings: HeatmapSettings, antenna: AntennaSettings) -> None:
        shape = radar.calibration.gain.shape
        self._reference_m = radar.calibration.reference_range_m
        plain = Calibration(np.ones(shape, np.complex64), np.zeros(shape), self._reference_m)
        super().__init__(replace(radar, calibration=plain), settings, antenna)
        self._taper = self._window[:, 0].copy()

    def calibrate(self, calibration: Calibration) -> None:
        """Use ``calibration`` from the next frame on.

        Raises:
            ConfigError: another reference range, on which the focusing tables depend.
        """
        reference_m = calibration.reference_range_m
        require(reference_m == self._reference_m, "calibration.reference_range_m", reference_m, str(self._reference_m))
        samples, rx = self.layout.samples, self.layout.rx
        turns = calibration.range_shift_bins[..., None] * (np.arange(samples) / samples)
        channel = np.asarray(calibration.gain)[..., None] * np.exp(-2j * np.pi * turns).astype(np.complex64)
        for block, (slot, device) in enumerate(self._pairs):
            values = channel[slot, device * rx : (device + 1) * rx].T.reshape(-1)
            taper = self._taper[block, : len(values)]
            self._window[block, 0, : len(values)] = taper * values.real
            self._window[block, 1, : len(values)] = taper * values.imag


class SharedStages:
    """Stages by what they were made for; for one thread."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, object] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def synthesizers(self, rig: Rig) -> dict[RadarId, Synthesizer]:
        """Of every radar of the rig."""
        return {
            radar: self._get((Synthesizer, *_board(board)), lambda board=board: Synthesizer(board))  # type: ignore[misc]
            for radar, board in rig.radars.items()
        }

    def imaging(self, rig: Rig) -> Mapping[RadarId, tuple[Imager, Detector]]:
        """Imager, with the rig's calibration, and detector of every radar; valid until the next rig's are asked for."""
        return {radar: self._pair(board, rig) for radar, board in rig.radars.items()}

    def _pair(self, board: Radar, rig: Rig) -> tuple[Imager, Detector]:
        settings = rig.settings
        key = (*_board(board), board.calibration.reference_range_m, settings.heatmap, settings.antenna)
        imager = self._get((Imager, *key), lambda: CalibratedImager(board, settings.heatmap, settings.antenna))
        imager.calibrate(board.calibration)
        return imager, self._get((Detector, *key, settings.cfar), lambda: Detector(board, settings.cfar))

    def _get(self, key: Hashable, make: Callable[[], T]) -> T:
        if key not in self._kept:
            self._kept[key] = make()
        self._kept.move_to_end(key)
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return self._kept[key]  # type: ignore[return-value]


def _board(board: Radar) -> tuple[Hashable, ...]:
    return board.radar, board.schedule, board.mounting
