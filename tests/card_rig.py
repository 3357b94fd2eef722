# SPDX-License-Identifier: Apache-2.0
"""Emulated single-chip radars with their capture cards, and drivers that reach them, for tests."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

from edge.board_settings import CaptureCardBoard
from edge.drivers.single_chip import SingleChipDriver
from edge.frames import RADARS, RadarId
from edge.rig import Rig, load_rig
from train.simulate.dca1000_board import Dca1000Settings
from train.simulate.demo_cli import DemoSettings
from train.simulate.faults import Faults
from train.simulate.rig import VirtualRig, VirtualRigSettings
from train.simulate.supplies import CyclicSupply, targets

HOST = "127.0.0.2"
"""The cards are at 127.0.0.1: commands use one port number on both sides, as on real boards."""


def free_port(host: str = HOST) -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])


def slow_pair(period_s: float = 0.1, radars: tuple[RadarId, ...] = RADARS, **changes: Any) -> Rig:
    """The pair with frames rare enough for a busy machine."""
    rig = load_rig("awr1843_pair")
    boards = {}
    for radar in radars:
        board = rig.radars[radar]
        profile = replace(board.schedule.profile, samples=changes.get("samples", 182))
        boards[radar] = replace(board, schedule=replace(board.schedule, profile=profile, frame_period_s=period_s))
    return replace(rig, radars=boards)


class CardRig:
    """A virtual rig of single chips.

    Attributes:
        rig, supply, virtual: as they are.
        drivers: not connected.
    """

    def __init__(
        self, rig: Rig, root: Path, faults: Faults | None = None, supply: CyclicSupply | None = None, **settings: Any
    ) -> None:
        self.rig = rig
        self.supply = supply or targets(rig, count=3)
        demo = DemoSettings(**{"start_s": 0.0, "restart_s": 0.0, "boot_s": 0.0, **settings.pop("demo", {})})
        card = Dca1000Settings(**{"deaf_s": 0.01, "flush_s": 2.0, **settings.pop("card", {})})
        chosen = VirtualRigSettings(demo=demo, card=card, **{"pace": 1.0, "links": root / "ports", **settings})
        self.virtual = VirtualRig(rig, self.supply, root, None, chosen, faults)
        self.drivers: dict[RadarId, SingleChipDriver] = {}
        for radar, emulated in self.virtual.cards.items():
            board = CaptureCardBoard(
                card_address="127.0.0.1",
                host_address=HOST,
                command_port=emulated.address[1],
                data_port=free_port(),
                port=str(root / "ports" / radar),
            )
            emulated.data_target = (HOST, board.data_port)
            self.drivers[radar] = SingleChipDriver(radar, rig.radars[radar].schedule, board)

    def __enter__(self) -> CardRig:
        self.virtual.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for driver in self.drivers.values():
            driver.close()
        assert self.virtual.stop(), "threads that do not end"

    def ready(self) -> CardRig:
        """Connect and configure."""
        for driver in self.drivers.values():
            driver.connect()
            driver.configure(lambda what, done, total: None)
        return self

    def violations(self) -> list[str]:
        """What the drivers did wrong."""
        return [f"{part}: {text}" for part, texts in self.virtual.violations().items() for text in texts]
