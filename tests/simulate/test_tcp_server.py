# SPDX-License-Identifier: Apache-2.0
"""One client at a time: the next is let in when what the last one left behind is put away."""

from __future__ import annotations

import socket
import threading

from train.simulate.tcp_server import OneClientServer

SAFETY_S = 10.0


class Echo:
    """Gives back what comes."""

    def __init__(self, server: list[OneClientServer]) -> None:
        self._server = server

    def feed(self, data: bytes) -> bool:
        self._server[0].send(data)
        return True


def test_no_client_is_served_while_the_last_one_is_put_away() -> None:
    """``closed`` takes its time; a client that comes meanwhile is refused or served after it, never before."""
    entered, go_on, order = threading.Event(), threading.Event(), list[str]()
    servers: list[OneClientServer] = []

    def closed() -> None:
        entered.set()
        assert go_on.wait(SAFETY_S)
        order.append("closed")

    def session() -> Echo:
        order.append("session")
        return Echo(servers)

    server = OneClientServer("127.0.0.1", 0, "test", session, closed)
    servers.append(server)
    server.start()
    with socket.create_connection(server.address, SAFETY_S) as first:
        first.sendall(b"a")
        assert first.recv(1) == b"a"
    assert entered.wait(SAFETY_S)
    with socket.create_connection(server.address, SAFETY_S) as second:
        second.settimeout(SAFETY_S)
        second.sendall(b"b")
        assert order == ["session"], "the place is not free yet"
        go_on.set()
        assert second.recv(1) == b"b"
        assert order == ["session", "closed", "session"]
    assert server.stop()
    assert order.count("closed") == 2, "once for every client"
