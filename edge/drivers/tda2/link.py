# SPDX-License-Identifier: Apache-2.0
"""The TCP connection to a capture board: orders out, answers matched to them, interrupts noted, every wait bounded.

One thread uses a link; nothing is received between calls, the kernel keeps what comes. Answers are matched by ackCode
and devSelection; whatever fits no order is counted in ``strays`` and passed over.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections import deque
from collections.abc import Callable

from edge.drivers.tda2.packets import Opcode, Packet, PacketError, PacketReader, device_name, order_name
from edge.drivers.tda2.timeouts import TimeOuts
from edge.errors import LinkError, RefusalError

KEEP_ALIVE = (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 20))
"""Seconds of idle time and between probes, and probes: what TI's host sets."""
_RECEIVE_BYTES = 4096
LONGEST_DRAIN_S = 0.1
"""A board that never stops talking is not listened to for longer before an order is sent."""
_ALONE = "the board serves one host at a time: end other programs that use it; if it rebooted, check its supply"
_STRANGER = "connect again; if it stays, something else answers at radars.<id>.board.address and control_port"
_POWER = "check the board's 12 V supply, its Ethernet cable and radars.<id>.board.address, and that it has booted"


class AnswerTimeoutError(LinkError):
    """The board or a chip did not answer in time; the connection stands."""


class LinkLostError(LinkError):
    """The connection ended, or its bytes make no sense any more."""


def _any(_packet: Packet) -> bool:
    return True


class Link:
    """One connection.

    Args:
        owner: whose board it is, for messages: "horizontal".
        address, port: of the board.
        timeouts: waits.
    Attributes:
        strays: answers that fitted no order.
    """

    def __init__(self, owner: str, address: str, port: int, timeouts: TimeOuts) -> None:
        self.strays = 0
        self._where = f"{owner} capture board at {address}:{port}"
        self._address, self._timeouts = (address, port), timeouts
        self._socket: socket.socket | None = None
        self._reader = PacketReader()
        self._replies: deque[tuple[Packet, int]] = deque()
        self._interrupts: dict[int, int] = {}
        self._last_stray = ""

    @property
    def is_open(self) -> bool:
        """Whether there is a connection, as far as is known."""
        return self._socket is not None

    def open(self) -> None:
        """Connect. LinkError: nobody there, or the address does not exist."""
        self.close()
        try:
            connection = socket.create_connection(self._address, timeout=self._timeouts.connect_s)
        except socket.gaierror as error:
            raise LinkError(
                f"no such address: {self._where}", value=error.strerror, action="set radars.<id>.board.address"
            ) from error
        except TimeoutError as error:
            within = f"an answer within {self._timeouts.connect_s:g} s"
            raise LinkError(f"nothing answers: {self._where}", allowed=within, action=_POWER) from error
        except ConnectionRefusedError as error:
            action = "it is still booting, or radars.<id>.board.control_port is another"
            raise LinkError(f"connection refused: {self._where}", action=action) from error
        except OSError as error:
            raise LinkError(f"no way to the {self._where}", value=error.strerror, action=_POWER) from error
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in KEEP_ALIVE:
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._socket, self._reader = connection, PacketReader()
        self._replies.clear()
        self._interrupts.clear()

    def close(self) -> None:
        """End the connection; never fails."""
        connection, self._socket = self._socket, None
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def send(self, packet: Packet) -> int:
        """Send one packet; what came before it unasked is passed over.

        Returns:
            CLOCK_MONOTONIC just before it left: what it does is done after that.
        Raises:
            LinkLostError: no connection, or it broke.
        """
        self._drain()
        connection = self._connected()
        try:
            connection.settimeout(self._timeouts.connect_s)
            data, t_ns = packet.to_bytes(), time.monotonic_ns()
            connection.sendall(data)
        except OSError as error:
            raise self._lost(f"the connection broke while {order_name(packet.opcode)} was sent: {error}") from error
        return t_ns

    def answer(
        self,
        asked: Packet,
        reply: int,
        timeout_s: float,
        what: str,
        accept: Callable[[Packet], bool] = _any,
    ) -> tuple[Packet, int]:
        """The answer to a packet that was sent.

        Args:
            asked: that packet.
            reply: opcode of a good answer.
            timeout_s: longest wait.
            what: name for messages.
            accept: whether an answer with the right opcode is the one; others are strays.
        Returns:
            The answer, and CLOCK_MONOTONIC when it was there.
        Raises:
            RefusalError: NACK.
            AnswerTimeoutError: no answer in time.
            LinkLostError: the connection broke.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            while self._replies:
                packet, t_ns = self._replies.popleft()
                ours = (packet.ack_code, packet.device) == (asked.opcode, asked.device)
                if ours and packet.opcode == Opcode.NACK:
                    raise self._refused(asked, what)
                if ours and packet.opcode == reply and accept(packet):
                    return packet, t_ns
                self._stray(packet)
            if time.monotonic() > deadline_s or not self._receive(deadline_s):
                raise self._late(asked, timeout_s, what)

    def order(self, packet: Packet, reply: int, timeout_s: float, what: str) -> Packet:
        """``send`` and ``answer``."""
        self.send(packet)
        return self.answer(packet, reply, timeout_s, what)[0]

    def interrupt(self, device: int, deadline_s: float) -> int | None:
        """Wait for a chip's interrupt.

        Args:
            device: bit of devSelection.
            deadline_s: of time.monotonic; in the past: only what has come is looked at.
        Returns:
            CLOCK_MONOTONIC when it came; None: it did not.
        """
        while device not in self._interrupts:
            if not self._receive(deadline_s) or time.monotonic() > deadline_s:
                break
        return self._interrupts.get(device)

    def clear_interrupt(self, device: int) -> None:
        """The chip has lowered its line."""
        self._interrupts.pop(device, None)

    def _connected(self) -> socket.socket:
        if self._socket is None:
            raise LinkLostError(f"no connection to the {self._where}", action="connect again")
        return self._socket

    def _receive(self, deadline_s: float) -> bool:
        """Take in what comes next; False: nothing came before the deadline."""
        connection = self._connected()
        left_s = deadline_s - time.monotonic()
        try:
            connection.settimeout(max(0.0, left_s))
            data = connection.recv(_RECEIVE_BYTES)
        except (TimeoutError, BlockingIOError):
            return False
        except OSError as error:
            raise self._lost(f"the connection broke: {error}") from error
        if not data:
            half = f" in the middle of a packet ({self._reader.pending} bytes of it came)"
            raise self._lost(f"the board ended the connection{half if self._reader.pending else ''}")
        t_ns = time.monotonic_ns()
        try:
            packets = self._reader.feed(data)
        except PacketError as error:
            raise self._lost(f"garbage instead of a packet: {error}", _STRANGER) from error
        for packet in packets:
            if packet.opcode != Opcode.HOST_IRQ:
                self._replies.append((packet, t_ns))
                continue
            for bit in range(8):
                if packet.device >> bit & 1:
                    self._interrupts.setdefault(1 << bit, t_ns)
        return True

    def _drain(self) -> None:
        end_s = time.monotonic() + LONGEST_DRAIN_S
        while self._receive(0.0) and time.monotonic() < end_s:
            pass
        while self._replies:
            self._stray(self._replies.popleft()[0])

    def _stray(self, packet: Packet) -> None:
        self.strays += 1
        to = f" to {order_name(packet.ack_code)}" if packet.ack_code else ""
        self._last_stray = f"{order_name(packet.opcode)}{to} of {device_name(packet.device)}"

    def _refused(self, asked: Packet, what: str) -> RefusalError:
        return RefusalError(
            f"{self._where} answered NACK to {what} ({order_name(asked.opcode)}, {device_name(asked.device)})",
            action="the board gives no reason; configure it anew, and if it refuses again reset it with S1",
        )

    def _late(self, asked: Packet, timeout_s: float, what: str) -> LinkError:
        text = f"{what} ({order_name(asked.opcode)}, {device_name(asked.device)})"
        if self._reader.pending:
            return self._lost(f"only {self._reader.pending} bytes of a packet came within {timeout_s:g} s of {text}")
        stray = f"; last came {self._last_stray}" if self._last_stray else ""
        return AnswerTimeoutError(
            f"{self._where} did not answer {text} within {timeout_s:g} s{stray}", action=f"{_POWER}; reset it with S1"
        )

    def _lost(self, why: str, action: str = _ALONE) -> LinkLostError:
        self.close()
        return LinkLostError(f"{self._where}: {why}", action=action)
