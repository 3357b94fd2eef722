# SPDX-License-Identifier: Apache-2.0
"""The emulated demo for tests: its configuration, a host's terminal, frames, a place for the samples."""

from __future__ import annotations

import os
import select
import termios
import time
import tty
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from edge.frames import Layout, RadarFrame, RadarId
from train.simulate.demo_cli import DemoRadar, DemoSettings
from train.simulate.faults import Faults

SAFETY_S = 20.0
PROMPT = b"mmwDemo:/>"
LAYOUT = Layout("dca1000", 1, 16, 3, 182, 4, "QI")
CONFIG = """sensorStop
flushCfg
dfeDataOutputMode 1
channelCfg 15 7 0
adcCfg 2 1
adcbufCfg -1 0 1 1 1
lowPower 0 0
profileCfg 0 77 7 6 50 0 0 70 1 182 6250 0 0 30
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 4
chirpCfg 2 2 0 0 0 0 0 2
frameCfg 0 2 16 {frames} {period} {trigger} 0
guiMonitor -1 0 0 0 0 0 0
cfarCfg -1 0 2 8 4 3 0 100 0
cfarCfg -1 1 0 4 2 3 1 100 0
multiObjBeamForming -1 0 0.5
clutterRemoval -1 0
calibDcRangeSig -1 0 -5 8 256
extendedMaxVelocity -1 0
compRangeBiasAndRxChanPhase 0.0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0
measureRangeBiasAndRxChanPhase 0 1.5 0.2
CQRxSatMonitor 0 3 4 127 0
CQSigImgMonitor 0 127 4
analogMonitor 0 0
aoaFovCfg -1 -90 90 -90 90
cfarFovCfg -1 0 0 13.38
cfarFovCfg -1 1 -5.56 5.56
lvdsStreamCfg -1 0 {lvds} 0
calibData 0 0 0"""


def lines(frames: int = 0, period: float = 16.667, trigger: int = 1, lvds: int = 1) -> list[str]:
    return CONFIG.format(frames=frames, period=period, trigger=trigger, lvds=lvds).splitlines()


def supply(radar: RadarId, number: int) -> RadarFrame:
    index = np.arange(LAYOUT.int16_count, dtype=np.int64).reshape(LAYOUT.shape)
    return RadarFrame(radar, number, number, ((index + 7919 * number) % 30_011).astype(np.int16), LAYOUT)


class Terminal:
    """A host's end of the serial line, raw."""

    def __init__(self, path: str) -> None:
        self.handle = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.handle, termios.TCSANOW)  # what has been written already stays
        self.text = b""

    def close(self) -> None:
        os.close(self.handle)

    def until(self, mark: bytes = PROMPT) -> bytes:
        """Everything up to and including the mark."""
        end_s = time.monotonic() + SAFETY_S
        while mark not in self.text:
            assert select.select([self.handle], [], [], max(0.0, end_s - time.monotonic()))[0], self.text
            self.text += os.read(self.handle, 4096)
        place = self.text.index(mark) + len(mark)
        found, self.text = self.text[:place], self.text[place:]
        return found

    def ask(self, line: str) -> list[str]:
        """Send a line; the lines between its echo and the prompt."""
        os.write(self.handle, line.encode() + b"\n")
        answer = self.until().decode().removesuffix("mmwDemo:/>").splitlines()
        assert answer[0] == line, "echo"
        return answer[1:]

    def silent(self) -> bool:
        return not self.text and not select.select([self.handle], [], [], 0.05)[0]


class Sink:
    """Takes the samples in place of a card."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []

    def __call__(self, data: memoryview, period_s: float) -> None:
        assert period_s == pytest.approx(16.667e-3)
        self.frames.append(bytes(data))


Make = Callable[..., tuple[DemoRadar, Terminal, Sink]]


def radars() -> Iterator[Make]:
    """Makes radars with a terminal on each; all are stopped in the end."""
    made: list[tuple[DemoRadar, Terminal]] = []

    def make_radar(faults: Faults | None = None, **settings: Any) -> tuple[DemoRadar, Terminal, Sink]:
        sink = Sink()
        chosen = DemoSettings(**{"pace": 0.0, "start_s": 0.0, "restart_s": 0.0, "boot_s": 0.0, **settings})
        radar = DemoRadar("vertical", supply, sink, chosen, faults)
        terminal = Terminal(radar.port)
        radar.start()
        banner = terminal.until()
        assert banner.count(b"*****") >= 2
        made.append((radar, terminal))
        return radar, terminal, sink

    yield make_radar
    for radar, terminal in made:
        terminal.close()
        assert radar.stop(), "threads that do not end"


def configure(terminal: Terminal, **changes: Any) -> None:
    for line in lines(**changes):
        assert terminal.ask(line)[-1] == "Done", line


def eventually(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + SAFETY_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.002)
