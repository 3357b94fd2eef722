# SPDX-License-Identifier: Apache-2.0
"""Receives the capture card's samples: a thread that empties the socket, assembles frames and keeps the newest.

Packets are taken by ``recvmmsg``, hundreds in one call: at 100 MB/s there are 70,000 of them a second. What the kernel
drops because nobody read in time it counts itself (SO_RXQ_OVFL), and it stamps arrivals (SO_TIMESTAMPNS).
"""

from __future__ import annotations

import ctypes
import errno
import os
import select
import socket
import threading
import time
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from edge.drivers.dca1000 import kernels_packets as kernels
from edge.drivers.dca1000.assembler import Account, Assembled, Batch, FrameAssembler
from edge.errors import LinkError

SO_RCVBUFFORCE = 33
BATCH = 512
ROW_BYTES = 1536
"""Room for one packet: more than 1466, so that a longer one shows."""
CONTROL_BYTES = 64
MMSGHDR = np.dtype(
    {
        "names": ["name", "name_bytes", "iov", "iovs", "control", "control_bytes", "flags", "bytes"],
        "formats": ["u8", "u4", "u8", "u8", "u8", "u8", "i4", "u4"],
        "offsets": [0, 8, 16, 24, 32, 40, 48, 56],
        "itemsize": 64,
    }
)
"""struct mmsghdr of 64-bit Linux."""
SOCKADDR = np.dtype([("family", "u2"), ("port", ">u2"), ("address", "u4"), ("zero", "u8")])
POLL_S = 0.1
PAUSE_S = 1e-3
"""After a batch that was not full: more packets come together next time. The socket holds a hundred times as much."""
FLUSH_S = 2.5
"""Silence after which open frames are closed: the card sends the rest of a recording after 2 s without samples."""
JOIN_S = 5.0
KERNEL_OVERHEAD = 2
"""The kernel doubles what is asked for, and charges each packet about twice its size."""


class PacketSocket:
    """UDP socket that gives batches of packets with arrival times.

    Args:
        address, port: of this host; port 0: any free one.
        buffer_bytes: asked of the kernel.
    Attributes:
        notes: what the host should be told, for example that the buffer is smaller than it was asked for.
        drops: packets that the kernel dropped because the buffer was full.
    Raises:
        LinkError: the address is not this host's, or the port is taken.
    """

    def __init__(self, address: str, port: int, buffer_bytes: int) -> None:
        self.notes: list[str] = []
        self.drops = 0
        self._socket = open_udp(address, port, "samples")
        try:
            self.buffer_bytes = self._enlarge(buffer_bytes)
            self._socket.setsockopt(socket.SOL_SOCKET, kernels.SO_TIMESTAMPNS, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, kernels.SO_RXQ_OVFL, 1)
        except OSError:
            self._socket.close()
            raise
        self.address: tuple[str, int] = self._socket.getsockname()
        self._socket.setblocking(False)
        self._packets = np.zeros((BATCH, ROW_BYTES), np.uint8)
        self._control = np.zeros((BATCH, CONTROL_BYTES), np.uint8)
        self._names = np.zeros(BATCH, SOCKADDR)
        self._vectors = np.zeros((BATCH, 2), np.uint64)
        self._headers = np.zeros(BATCH, MMSGHDR)
        self._stamps, self._lengths = np.zeros(BATCH, np.int64), np.zeros(BATCH, np.int64)
        self._sizes, self._senders = np.zeros(BATCH, np.int32), np.zeros(BATCH, np.uint32)
        self._dropped = np.zeros(1, np.int64)
        self._prepare()
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        self._recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg
        self._recvmmsg.argtypes = [ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p]

    def wait(self, timeout_s: float) -> bool:
        """Whether a packet is there; waits for one at most ``timeout_s``."""
        return bool(self._poll.poll(1e3 * timeout_s))

    def receive(self) -> Batch:
        """The packets that are there, at most 512; the arrays are overwritten by the next call.

        Raises:
            LinkError: the socket broke.
        """
        headers = self._headers
        headers["name_bytes"], headers["control_bytes"] = SOCKADDR.itemsize, CONTROL_BYTES
        flags = socket.MSG_DONTWAIT | socket.MSG_TRUNC
        count = self._recvmmsg(self._socket.fileno(), headers.ctypes.data, BATCH, flags, None)
        if count < 0:
            code = ctypes.get_errno()
            if code not in (errno.EAGAIN, errno.EINTR, errno.ECONNREFUSED):
                raise LinkError("the socket of the samples broke", value=os.strerror(code))
            count = 0
        self._sizes[:count] = headers["bytes"][:count]
        self._lengths[:count] = headers["control_bytes"][:count]
        self._senders[:count] = self._names["address"][:count]
        now_ns = time.monotonic_ns()
        self._stamps[:count] = now_ns
        shift_ns = now_ns - time.time_ns()
        before = int(self._dropped[0])
        kernels.read_control(self._control, self._lengths, count, shift_ns, self._stamps, self._dropped)
        self.drops += (int(self._dropped[0]) - before) & 0xFFFFFFFF
        return Batch(self._packets, self._sizes, self._senders, self._stamps, int(count))

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()

    def _prepare(self) -> None:
        """Addresses of all buffers into the headers, once."""
        rows = np.arange(BATCH, dtype=np.uint64)
        self._vectors[:, 0] = self._packets.ctypes.data + rows * np.uint64(ROW_BYTES)
        self._vectors[:, 1] = ROW_BYTES
        self._headers["name"] = self._names.ctypes.data + rows * np.uint64(SOCKADDR.itemsize)
        self._headers["iov"], self._headers["iovs"] = self._vectors.ctypes.data + rows * np.uint64(16), 1
        self._headers["control"] = self._control.ctypes.data + rows * np.uint64(CONTROL_BYTES)

    def _set(self, option: int, value: int) -> None:
        self._socket.setsockopt(socket.SOL_SOCKET, option, value)

    def _enlarge(self, wanted: int) -> int:
        """Ask for a receive buffer, with force where that is allowed; what the kernel gave."""
        for option in (SO_RCVBUFFORCE, socket.SO_RCVBUF):
            try:
                self._set(option, wanted)
                break
            except PermissionError:
                continue
        given = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // KERNEL_OVERHEAD
        if given < wanted:
            self.notes.append(
                f"the kernel gave a receive buffer of {given} instead of {wanted} bytes: "
                f"sudo sysctl -w net.core.rmem_max={wanted} (docs/hardware.md)"
            )
        return given


def open_udp(address: str, port: int, what: str) -> socket.socket:
    """UDP socket bound to an address of this host.

    Raises:
        LinkError: the address is not this host's, is no address, or the port is taken.
    """
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.bind((address, port))
    except OSError as error:
        opened.close()
        actions = {
            errno.EADDRNOTAVAIL: f"give it to the interface of the card: sudo ip address add {address}/24 dev NAME",
            errno.EADDRINUSE: "another program has this port: end it, or give the second card another address",
        }
        raise LinkError(
            f"no socket for the card's {what} at {address}:{port}",
            value=error.strerror or str(error),
            action=actions.get(error.errno or 0, "check board.host_address"),
        ) from error
    return opened


@dataclass(frozen=True, slots=True)
class ReceiverCounters:
    """State of a receiver.

    Args:
        account: of packets and bytes.
        kernel_drops: packets that the kernel dropped.
        overflow_frames: frames that were given up because nobody took them.
        queued: frames and losses that wait.
    """

    account: Account
    kernel_drops: int
    overflow_frames: int
    queued: int

    def text(self) -> str:
        """What came and what did not, for people; what never happened is left out."""
        a = self.account
        seldom = {
            "dropped by the kernel": self.kernel_drops,
            "twice": a.duplicate_packets,
            "out of order": a.reordered_packets,
            "too late": a.late_packets,
            "of another recording": a.outside_packets,
            "from elsewhere": a.foreign_packets,
            "garbage": a.garbage_packets,
        }
        parts = [f"{a.packets} packets", *(f"{count} {what}" for what, count in seldom.items() if count)]
        frames = {"cut": a.frames_cut, "missing": a.frames_missing, "not taken in time": self.overflow_frames}
        parts += [f"{a.frames_whole} frames whole", *(f"{count} {what}" for what, count in frames.items() if count)]
        return ", ".join(parts)


class CardReceiver:
    """Thread that receives one card's samples and keeps its newest frames.

    Args:
        packets: socket; closed by ``close``.
        assembler: of this card; nobody else may use it.
        name: of the thread.
        keep: frames that may wait; the oldest one is given up for the next.
        flush_s: silence after which open frames are closed.
    """

    def __init__(
        self, packets: PacketSocket, assembler: FrameAssembler, name: str, keep: int = 64, flush_s: float = FLUSH_S
    ) -> None:
        self._packets, self._assembler, self._keep, self._flush_s = packets, assembler, keep, flush_s
        self._queue: deque[Assembled] = deque()
        self._change, self._lock = threading.Condition(), threading.Lock()
        self._last_ns, self._first_ns, self._overflow, self._waiting_frames = 0, 0, 0, 0
        self._error: LinkError | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{name} samples")

    def start(self) -> CardReceiver:
        """Receive from now on."""
        self._thread.start()
        return self

    def begin(self) -> None:
        """A recording is about to begin: what is in the socket belongs to the one before, bytes count from 0."""
        with self._lock:
            self._drain()
            self._put(self._assembler.begin())
            self._first_ns = 0

    def finish(self) -> None:
        """The recording ended: take what is in the socket, close open frames."""
        with self._lock:
            self._drain()
            self._put(self._assembler.flush())

    def get(self, timeout_s: float = 0.0) -> Assembled | None:
        """Next frame or loss; None: none came in time.

        Raises:
            LinkError: the socket broke, or the card records something else than what was begun.
        """
        with self._change:
            if not self._queue and timeout_s > 0:
                self.wait(timeout_s)
            if self._queue:
                item = self._queue.popleft()
                self._waiting_frames -= item.data is not None
                return item
            if self._error is not None:
                raise self._error
            return None

    def wait(self, timeout_s: float) -> bool:
        """Whether a frame or loss waits; waits for one at most ``timeout_s``."""
        with self._change:
            return self._change.wait_for(lambda: bool(self._queue) or self._error is not None, timeout_s)

    def wait_first(self, timeout_s: float) -> int | None:
        """Arrival of the recording's first packet of samples, CLOCK_MONOTONIC in ns; None: it did not come in time."""
        with self._change:
            self._change.wait_for(lambda: self._first_ns > 0 or self._error is not None, timeout_s)
            return self._first_ns or None

    @property
    def last_packet_ns(self) -> int:
        """When packets were received last, CLOCK_MONOTONIC; 0: never."""
        return self._last_ns

    @property
    def recording(self) -> int:
        """Number of the present recording; frames carry it."""
        return self._assembler.recording

    @property
    def outside_in_a_row(self) -> int:
        """Latest packets that all belonged to places far away."""
        return self._assembler.outside_in_a_row

    @property
    def notes(self) -> list[str]:
        """Of the socket."""
        return self._packets.notes

    def counters(self) -> ReceiverCounters:
        """Counters that belong together."""
        with self._lock, self._change:
            account = self._assembler.account()
            return ReceiverCounters(account, self._packets.drops, self._overflow, len(self._queue))

    def close(self) -> None:
        """End the thread, give the port back; what waits can still be taken."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join(JOIN_S)
        self._packets.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                if not self._packets.wait(POLL_S):
                    self._flush_when_silent()
                    continue
                with self._lock:
                    count = self._take()
            except (LinkError, OSError, ValueError) as error:
                broken = error if isinstance(error, LinkError) else LinkError(f"receiving samples failed ({error})")
                with self._change:
                    self._error = broken
                    self._change.notify_all()
                return
            if count < BATCH:
                time.sleep(PAUSE_S)

    def _take(self) -> int:
        """One batch from the socket to the frames; packets in it."""
        batch = self._packets.receive()
        if not batch.count:
            return 0
        closed = self._assembler.feed(batch)
        self._last_ns = int(batch.stamps[batch.count - 1])
        if not self._first_ns and self._assembler.first_arrival_ns:
            with self._change:
                self._first_ns = self._assembler.first_arrival_ns
                self._change.notify_all()
        self._put(closed)
        return batch.count

    def _drain(self) -> None:
        while self._take() == BATCH:
            pass

    def _flush_when_silent(self) -> None:
        silent_s = 1e-9 * (time.monotonic_ns() - self._last_ns)
        if self._assembler.open and silent_s > self._flush_s:
            with self._lock:
                self._put(self._assembler.flush())

    def _put(self, items: list[Assembled]) -> None:
        if not items:
            return
        with self._change:
            for item in items:
                self._queue.append(item)
                self._waiting_frames += item.data is not None
            while self._waiting_frames > self._keep:
                self._give_up_oldest()
            self._change.notify_all()

    def _give_up_oldest(self) -> None:
        """The oldest frame that waits becomes a loss; neighbouring ones become one."""
        place = next(k for k, item in enumerate(self._queue) if item.data is not None)
        lost = replace(self._queue[place], data=None, overflow=True)
        before = self._queue[place - 1] if place else None
        if before and before.overflow and before.follower == (lost.recording, lost.index):
            del self._queue[place]
            place, lost = place - 1, replace(before, count=before.count + 1)
        self._queue[place] = lost
        self._overflow += 1
        self._waiting_frames -= 1
