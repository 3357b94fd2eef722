# SPDX-License-Identifier: Apache-2.0
"""A ZeroMQ subscriber that notices a dead peer: the socket options that every subscribing end of this project has."""

from __future__ import annotations

import zmq

from edge.stream.wire import MESSAGE_LIMIT_BYTES


def subscriber(context: zmq.Context[zmq.Socket[bytes]], high_water_mark: int) -> zmq.Socket[bytes]:
    """A SUB socket with a bounded queue that notices a dead peer and keeps looking for it.

    A dead peer is noticed by TCP. ZMQ_HEARTBEAT_IVL must not be set here: a reader that is busy while its queue is full
    misses the answers to its own heartbeats, reconnects, and libzmq up to 4.3.5 aborts the process when it goes on
    reading (zeromq/libzmq issue 3937).

    Args:
        context: of the socket.
        high_water_mark: messages that wait at most.
    """
    receiver = context.socket(zmq.SUB)
    for option, value in (
        (zmq.RCVHWM, high_water_mark),
        (zmq.MAXMSGSIZE, MESSAGE_LIMIT_BYTES),
        (zmq.HANDSHAKE_IVL, 2000),
        (zmq.TCP_KEEPALIVE, 1),
        (zmq.TCP_KEEPALIVE_IDLE, 2),
        (zmq.TCP_KEEPALIVE_INTVL, 1),
        (zmq.TCP_KEEPALIVE_CNT, 3),
        (zmq.RECONNECT_IVL, 100),
        (zmq.RECONNECT_IVL_MAX, 1000),
    ):
        receiver.setsockopt(option, value)
    return receiver
