# SPDX-License-Identifier: Apache-2.0
"""What the drive-bys of one process share: synthesizers, imagers and detectors, whose tables take longer than a drive.

Rigs that differ only in calibration, height or name use the same ones.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.frames import RadarId
from edge.rig import Radar, Rig
from train.simulate.synthesis import Synthesizer

T = TypeVar("T")
KEPT = 24
"""Imagers, detectors and synthesizers that are kept, those used last."""


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
        imager = self._get((Imager, *key), lambda: Imager(board, settings.heatmap, settings.antenna))
        imager.recalibrate(board.calibration)
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
