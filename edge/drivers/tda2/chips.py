# SPDX-License-Identifier: Apache-2.0
"""Commands to the radar chips behind a capture board, their answers and events: sequences, checks, repeats.

A message of a chip is read after its interrupt: a read request whose ACK says that the line is low again, then sync
word, header, payload and CRC one by one. Commands for several chips are all sent before the first answer is read, as
TI's host does with a thread for each chip.
"""

from __future__ import annotations

import logging
import struct
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from edge.drivers.tda2 import rhcp
from edge.drivers.tda2.link import AnswerTimeoutError, Link
from edge.drivers.tda2.packets import CHIPS, AckType, Opcode, Packet, device_name
from edge.drivers.tda2.plan import command_packet
from edge.drivers.tda2.rhcp import ChipMessage, ChipMessageError, Event, Kind
from edge.drivers.tda2.steps import Command
from edge.drivers.tda2.timeouts import NACK_TRIES, TimeOuts
from edge.errors import DeviceError, LinkError, RefusalError

_LOG = logging.getLogger(__name__)
_SYNC_READS = 32
"""Words in which the sync word must come; a chip that is late fills with FF before it (TI's host reads 1000 bytes)."""
_EVENTS_KEPT = 64
_SILENT = "the chip hangs, or its supply is weak: configure it anew"
_SILENT_BOOT = "the chip has no power, or booted in another than functional mode (SOP lines)"


class ChipAnswerError(LinkError):
    """What was read from a chip is no message, or not the answer to the command."""


class ChipFaultError(DeviceError):
    """A chip reported a fault of its own; it must be reset."""


class CommandRefusedError(RefusalError):
    """A chip refused a command with an error code.

    Args:
        what, value, allowed, action: as in every error.
        code: the chip's.
    """

    def __init__(self, what: str, *, value: object = None, allowed: str = "", action: str = "", code: int = 0) -> None:
        super().__init__(what, value=value, allowed=allowed, action=action)
        self.code = code


@dataclass(frozen=True, slots=True)
class Answer:
    """A chip's answer to a command that it accepted.

    Args:
        data: of the sub-block that was asked for; often empty.
        sent_ns: the command had left this host.
        acknowledged_ns: the board's ACK of its reception was there.
    """

    data: bytes
    sent_ns: int
    acknowledged_ns: int


@dataclass(frozen=True, slots=True)
class ChipEvent:
    """An asynchronous event.

    Args:
        block: see ``Event``; any number.
        data: of the sub-block.
        t_ns: its interrupt was there.
    """

    block: int
    data: bytes
    t_ns: int


@dataclass(slots=True)
class _Sent:
    sequence: int
    sent_ns: int
    acknowledged_ns: int


class Chips:
    """The four chips behind one link.

    Args:
        owner: whose they are, for messages.
        link: open or not yet.
        timeouts: waits.
    Attributes:
        repeated: commands that were sent again after a NACK.
        spurious: interrupts with nothing to read.
    """

    def __init__(self, owner: str, link: Link, timeouts: TimeOuts) -> None:
        self.repeated = self.spurious = 0
        self._owner, self._link, self._timeouts = owner, link, timeouts
        self._sequence = dict.fromkeys(CHIPS, 0)
        self._events: dict[int, deque[ChipEvent]] = {device: deque(maxlen=_EVENTS_KEPT) for device in CHIPS}
        self._running = dict.fromkeys(CHIPS, False)

    def forget(self, device: int) -> None:
        """The chip is reset: what it had to say is gone, sequence numbers begin anew."""
        self._sequence[device] = 0
        self._running[device] = False
        self._events[device].clear()
        self._link.clear_interrupt(device)

    def run(self, devices: Sequence[int], command: Command) -> dict[int, Answer]:
        """Give a command to chips.

        Returns:
            Device -> its answer.
        Raises:
            RefusalError: a chip refused it, or answered NACK three times.
            AnswerTimeoutError: no answer in time.
            ChipAnswerError: an answer that fails its checks or belongs to another command.
            ChipFaultError: a chip reported a fault instead.
            LinkLostError: the connection broke.
        """
        sent = {device: self._send(device, command) for device in devices}
        return {device: self._answer(device, command, sent[device]) for device in devices}

    def event(self, device: int, block: Event, timeout_s: float) -> ChipEvent:
        """Wait for an event. AnswerTimeoutError: it did not come; others as ``run``."""
        deadline_s = time.monotonic() + timeout_s
        while (found := self.take(device, block)) is None:
            message = self._read(device, deadline_s)
            if message is None:
                raise AnswerTimeoutError(
                    f"{self._name(device)} did not report {block.name} (0x{block:04x}) within {timeout_s:g} s",
                    action=_SILENT_BOOT if block == Event.POWERED_UP else _SILENT,
                )
            self._keep(device, *message)
        return found

    def take(self, device: int, block: Event) -> ChipEvent | None:
        """An event that was read already, once."""
        for event in self._events[device]:
            if event.block == block:
                self._events[device].remove(event)
                return event
        return None

    def poll(self, device: int) -> None:
        """Read the events that wait; raises as ``run``."""
        for _ in range(_EVENTS_KEPT):
            if self._link.interrupt(device, 0.0) is None:
                return
            if message := self._read(device, time.monotonic() + self._timeouts.spi_s):
                self._keep(device, *message)

    def _name(self, device: int) -> str:
        return f"{self._owner} radar, {device_name(device)}"

    def _send(self, device: int, command: Command) -> _Sent:
        sequence = self._sequence[device]
        self._sequence[device] = (sequence + 1) % rhcp.SEQUENCES
        packet = command_packet(device, command, sequence)
        sent_ns = self._link.send(packet)
        _, acknowledged_ns = self._link.answer(packet, Opcode.ACK, self._timeouts.spi_s, command.name)
        return _Sent(sequence, sent_ns, acknowledged_ns)

    def _answer(self, device: int, command: Command, sent: _Sent) -> Answer:
        nacks = 0
        deadline_s = time.monotonic() + self._timeouts.answer_s
        while True:
            read = self._read(device, deadline_s)
            if read is None:
                raise AnswerTimeoutError(
                    f"{self._name(device)} did not answer {command.name} within {self._timeouts.answer_s:g} s",
                    action=_SILENT,
                )
            message, t_ns = read
            if message.header.kind == Kind.EVENT:
                self._keep(device, message, t_ns)
            elif message.header.kind == Kind.NACK:
                nacks += 1
                if nacks >= NACK_TRIES:
                    raise RefusalError(
                        f"{self._name(device)} answered NACK to {command.name} {nacks} times",
                        action="messages reach the chip damaged: check the connector between both boards",
                    )
                self.repeated += 1
                sent = self._send(device, command)
                deadline_s = time.monotonic() + self._timeouts.answer_s
            elif message.header.sequence == sent.sequence:
                return self._accepted(device, command, message, sent)
            else:
                _LOG.warning("%s: late answer %s passed over", self._name(device), message.header.raw.hex())

    def _accepted(self, device: int, command: Command, message: ChipMessage, sent: _Sent) -> Answer:
        if message.refusal is not None:
            code, block = message.refusal
            text = rhcp.refusal_text(code, block)
            action = "the rig's schedule asks for what the chip cannot do, or an earlier step was lost"
            raise CommandRefusedError(f"{self._name(device)} refused {command.name}: {text}", action=action, code=code)
        if message.header.kind != Kind.RESPONSE or message.header.message != command.message:
            raise ChipAnswerError(
                f"{self._name(device)} answered something else to {command.name}", value=message.header.raw.hex()
            )
        return Answer(message.data(command.block), sent.sent_ns, sent.acknowledged_ns)

    def _read(self, device: int, deadline_s: float) -> tuple[ChipMessage, int] | None:
        """The next message of a chip and when its interrupt came; None: none until the deadline."""
        while (t_ns := self._link.interrupt(device, deadline_s)) is not None:
            if time.monotonic() > deadline_s + self._timeouts.spi_s:
                return None  # a chip that never stops talking
            request = Packet(Opcode.SPI_WRITE, device, AckType.PROCESSED, rhcp.READ_REQUEST)
            self._link.order(request, Opcode.ACK, self._timeouts.spi_s, "read request")
            self._link.clear_interrupt(device)
            time.sleep(self._timeouts.after_request_s)
            begun = self._sync(device)
            if begun is not None:
                return self._message(device, begun), t_ns
            self.spurious += 1
        return None

    def _sync(self, device: int) -> bytes | None:
        """Find the sync word, as TI's host does; what was read after it, or None: the chip has nothing to say."""
        read = b""
        for _ in range(_SYNC_READS):
            read += self._spi_read(device, len(rhcp.CHIP_SYNC), "sync word")
            _, found, after = read.partition(rhcp.CHIP_SYNC)
            if found:
                return after
        if read.strip(b"\xff") and read.strip(b"\0"):
            raise ChipAnswerError(f"{self._name(device)}: no sync word", value=read.hex(), allowed=rhcp.CHIP_SYNC.hex())
        return None

    def _message(self, device: int, begun: bytes) -> ChipMessage:
        try:
            header = rhcp.parse_header(begun + self._spi_read(device, rhcp.HEADER_BYTES - len(begun), "header"))
            size = header.payload_bytes
            payload = self._spi_read(device, size, "payload") if size else b""
            crc = self._spi_read(device, header.crc_bytes, "CRC") if header.crc_bytes else b""
            return rhcp.parse_message(header, payload, crc)
        except ChipMessageError as error:
            raise ChipAnswerError(f"{self._name(device)} sent a damaged message: {error}") from error

    def _spi_read(self, device: int, count: int, what: str) -> bytes:
        packet = Packet(Opcode.SPI_READ, device, data=struct.pack("<H", count))
        self._link.send(packet)
        wait_s = self._timeouts.spi_s
        answer, _ = self._link.answer(packet, Opcode.SPI_DATA, wait_s, what, lambda p: len(p.data) == count)
        return answer.data

    def _keep(self, device: int, message: ChipMessage, t_ns: int) -> None:
        """Take in events.

        While a chip boots, faults are only logged: first silicon reports some each time (TI's host waits for them).

        Raises:
            ChipFaultError: the chip says that it is at its end.
        """
        if message.header.kind != Kind.EVENT:
            _LOG.warning("%s: %s came unasked", self._name(device), message.header.raw.hex())
            return
        for block, data in message.blocks:
            fault = rhcp.fault_text(block, data)
            if fault and self._running[device]:
                raise ChipFaultError(
                    f"{self._name(device)} reports a {fault} (event 0x{block:04x})",
                    value=data.hex(),
                    action="configure it anew; if it stays, check firmware image and supply",
                )
            if fault:
                _LOG.warning("%s reports a %s while it boots: %s", self._name(device), fault, data.hex())
            self._running[device] |= block == Event.RADAR_POWERED_UP
            self._events[device].append(ChipEvent(block, data, t_ns))
