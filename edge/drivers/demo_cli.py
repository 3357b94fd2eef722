# SPDX-License-Identifier: Apache-2.0
"""Command line of TI's mmWave demo over a serial port: one line, one answer, each within a stated time.

The demo echoes a line, answers, and writes its prompt; ``Done`` means yes. Source: mmWave SDK 3.5, CLI utility.
"""

from __future__ import annotations

import contextlib
import termios
import time
from collections.abc import Callable, Iterable

import serial

from edge.drivers.usb import cli_port
from edge.errors import LinkError, RefusalError

PROMPT = b"mmwDemo:/>"
ANSWER_S = 10.0
"""The first sensorStart calibrates and takes 1 to 3 s."""
BANNER_S = 5.0
"""From reset to the first prompt."""
POKE_S = 1.0
READ_S = 0.05
LONGEST_ANSWER = 1 << 16
"""A board that writes more than this without a prompt talks nonsense."""
SHOWN = 120
BANNER = "****"
GONE = (OSError, termios.error, TypeError)
"""What pyserial raises when a port vanishes, or is closed, under it; SerialException is an OSError."""


class DemoCli:
    """Serial port of one board.

    Args:
        port: path of the port.
        name: for messages: "horizontal radar".
        baud_rate: 115200 as delivered.
        answer_s: for each line.
    Raises:
        LinkError: the port does not exist, may not be opened, or another program has it.
    """

    def __init__(self, port: str, name: str, baud_rate: int = 115200, answer_s: float = ANSWER_S) -> None:
        self.port, self.name, self._answer_s = port, name, answer_s
        try:
            self._serial = serial.Serial(port, baud_rate, timeout=READ_S, write_timeout=answer_s, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise LinkError(
                f"serial port of the {name} cannot be opened",
                value=f"{port}: {error}",
                action="check the USB cable; end what else uses it (another terminal, ModemManager); "
                "the user must be in group dialout (docs/hardware.md)",
            ) from error

    def command(self, line: str) -> list[str]:
        """Send one line.

        Returns:
            Lines of the answer, without echo and prompt; the last one is ``Done``.
        Raises:
            RefusalError: Error, or not recognized.
            LinkError: no answer in time, half an answer, an endless one; the board restarted; the port vanished.
        """
        self.send(line)
        return self.answer(line)

    def send(self, line: str) -> int:
        """Write one line; what came before is thrown away.

        Returns:
            When it had been given to the port, CLOCK_MONOTONIC in ns.
        Raises:
            LinkError: the port vanished or takes nothing.
        """

        def write() -> None:
            self._serial.reset_input_buffer()
            self._serial.write(line.encode("ascii") + b"\n")

        self._guarded(write)
        return time.monotonic_ns()

    def answer(self, line: str) -> list[str]:
        """Answer to a line that was sent; returns and raises as ``command``."""
        end_s, buffer = time.monotonic() + self._answer_s, b""
        while True:
            buffer = self._until_prompt(buffer, line, end_s)
            part, _, buffer = buffer.partition(PROMPT)
            lines = _lines(part)
            if any(BANNER in text for text in lines):
                raise LinkError(
                    f"{self.name} restarted in the middle",
                    value=line,
                    action="check its supply (5 V, 2.5 A); configure it again",
                )
            if line in lines:
                return self._judged(line, lines[lines.index(line) + 1 :])
            if _verdict(lines):  # a board without echo
                return self._judged(line, lines)

    def discard(self) -> None:
        """Throw away what came so far. LinkError: the port vanished."""
        self._guarded(self._serial.reset_input_buffer)

    def wait_prompt(self, timeout_s: float = BANNER_S) -> None:
        """Wait for the prompt after a reset, and for silence; an empty line asks for it from the second second on.

        Raises:
            LinkError: none came.
        """
        end_s, poke_s, buffer = time.monotonic() + timeout_s, time.monotonic() + POKE_S, b""
        while PROMPT not in buffer:
            now_s = time.monotonic()
            if now_s > end_s:
                raise self._silent("after the reset", buffer, timeout_s)
            if now_s > poke_s:
                poke_s = now_s + POKE_S
                self._guarded(lambda: self._serial.write(b"\n"))
            buffer = (buffer + self._read())[-LONGEST_ANSWER:]
        while self._read() and time.monotonic() < end_s:
            pass

    def close(self) -> None:
        """Give the port back; never raises."""
        with contextlib.suppress(*GONE):
            self._serial.reset_output_buffer()  # a hung port would wait for what it never takes
        with contextlib.suppress(*GONE):
            self._serial.close()

    def _until_prompt(self, buffer: bytes, line: str, end_s: float) -> bytes:
        while PROMPT not in buffer:
            if time.monotonic() > end_s:
                raise self._silent(f"{line!r}", buffer, self._answer_s)
            buffer += self._read()
            if len(buffer) > LONGEST_ANSWER:
                raise LinkError(
                    f"{self.name} answers {line!r} without an end",
                    value=f"{len(buffer)} bytes, beginning {buffer[:SHOWN]!r}",
                    allowed=f"a prompt {PROMPT.decode()} within {LONGEST_ANSWER} bytes",
                    action="is this the command port, not the data port, and 115200 baud?",
                )
        return buffer

    def _judged(self, line: str, lines: list[str]) -> list[str]:
        verdict = _verdict(lines)
        if verdict == "Done":
            return lines
        if verdict:
            raise RefusalError(
                f"{self.name} refuses {line!r}",
                value="; ".join(lines)[:SHOWN],
                allowed="Done",
                action="is the board's firmware the demo of its SDK (mmWave SDK 3.x, MCU+ SDK for the AWR2944)?",
            )
        raise LinkError(
            f"{self.name} answers {line!r} by half",
            value="; ".join(lines)[:SHOWN],
            allowed="Done, or Error",
            action="check the USB cable; reset the board",
        )

    def _silent(self, what: str, buffer: bytes, timeout_s: float) -> LinkError:
        return LinkError(
            f"{self.name} does not answer: {what}",
            value=f"{buffer[-SHOWN:]!r} at {self.port}",
            allowed=f"{PROMPT.decode()} within {timeout_s:g} s",
            action="is the board powered, in functional mode (SOP 001), with the demo in its flash? press NRST",
        )

    def _read(self) -> bytes:
        found: list[bytes] = []
        self._guarded(lambda: found.append(self._serial.read(max(1, self._serial.in_waiting))))
        return found[0]

    def _guarded(self, action: Callable[[], object]) -> None:
        try:
            action()
        except GONE as error:
            raise LinkError(
                f"serial port of the {self.name} is gone",
                value=f"{self.port}: {error}",
                action="check the USB cable and the supply; then connect again",
            ) from error


def find_cli_port(serial_number: str, name: str) -> str:
    """Path of the command line's serial port.

    Args:
        serial_number: of the debugger (XDS110) or bridge (CP2105); empty: the only one there is.
        name: for messages: "horizontal radar".
    Raises:
        LinkError: none, or several and no serial number.
    """
    try:
        return cli_port(serial_number)
    except LinkError as error:
        what = f"no serial port for the {name}: {error.what}"
        raise LinkError(what, value=error.value, allowed=error.allowed, action=error.action) from error


def _lines(part: bytes) -> list[str]:
    """Text of an answer in lines, without empty ones."""
    text = part.decode("ascii", "replace").replace("\r", "\n")
    return [line.strip() for line in text.split("\n") if line.strip()]


def _verdict(lines: Iterable[str]) -> str:
    """"Done", the first line that says no, or "": neither."""
    done = ""
    for line in lines:
        if line.startswith("Error") or "not recognized" in line:
            return line
        if line == "Done":
            done = line
    return done
