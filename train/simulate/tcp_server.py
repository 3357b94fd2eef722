# SPDX-License-Identifier: Apache-2.0
"""A TCP server with one client at a time, as the boards are; it never waits for a client that does not read."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Callable
from typing import Protocol

from train.simulate.threads import join

_SEND_TIMEOUT = struct.pack("@ll", 2, 0)
"""struct timeval of two seconds."""


class Session(Protocol):
    """What happens to one client's bytes."""

    def feed(self, data: bytes) -> bool:
        """Take bytes; False: hang up."""


class OneClientServer:
    """Listens, serves one client on a thread, closes every other one at once.

    Args:
        host, port: address; port 0: any free one.
        name: of the threads.
        session: makes what takes the bytes of a new client.
        closed: called when a client is gone, before the next one is let in.
        refused: called when a second client was refused.
    """

    def __init__(
        self,
        host: str,
        port: int,
        name: str,
        session: Callable[[], Session],
        closed: Callable[[], None] = lambda: None,
        refused: Callable[[], None] = lambda: None,
    ) -> None:
        self._listener = socket.create_server((host, port))
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self.accepting = True
        """False: clients are closed at once."""
        self._name, self._session, self._closed, self._refused = name, session, closed, refused
        self._client: socket.socket | None = None
        self._lock, self._ending = threading.Lock(), False
        self._leaving = threading.RLock()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Listen."""
        self._spawn(self._accept)

    def stop(self) -> bool:
        """Close everything; whether all threads ended."""
        self._ending = True
        _shut(self._listener)
        self._listener.close()
        self.hang_up()
        return all([join(thread) for thread in self._threads])  # noqa: C419 every thread is waited for

    def hang_up(self) -> None:
        """Close the present client's connection."""
        with self._lock:
            client = self._client
        if client is not None:
            _shut(client)
            self._release(client)

    def _release(self, client: socket.socket) -> None:
        """Give the place back, once: ``closed`` has run before another client can have it."""
        with self._leaving:
            if self._client is client:
                self._closed()
                with self._lock:
                    self._client = None

    def send(self, data: bytes, piece: int = 0) -> None:
        """Send to the present client, if there is one; in writes of ``piece`` bytes when it is not 0."""
        with self._lock:
            if self._client is None:
                return
            with contextlib.suppress(OSError):
                step = piece or max(1, len(data))
                for start in range(0, len(data), step):
                    self._client.sendall(data[start : start + step])

    def _spawn(self, run: Callable[..., None], *arguments: object) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=run, args=arguments, name=self._name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while not self._ending:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            if self._client is not None and _left(self._client):
                self.hang_up()  # its thread has not noticed yet
            with self._lock:
                welcome = self._client is None and self.accepting and not self._ending
                if welcome:
                    self._client = client
            if not welcome:
                client.close()
                self._refused()
                continue
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_TIMEOUT)
            self._spawn(self._serve, client)

    def _serve(self, client: socket.socket) -> None:
        session = self._session()
        with contextlib.suppress(OSError):
            while (data := client.recv(4096)) and session.feed(data):
                pass
        self._release(client)
        client.close()


def _shut(connection: socket.socket) -> None:
    """Wake whoever waits for this socket."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def _left(client: socket.socket) -> bool:
    """Whether the other end has closed and everything it sent was read."""
    try:
        return client.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
