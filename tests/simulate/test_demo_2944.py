# SPDX-License-Identifier: Apache-2.0
"""The emulated demo of an AWR2944: real samples, other command lines, what it refuses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from demo_terminal import Sink, Terminal, eventually, lines

from edge.frames import Layout, RadarFrame, RadarId
from train.simulate.demo_cli import DemoRadar, DemoSettings

CONFIG_2944 = """flushCfg
dfeDataOutputMode 1
channelCfg 15 15 0
adcCfg 2 0
adcbufCfg -1 1 1 1 1
lowPower 0 0
profileCfg 0 77 7 6 50 0 0 70 1 512 12500 0 0 30
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 8
frameCfg 0 1 16 2 512 16.667 1 0
compRangeBiasAndRxChanPhase 0.0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0 1 0"""
"""Notes 4.1: what an AWR2944's demo wants otherwise than others."""
REAL = Layout("dca1000_real", 1, 16, 2, 512, 4)


def real_supply(radar: RadarId, number: int) -> RadarFrame:
    index = np.arange(REAL.int16_count, dtype=np.int64).reshape(REAL.shape)
    return RadarFrame(radar, number, number, ((index + 7919 * number) % 30_011).astype(np.int16), REAL)


@pytest.fixture
def of_2944() -> Iterator[tuple[DemoRadar, Terminal, Sink]]:
    """An AWR2944 with a terminal, everything configured but for the sensor start."""
    sink = Sink()
    radar = DemoRadar("vertical", real_supply, sink, DemoSettings("AWR2944", pace=0.0, start_s=0.0, boot_s=0.0))
    terminal = Terminal(radar.port)
    radar.start()
    terminal.until()
    own = {line.split()[0] for line in CONFIG_2944.splitlines()}
    for line in [*CONFIG_2944.splitlines(), *(one for one in lines() if one.split()[0] not in {*own, "sensorStop"})]:
        assert terminal.ask(line) == ["Done"], line
    yield radar, terminal, sink
    terminal.close()
    assert radar.stop()


def test_real_samples_of_an_awr2944(of_2944: tuple[DemoRadar, Terminal, Sink]) -> None:
    """int16 by int16, RX0 all samples, RX1, ...: notes 4.3."""
    radar, terminal, sink = of_2944
    assert "Data port baud rate: 3125000" in terminal.ask("queryDemoStatus")
    assert any("xWR29xx" in line for line in terminal.ask("version"))
    assert terminal.ask("sensorStart")[-1] == "Done"
    eventually(lambda: len(sink.frames) == 2)
    assert sink.frames == [real_supply("vertical", k).adc.astype("<i2").tobytes() for k in range(2)]
    assert len(sink.frames[0]) == 16 * 2 * 4 * 512 * 2
    assert radar.firmware.violations == []


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("adcCfg 2 1", "real"),
        ("adcbufCfg -1 0 1 1 1", "ADC buffer"),
        ("channelCfg 15 31 0", "tx"),
        ("chirpCfg 0 0 0 0 0 0 0 16", "transmitters"),
        ("frameCfg 0 1 16 0 16.667 1 0", "usage"),
    ],
)
def test_what_an_awr2944_refuses(of_2944: tuple[DemoRadar, Terminal, Sink], line: str, what: str) -> None:
    _, terminal, _ = of_2944
    answer = terminal.ask(line)
    assert answer[-1] == "Error -1"
    assert what in answer[0]


def test_an_awr2944_wants_one_number_of_samples(of_2944: tuple[DemoRadar, Terminal, Sink]) -> None:
    _, terminal, _ = of_2944
    assert terminal.ask("frameCfg 0 1 16 0 256 16.667 1 0") == ["Done"]
    assert "samples of frameCfg and profileCfg differ" in terminal.ask("sensorStart")[0]
