# SPDX-License-Identifier: Apache-2.0
"""A rig: one or two radars with schedules, mounting and calibration, and the settings, read from ``rig.toml``."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.array import VirtualArray, array_for
from edge.board_settings import BoardSettings, PoseSettings
from edge.calibration import Calibration, load_calibration
from edge.calibration_ti import import_ti_calibration
from edge.config import Mounting, PipelineSettings, RigGeometry, require
from edge.constraints import DRIFT_S_PER_S, REARM_S, Constraint, check_interleave, check_schedule, require_passed
from edge.errors import ConfigError
from edge.frames import RADARS, RadarId
from edge.resources import shipped_dir
from edge.rig_boards import read_boards
from edge.rig_toml import Place, fill, merged, read_toml, require_known, subtable
from edge.waveform import Schedule

FILE_NAME = "rig.toml"
SETTINGS = tuple(f.name for f in fields(PipelineSettings))
NAME = re.compile(r"\w[\w.-]*")
TOP_KEYS = ("name", "description", "schedule", "interleave", "geometry", "radars", "pose", *SETTINGS)
RADAR_KEYS = ("mounting", "calibration", "schedule", "board")


@dataclass(frozen=True, slots=True)
class InterleaveSettings:
    """How two radars share the time: the second starts half a period after the first, each by its own clock.

    Args:
        drift_s_per_s: largest drift of the two boards' clocks against each other; two crystals of +-20 ppm.
        rearm_s: the offset is set anew after this time; 0: no allowance for drift (frames started by hardware).
    """

    drift_s_per_s: float = DRIFT_S_PER_S
    rearm_s: float = REARM_S

    def __post_init__(self) -> None:
        require(0 <= self.drift_s_per_s <= 1e-3, "interleave.drift_s_per_s", self.drift_s_per_s, "0..1e-3")
        require(self.rearm_s >= 0, "interleave.rearm_s", self.rearm_s, ">= 0")


@dataclass(frozen=True, slots=True)
class Radar:
    """One radar of a rig.

    Args:
        radar: which one.
        schedule: chirps, loops, frame period.
        array: the board's antennas, slots in firing order.
        mounting: where and how the board stands on the rig.
        calibration: [slots, receivers] of the array; the identity when the rig names no file.
    """

    radar: RadarId
    schedule: Schedule
    array: VirtualArray
    mounting: Mounting
    calibration: Calibration


@dataclass(frozen=True, slots=True)
class Rig:
    """The radars of a vehicle and how their frames are processed.

    Args:
        name: as ``rig.toml`` says, or the folder's. Models are made for names: a copy of a rig may name the original.
        radars: one or two.
        geometry: how the rig stands on the vehicle.
        settings: of every stage.
        directory: the rig's folder.
        description: one line for people.
        interleave: how the two radars share the time.
        boards: where each radar is reached.
        pose: where poses come from.
    """

    name: str
    radars: dict[RadarId, Radar]
    geometry: RigGeometry
    settings: PipelineSettings
    directory: Path
    description: str = ""
    interleave: InterleaveSettings = InterleaveSettings()
    boards: dict[RadarId, BoardSettings] = field(default_factory=dict)
    pose: PoseSettings = field(default_factory=PoseSettings)

    @property
    def config_hash(self) -> bytes:
        """8 bytes, BLAKE2b over schedules, mounting, geometry and settings; the calibration is not in it."""
        content = {
            "radars": {r: [asdict(x.schedule), asdict(x.mounting)] for r, x in self.radars.items()},
            "geometry": asdict(self.geometry),
            "settings": asdict(self.settings),
            "interleave": asdict(self.interleave),
        }
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.blake2b(text.encode(), digest_size=8).digest()

    @property
    def calibration_hash(self) -> bytes:
        """8 bytes, BLAKE2b over all gains, shifts and reference ranges."""
        digest = hashlib.blake2b(digest_size=8)
        for name, radar in sorted(self.radars.items()):
            calibration = radar.calibration
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(calibration.gain, dtype="<c8").tobytes())
            digest.update(np.ascontiguousarray(calibration.range_shift_bins, dtype="<f8").tobytes())
            digest.update(np.array(calibration.reference_range_m, dtype="<f8").tobytes())
        return digest.digest()

    def with_calibration(self, radar: RadarId, path: Path) -> Rig:
        """This rig with another calibration file for one radar: ours, or TI's ``.mat``.

        Raises:
            ConfigError: the rig has no such radar.
            CalibrationError: as ``load_calibration`` and ``import_ti_calibration``.
            DependencyError: a ``.mat`` file without SciPy.
        """
        if radar not in self.radars:
            raise ConfigError(f"rig {self.name} has no such radar", value=radar, allowed=", ".join(self.radars))
        calibrated = replace(self.radars[radar], calibration=_calibration(path, self.radars[radar].schedule))
        return replace(self, radars={**self.radars, radar: calibrated})

    def constraints(self) -> list[Constraint]:
        """Every rule of the hardware with its measured value, passed or not."""
        schedules = [radar.schedule for radar in self.radars.values()]
        found = [constraint for schedule in dict.fromkeys(schedules) for constraint in check_schedule(schedule)]
        if len(schedules) == 2:
            found += check_interleave(schedules[0], schedules[1], **asdict(self.interleave))
        return found


def known_rigs() -> list[str]:
    """Names of the rigs that came with the software."""
    return sorted(path.parent.name for path in shipped_dir("firmware_cfg").glob(f"*/{FILE_NAME}"))


def find_rig(name_or_directory: str | Path) -> Path:
    """Folder of a rig: a path to it or to its ``rig.toml``, or the name of a shipped one.

    Raises:
        ConfigError: neither; lists the known rigs.
    """
    as_path = Path(name_or_directory)
    shipped = shipped_dir("firmware_cfg") / as_path
    for folder in (as_path.parent if as_path.name == FILE_NAME else as_path, shipped):
        if (folder / FILE_NAME).is_file():
            return folder
    raise ConfigError(
        f"no rig {name_or_directory}",
        value=str(name_or_directory),
        allowed=f"{', '.join(known_rigs())}, or a folder that holds {FILE_NAME}",
    )


def load_rig(name_or_directory: str | Path, boards: Path | None = None) -> Rig:
    """Read a rig and check it against the hardware's rules.

    Args:
        name_or_directory: folder with ``rig.toml``, or the name of one in ``firmware_cfg``.
        boards: file that overrides where boards and pose sensor are reached (``edge/rig_boards.py``).
    Raises:
        ConfigError: no such rig; unknown key, wrong type or unit; a rule of the hardware is broken; the two radars have
            different range bins or overlap in time.
        CalibrationError: a calibration file that is a dummy, foreign, inconsistent or absent.
    """
    directory = find_rig(name_or_directory)
    place = Place(directory / FILE_NAME)
    table = read_toml(place.file)
    require_known(table, TOP_KEYS, place)
    name, description = table.get("name", directory.resolve().name), table.get("description", "")
    if not isinstance(description, str):
        raise place.at("description").error("wrong type", value=description, allowed="text")
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise place.at("name").error("no name of a rig", value=name, allowed=f"text like {NAME.pattern}")
    radars = _radars(table, place)
    reached, pose = read_boards(table, {r: x.schedule.is_cascade for r, x in radars.items()}, place, boards)
    rig = Rig(
        name=name,
        radars=radars,
        geometry=fill(RigGeometry, subtable(table, "geometry", place), place.at("geometry")),
        settings=fill(PipelineSettings, {key: subtable(table, key, place) for key in SETTINGS}, place),
        directory=directory,
        description=description,
        interleave=fill(InterleaveSettings, subtable(table, "interleave", place), place.at("interleave")),
        boards=reached,
        pose=pose,
    )
    require_passed(rig.constraints(), f"{place.file}: the schedule")
    return rig


def _radars(table: Mapping[str, Any], place: Place) -> dict[RadarId, Radar]:
    tables = subtable(table, "radars", place)
    require_known(tables, RADARS, place.at("radars"))
    if not tables:
        raise place.at("radars").error("rig without radars", allowed=", ".join(f"[radars.{r}]" for r in RADARS))
    common = subtable(table, "schedule", place)
    return {radar: _radar(radar, tables, common, place) for radar in RADARS if radar in tables}


def _radar(radar: RadarId, tables: Mapping[str, Any], common: Mapping[str, Any], place: Place) -> Radar:
    """One radar; its own schedule table replaces the common one key by key."""
    here = place.at("radars").at(radar)
    table = subtable(tables, radar, place.at("radars"))
    require_known(table, RADAR_KEYS, here)
    own = subtable(table, "schedule", here)
    schedule = fill(Schedule, merged(common, own), here.at("schedule") if own else place.at("schedule"))
    with place.named():
        array = array_for(schedule.profile.device, schedule.transmitters)
    name = table.get("calibration")
    if not (name is None or (isinstance(name, str) and name)):
        raise here.at("calibration").error("wrong type", value=name, allowed="name of a file in the rig's folder")
    if name is None:
        shape = array.position.shape
        calibration = Calibration(np.ones(shape, dtype=np.complex64), np.zeros(shape))
    else:
        calibration = _calibration(place.file.parent / name, schedule)
    mounting = fill(Mounting, subtable(table, "mounting", here), here.at("mounting"))
    return Radar(radar, schedule, array, mounting, calibration)


def _calibration(path: Path, schedule: Schedule) -> Calibration:
    read = import_ti_calibration if path.suffix == ".mat" else load_calibration
    return read(path, schedule)
