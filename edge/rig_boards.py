# SPDX-License-Identifier: Apache-2.0
"""Boards and pose sensor of a rig: from its file, overridden for one vehicle by another with the same tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edge.board_settings import BoardSettings, CaptureCardBoard, CascadeBoard, PoseSettings
from edge.errors import ConfigError
from edge.frames import RADARS, RadarId
from edge.rig_toml import Place, fill, merged, read_toml, require_known, subtable


def board_table(tables: Mapping[str, Any], radar: RadarId, place: Place) -> dict[str, Any]:
    """Table ``radars.<radar>.board`` below a file's top table, empty when absent. ConfigError: something else there."""
    radars = subtable(tables, "radars", place)
    return subtable(subtable(radars, radar, place.at("radars")), "board", place.at("radars").at(radar))


def read_boards(
    table: Mapping[str, Any], cascade: Mapping[RadarId, bool], place: Place, override: Path | None = None
) -> tuple[dict[RadarId, BoardSettings], PoseSettings]:
    """Boards of the radars, and the pose sensor.

    Args:
        table: of the rig's file.
        cascade: the rig's radars, and which of them are cascades.
        place: of ``table``.
        override: file whose tables ``[radars.<id>.board]`` and ``[pose]`` replace the rig's key by key.
    Raises:
        ConfigError: unknown key, wrong type, impossible value; a radar in ``override`` that the rig does not have; two
            radars at one address.
    """
    over, over_place = ({}, place) if override is None else (read_toml(override), Place(override))
    if override is not None:
        _require_only_boards(over, cascade, over_place)
    boards: dict[RadarId, BoardSettings] = {}
    for radar, is_cascade in cascade.items():
        own, other = board_table(table, radar, place), board_table(over, radar, over_place)
        where = (over_place if other else place).at("radars").at(radar).at("board")
        kind: type[BoardSettings] = CascadeBoard if is_cascade else CaptureCardBoard
        boards[radar] = fill(kind, merged(own, other), where)
    own, other = subtable(table, "pose", place), subtable(over, "pose", over_place)
    return boards, fill(PoseSettings, merged(own, other), (over_place if other else place).at("pose"))


def require_apart(boards: Mapping[RadarId, BoardSettings]) -> None:
    """Refuse two radars at one place.

    Raises:
        ConfigError: the same address and port, serial port or debugger; names both and what to change.
    """
    taken: dict[tuple[str, object], RadarId] = {}
    for radar, board in boards.items():
        for key, value in _places(board).items():
            other = taken.setdefault((key, value), radar)
            if other != radar:
                raise ConfigError(
                    f"{other} and {radar} radar share one {key}",
                    value=value,
                    allowed="another one for each board",
                    action=f"give one board another address and set radars.{radar}.board (docs/hardware.md)",
                )


def _places(board: BoardSettings) -> dict[str, object]:
    """What only one board can have."""
    if isinstance(board, CascadeBoard):
        return {"control address": f"{board.address}:{board.control_port}"}
    found: dict[str, object] = {
        "command address": f"{board.card_address}:{board.command_port}",
        "data address": f"{board.host_address}:{board.data_port}",
    }
    if board.port:
        found["serial port"] = board.port
    if board.serial_number:
        found["serial number"] = board.serial_number
    return found


def _require_only_boards(over: Mapping[str, Any], cascade: Mapping[RadarId, bool], place: Place) -> None:
    require_known(over, ("radars", "pose"), place)
    radars = subtable(over, "radars", place)
    require_known(radars, RADARS, place.at("radars"))
    for radar in radars:
        here = place.at("radars").at(radar)
        if radar not in cascade:
            raise here.error("the rig has no such radar", value=radar, allowed=", ".join(cascade))
        require_known(subtable(radars, radar, place.at("radars")), ("board",), here)
