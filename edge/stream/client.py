# SPDX-License-Identifier: Apache-2.0
"""Receives results: an iterator of typed messages that knows whether the publisher lives and what was lost."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType

import zmq

from edge.errors import ConfigError, WireError
from edge.stream.authenticator import HandshakeMonitor
from edge.stream.decode import decode
from edge.stream.keys import Certificate, read_secret
from edge.stream.messages import Header, HeartbeatMessage, Message
from edge.stream.subscribe import subscriber
from edge.stream.wire import FLAG_REPEATED, HEARTBEAT_HZ, MAJOR, split_conflatable

DEFAULT_ENDPOINT = "tcp://127.0.0.1:5600"
ALIVE_PERIODS = 10
"""Heartbeat periods without any message after which the publisher counts as gone."""
LEAST_RATE = 0.9
"""Share of the nominal heartbeat rate below which the publisher counts as starved."""
RATE_WINDOW = 21
RECEIVE_HIGH_WATER_MARK = 64
LONGEST_WAIT_MS = 5000
"""A wait is cut into parts of this length, and refused handshakes are counted between them."""
_HEARTBEAT_TOPIC = f"{MAJOR}/hb/"


def connect(
    endpoint: str = DEFAULT_ENDPOINT,
    topics: Sequence[str] = (),
    timeout_s: float | None = None,
    latest: bool = False,
    keys: str | Path | None = None,
    conflate: bool = False,
) -> Client:
    """Subscribe to an appliance.

    Args:
        endpoint: its address; it need not be there yet, and is found again after a restart.
        topics: for example ("shape", "pose") or ("shape/car", "heat/vertical"); none: everything.
        timeout_s: silence after which iteration ends; None: never.
        latest: of the messages that wait, give only the newest of each topic (for slow readers).
        keys: the client's ``NAME.key_secret`` (``rfconstruct keys client``), for an appliance on another machine.
        conflate: the address is one of ``stream.latest_endpoints``; ZeroMQ itself keeps nothing but the newest message
            of each of ``topics``, however long the reader is busy.
    Returns:
        The client; iterate over it.
    Raises:
        ConfigError: the address is not one, the keys cannot be used, or ``conflate`` without topics.
    """
    return Client(endpoint, topics, timeout_s, latest, keys, conflate)


class Client:
    """The receiving end of docs/wire_format.md; made by ``connect``. Not for use by several threads.

    Args:
        endpoint, topics, timeout_s, latest, keys, conflate: of ``connect``.
    """

    def __init__(
        self,
        endpoint: str,
        topics: Sequence[str],
        timeout_s: float | None,
        latest: bool = False,
        keys: str | Path | None = None,
        conflate: bool = False,
    ) -> None:
        self.endpoint, self.keys = endpoint, keys
        self.malformed = 0
        """Messages that did not follow the format and were dropped."""
        self.ignored = 0
        """Messages of a type that this version does not know."""
        self.skipped = 0
        """Messages passed over because a newer one of their topic was waiting (``latest``, ``conflate``)."""
        self.repeated = 0
        """Messages that were sent again for somebody else, and were dropped because they are known here."""
        self.restarts = 0
        """How often the publisher was started anew while this client listened."""
        self._topics = [f"{MAJOR}/{topic.strip('/')}/" for topic in topics]
        self._timeout_s, self._latest = timeout_s, latest
        self._boot = b""
        self._sequence: dict[str, int] = {}
        self._lost: dict[str, int] = {}
        self._newest_ns: dict[str, int] = {}
        self._beats: deque[tuple[int, int]] = deque(maxlen=RATE_WINDOW)
        self._heard_s: float | None = None
        self._ready: deque[Message] = deque()
        if conflate and not topics:
            raise ConfigError("conflate keeps one message a topic", value=list(topics), allowed="name the topics")
        certificate = None if keys is None else _client_keys(Path(keys))
        self._conflate = conflate
        wanted = [*self._topics, _HEARTBEAT_TOPIC] if topics else [""]
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._sockets: list[zmq.Socket[bytes]] = []
        self._monitors: list[HandshakeMonitor] = []
        self._poller = zmq.Poller()
        try:
            for prefixes in [[prefix] for prefix in dict.fromkeys(wanted)] if conflate else [wanted]:
                receiver = _sub_socket(self._context, prefixes, certificate, conflate)
                self._sockets.append(receiver)
                self._poller.register(receiver, zmq.POLLIN)
                self._monitors.append(HandshakeMonitor(self._context, receiver, len(self._monitors)))
                receiver.setsockopt(zmq.IPV6, int("[" in endpoint))
                receiver.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise ConfigError(
                f"cannot connect ({zmq.strerror(error.errno or 0)})",
                value=endpoint,
                allowed="tcp://HOST:PORT or ipc:///PATH",
            ) from error

    @property
    def lost(self) -> dict[str, int]:
        """Topic -> messages that are missing in its sequence; a restarted publisher loses nothing by it."""
        return dict(self._lost)

    @property
    def refused(self) -> int:
        """Handshakes that failed: no or unknown keys, another appliance's keys, or keys where none are wanted."""
        return sum(monitor.failures() for monitor in self._monitors)

    @property
    def alive(self) -> bool:
        """Whether a message came within the last second, or is waiting to be taken."""
        if self._closed:
            return False
        recent = self._heard_s is not None and time.monotonic() - self._heard_s < ALIVE_PERIODS / HEARTBEAT_HZ
        return recent or bool(self._ready) or bool(self._poller.poll(0))

    @property
    def frequency_ok(self) -> bool:
        """Whether the last heartbeats (up to two seconds of them) came at 90 % of ten a second or more."""
        if not self.alive or len(self._beats) < 2:
            return False
        (first, first_ns), (last, last_ns) = self._beats[0], self._beats[-1]
        sent = last - first if self._conflate else len(self._beats) - 1
        return sent * 1e9 >= LEAST_RATE * HEARTBEAT_HZ * (last_ns - first_ns)

    def recv(self, timeout_s: float | None = None) -> Message | None:
        """The next message.

        Args:
            timeout_s: longest wait; None: as long as it takes.
        Returns:
            The message, or None when the time is over or the client is closed.
        """
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._ready:
            left_ms = None if deadline_s is None else max(0, round(1000 * (deadline_s - time.monotonic())))
            if self._closed:
                return None
            wait_ms = LONGEST_WAIT_MS if left_ms is None else min(left_ms, LONGEST_WAIT_MS)
            if self._poller.poll(wait_ms):
                self._take()
                continue
            _ = self.refused  # takes the reports, so that they do not pile up
            if left_ms == wait_ms:
                return None
        return self._ready.popleft()

    def close(self) -> None:
        """Disconnect; iteration ends."""
        for monitor in self._monitors:
            monitor.close()
        for receiver in self._sockets:
            if receiver in self._poller:
                self._poller.unregister(receiver)
            receiver.close(linger=0)
        self._context.term()

    def __iter__(self) -> Iterator[Message]:
        while (message := self.recv(self._timeout_s)) is not None:
            yield message

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def _closed(self) -> bool:
        return self._context.closed

    def _take(self) -> None:
        """Take one message of each socket, or all that wait and the newest of each topic when only the latest count."""
        newest: dict[str, Message] = {}
        for receiver in self._sockets:
            for _ in range(RECEIVE_HIGH_WATER_MARK if self._latest else 1):
                try:
                    frames = receiver.recv_multipart(zmq.DONTWAIT)
                except zmq.Again:
                    break
                message = self._accept(frames)
                if message is not None:
                    self.skipped += newest.pop(message.header.topic, None) is not None
                    newest[message.header.topic] = message
        self._ready.extend(newest.values())

    def _accept(self, frames: list[bytes]) -> Message | None:
        """Decode and account for one message; None when the caller did not ask for it."""
        try:
            message = decode(split_conflatable(frames[0]) if self._conflate and len(frames) == 1 else frames)
        except WireError:
            self.malformed += 1
            return None
        if message is None:
            self.ignored += 1
            return None
        self._heard_s = time.monotonic()
        if self._known(message.header):
            self.repeated += 1
            return None
        if isinstance(message, HeartbeatMessage):
            self._beats.append((message.header.sequence, message.header.t_pub_ns))
        wanted = not self._topics or message.header.topic.startswith(tuple(self._topics))
        return message if wanted else None

    def _known(self, header: Header) -> bool:
        """Account for a message; whether it was received before and is only repeated for another subscriber."""
        topic = header.topic
        if self._conflate and header.boot == self._boot and self._sequence.get(topic) == header.sequence:
            return True
        self._count(header)
        before_ns = self._newest_ns.get(topic)
        if header.flags & FLAG_REPEATED and before_ns is not None and header.t_ns <= before_ns:
            return True
        self._newest_ns[topic] = header.t_ns
        return False

    def _count(self, header: Header) -> None:
        """Gaps in the topic's sequence; another boot or a sequence that goes back is a new start."""
        last = self._sequence.get(header.topic)
        if header.boot != self._boot or (last is not None and header.sequence <= last):
            self.restarts += bool(self._boot)
            self._boot, last = header.boot, None
            self._sequence.clear()
            self._newest_ns.clear()
            self._beats.clear()
        if last is not None and header.sequence > last + 1:
            missing = header.sequence - last - 1
            self.skipped += missing if self._conflate else 0
            if not self._conflate:
                self._lost[header.topic] = self._lost.get(header.topic, 0) + missing
        self._sequence[header.topic] = header.sequence


def _client_keys(path: Path) -> Certificate:
    """The client's pair and the appliance's public key; ConfigError when one is missing or others may read them."""
    certificate = read_secret(path)
    if not certificate.server:
        raise ConfigError(
            f"keys: {path} does not say which appliance",
            allowed='server-key = "public key of the appliance"',
            action="rfconstruct keys client makes a complete file",
        )
    return certificate


def _sub_socket(
    context: zmq.Context[zmq.Socket[bytes]],
    prefixes: Sequence[str],
    certificate: Certificate | None,
    conflate: bool,
) -> zmq.Socket[bytes]:
    """A subscriber with these prefixes, keys and, of /latest, only the newest message of each."""
    receiver = subscriber(context, RECEIVE_HIGH_WATER_MARK)
    if conflate:
        receiver.setsockopt(zmq.CONFLATE, 1)
    if certificate is not None:
        receiver.setsockopt(zmq.CURVE_SERVERKEY, certificate.server)
        receiver.setsockopt(zmq.CURVE_PUBLICKEY, certificate.public)
        receiver.setsockopt(zmq.CURVE_SECRETKEY, certificate.secret)
    for prefix in prefixes:
        receiver.setsockopt_string(zmq.SUBSCRIBE, prefix)
    return receiver
