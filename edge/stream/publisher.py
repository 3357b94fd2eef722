# SPDX-License-Identifier: Apache-2.0
"""Publishes results on a ZeroMQ PUB socket; a subscriber that is slow, stuck or hostile never holds it up."""

from __future__ import annotations

import ctypes
import ipaddress
import os
import re
import socket
import threading
import time
from pathlib import Path
from types import TracebackType

import zmq

from edge.config import StreamSettings
from edge.errors import ConfigError
from edge.frames import Detections, FusedCloud, Heatmap, PointCloud, Pose, Shape
from edge.stream import convert
from edge.stream.messages import State, Status
from edge.stream.wire import (
    BOOT_BYTES,
    HASH_BYTES,
    HEARTBEAT_HZ,
    HEATMAP_HZ,
    SOURCES,
    STATUS_HZ,
    Draft,
    Source,
    Stamp,
    pack,
)

LINGER_MS = 500
"""How long ``close`` waits for subscribers to take the last messages."""
SEND_BUFFER_BYTES = 256 * 2**10
INCOMING_LIMIT_BYTES = 64 * 2**10
HEARTBEAT_MS, PEER_TIMEOUT_MS, HANDSHAKE_MS = 1000, 3000, 2000
IPC_PATH_LIMIT = 107
_LIBC = ctypes.CDLL(None)
_TIME_ERROR = 5  # ntp_gettime(3): the clock is not synchronised


class Publisher:
    """The sending end of docs/wire_format.md; usable from several threads, and as a context manager.

    Every sending method returns the frames it sent (``wire.join`` makes one block for a recording of them).

    Args:
        settings: addresses to bind and queue length.
        config_hash, calibration_hash: hashes of what produces the data; the first 8 bytes are sent.
        source: "live", "replay" or "sim".
    Raises:
        ConfigError: an address is in use, cannot be bound, or is reachable from other machines.
    """

    def __init__(
        self, settings: StreamSettings, config_hash: bytes, calibration_hash: bytes, source: Source = "live"
    ) -> None:
        for name, value in (("config_hash", config_hash), ("calibration_hash", calibration_hash)):
            if len(value) < HASH_BYTES:
                raise ConfigError(f"publisher: {name} is too short", value=len(value), allowed=f">= {HASH_BYTES} bytes")
        if source not in SOURCES:
            raise ConfigError("publisher: unknown source", value=source, allowed=", ".join(SOURCES))
        self._hashes = config_hash[:HASH_BYTES], calibration_hash[:HASH_BYTES]
        self._source, self._encoding, self._boot = source, settings.shape_encoding, os.urandom(BOOT_BYTES)
        self._sequence: dict[str, int] = {}
        self._paces: dict[str, _Pace] = {}
        self._summary: tuple[object, ...] = ()
        self._lock = threading.Lock()
        addresses = [checked_endpoint(endpoint) for endpoint in settings.endpoints]
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = _pub_socket(self._context, settings.send_high_water_mark)
        self.endpoints: tuple[str, ...] = ()
        """Addresses that are bound; a port that was given as * is a number here."""
        try:
            self.endpoints = tuple(_bind(self._socket, address) for address in addresses)
        except ConfigError:
            self.close()
            raise

    def shape(self, shape: Shape) -> list[bytes]:
        """Send a completed object. WireError: points that are not finite or do not fit the encoding."""
        return self._send(convert.encode_shape(shape, self._encoding))

    def cloud(self, cloud: FusedCloud) -> list[bytes]:
        """Send the fused cloud of a window."""
        return self._send(convert.encode_cloud(cloud))

    def heatmap(self, heatmap: Heatmap) -> list[bytes]:
        """Send a heatmap; at most ten a second of measurement time, others return [] unsent."""
        if not self._due(f"heat {heatmap.radar}", HEATMAP_HZ, heatmap.t_first_chirp_ns):
            return []
        return self._send(convert.encode_heatmap(heatmap))

    def detections(
        self, horizontal: Detections | None, vertical: Detections | None, points: PointCloud | None = None
    ) -> list[bytes]:
        """Send one frame's detections and the 3-D points made of them; None: the rig has no such radar or points."""
        return self._send(convert.encode_detections(horizontal, vertical, points))

    def pose(self, pose: Pose) -> list[bytes]:
        """Send a pose."""
        return self._send(convert.encode_pose(pose))

    def status(self, status: Status) -> list[bytes]:
        """Send the state of the appliance: once a second and at once when state, level or reasons change."""
        now_ns = time.monotonic_ns()
        summary = (status.state, status.level, *sorted(reason.code for reason in status.reasons))
        if summary != self._summary:
            self._summary = summary
            self._paces.pop("status", None)
        if not self._due("status", STATUS_HZ, now_ns):
            return []
        return self._send(convert.encode_status(status, now_ns))

    def heartbeat(self, state: State = "RUN") -> list[bytes]:
        """Send a sign of life, ten a second at most: call it as often as convenient."""
        now_ns = time.monotonic_ns()
        return self._send(convert.encode_heartbeat(state, now_ns)) if self._due("hb", HEARTBEAT_HZ, now_ns) else []

    def close(self) -> None:
        """Give subscribers half a second to take the last messages, then release the addresses."""
        with self._lock:
            self._socket.close(linger=LINGER_MS)
            self._context.term()

    def __enter__(self) -> Publisher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _due(self, key: str, rate_hz: float, t_ns: int) -> bool:
        with self._lock:
            return self._paces.setdefault(key, _Pace(rate_hz)).due(t_ns)

    def _send(self, draft: Draft) -> list[bytes]:
        with self._lock:
            sequence = self._sequence.get(draft.topic, 0)
            stamp = Stamp(
                self._boot,
                sequence,
                time.monotonic_ns(),
                time.time_ns(),
                clock_synchronised(),
                self._source,
                *self._hashes,
            )
            frames = pack(draft, stamp)
            self._sequence[draft.topic] = sequence + 1
            self._socket.send_multipart(frames, zmq.DONTWAIT)
        return frames


class _Pace:
    """Lets through so many events a second on average; time that runs backwards starts again."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = round(1e9 / rate_hz)
        self._next_ns: int | None = None
        self._last_ns = 0

    def due(self, t_ns: int) -> bool:
        """Whether the event at ``t_ns`` is let through."""
        restart = self._next_ns is None or t_ns < self._last_ns
        self._last_ns = t_ns
        due_ns = t_ns if restart or self._next_ns is None else self._next_ns
        if t_ns < due_ns:
            return False
        self._next_ns = max(due_ns + self._period_ns, t_ns + self._period_ns // 4)
        return True


def clock_synchronised() -> bool:
    """Whether the kernel says that UTC is disciplined (ntp_gettime(3))."""
    if not hasattr(_LIBC, "ntp_gettime"):
        return False
    return int(_LIBC.ntp_gettime(ctypes.create_string_buffer(256))) in range(_TIME_ERROR)


def checked_endpoint(endpoint: str) -> str:
    """The address to bind, if only this machine can reach it.

    Args:
        endpoint: ``tcp://127.0.0.1:5600``, ``tcp://[::1]:5600``, ``tcp://localhost:5600`` or ``ipc:///run/name``.
    Returns:
        The same; localhost as a number.
    Raises:
        ConfigError: another transport, or a host that is not this machine's loopback.
    """
    match = re.fullmatch(r"tcp://(\[[^\]]+\]|[^:\[\]]+):(\*|\d{1,5})", endpoint)
    if match is not None and (match[2] == "*" or int(match[2]) <= 65535):
        host = "127.0.0.1" if match[1] == "localhost" else match[1].strip("[]")
        try:
            if ipaddress.ip_address(host).is_loopback:
                return endpoint.replace("localhost", "127.0.0.1")
        except ValueError:
            pass
    path = endpoint.removeprefix("ipc://")
    if path != endpoint and 0 < len(os.fsencode(path)) <= IPC_PATH_LIMIT:
        return endpoint
    raise ConfigError(
        "setting stream.endpoints: address cannot be used",
        value=endpoint,
        allowed="tcp://127.0.0.1:PORT, tcp://[::1]:PORT, ipc:///PATH (up to 107 bytes)",
        action="other machines may not subscribe: the stream is not encrypted",
    )


def _pub_socket(context: zmq.Context[zmq.Socket[bytes]], high_water_mark: int) -> zmq.Socket[bytes]:
    """A PUB socket with bounded queues, heartbeats and a short handshake."""
    sender = context.socket(zmq.PUB)
    for option, value in (
        (zmq.SNDHWM, high_water_mark),
        (zmq.SNDBUF, SEND_BUFFER_BYTES),
        (zmq.MAXMSGSIZE, INCOMING_LIMIT_BYTES),
        (zmq.HEARTBEAT_IVL, HEARTBEAT_MS),
        (zmq.HEARTBEAT_TIMEOUT, PEER_TIMEOUT_MS),
        (zmq.HANDSHAKE_IVL, HANDSHAKE_MS),
        (zmq.TCP_KEEPALIVE, 1),
    ):
        sender.setsockopt(option, value)
    return sender


def _bind(sender: zmq.Socket[bytes], endpoint: str) -> str:
    """Bind and return the actual address; one that someone else serves, or a file that is no socket, is refused."""
    path = Path(endpoint.removeprefix("ipc://"))
    if endpoint.startswith("ipc:///") and path.exists() and not path.is_socket():
        raise ConfigError(
            "setting stream.endpoints: there is a file of this name, and it is no socket",
            value=endpoint,
            action="set another address: binding would delete the file",
        )
    try:
        if endpoint.startswith("ipc://") and _is_served(endpoint.removeprefix("ipc://")):
            raise zmq.ZMQError(zmq.EADDRINUSE)
        sender.setsockopt(zmq.IPV6, int("[" in endpoint))
        sender.bind(endpoint)
    except zmq.ZMQError as error:
        raise ConfigError(
            f"setting stream.endpoints: address cannot be bound ({zmq.strerror(error.errno or 0)})",
            value=endpoint,
            action="stop the other publisher or set another address"
            if error.errno == zmq.EADDRINUSE
            else "check that the address and its folder exist and may be used",
        ) from error
    return sender.getsockopt_string(zmq.LAST_ENDPOINT)


def _is_served(path: str) -> bool:
    """Whether someone listens at a Unix socket: ZeroMQ would take the path away from them without a word."""
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(("\0" + path[1:]) if path.startswith("@") else path)
        except OSError:
            return False
    return True
