# SPDX-License-Identifier: Apache-2.0
"""One bound socket of the publisher: bounded queues, who subscribed, and encryption where other machines listen."""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from edge.stream.addresses import bind
from edge.stream.authenticator import DOMAIN
from edge.stream.keys import Certificate
from edge.stream.wire import TOPIC_LIMIT_BYTES

LINGER_MS = 500
"""How long ``close`` waits for subscribers to take the last messages."""
SEND_BUFFER_BYTES = 256 * 2**10
INCOMING_LIMIT_BYTES = 1024
"""A subscription has at most 129 bytes, a command of the CURVE handshake some hundred."""
INCOMING_QUEUE = 64
HEARTBEAT_MS, PEER_TIMEOUT_MS, HANDSHAKE_MS = 1000, 3000, 2000
SUBSCRIPTIONS_AT_ONCE = 256
_SUBSCRIBE = 1


class Outlet:
    """An XPUB socket; not for several threads at once.

    Args:
        context: of the publisher.
        high_water_mark: messages queued for each subscriber before the newest are dropped for it.
        pair: the appliance's CURVE pair; None: not encrypted.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], high_water_mark: int, pair: Certificate | None = None
    ) -> None:
        self.socket = context.socket(zmq.XPUB)
        self.endpoints: tuple[str, ...] = ()
        """Addresses that are bound."""
        for option, value in (
            (zmq.SNDHWM, high_water_mark),
            (zmq.RCVHWM, INCOMING_QUEUE),
            (zmq.SNDBUF, SEND_BUFFER_BYTES),
            (zmq.MAXMSGSIZE, INCOMING_LIMIT_BYTES),
            (zmq.HEARTBEAT_IVL, HEARTBEAT_MS),
            (zmq.HEARTBEAT_TIMEOUT, PEER_TIMEOUT_MS),
            (zmq.HANDSHAKE_IVL, HANDSHAKE_MS),
            (zmq.TCP_KEEPALIVE, 1),
            (zmq.XPUB_VERBOSER, 1),
        ):
            self.socket.setsockopt(option, value)
        if pair is not None:
            self.socket.setsockopt(zmq.CURVE_SERVER, 1)
            self.socket.setsockopt(zmq.CURVE_SECRETKEY, pair.secret)
            self.socket.setsockopt(zmq.ZAP_DOMAIN, DOMAIN)
            self.socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def bind(self, endpoints: Sequence[str], setting: str = "stream.endpoints") -> None:
        """Bind checked addresses; ConfigError names the first that cannot be bound."""
        for endpoint in endpoints:
            self.endpoints = (*self.endpoints, bind(self.socket, endpoint, setting))

    def send(self, frames: Sequence[bytes]) -> None:
        """Give the message to every subscriber that has room for it; never waits."""
        self.socket.send_multipart(frames, zmq.DONTWAIT)

    def subscriptions(self) -> list[bytes]:
        """Topic prefixes that were subscribed since the last call; what is no subscription is thrown away."""
        found: list[bytes] = []
        for _ in range(SUBSCRIPTIONS_AT_ONCE):
            try:
                event = self.socket.recv(zmq.DONTWAIT)
            except zmq.Again:
                break
            if event[:1] == bytes([_SUBSCRIBE]) and len(event) <= TOPIC_LIMIT_BYTES + 1:
                found.append(event[1:])
        return found

    def close(self) -> None:
        """Stop listening; subscribers have half a second to take the last messages."""
        self.socket.close(linger=LINGER_MS)
