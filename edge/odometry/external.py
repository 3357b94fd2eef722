# SPDX-License-Identifier: Apache-2.0
"""Poses that another process publishes (wheel odometry, INS): messages ``1/pose/`` of docs/wire_format.md.

The sender's clock need not be ours: by default it is fitted (``edge/odometry/clock_fit.py``) from the instants of
publication and arrival, so that queueing delays do not count and the way takes its least delay only. Where PTP or GPS
keeps both hosts' clocks right, or both are one host, the setting says which clock the stamps are of.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import zmq

from edge.board_settings import PoseSettings
from edge.config import RigGeometry
from edge.errors import ConfigError, WireError
from edge.frames import Pose
from edge.odometry.clock_fit import ClockFit
from edge.odometry.host_clock import offset_to_monotonic, tai_is_set, utc_synchronised
from edge.odometry.source import NS_PER_S, EventKind, Meter, Placement, PoseEvent, PoseHealth
from edge.stream.decode import decode
from edge.stream.messages import Header, PoseMessage
from edge.stream.subscribe import subscriber
from edge.stream.wire import MAJOR

TOPIC = f"{MAJOR}/pose/"
HIGH_WATER_MARK = 256
"""Four seconds of 60 poses; the queue's oldest are kept, and what did not fit shows as a gap."""
SETTLE_S = 1.0
"""Until the fit covers so much, a pose's time counts as guessed."""
OFFSET_PERIOD_NS = NS_PER_S
"""A host clock's offset is measured anew so often: it is slewed against CLOCK_MONOTONIC by at most 500 ppm."""
LARGEST_DELAY_S = 2.0
"""From the instant of a pose to its arrival."""


class SenderTime:
    """A sender's time stamps on our CLOCK_MONOTONIC.

    Args:
        settings: which clock they are of.
        now: our clock, for tests.
    """

    def __init__(self, settings: PoseSettings, now: Callable[[], int] = time.monotonic_ns) -> None:
        self._kind, self._now = settings.clock, now
        self.fit = ClockFit()
        self._offset_ns = self._measured_ns = 0

    @property
    def settled(self) -> bool:
        """Whether times are as good as they get."""
        return self._kind != "fit" or self.fit.span_s >= SETTLE_S

    def restart(self) -> None:
        """The sender is another one from now on."""
        self.fit = ClockFit()

    def note(self, header: Header, arrival_ns: int) -> bool:
        """A message of the sender arrived; False: its clock was set since the last one."""
        return self._kind != "fit" or self.fit.add(header.t_pub_ns, arrival_ns)

    def local_ns(self, header: Header, t_ns: int) -> int:
        """An instant of the message on our clock."""
        if self._kind == "fit":
            return self.fit.to_local_ns(t_ns)
        if self._kind == "utc":
            t_ns += header.utc_ns - header.t_pub_ns
        return t_ns + self._host_offset_ns()

    def _host_offset_ns(self) -> int:
        """Of the clock that sender and host share, to CLOCK_MONOTONIC."""
        if self._kind in ("monotonic", "fit"):
            return 0
        now_ns = self._now()
        if not self._measured_ns or now_ns - self._measured_ns > OFFSET_PERIOD_NS:
            self._measured_ns = now_ns
            self._offset_ns = offset_to_monotonic("tai" if self._kind == "tai" else "realtime").offset_ns
        return self._offset_ns


class ExternalSource:
    """Subscribes to another process's poses; finds it again after it or the network was gone.

    Args:
        settings: of the rig.
        geometry: of the rig.
    """

    def __init__(self, settings: PoseSettings, geometry: RigGeometry) -> None:
        self._settings = settings
        self._placement = Placement(settings, geometry)
        self._meter = Meter(settings.timeout_s)
        self._time = SenderTime(settings)
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._boot, self._sequence, self._quiet_ns = b"", -1, 0
        self._items: list[Pose | PoseEvent] = []

    @property
    def name(self) -> str:
        """For messages."""
        return f"zmq ({self._settings.endpoint})"

    @property
    def health(self) -> PoseHealth:
        """Counters and state now."""
        return self._meter.health()

    @property
    def clock(self) -> ClockFit:
        """The fit of the sender's clock; unused unless ``pose.clock`` is "fit"."""
        return self._time.fit

    def start(self) -> None:
        """Connect; the publisher need not be there yet.

        Raises:
            ConfigError: the address is none; a clock that this host does not have.
        """
        if self._meter.state != "idle":
            return
        _require_clock(self._settings.clock)
        self._context = zmq.Context()
        self._socket = _subscriber(self._context)
        try:
            self._socket.setsockopt(zmq.IPV6, int("[" in self._settings.endpoint))
            self._socket.connect(self._settings.endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise ConfigError(
                f"pose.endpoint: cannot connect ({zmq.strerror(error.errno or 0)})",
                value=self._settings.endpoint,
                allowed="tcp://HOST:PORT or ipc:///PATH",
            ) from error
        self._meter.state = "starting"
        self._quiet_ns = time.monotonic_ns() + self._timeout_ns

    def poll(self, timeout_s: float) -> list[Pose | PoseEvent]:
        """What came; waits at most ``timeout_s`` for it."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * NS_PER_S)
        while self._socket is not None:
            now_ns = time.monotonic_ns()
            until_ns = deadline_ns if self._meter.state == "silent" else min(deadline_ns, self._quiet_ns)
            if self._socket.poll(max(0, until_ns - now_ns + 999_999) // 1_000_000):
                self._receive()
            self._watch()
            if self._items or time.monotonic_ns() >= deadline_ns:
                break
        items, self._items = self._items, []
        return items

    def close(self) -> None:
        """Disconnect."""
        self._meter.state = "ended"
        if self._socket is not None:
            self._socket.close(linger=0)
        if self._context is not None:
            self._context.term()
        self._socket = self._context = None

    @property
    def _timeout_ns(self) -> int:
        return round(self._settings.timeout_s * NS_PER_S)

    def _receive(self) -> None:
        """All messages that wait."""
        assert self._socket is not None
        for _ in range(HIGH_WATER_MARK):
            try:
                frames = self._socket.recv_multipart(zmq.DONTWAIT)
            except zmq.Again:
                return
            arrival_ns = time.monotonic_ns()
            try:
                message = decode(frames)
            except WireError:
                message = None
            if isinstance(message, PoseMessage):
                self._take(message, arrival_ns)
            else:
                self._meter.refused += 1

    def _take(self, message: PoseMessage, arrival_ns: int) -> None:
        header = message.header
        self._count(header)
        if not self._time.note(header, arrival_ns):
            self._event("new_clock", f"{self.name}: the sender's clock was set")
        pose = message.pose
        local_ns = self._time.local_ns(header, pose.t_ns)
        if arrival_ns - local_ns > LARGEST_DELAY_S * NS_PER_S:
            self._meter.refused += 1
            return
        placed = self._placement.rig(Pose(local_ns, pose.position_m, pose.quaternion_xyzw))
        if not self._meter.accept(placed):
            return
        if self._meter.state != "running":
            self._event("started" if self._meter.state == "starting" else "resumed", f"{self.name}: poses come")
            self._meter.state = "running"
        self._quiet_ns = arrival_ns + self._timeout_ns
        self._meter.time_guessed += not self._time.settled
        self._items.append(placed)

    def _count(self, header: Header) -> None:
        """Gaps in the numbers; another boot is another run of the sender, with another odometry frame and clock."""
        if header.boot != self._boot:
            if self._boot:
                self._meter.restarts += 1
                self._meter.pause()
                self._time.restart()
                self._event("new_frame", f"{self.name}: the sender restarted", new_frame=True)
            self._boot, self._sequence = header.boot, header.sequence - 1
        self._meter.lost += max(0, header.sequence - self._sequence - 1)
        self._sequence = max(self._sequence, header.sequence)

    def _watch(self) -> None:
        """Say once that no pose comes."""
        if self._meter.state in ("starting", "running") and time.monotonic_ns() > self._quiet_ns:
            started = self._meter.state == "running"
            self._meter.state = "silent"
            what = "the sender stopped" if started else "no sender, or it sends no 1/pose/"
            self._event("silent", f"{self.name}: no pose for {self._settings.timeout_s:g} s: {what}")

    def _event(self, kind: EventKind, detail: str, new_frame: bool = False) -> None:
        self._items.append(PoseEvent(kind, time.monotonic_ns(), detail, new_frame))


def _require_clock(clock: str) -> None:
    """ConfigError: stamps on a clock that nothing keeps right here."""
    if clock == "utc" and not utc_synchronised():
        raise ConfigError(
            "pose.clock is utc, but nothing keeps this host's UTC right",
            value=clock,
            allowed="a clock disciplined by PTP, GPS or NTP",
            action='start ptp4l with phc2sys, gpsd with chrony, or set pose.clock = "fit"',
        )
    if clock == "tai" and not tai_is_set():
        raise ConfigError(
            "pose.clock is tai, but this host's kernel does not know TAI - UTC",
            value=clock,
            allowed="a host with PTP (phc2sys) or a leap second file",
            action='set it, or use pose.clock = "fit"',
        )


def _subscriber(context: zmq.Context[zmq.Socket[bytes]]) -> zmq.Socket[bytes]:
    """A subscriber of poses whose unread messages are nobody's when it closes."""
    receiver = subscriber(context, HIGH_WATER_MARK)
    receiver.setsockopt(zmq.LINGER, 0)
    receiver.setsockopt_string(zmq.SUBSCRIBE, TOPIC)
    return receiver
