# SPDX-License-Identifier: Apache-2.0
"""Serves the metrics over HTTP on a Unix socket of mode 0600, and on a loopback port if asked; bounded in every way."""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
import time
from pathlib import Path
from types import TracebackType

from edge.errors import ConfigError
from edge.service.metrics_text import CONTENT_TYPE, exposition
from edge.service.snapshot import Snapshot
from edge.stream.addresses import is_served

REQUEST_LIMIT_BYTES = 4096
VISITOR_LIMIT = 16
"""Connections at once; the oldest is closed for another."""
BACKLOG = 64
"""Connections that the kernel holds until they are taken."""
TIME_LIMIT_S = 2.0
"""Longest life of a connection."""
PATH = "/metrics"
LOOPBACK = "127.0.0.1"
_POLL_S = 0.25
_REASONS = {
    200: "OK",
    400: "Bad Request",
    404: "Not Found",
    405: "Method Not Allowed",
    431: "Request Header Fields Too Large",
    503: "Service Unavailable",
}


class Metrics:
    """Answers ``GET /metrics`` with the newest snapshot, from a thread of its own; a context manager.

    Args:
        path: Unix socket; None: none.
        port: TCP port of 127.0.0.1, 0 for any that is free; None: none.
    Raises:
        ConfigError: an address is in use or cannot be bound, or there is a file that is no socket.
    """

    def __init__(self, path: Path | None, port: int | None = None) -> None:
        self._path = path
        self._snapshot: Snapshot | None = None
        self._text: tuple[Snapshot | None, bytes] = (None, b"")
        self._selector = selectors.DefaultSelector()
        self._visitors: dict[socket.socket, _Visitor] = {}
        self._stopping = threading.Event()
        self.port: int | None = None
        """Bound TCP port."""
        try:
            if path is not None:
                self._selector.register(_unix_listener(path), selectors.EVENT_READ, "listener")
            if port is not None:
                listener = _tcp_listener(port)
                self.port = listener.getsockname()[1]
                self._selector.register(listener, selectors.EVENT_READ, "listener")
        except BaseException:
            self._release()
            raise
        self._thread = threading.Thread(target=self._run, name="metrics", daemon=True)
        self._thread.start()

    def update(self, snapshot: Snapshot) -> None:
        """Show this one from now on; costs nothing until somebody asks."""
        self._snapshot = snapshot

    def close(self) -> None:
        """Stop listening and remove the socket."""
        self._stopping.set()
        self._thread.join()

    def __enter__(self) -> Metrics:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                for key, _ in self._selector.select(_POLL_S):
                    if key.data == "listener":
                        self._welcome(key.fileobj)  # type: ignore[arg-type]
                    else:
                        self._attend(key.data)
                now_s = time.monotonic()
                for visitor in [v for v in self._visitors.values() if now_s > v.deadline_s]:
                    self._dismiss(visitor)
        finally:
            self._release()

    def _welcome(self, listener: socket.socket) -> None:
        """Take one connection; the oldest makes room."""
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        connection.setblocking(False)
        if len(self._visitors) >= VISITOR_LIMIT:
            self._dismiss(min(self._visitors.values(), key=lambda v: v.deadline_s))
        visitor = _Visitor(connection, time.monotonic() + TIME_LIMIT_S)
        self._visitors[connection] = visitor
        self._selector.register(connection, selectors.EVENT_READ, visitor)

    def _attend(self, visitor: _Visitor) -> None:
        """Read or write what is possible now."""
        try:
            if visitor.answer is None:
                if not visitor.read():
                    self._dismiss(visitor)
                    return
                if not visitor.complete:
                    return
                visitor.answer = memoryview(self._answer(bytes(visitor.request)))
                self._selector.modify(visitor.connection, selectors.EVENT_WRITE, visitor)
            elif visitor.write():
                self._dismiss(visitor)
        except OSError:
            self._dismiss(visitor)

    def _dismiss(self, visitor: _Visitor) -> None:
        self._visitors.pop(visitor.connection, None)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(visitor.connection)
        with contextlib.suppress(OSError):
            visitor.connection.shutdown(socket.SHUT_WR)
        visitor.connection.close()

    def _release(self) -> None:
        for visitor in list(self._visitors.values()):
            self._dismiss(visitor)
        for key in list(self._selector.get_map().values()):
            if isinstance(key.fileobj, socket.socket):
                if key.fileobj.family == socket.AF_UNIX and self._path is not None:
                    self._path.unlink(missing_ok=True)
                key.fileobj.close()
        self._selector.close()

    def _answer(self, request: bytes) -> bytes:
        """The response to a request, which is whole or too long."""
        code, head = _judged(request)
        snapshot = self._snapshot
        if code == 200 and snapshot is None:
            code = 503
        body = f"{_REASONS[code]}\n".encode()
        if code == 200 and snapshot is not None:
            if self._text[0] is not snapshot:
                self._text = snapshot, exposition(snapshot).encode("utf-8", "replace")
            body = self._text[1]
        kind = CONTENT_TYPE if code == 200 else "text/plain; charset=utf-8"
        fields = [f"HTTP/1.1 {code} {_REASONS[code]}", f"Content-Type: {kind}", f"Content-Length: {len(body)}"]
        fields += ["Allow: GET, HEAD"] if code == 405 else []
        start = "\r\n".join([*fields, "Connection: close", "", ""]).encode()
        return start if head else start + body


class _Visitor:
    """One connection: what it asked so far and what is left to send."""

    def __init__(self, connection: socket.socket, deadline_s: float) -> None:
        self.connection, self.deadline_s = connection, deadline_s
        self.request = bytearray()
        self.answer: memoryview | None = None

    def read(self) -> bool:
        """Take what came; False when the visitor left."""
        try:
            received = self.connection.recv(REQUEST_LIMIT_BYTES)
        except BlockingIOError:
            return True
        self.request += received
        return bool(received)

    @property
    def complete(self) -> bool:
        """The header ended, or is longer than it may be."""
        return b"\r\n\r\n" in self.request or b"\n\n" in self.request or len(self.request) > REQUEST_LIMIT_BYTES

    def write(self) -> bool:
        """Send what goes out now; True when all is sent."""
        assert self.answer is not None
        try:
            self.answer = self.answer[self.connection.send(self.answer) :]
        except BlockingIOError:
            return False
        return not self.answer


def _judged(request: bytes) -> tuple[int, bool]:
    """Status code of a request, and whether only the head of the answer is wanted."""
    if len(request) > REQUEST_LIMIT_BYTES:
        return 431, False
    words = request.split(b"\n", 1)[0].decode("latin-1").rstrip("\r").split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1.") or not words[1].startswith("/"):
        return 400, False
    if words[0] not in ("GET", "HEAD"):
        return 405, False
    return (200 if words[1].split("?")[0] == PATH else 404), words[0] == "HEAD"


def _unix_listener(path: Path) -> socket.socket:
    """A listening socket that only its owner may use, from before the first connection is possible."""
    if path.is_socket() and not is_served(str(path)):
        path.unlink()
    listener = socket.socket(socket.AF_UNIX)
    try:
        listener.bind(str(path))
        os.chmod(path, 0o600)
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise _refused(str(path), error) from error
    listener.setblocking(False)
    return listener


def _tcp_listener(port: int) -> socket.socket:
    listener = socket.socket()
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((LOOPBACK, port))
        listener.listen(BACKLOG)
    except (OSError, OverflowError) as error:
        listener.close()
        raise _refused(f"{LOOPBACK}:{port}", error) from error
    listener.setblocking(False)
    return listener


def _refused(address: str, error: Exception) -> ConfigError:
    return ConfigError(f"metrics: address cannot be bound ({error})", value=address, action="set another address")
