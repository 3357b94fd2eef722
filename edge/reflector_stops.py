# SPDX-License-Identifier: Apache-2.0
"""Finds a corner reflector in the frames of two radars, wherever it stood still for a while."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import CalibrationError
from edge.frames import RADARS, Detections, Float64, Pose, RadarFrame, RadarId
from edge.rig import Rig
from edge.sources.base import Loss

LEAST_FRAMES = 5
RANGE_TOLERANCE_M, COSINE_TOLERANCE = 0.01, 0.01
LARGEST_COSINE = 0.87
LEAST_MARGIN_DB = 6.0
SAME_ECHO_M, SAME_ECHO_COSINE = 0.2, 0.1
SURVEY_GATE_M = 0.5
RANGE_FLOOR_M, COSINE_FLOOR, POWER_FLOOR_DB = 1e-3, 1e-3, 0.1


@dataclass(frozen=True, slots=True)
class Sight:
    """What one radar measured of a reflector that stood still; each with its standard error.

    Args:
        range_m, range_sigma_m: from the phase centre, with the mounting's range offset.
        cosine, cosine_sigma: direction cosine along the radar's array.
        power_db, power_sigma_db: compensated for the antenna gain along the array, without the mounting's offset.
    """

    range_m: float
    cosine: float
    power_db: float
    range_sigma_m: float = RANGE_FLOOR_M
    cosine_sigma: float = COSINE_FLOOR
    power_sigma_db: float = POWER_FLOOR_DB


@dataclass(frozen=True, slots=True)
class Stop:
    """One place of the reflector as both radars saw it.

    Args:
        horizontal, vertical: the two measurements.
        frames: frame pairs that were averaged.
        survey_m: float64 [3], surveyed place in the rig frame; None: not surveyed.
    """

    horizontal: Sight
    vertical: Sight
    frames: int = 1
    survey_m: Float64 | None = None


class StopFinder:
    """Collects stops from frames in time order.

    In every frame pair the reflector is the strongest echo of the horizontal radar, at least 6 dB above any other, and
    the strongest of the vertical radar at a range that the distance of the boards allows. A stop is a row of at least
    five pairs within 1 cm and 0.01 in direction cosine of their mean.

    Args:
        rig: two radars.
        survey_m: surveyed places [n, 3]; only echoes within 0.5 m of one's range count, and no margin is asked.
    """

    def __init__(self, rig: Rig, survey_m: Sequence[Float64] = ()) -> None:
        settings = rig.settings
        self._rig, self._survey = rig, list(survey_m)
        self._imagers = {r: Imager(rig.radars[r], settings.heatmap, settings.antenna) for r in RADARS}
        self._detectors = {r: Detector(rig.radars[r], settings.cfar) for r in RADARS}
        positions = [np.asarray(rig.radars[r].mounting.position_m) for r in RADARS]
        self._reach_m = float(np.linalg.norm(positions[0] - positions[1])) + SAME_ECHO_M
        self._waiting: dict[RadarId, tuple[int, Detections]] = {}
        self._row: list[Float64] = []
        self.stops: list[Stop] = []
        self.pairs = self.unclear = 0

    def feed(self, items: Iterable[RadarFrame | Pose | Loss]) -> None:
        """Look through one recording; a stop does not reach beyond it."""
        for item in items:
            if isinstance(item, RadarFrame):
                found = self._detectors[item.radar].process(self._imagers[item.radar].process(item))
                self._waiting[item.radar] = (item.number, found)
                numbers = {number for number, _ in self._waiting.values()}
                if len(self._waiting) == len(RADARS) and len(numbers) == 1:
                    self._pair(self._waiting["horizontal"][1], self._waiting["vertical"][1])
        self._close()
        self._waiting.clear()

    def result(self) -> list[Stop]:
        """All stops, with their surveyed places.

        Raises:
            CalibrationError: none, or another number than was surveyed.
        """
        if not self.stops:
            raise CalibrationError(
                "no stop of a reflector was found",
                value=f"{self.pairs} frame pairs, in {self.unclear} of them no echo stood out",
                allowed=f"the reflector still for {LEAST_FRAMES} frames, {LEAST_MARGIN_DB:.0f} dB above all else",
                action="clear the place, or give surveyed places (--positions)",
            )
        if self._survey and len(self._survey) != len(self.stops):
            raise CalibrationError(
                "another number of stops was found than was surveyed",
                value=f"{len(self.stops)} at {', '.join(f'{s.horizontal.range_m:.2f} m' for s in self.stops)}",
                allowed=f"{len(self._survey)}",
                action="give one recording for each stop, in the order of the survey",
            )
        if not self._survey:
            return self.stops
        pairs = zip(self.stops, self._survey, strict=True)
        return [Stop(stop.horizontal, stop.vertical, stop.frames, place) for stop, place in pairs]

    def _pair(self, horizontal: Detections, vertical: Detections) -> None:
        self.pairs += 1
        first = self._strongest(horizontal, "horizontal", None)
        second = None if first is None else self._strongest(vertical, "vertical", float(first[0]))
        if first is None or second is None:
            self.unclear += 1
            self._close()
            return
        seen = np.concatenate((first, second))
        if self._row:
            off = np.abs(seen - np.mean(self._row, axis=0))
            if (off[[0, 3]] > RANGE_TOLERANCE_M).any() or (off[[1, 4]] > COSINE_TOLERANCE).any():
                self._close()
        self._row.append(seen)

    def _strongest(self, found: Detections, radar: RadarId, near_m: float | None) -> Float64 | None:
        """Range, cosine, power of the reflector; None when no echo stands out."""
        range_m, cosine = found.range_m.astype(np.float64), found.direction_cosine.astype(np.float64)
        usable = np.abs(cosine) <= LARGEST_COSINE
        if near_m is not None:
            usable &= np.abs(range_m - near_m) <= self._reach_m
        if self._survey:
            board_m = np.asarray(self._rig.radars[radar].mounting.position_m)
            expected_m = [np.linalg.norm(place - board_m) for place in self._survey]
            usable &= (np.abs(range_m[:, None] - np.array(expected_m)) <= SURVEY_GATE_M).any(axis=1)
        index = np.flatnonzero(usable)
        if not len(index):
            return None
        best = int(index[found.power_db[index].argmax()])
        away = (np.abs(range_m - range_m[best]) > SAME_ECHO_M) | (np.abs(cosine - cosine[best]) > SAME_ECHO_COSINE)
        rivals = found.power_db[usable & away]
        if not self._survey and len(rivals) and found.power_db[best] - rivals.max() < LEAST_MARGIN_DB:
            return None
        return np.array([range_m[best], cosine[best], float(found.power_db[best])])

    def _close(self) -> None:
        """The row so far is a stop when it is long enough."""
        if len(self._row) >= LEAST_FRAMES:
            rows = np.array(self._row)
            floor = np.tile((RANGE_FLOOR_M, COSINE_FLOOR, POWER_FLOOR_DB), 2)
            value, error = rows.mean(axis=0), np.hypot(floor, rows.std(axis=0) / np.sqrt(len(rows)))
            first, second = (Sight(*(*value[k : k + 3].tolist(), *error[k : k + 3].tolist())) for k in (0, 3))
            self.stops.append(Stop(first, second, len(rows)))
        self._row = []


def read_survey(path: Path) -> list[Float64]:
    """Surveyed places of a CSV file: ``x_m,y_m,z_m`` in the rig frame, a head line or comments (#) may stand before.

    Raises:
        CalibrationError: unreadable, or a line that is not three finite numbers; names the line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot be read", value=str(error), action="check the path") from error
    places: list[Float64] = []
    for number, cells in enumerate(csv.reader(lines), start=1):
        if not cells or cells[0].lstrip().startswith("#") or [c.strip() for c in cells] == ["x_m", "y_m", "z_m"]:
            continue
        try:
            place = np.array([float(cell) for cell in cells])
        except ValueError:
            place = np.empty(0)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise CalibrationError(f"{path}, line {number}: no place", value=",".join(cells), allowed="x_m,y_m,z_m")
        places.append(place)
    if not places:
        raise CalibrationError(f"{path}: holds no place", allowed="x_m,y_m,z_m, one line for each stop")
    return places
