# SPDX-License-Identifier: Apache-2.0
"""Commands to one DCA1000 capture card, each answered within a stated time, and what the card reports by itself.

Source: TI's DCA1000EVM CLI software; order and time-outs as mmwave-capture-std and xwr use them.
"""

from __future__ import annotations

import select
import socket
import time
from collections import Counter
from dataclasses import dataclass

from edge.board_settings import CaptureCardBoard
from edge.drivers.dca1000.packets import (
    Answer,
    Code,
    FpgaVersion,
    Status,
    command,
    fpga_configuration,
    packet_delay,
    parse_answer,
    parse_version,
)
from edge.drivers.dca1000.receiver import open_udp
from edge.errors import LinkError, RefusalError, WireError

ANSWER_S = 0.5
"""The real card answers within milliseconds."""
TRIES = 4
"""Of one command; a packet may be lost. All commands that are repeated may be."""
ALIVE_S = 0.1
ALIVE_TRIES = 30
"""After its FPGA was configured the card is deaf for a moment; mmwave-capture-std asks as often."""
LARGEST_ANSWER = 2048
LONGEST_LIST = 1000
"""Status reports that are kept; older ones are only counted."""


@dataclass(frozen=True, slots=True)
class CardStatus:
    """A report that nobody asked for.

    Args:
        t_ns: when it came, CLOCK_MONOTONIC.
        status: its bits.
    """

    t_ns: int
    status: Status


class CaptureCard:
    """Command socket of one card.

    Args:
        board: addresses and ports.
        name: for messages: "horizontal card".
    Attributes:
        counts: status bit -> how often it was reported since the socket was opened.
        strangers: packets that came from elsewhere or were no answers.
    """

    def __init__(self, board: CaptureCardBoard, name: str) -> None:
        self.name, self._address = name, (board.card_address, board.command_port)
        self._host = (board.host_address, board.command_port)
        self.counts: Counter[Status] = Counter()
        self.strangers = 0
        self._statuses: list[CardStatus] = []
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Bind the command port: the card answers to it, whoever asks.

        Raises:
            LinkError: the address is not this host's, or the port is taken.
        """
        if self._socket is None:
            self._socket = open_udp(*self._host, "commands")

    def close(self) -> None:
        """Give the port back."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def request(self, code: Code, data: bytes = b"", timeout_s: float = ANSWER_S, tries: int = TRIES) -> int:
        """Send a command until it is answered.

        Returns:
            Status of the answer.
        Raises:
            LinkError: no answer in any try, or this host cannot reach the card.
        """
        packet = command(code, data)
        for _ in range(tries):
            self.poll()
            self._send(packet)
            end_s = time.monotonic() + timeout_s
            while (answer := self._receive(end_s - time.monotonic())) is not None:
                if answer.code == code:
                    return answer.status
        raise LinkError(
            f"{self.name} does not answer {code.name}",
            value=f"{tries} times {packet.hex()} to {self._address[0]}:{self._address[1]}",
            allowed=f"an answer within {timeout_s:g} s",
            action="check its power (5 V), the Ethernet cable, and SW2 in software-config mode; "
            f"this host must be {self._host[0]}, the card {self._address[0]} (docs/hardware.md)",
        )

    def do(self, code: Code, data: bytes = b"") -> None:
        """Send a command that must succeed.

        Raises:
            RefusalError: the card answers "failed".
            LinkError: as ``request``.
        """
        status = self.request(code, data)
        if status:
            raise RefusalError(
                f"{self.name} refuses {code.name}",
                value=f"{command(code, data).hex()}, status {status}",
                allowed="status 0",
                action="power the card off and on",
            )

    def wait_alive(self) -> None:
        """Ask until the card answers.

        Raises:
            LinkError: it does not within 3 s.
        """
        self.request(Code.SYSTEM_ALIVE, timeout_s=ALIVE_S, tries=ALIVE_TRIES)

    def version(self) -> FpgaVersion:
        """Version of the FPGA image. LinkError: as ``request``."""
        return parse_version(self.request(Code.FPGA_VERSION))

    def configure(self, delay_s: float, lanes: int) -> None:
        """Packet delay, then FPGA: raw 16 bit samples to Ethernet.

        Raises:
            RefusalError, LinkError: as ``do``.
        """
        self.do(Code.PACKET_DELAY, packet_delay(delay_s))
        self.do(Code.CONFIGURE_FPGA, fpga_configuration(lanes))
        self.wait_alive()

    def record(self) -> None:
        """Start a recording, ending one that runs.

        Raises:
            RefusalError, LinkError: as ``do``.
        """
        for _ in range(TRIES):
            try:
                if self.request(Code.RECORD_START, tries=1) == 0:
                    return
            except LinkError:
                pass  # its answer may be what was lost: then it records
            self.stop()
        self.do(Code.RECORD_START)

    def stop(self) -> None:
        """End the recording; the card sends the rest and reports. RefusalError, LinkError: as ``do``."""
        self.do(Code.RECORD_STOP)

    def poll(self) -> list[CardStatus]:
        """Reports since the last call; does not wait. LinkError: the socket broke."""
        while (answer := self._receive(0.0)) is not None:
            if not answer.is_status:
                self.strangers += 1  # second answer to a repeated command
        found, self._statuses = self._statuses, []
        return found

    def wait_status(self, bit: Status, timeout_s: float) -> bool:
        """Whether a status bit is reported in time; reports stay for ``poll``."""
        end_s = time.monotonic() + timeout_s
        while not any(bit in report.status for report in self._statuses):
            if self._receive(end_s - time.monotonic()) is None:
                return any(bit in report.status for report in self._statuses)
        return True

    def _send(self, packet: bytes) -> None:
        try:
            self._open_socket.sendto(packet, self._address)
        except OSError as error:
            raise LinkError(
                f"{self.name} cannot be reached",
                value=f"{self._address[0]}: {error.strerror or error}",
                action="check the Ethernet cable and this host's address on that interface",
            ) from error

    def _receive(self, timeout_s: float) -> Answer | None:
        """Next answer or report, which is kept for ``poll`` too; None: nothing in time."""
        end_s = time.monotonic() + timeout_s
        opened = self._open_socket
        while select.select([opened], [], [], max(0.0, end_s - time.monotonic()))[0]:
            try:
                packet, sender = opened.recvfrom(LARGEST_ANSWER)
                answer = parse_answer(packet)
            except WireError:
                self.strangers += 1
                continue
            except OSError:
                continue  # ICMP error of an earlier packet
            if sender[0] != self._address[0]:
                self.strangers += 1
                continue
            if answer.is_status:
                self._report(Status(answer.status))
            return answer
        return None

    def _report(self, status: Status) -> None:
        for bit in Status:
            self.counts[bit] += bit in status
        self._statuses.append(CardStatus(time.monotonic_ns(), status))
        del self._statuses[:-LONGEST_LIST]

    @property
    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise LinkError(f"{self.name} is not connected", action="call connect first")
        return self._socket
