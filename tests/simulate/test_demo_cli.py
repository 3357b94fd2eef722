# SPDX-License-Identifier: Apache-2.0
"""The emulated demo on its pseudo-terminal: prompt, answers, refusals, state, and samples through the capture card."""

from __future__ import annotations

import os
import socket
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from demo_terminal import (
    LAYOUT,
    PROMPT,
    SAFETY_S,
    Make,
    Terminal,
    configure,
    eventually,
    lines,
    radars,
    supply,
)

from edge.errors import CaptureError
from train.simulate.dca1000_board import Dca1000Board, Dca1000Settings
from train.simulate.demo_cli import DemoRadar, DemoSettings
from train.simulate.demo_firmware import ARGUMENTS
from train.simulate.faults import Faults


@pytest.fixture
def make() -> Iterator[Make]:
    yield from radars()


def test_answers_to_every_kind_of_line(make: Make) -> None:
    radar, terminal, _ = make()
    assert terminal.ask("sensorStop") == ["Ignored: Sensor is already stopped", "Done"]
    assert terminal.ask("% a comment") == []
    assert terminal.ask("") == []
    assert terminal.ask("sensorHalt") == ["'sensorHalt' is not recognized as a CLI command"]
    assert terminal.ask("channelCfg 15 7")[-1] == "Error -1"
    assert terminal.ask("channelCfg 15 x 0")[0].startswith("Error: ")
    assert terminal.ask("queryDemoStatus")[0] == "Sensor State: 0"
    assert terminal.ask("x" * 300)[0].endswith("is not recognized as a CLI command")
    assert radar.lines[0] == "sensorStop"
    os.write(terminal.handle, b"sensor")
    assert terminal.until(b"sensor") == b"sensor"
    os.write(terminal.handle, b"Stop\r\n")
    assert b"Done" in terminal.until()


def test_the_terminal_itself_adds_nothing(make: Make) -> None:
    radar, terminal, _ = make()
    attributes = termios.tcgetattr(terminal.handle)
    assert not attributes[3] & (termios.ECHO | termios.ICANON)
    assert os.path.exists(radar.port)


def test_frames_in_the_configured_layout(make: Make) -> None:
    radar, terminal, sink = make()
    configure(terminal, frames=3)
    assert terminal.ask("sensorStart")[-1] == "Done"
    eventually(lambda: len(sink.frames) == 3)
    assert sink.frames == [supply("vertical", k).adc.astype("<i2").tobytes() for k in range(3)]
    assert terminal.ask("queryDemoStatus")[0] == "Sensor State: 2"
    assert terminal.ask("sensorStart") == ["Ignored: Sensor is already started", "Done"]
    assert terminal.ask("profileCfg 0 77 7 6 50 0 0 70 1 182 6250 0 0 30")[-1] == "Error -1"
    assert terminal.ask("sensorStop") == ["Done"]
    assert terminal.ask("queryDemoStatus")[0] == "Sensor State: 3"
    assert terminal.ask("sensorStart 0") == ["Done"]
    eventually(lambda: len(sink.frames) == 6)
    assert sink.frames[5] == supply("vertical", 5).adc.astype("<i2").tobytes(), "the drive goes on"
    configuration = radar.firmware.configuration
    assert configuration.frame_bytes == 16 * 3 * 4 * 182 * 4 == len(sink.frames[0])
    assert (configuration.profiles[0].slope_mhz_us, configuration.profiles[0].samples) == (70.0, 182)
    assert [configuration.chirps[k] for k in range(3)] == [(0, 1), (0, 4), (0, 2)]
    assert configuration.frame is not None
    assert (configuration.frame.period_ms, configuration.frame.loops) == (16.667, 16)


def test_first_start_needs_the_whole_list(make: Make) -> None:
    _, terminal, sink = make()
    assert "profileCfg" in terminal.ask("sensorStart")[0]
    for line in lines(frames=1):
        if not line.startswith(("cfarFovCfg -1 1", "analogMonitor")):
            terminal.ask(line)
    answer = terminal.ask("sensorStart")
    assert "cfarFovCfg 1" in answer[0]
    assert "analogMonitor" in answer[0]
    assert answer[-1] == "Error -1"
    assert terminal.ask("sensorStart 0")[-1] == "Error -1"
    assert sink.frames == []


def test_what_cannot_change_after_the_first_start(make: Make) -> None:
    radar, terminal, _ = make()
    configure(terminal, frames=1)
    terminal.ask("sensorStart")
    terminal.ask("sensorStop")
    assert terminal.ask("channelCfg 15 7 0") == ["Done"], "the same again is no change"
    assert terminal.ask("channelCfg 15 5 0")[-1] == "Error -1"
    assert terminal.ask("lowPower 0 1")[-1] == "Error -1"
    configure(terminal, frames=1)
    radar.reset()
    assert b"*****" in terminal.until()
    assert terminal.ask("queryDemoStatus")[0] == "Sensor State: 0"
    assert terminal.ask("channelCfg 15 5 0") == ["Done"]


@pytest.mark.parametrize(
    "line",
    [
        "profileCfg 0 75 7 6 50 0 0 70 1 182 6250 0 0 30",
        "profileCfg 0 77 7 6 60 0 0 70 1 182 6250 0 0 30",
        "profileCfg 0 77 7 6 30 0 0 70 1 182 6250 0 0 30",
        "profileCfg 0 77 7 6 50 0 0 101 1 182 6250 0 0 30",
        "profileCfg 0 77 7 6 50 0 0 70 1 182 12501 0 0 30",
        "profileCfg 0 77 7 6 50 0 0 70 1 182 6250 0 0 31",
        "chirpCfg 0 0 0 0 0 0 0 8",
        "frameCfg 0 2 8 0 16.667 1 0",
        "frameCfg 0 2 18 0 16.667 1 0",
        "frameCfg 0 2 16 0 16.667 3 0",
        "adcCfg 1 1",
        "adcbufCfg -1 0 1 0 1",
        "dfeDataOutputMode 3",
    ],
)
def test_fields_out_of_range(make: Make, line: str) -> None:
    _, terminal, _ = make()
    if line.startswith("profileCfg 0 77 7 6 60"):
        assert terminal.ask(line.replace("70 1", "66 1")) == ["Done"]
    assert terminal.ask(line)[-1] == "Error -1"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("frameCfg 0 2 16 0 2.9 1 0", "period"),
        ("frameCfg 0 2 16 0 4.7 1 0", "duty"),
        ("frameCfg 0 3 16 0 16.667 1 0", "chirp 3"),
        ("frameCfg 0 2 128 0 100 1 0", "cube"),
        ("chirpCfg 2 2 1 0 0 0 0 2", "chirp 2"),
    ],
)
def test_limits_of_the_whole(make: Make, line: str, words: str) -> None:
    _, terminal, _ = make()
    configure(terminal)
    assert terminal.ask(line) == ["Done"]
    answer = terminal.ask("sensorStart")
    assert words in answer[0]
    assert answer[-1] == "Error -1"


def test_nothing_is_streamed_without_lvds(make: Make) -> None:
    radar, terminal, sink = make()
    configure(terminal, frames=2, lvds=0)
    terminal.ask("sensorStart")
    eventually(lambda: radar.bursts == 2)
    assert sink.frames == []
    assert any("nothing is streamed" in text for text in radar.firmware.violations)


def test_sample_swap_changes_the_order_of_i_and_q(make: Make) -> None:
    _, terminal, sink = make()
    configure(terminal, frames=1)
    terminal.ask("adcbufCfg -1 0 0 1 1")
    terminal.ask("sensorStart")
    eventually(lambda: len(sink.frames) == 1)
    ours = np.frombuffer(sink.frames[0], "<i2").reshape(-1, 4)
    assert np.array_equal(ours, supply("vertical", 0).adc.reshape(-1, 4)[:, [2, 3, 0, 1]])


def test_hardware_trigger(make: Make) -> None:
    radar, terminal, sink = make()
    configure(terminal, trigger=2)
    terminal.ask("sensorStart")
    assert sink.frames == []
    for count in (1, 2):
        radar.pulse()
        eventually(lambda expected=count: len(sink.frames) == expected)  # type: ignore[misc]


def test_faults_of_the_line(make: Make) -> None:
    faults = Faults(seed=2)
    _, terminal, _ = make(faults)
    faults.set("nack", "vertical/cli", times=2)
    assert [terminal.ask("sensorStop")[-1] for _ in range(3)] == ["Error -1", "Error -1", "Done"]
    faults.set("drop", "vertical/cli", times=1)
    os.write(terminal.handle, b"sensorStop\n")
    assert terminal.until(b"sensorStop\r\n") == b"sensorStop\r\n", "only the echo"
    assert terminal.silent()
    faults.set("babble", "vertical/cli", times=1, value=300)
    os.write(terminal.handle, b"sensorStop\n")
    assert terminal.until(b"\r\n") == b"sensorStop\r\n"
    while len(terminal.text) < 300:
        terminal.text += os.read(terminal.handle, 4096)
    assert len(terminal.text) == 300
    assert b"\n" not in terminal.text
    terminal.text = b""
    faults.set("delay", "vertical/cli", times=1, value=0.02)
    assert terminal.ask("sensorStop")[-1] == "Done"
    faults.set("garble", "vertical/cli", times=1, value=4)
    os.write(terminal.handle, b"sensorStop\n")
    clean = b"sensorStop\r\nIgnored: Sensor is already stopped\r\nDone\r\nmmwDemo:/>"
    got = b""
    while len(got) < len(clean):
        got += os.read(terminal.handle, 4096)
    assert sum(bin(a ^ b).count("1") for a, b in zip(got, clean, strict=True)) == 4


def test_unplug_and_link(make: Make, tmp_path: Path) -> None:
    link = tmp_path / "ports" / "vertical"
    radar, terminal, _ = make(link=link)
    assert os.path.realpath(link) == os.path.realpath(radar.port)
    radar.unplug()
    assert not link.is_symlink()
    assert radar.port == ""
    with pytest.raises(OSError, match="Input/output error"):
        os.write(terminal.handle, b"sensorStop\n")
    radar.plug()
    again = Terminal(str(link))
    try:
        again.until()
        assert again.ask("queryDemoStatus")[0] == "Sensor State: 0"
        radar.plug()
        assert again.ask("queryDemoStatus")[0] == "Sensor State: 0", "it was in already"
    finally:
        again.close()


def test_cable_pulled_and_put_back(make: Make) -> None:
    """The radar has its own supply: frames and state go on, no banner comes."""
    faults = Faults()
    radar, terminal, sink = make(faults, pace=1.0)
    configure(terminal)
    assert terminal.ask("sensorStart")[-1] == "Done"
    faults.set("unplug", "vertical/cli", times=1)
    os.write(terminal.handle, b"queryDemoStatus\n")
    eventually(lambda: radar.port == "")
    count = len(sink.frames)
    radar.plug()
    again = Terminal(radar.port)
    try:
        assert again.ask("queryDemoStatus")[0] == "Sensor State: 2"
        eventually(lambda: len(sink.frames) > count)
    finally:
        again.close()


def test_pyserial_reads_it(make: Make) -> None:
    serial = pytest.importorskip("serial")
    radar, _, _ = make()
    with serial.Serial(radar.port, 115200, timeout=SAFETY_S) as port:
        port.write(b"sensorStop\n")
        assert port.read_until(PROMPT) == b"sensorStop\r\nIgnored: Sensor is already stopped\r\nDone\r\nmmwDemo:/>"


def test_unplug_in_the_middle_of_the_frames(make: Make) -> None:
    faults = Faults()
    faults.set("unplug", "vertical/frames", skip=2, times=1)
    radar, terminal, sink = make(faults)
    configure(terminal)
    os.write(terminal.handle, b"sensorStart\n")
    eventually(lambda: radar.port == "")
    assert len(sink.frames) == 2


def test_any_bytes_leave_the_radar_alive(make: Make) -> None:
    rng = np.random.default_rng(3)
    radar, terminal, _ = make()
    names = ["profileCfg", "chirpCfg", "frameCfg", "adcbufCfg", "channelCfg", "sensorStart", "lvdsStreamCfg", "cfarCfg"]
    for k in range(60):
        words = [str(word) for word in rng.choice(["nan", "-1", "1e400", "0", "3", "x"], int(rng.integers(0, 16)))]
        noise = rng.integers(1, 256, int(rng.integers(0, 40)), dtype=np.uint8).tobytes().replace(b"\n", b"")
        line = noise if k % 3 == 0 else " ".join([names[k % len(names)], *words]).encode()
        os.write(terminal.handle, line + b"\n")
        terminal.until()
    for name, count in ARGUMENTS.items():
        for word in ("nan", "inf", "-1", "1e9"):
            assert radar.firmware.execute(f"{name} {' '.join([word] * count)}")[-1] in ("Done", "Error -1")
    terminal.text = b""
    termios.tcflush(terminal.handle, termios.TCIFLUSH)
    assert radar.firmware.execute("sensorStop") == ["Ignored: Sensor is already stopped", "Done"]


def test_a_reader_that_sleeps_holds_nothing_up(make: Make) -> None:
    radar, terminal, _ = make()
    for _ in range(200):
        os.write(terminal.handle, b"queryDemoStatus\n")
        time.sleep(0)
    eventually(lambda: len(radar.lines) >= 100)
    termios.tcflush(terminal.handle, termios.TCIFLUSH)
    assert radar.port


def test_a_whole_radar_with_its_card() -> None:
    """Card first, then sensorStart: the samples come back bit by bit over UDP; code 2 resets the radar."""
    command, data = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for one in (command, data):
        one.bind(("127.0.0.1", 0))
        one.settimeout(SAFETY_S)
    data.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
    card = Dca1000Board("vertical", Dca1000Settings(data_target=data.getsockname(), pace=0.0, deaf_s=0.0))
    radar = DemoRadar("vertical", supply, card.lvds, DemoSettings(start_s=0.0, boot_s=0.0))
    card._reset_radar = radar.reset
    terminal = Terminal(radar.port)

    def order(text: str) -> bytes:
        command.sendto(bytes.fromhex(text), card.address)
        return command.recv(64)

    try:
        card.start()
        radar.start()
        terminal.until()
        for text in ("5aa506000000aaee", "5aa502000000aaee", "5aa509000000aaee", "5aa50b000600be0571020000aaee"):
            assert order(text)[4:6] == b"\0\0"
        assert b"*****" in terminal.until()
        assert order("5aa50300060001020102031eaaee") == bytes.fromhex("5aa503000000aaee")
        assert order("5aa505000000aaee") == bytes.fromhex("5aa505000000aaee")
        configure(terminal, frames=1)
        received = b""
        for k, start in enumerate(("sensorStart", "sensorStart 0")):
            assert terminal.ask(start)[-1] == "Done"
            while len(received) < (k + 1) * LAYOUT.nbytes:
                packet = data.recv(4096)
                assert int.from_bytes(packet[4:10], "little") == len(received)
                received += packet[10:]
            assert terminal.ask("sensorStop") == ["Done"]
        assert received == b"".join(supply("vertical", k).adc.tobytes() for k in range(2))
        assert LAYOUT.nbytes == 96 * 1456, "182 samples: frames of whole packets"
        assert order("5aa506000000aaee") == bytes.fromhex("5aa506000000aaee")
        assert card.violations == []
        assert radar.firmware.violations == []
    finally:
        terminal.close()
        for one in (command, data):
            one.close()
        assert radar.stop()
        assert card.stop()


def test_unknown_device() -> None:
    with pytest.raises(CaptureError, match="no demo for this device"):
        DemoRadar("vertical", supply, lambda data, period_s: None, DemoSettings(device="AWR2243"))
