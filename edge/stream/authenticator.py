# SPDX-License-Identifier: Apache-2.0
"""Decides who may subscribe from other machines: answers ZeroMQ's questions about CURVE keys (ZAP, RFC 27)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zmq
from zmq.utils import z85
from zmq.utils.monitor import recv_monitor_message

ZAP_ADDRESS = "inproc://zeromq.zap.01"
DOMAIN = b"rfconstruct"
"""Sockets of this domain are authenticated; with ``ZAP_ENFORCE_DOMAIN`` they let nobody in when nobody answers."""
FAILURES = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_AUTH
_POLL_MS = 50
_JOIN_S = 5.0


class Authenticator:
    """A thread that answers ZAP requests of its context, and counts the handshakes that failed.

    Args:
        context: of the sockets that it guards; ZAP reaches no other.
        guarded: those sockets, before they are bound.
        allowed: gives the public keys (Z85) that may come in; asked at every handshake.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        guarded: Sequence[zmq.Socket[bytes]],
        allowed: Callable[[], Mapping[bytes, str]],
    ) -> None:
        self.failures = 0
        """Handshakes that failed: wrong or no key, another mechanism, bytes that are no ZeroMQ."""
        self._allowed = allowed
        self._zap = context.socket(zmq.REP)
        self._zap.bind(ZAP_ADDRESS)
        self._monitors = [_monitor(context, sender, number) for number, sender in enumerate(guarded)]
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="authenticator", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread answers; nobody is let in when it does not."""
        return self._thread.is_alive()

    def stop(self) -> None:
        """End the thread and close its sockets."""
        self._stopping.set()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            poller = zmq.Poller()
            poller.register(self._zap, zmq.POLLIN)
            for monitor in self._monitors:
                poller.register(monitor, zmq.POLLIN)
            while not self._stopping.is_set():
                ready: dict[Any, int] = dict(poller.poll(_POLL_MS))
                if self._zap in ready:
                    self._zap.send_multipart(self._answer(self._zap.recv_multipart()))
                for monitor in (monitor for monitor in self._monitors if monitor in ready):
                    recv_monitor_message(monitor)
                    self.failures += 1
        finally:
            for own in (self._zap, *self._monitors):
                own.close(linger=0)

    def _answer(self, request: list[bytes]) -> list[bytes]:
        """Reply to a request: version, number, domain, address, identity, mechanism, 32 bytes of public key."""
        number = request[1] if len(request) > 1 else b""
        name = None
        if len(request) == 7 and (request[0], request[2], request[5]) == (b"1.0", DOMAIN, b"CURVE"):
            name = self._allowed().get(z85.encode(request[6])) if len(request[6]) == 32 else None
        if name is None:
            return [b"1.0", number, b"400", b"not allowed", b"", b""]
        return [b"1.0", number, b"200", b"OK", name.encode(), b""]


def _monitor(context: zmq.Context[zmq.Socket[bytes]], sender: zmq.Socket[bytes], number: int) -> zmq.Socket[bytes]:
    """A socket on which the failed handshakes of ``sender`` arrive."""
    address = f"inproc://rfconstruct.handshakes.{number}"
    sender.monitor(address, FAILURES)
    monitor = context.socket(zmq.PAIR)
    monitor.connect(address)
    return monitor
