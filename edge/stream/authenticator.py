# SPDX-License-Identifier: Apache-2.0
"""Decides who may subscribe from other machines: answers ZeroMQ's questions about CURVE keys (ZAP, RFC 27)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

import zmq
from zmq.utils import z85

from edge.errors import RfconstructError

ZAP_ADDRESS = "inproc://zeromq.zap.01"
DOMAIN = b"rfconstruct"
"""Sockets of this domain are authenticated; with ``ZAP_ENFORCE_DOMAIN`` they let nobody in when nobody answers."""
_POLL_MS = 50
_JOIN_S = 5.0


class Authenticator:
    """A thread that answers the ZAP requests of its context.

    Args:
        context: of the sockets that it guards; ZAP reaches no other.
        allowed: gives the public keys (Z85) that may come in; asked at every handshake.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], allowed: Callable[[], Mapping[bytes, str]]) -> None:
        self.errors = 0
        """Questions that could not be decided, since the keys could not be read: answered by no."""
        self._allowed = allowed
        self._zap = context.socket(zmq.REP)
        self._zap.bind(ZAP_ADDRESS)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="authenticator", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread answers; nobody is let in when it does not."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """End the thread and close its socket."""
        self._stopping.set()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                if self._zap.poll(_POLL_MS):
                    self._zap.send_multipart(self._answer(self._zap.recv_multipart()))
        finally:
            self._zap.close(linger=0)

    def _answer(self, request: list[bytes]) -> list[bytes]:
        """Reply to a request: version, number, domain, address, identity, mechanism, 32 bytes of public key."""
        number = request[1] if len(request) > 1 else b""
        name = None
        if len(request) == 7 and (request[0], request[2], request[5]) == (b"1.0", DOMAIN, b"CURVE"):
            name = self._name(request[6])
        if name is None:
            return [b"1.0", number, b"400", b"not allowed", b"", b""]
        return [b"1.0", number, b"200", b"OK", name.encode("ascii", "replace"), b""]

    def _name(self, key: bytes) -> str | None:
        """The client with this public key, None when it may not come in."""
        try:
            return self._allowed().get(z85.encode(key)) if len(key) == 32 else None
        except (OSError, RfconstructError):
            self.errors += 1
            return None


class HandshakeMonitor:
    """Counts the handshakes of one socket that failed: wrong or no key, another mechanism, bytes that are no ZeroMQ.

    ZeroMQ's I/O thread waits for room when nobody takes its reports, so their queue has no bound; ``failures`` empties
    it. Not for several threads at once.

    Args:
        context: of the socket.
        guarded: the socket, before it is bound.
        number: tells the monitors of a context apart.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], guarded: zmq.Socket[bytes], number: int) -> None:
        address = f"inproc://rfconstruct.handshakes.{number}"
        self._failures = 0
        self._guarded = guarded
        self._reports = context.socket(zmq.PAIR)
        self._reports.setsockopt(zmq.RCVHWM, 0)
        guarded.monitor(
            address,
            zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
            | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
            | zmq.EVENT_HANDSHAKE_FAILED_AUTH,
        )
        self._reports.connect(address)

    def failures(self) -> int:
        """Failed handshakes since the start."""
        while not self._reports.closed and self._reports.poll(0):
            self._reports.recv_multipart()
            self._failures += 1
        return self._failures

    def close(self) -> None:
        """Stop counting; before the socket is closed."""
        if not self._reports.closed:
            self.failures()
            self._guarded.disable_monitor()
            self._reports.close(linger=0)
