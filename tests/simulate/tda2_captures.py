# SPDX-License-Identifier: Apache-2.0
"""Emulated capture boards for tests: their frames, and a host that records."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import tda2_host as h
from tda2_host import ACK, SAFETY_S, Host

from edge.frames import Layout, RadarFrame, RadarId
from edge.sources.ti_capture import CaptureFolder
from train.simulate.faults import Faults
from train.simulate.tda2_board import Tda2Board, Tda2Settings

LOOPS, SAMPLES = 2, 8
LAYOUT = Layout("cascade", 4, LOOPS, 12, SAMPLES, 4)
FRAME_BYTES = LOOPS * 12 * SAMPLES * 4 * 4
DEVICES = (1, 2, 4, 8)
Make = Callable[..., Tda2Board]


def supply(layout: Layout = LAYOUT) -> Callable[[RadarId, int], RadarFrame]:
    """Frames whose samples tell number, device, loop, slot, sample, receiver and part."""

    def frame(radar: RadarId, number: int) -> RadarFrame:
        index = np.arange(layout.int16_count, dtype=np.int64).reshape(layout.shape)
        return RadarFrame(radar, number, number, ((index + 7919 * number) % 30_011).astype(np.int16), layout)

    return frame


def eventually(condition: Callable[[], bool]) -> None:
    """The board's threads get there; the limit is for safety only."""
    end_s = time.monotonic() + SAFETY_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.002)


def boards_in(tmp_path: Path) -> Iterator[Make]:
    """Makes boards; all are stopped in the end."""
    boards: list[Tda2Board] = []

    def make_board(faults: Faults | None = None, layout: Layout = LAYOUT, **settings: Any) -> Tda2Board:
        chosen = Tda2Settings(**{"pace": 0.0, **settings})
        boards.append(Tda2Board("horizontal", supply(layout), tmp_path / "ssd", chosen, faults).start())
        return boards[-1]

    yield make_board
    assert all([board.stop() for board in boards]), "threads that do not end"  # noqa: C419


def hexes(text: str) -> bytes:
    return bytes.fromhex(text.replace(" ", ""))


def ack_of(order: bytes) -> bytes:
    """The ACK of an order, by the notes' rule."""
    return h.packet(0x81, order[12], order[13], b"", 0x8C5A, struct.unpack_from("<H", order, 6)[0])


def run_capture(board: Tda2Board, host: Host, frames: int, session: str = "one", loops: int = LOOPS) -> None:
    """Configure all four chips, record ``frames`` frames, stop."""
    h.connect(host)
    for device in DEVICES:
        h.boot(host, device)
        h.configure(host, device, loops, SAMPLES, frames)
    record(host, frames, session, loops)


def record(host: Host, frames: int, session: str, loops: int = LOOPS) -> None:
    h.arm(host, loops, SAMPLES, session, frames)
    for device in (8, 4, 2, 1):
        assert h.trigger(host, device, 1).refusal is None
        host.event(device, 0x100B)
    for device in (8, 4, 2, 1):
        host.event(device, 0x100F)
    assert host.order(0x32) == ACK


def rig_of(layout: Layout = LAYOUT, period_s: float = 16.666665e-3) -> Any:
    schedule = SimpleNamespace(layout=layout, frame_period_s=period_s, packed_12_bit=False)
    return SimpleNamespace(name="emulated", radars={"horizontal": SimpleNamespace(schedule=schedule)})


def frames_in(folder: Path, layout: Layout = LAYOUT) -> list[RadarFrame]:
    return [item for item in CaptureFolder(folder, rig_of(layout), "horizontal") if isinstance(item, RadarFrame)]
