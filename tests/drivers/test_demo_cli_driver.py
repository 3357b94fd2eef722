# SPDX-License-Identifier: Apache-2.0
"""The command line of the demo, on the emulated radar's terminal and on one that talks nonsense."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from card_rig import slow_pair

from edge.cli_text import cli_lines
from edge.drivers import demo_cli
from edge.drivers.demo_cli import DemoCli, find_cli_port
from edge.errors import LinkError, RefusalError
from train.simulate.demo_cli import DemoRadar, DemoSettings
from train.simulate.faults import Faults
from train.simulate.supplies import targets

PROMPT = b"mmwDemo:/>"


class Scripted:
    """A terminal whose other end answers each line by what a function says."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self._answer = answer
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        pending = b""
        while True:
            try:
                pending += os.read(self._master, 1024)
            except OSError:
                return
            while b"\n" in pending:
                line, _, pending = pending.partition(b"\n")
                if line == b"quit":
                    return
                os.write(self._master, self._answer(line))

    def close(self) -> None:
        os.write(self._slave, b"\nquit\n")
        self._thread.join(10)
        os.close(self._slave)
        os.close(self._master)


@pytest.fixture
def scripted() -> Iterator[Callable[..., DemoCli]]:
    made: list[tuple[Scripted, DemoCli]] = []

    def make(answer: Callable[[bytes], bytes], answer_s: float = 0.3) -> DemoCli:
        terminal = Scripted(answer)
        made.append((terminal, DemoCli(terminal.port, "vertical radar", answer_s=answer_s)))
        return made[-1][1]

    yield make
    for terminal, cli in made:
        cli.close()
        terminal.close()


@pytest.fixture
def emulated(tmp_path: Path) -> Iterator[Any]:
    rig = slow_pair(0.1, ("vertical",))
    faults = Faults()
    settings = DemoSettings(start_s=0.0, restart_s=0.0, boot_s=0.0)
    with DemoRadar("vertical", targets(rig, count=1), lambda data, period_s: None, settings, faults) as radar:
        cli = DemoCli(radar.port, "vertical radar", answer_s=10.0)
        cli.wait_prompt()
        cli.command("queryDemoStatus")  # nothing of the start is left
        yield SimpleNamespace(radar=radar, cli=cli, faults=faults, rig=rig)
        cli.close()


def test_the_rigs_lines_configure_the_demo(emulated: Any) -> None:
    """Every line is answered Done; the first stop is ignored; the first start tells its calibration."""
    lines = cli_lines(emulated.rig.radars["vertical"].schedule)
    answers = [emulated.cli.command(line) for line in lines]
    assert answers[0] == ["Ignored: Sensor is already stopped", "Done"]
    assert answers[-1] == ["Debug: Init Calibration Status = 0x1ffe", "Done"]
    assert all(answer == ["Done"] for answer in answers[1:-1])
    assert emulated.radar.streaming
    assert emulated.cli.command("sensorStop") == ["Done"]
    assert emulated.cli.command("sensorStart 0") == ["Done"]
    assert emulated.cli.command("queryDemoStatus") == ["Sensor State: 2", "Data port baud rate: 921600", "Done"]
    assert emulated.radar.firmware.violations == []


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("sensorStart", "configuration is not complete"),
        ("profileCfg 0 77", "Invalid usage"),
        ("noSuchThing 1", "'noSuchThing 1' is not recognized as a CLI command"),
    ],
)
def test_refusals_name_line_and_answer(emulated: Any, line: str, answer: str) -> None:
    answer = answer.replace("noSuchThing 1' is", "noSuchThing' is")
    with pytest.raises(RefusalError, match="vertical radar refuses") as caught:
        emulated.cli.command(line)
    assert repr(line) in caught.value.what
    assert answer in str(caught.value.value)
    assert emulated.cli.command("sensorStop")[-1] == "Done", "the next line is answered as if nothing had been"


def test_reset_in_the_middle(scripted: Any) -> None:
    rule = b"*" * 42 + b"\r\n"
    cli = scripted(lambda line: b"sensor\r\n" + rule + b"xWR18xx MMW Demo 03.05.00.04\r\n" + rule + PROMPT)
    with pytest.raises(LinkError, match="restarted in the middle") as caught:
        cli.command("sensorStop")
    assert caught.value.value == "sensorStop"


def test_no_answer(emulated: Any) -> None:
    emulated.cli._answer_s = 0.2
    emulated.faults.set("drop", "vertical/cli", times=1)
    with pytest.raises(LinkError, match="does not answer: 'sensorStop'") as caught:
        emulated.cli.command("sensorStop")
    assert "within 0.2 s" in caught.value.allowed
    assert emulated.cli.command("flushCfg") == ["Done"]


def test_port_vanishes(emulated: Any) -> None:
    emulated.radar.unplug()
    with pytest.raises(LinkError, match="serial port of the vertical radar is gone"):
        emulated.cli.command("sensorStop")
    emulated.cli.close()
    emulated.cli.close()
    with pytest.raises(LinkError, match="gone"):
        emulated.cli.command("sensorStop")
    emulated.radar.plug()
    again = DemoCli(emulated.radar.port, "vertical radar")
    again.wait_prompt()
    assert again.command("sensorStop")[-1] == "Done"
    again.close()


def test_a_prompt_is_asked_for(emulated: Any) -> None:
    """A board that has booted long ago writes nothing by itself."""
    emulated.cli.wait_prompt()


def test_two_users_of_one_port(emulated: Any) -> None:
    with pytest.raises(LinkError, match="cannot be opened"):
        DemoCli(emulated.radar.port, "horizontal radar")
    with pytest.raises(LinkError, match="dialout"):
        DemoCli("/dev/no-such-port", "horizontal radar")


def test_half_an_answer(scripted: Any) -> None:
    """Echo and prompt, but neither Done nor Error between them."""
    cli = scripted(lambda line: line + b"\r\nDo\r\n" + PROMPT)
    with pytest.raises(LinkError, match="by half"):
        cli.command("flushCfg")


def test_endless_line_ends_the_wait(monkeypatch: pytest.MonkeyPatch, scripted: Any) -> None:
    monkeypatch.setattr(demo_cli, "LONGEST_ANSWER", 900)
    cli = scripted(lambda line: b"x" * 1000, answer_s=20.0)
    with pytest.raises(LinkError, match="without an end") as caught:
        cli.command("flushCfg")
    assert "data port" in caught.value.action


def test_answer_behind_a_stale_prompt(scripted: Any) -> None:
    """The prompt of a reset comes first; the answer is the part that holds the echo."""
    cli = scripted(lambda line: b"\r\n" + PROMPT + line + b"\r\nDone\r\n" + PROMPT)
    assert cli.command("flushCfg") == ["Done"]


def test_board_without_echo_and_with_other_line_ends(scripted: Any) -> None:
    cli = scripted(lambda line: b"\n\rSkipped\n\rDone\n\r" + PROMPT)
    assert cli.command("flushCfg") == ["Skipped", "Done"]


def test_bytes_that_are_no_text(scripted: Any) -> None:
    cli = scripted(lambda line: bytes(range(128, 256)) + b"\n" + line + b"\nDone\n" + PROMPT)
    assert cli.command("flushCfg") == ["Done"]


def test_port_is_found_by_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose port is missing is said; the rest is what the search on USB says."""

    def search(serial_number: str) -> str:
        if serial_number != "R1":
            raise LinkError("no such board on USB", value=serial_number, allowed="R1", action="plug it in")
        return "/dev/ttyACM0"

    monkeypatch.setattr(demo_cli, "cli_port", search)
    assert find_cli_port("R1", "horizontal radar") == "/dev/ttyACM0"
    with pytest.raises(LinkError, match="no serial port for the vertical radar: no such board") as caught:
        find_cli_port("R9", "vertical radar")
    assert (caught.value.value, caught.value.allowed, caught.value.action) == ("R9", "R1", "plug it in")
