# SPDX-License-Identifier: Apache-2.0
"""Publishes results over ZeroMQ; a subscriber that is slow, stuck or hostile never holds it up.

One socket serves this machine. Another, with an I/O thread of its own, serves other machines with CURVE and an
authenticator, and lets nobody in when that dies. More of both give single-frame messages to who wants only the newest.
"""

from __future__ import annotations

import ctypes
import os
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import zmq

from edge.config import StreamSettings
from edge.errors import ConfigError
from edge.frames import Detections, FusedCloud, Heatmap, PointCloud, Pose, Shape
from edge.stream import convert
from edge.stream.addresses import checked_endpoint, is_local
from edge.stream.authenticator import Authenticator, HandshakeMonitor
from edge.stream.keys import Certificate, KeyFolder
from edge.stream.messages import State, Status
from edge.stream.outlet import Outlet
from edge.stream.wire import (
    BOOT_BYTES,
    FLAG_REPEATED,
    HASH_BYTES,
    HEARTBEAT_HZ,
    HEATMAP_HZ,
    SOURCES,
    STATUS_HZ,
    Draft,
    Source,
    Stamp,
    conflatable,
    pack,
)

KEPT_TYPES = ("status", "shape")
"""The last message of every topic of these types is kept for those who subscribe later."""
REPEAT_HZ = 5.0
"""A kept message is repeated so often at most, however many subscribe: subscribing must not flood others."""
LATEST_HIGH_WATER_MARK = 4
AUTHENTICATOR_DIED = "authenticator died: closed to other machines until the service is started again"
_LIBC = ctypes.CDLL(None)
_TIME_ERROR = 5  # ntp_gettime(3): the clock is not synchronised


class Publisher:
    """The sending end of docs/wire_format.md; usable from several threads, and as a context manager.

    Every sending method returns the frames it sent (``wire.join`` makes one block for a recording of them).

    Args:
        settings: addresses to bind, queue length, keys.
        config_hash, calibration_hash: hashes of what produces the data; the first 8 bytes are sent.
        source: "live", "replay" or "sim".
    Raises:
        ConfigError: an address is in use, cannot be bound, or is reachable from other machines and there are no
            proper keys.
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
        self._kept: dict[str, Draft] = {}
        self._newest: dict[str, bytes] = {}
        self._asked: set[str] = set()
        self._lock = threading.Lock()
        self.fault = ""
        """Why part of the stream is closed; empty while all is well."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._remote_context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._outlets: list[Outlet] = []
        self._latest: list[Outlet] = []
        self._guarded: list[Outlet] = []
        self._authenticator: Authenticator | None = None
        self._monitors: list[HandshakeMonitor] = []
        try:
            self._open(settings)
        except BaseException:
            self.close()
            raise

    def _open(self, settings: StreamSettings) -> None:
        """Bind all addresses; those that other machines reach on sockets of their own, with keys."""
        encrypted = bool(settings.key_folder)
        kinds = (
            ("stream.endpoints", settings.endpoints, self._outlets, settings.send_high_water_mark),
            ("stream.latest_endpoints", settings.latest_endpoints, self._latest, LATEST_HIGH_WATER_MARK),
        )
        checked = [[checked_endpoint(e, encrypted, setting) for e in given] for setting, given, _, _ in kinds]
        keys, to_bind = KeyFolder(Path(settings.key_folder)), []
        for (setting, _, outlets, high_water_mark), addresses in zip(kinds, checked, strict=True):
            for local in (True, False):
                chosen = [address for address in addresses if is_local(address) is local]
                if chosen:
                    outlet = self._outlet(high_water_mark, None if local else keys.server())
                    outlets.append(outlet)
                    to_bind.append((outlet, chosen, setting))
        if self._guarded:
            self._authenticator = Authenticator(self._remote_context, keys.allowed)
        for outlet, addresses, setting in to_bind:
            outlet.bind(addresses, setting)

    def _outlet(self, high_water_mark: int, pair: Certificate | None) -> Outlet:
        """A socket that is not bound yet, with keys in the context that the authenticator guards."""
        if pair is None:
            return Outlet(self._context, high_water_mark)
        outlet = Outlet(self._remote_context, high_water_mark, pair)
        self._monitors.append(HandshakeMonitor(self._remote_context, outlet.socket, len(self._monitors)))
        self._guarded.append(outlet)
        return outlet

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Addresses that are bound, in the order of local and other ones; a port given as * is a number here."""
        return tuple(address for outlet in self._outlets for address in outlet.endpoints)

    @property
    def latest_endpoints(self) -> tuple[str, ...]:
        """The same, of the single-frame messages."""
        return tuple(address for outlet in self._latest for address in outlet.endpoints)

    @property
    def auth_failures(self) -> int:
        """Handshakes from other machines that failed since the start: wrong key, no key, no ZeroMQ."""
        with self._lock:
            return sum(monitor.failures() for monitor in self._monitors)

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
        """Send a sign of life, ten a second at most: call it as often as convenient. Serves new subscribers too."""
        now_ns = time.monotonic_ns()
        with self._lock:
            self._serve()
        return self._send(convert.encode_heartbeat(state, now_ns)) if self._due("hb", HEARTBEAT_HZ, now_ns) else []

    def close(self) -> None:
        """Give subscribers half a second to take the last messages, then release the addresses."""
        with self._lock:
            for monitor in self._monitors:
                monitor.close()
            for outlet in (*self._outlets, *self._latest):
                outlet.close()
            if self._authenticator is not None:
                self._authenticator.stop()
            self._context.term()
            self._remote_context.term()

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
            frames = self._emit(draft)
            if draft.type in KEPT_TYPES:
                self._kept[draft.topic] = replace(draft, flags=draft.flags | FLAG_REPEATED)
                self._asked.discard(draft.topic)
            if self._latest:
                self._newest[draft.topic] = block = conflatable(frames)
                for outlet in self._latest:
                    outlet.send([block])
            self._serve()
        return frames

    def _emit(self, draft: Draft) -> list[bytes]:
        """Stamp and send to all subscribers; the lock is held."""
        sequence = self._sequence.get(draft.topic, 0)
        times = time.monotonic_ns(), time.time_ns(), clock_synchronised()
        frames = pack(draft, Stamp(self._boot, sequence, *times, self._source, *self._hashes))
        self._sequence[draft.topic] = sequence + 1
        for outlet in self._outlets:
            outlet.send(frames)
        return frames

    def _serve(self) -> None:
        """Give new subscribers what is kept, and close what is no longer guarded; the lock is held."""
        if self._authenticator is not None and not self._authenticator.alive and not self.fault:
            self.fault = AUTHENTICATOR_DIED
            for monitor in self._monitors:
                monitor.close()
            for outlet in self._guarded:
                outlet.close()
            self._outlets = [outlet for outlet in self._outlets if outlet not in self._guarded]
            self._latest = [outlet for outlet in self._latest if outlet not in self._guarded]
        for monitor in self._monitors:
            monitor.failures()
        for outlet in self._outlets:
            self._asked.update(_matching(self._kept, outlet.subscriptions()))
        for outlet in self._latest:
            for topic in _matching(self._newest, outlet.subscriptions()):
                outlet.send([self._newest[topic]])
        now_ns = time.monotonic_ns()
        for topic in sorted(self._asked):
            if self._paces.setdefault(f"again {topic}", _Pace(REPEAT_HZ)).due(now_ns):
                self._asked.discard(topic)
                self._emit(self._kept[topic])


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


def _matching(kept: Iterable[str], prefixes: Sequence[bytes]) -> list[str]:
    """Topics that a subscription to any of the prefixes selects."""
    starts = tuple(prefix.decode("ascii", "replace") for prefix in prefixes)
    return [topic for topic in kept if topic.startswith(starts)]
