# SPDX-License-Identifier: Apache-2.0
"""The boards of a rig: drivers made from its settings, configured one after the other, said what they report."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from edge.board_settings import CaptureCardBoard, CascadeBoard
from edge.drivers.board import Board
from edge.drivers.single_chip import SingleChipDriver
from edge.drivers.tda2.cascade import CascadeDriver
from edge.errors import ConfigError
from edge.frames import RADARS, RadarId
from edge.rig import Rig
from edge.rig_boards import require_apart

KEEP_FRAMES = 256
"""Frames that wait in a receiver while the pipeline is busy: four seconds; 50 MB of the largest single-chip frames."""


def make_boards(rig: Rig) -> dict[RadarId, CascadeDriver] | dict[RadarId, SingleChipDriver]:
    """A driver for each radar, the horizontal one first; nothing is opened.

    Raises:
        ConfigError: two boards at one place; a cascade beside a single chip.
    """
    require_apart(rig.boards)
    cascades: dict[RadarId, CascadeDriver] = {}
    singles: dict[RadarId, SingleChipDriver] = {}
    for radar in (radar for radar in RADARS if radar in rig.radars):
        schedule, board = rig.radars[radar].schedule, rig.boards[radar]
        if isinstance(board, CascadeBoard):
            cascades[radar] = CascadeDriver(radar, schedule, board, rig.directory)
        elif isinstance(board, CaptureCardBoard):
            singles[radar] = SingleChipDriver(radar, schedule, board, KEEP_FRAMES)
    if cascades and singles:
        raise ConfigError(
            f"rig {rig.name} mixes a cascade, which records segments, with a single chip, which streams",
            allowed="two boards of one kind",
        )
    return cascades or singles


def configure(boards: Mapping[RadarId, Board], say: Callable[[str], None], stopped: Callable[[], bool]) -> list[str]:
    """Connect and configure, one board after the other: two at once were seen to run into time-outs.

    Args:
        boards: by radar.
        say: told what is done.
        stopped: asked between the boards; True leaves the rest.
    Returns:
        Notes of all boards.
    Raises:
        DeviceError: of the board that could not be.
    """
    from tqdm import tqdm

    notes: list[str] = []
    for radar, board in boards.items():
        if stopped():
            break
        say(f"{radar}: connecting")
        board.connect()
        with tqdm(desc=f"configuring {radar}", leave=False, disable=None) as bar:

            def show(what: str, done: int, of: int, bar: tqdm = bar) -> None:
                bar.total, bar.n = of, done
                bar.set_postfix_str(what)

            notes += board.configure(show)
        say(f"{radar}: configured")
    return notes
