# SPDX-License-Identifier: Apache-2.0
"""Puts the packets of one capture card together to frames: every byte in its place, every byte accounted for.

A recording is one stream of bytes; frame f is the bytes from f times the frame size on, whatever packets they come in.
What never comes stays zero, and is named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.drivers.dca1000 import kernels_packets as kernels
from edge.drivers.dca1000.packets import DATA_HEADER_BYTES, PAYLOAD_BYTES
from edge.errors import CaptureError

REORDER_PACKETS = 32
"""So many later packets may overtake one. A direct cable keeps the order; this is for what lies between."""
START_PACKETS = 4096
"""The first packet that comes of a recording must be one of its first so many, otherwise it is left from another."""
HISTORY_SLOTS = 256
"""Packets before the oldest open frame of which it is still known whether they came."""
LEAST_FRAMES = 4

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Batch:
    """Packets that came together.

    Args:
        packets: uint8 [n, bytes]; row k holds packet k.
        sizes: int32 [n], bytes of each packet, which may be more than a row has.
        senders: uint32 [n], IPv4 addresses as they lie in memory.
        stamps: int64 [n], arrivals on CLOCK_MONOTONIC in ns.
        count: packets.
    """

    packets: Bytes
    sizes: NDArray[np.int32]
    senders: NDArray[np.uint32]
    stamps: NDArray[np.int64]
    count: int


@dataclass(frozen=True, slots=True)
class Assembled:
    """One frame, or frames of which nothing came.

    Args:
        recording: counts calls of ``FrameAssembler.begin``.
        index: of the (first) frame in its recording.
        data: uint8 [frame bytes], zero where nothing came; None: nothing at all came.
        missing_bytes: of each frame.
        whole_chirps: bool [chirps], those of which every byte came; None: all.
        arrival_ns: when the packet with its first byte came, CLOCK_MONOTONIC; 0: it did not.
        count: frames; more than one only without data.
        overflow: the data came and were given up, because nobody took them in time.
    """

    recording: int
    index: int
    data: Bytes | None
    missing_bytes: int
    whole_chirps: NDArray[np.bool_] | None
    arrival_ns: int
    count: int = 1
    overflow: bool = False

    @property
    def follower(self) -> tuple[int, int]:
        """Recording and index of what comes next."""
        return self.recording, self.index + self.count


@dataclass(frozen=True, slots=True)
class Account:
    """What became of every packet and byte; ``check`` holds at any time.

    Args:
        packets, bytes: that came, headers included.
        header_bytes: of packets of this card.
        placed_bytes: samples in frames, the open ones included.
        duplicate_packets, duplicate_bytes: samples that had come before.
        late_packets, late_bytes: samples of frames that had been closed.
        outside_packets, outside_bytes: samples of places far from the present ones: another recording's.
        garbage_packets, garbage_bytes: no packets of samples, or with a header that contradicts itself.
        foreign_packets, foreign_bytes: from another sender.
        reordered_packets: that came after later ones, and in time.
        frames_whole, frames_cut, frames_missing: closed with all, some, none of their bytes.
        missing_bytes: of cut and missing frames.
    """

    packets: int
    bytes: int
    header_bytes: int
    placed_bytes: int
    duplicate_packets: int
    duplicate_bytes: int
    late_packets: int
    late_bytes: int
    outside_packets: int
    outside_bytes: int
    garbage_packets: int
    garbage_bytes: int
    foreign_packets: int
    foreign_bytes: int
    reordered_packets: int
    frames_whole: int
    frames_cut: int
    frames_missing: int
    missing_bytes: int

    @property
    def frames(self) -> int:
        """Closed frames, whatever came of them."""
        return self.frames_whole + self.frames_cut + self.frames_missing

    @property
    def unaccounted_bytes(self) -> int:
        """0, or there is a defect."""
        samples = self.placed_bytes + self.duplicate_bytes + self.late_bytes + self.outside_bytes
        return self.bytes - self.header_bytes - samples - self.garbage_bytes - self.foreign_bytes

    def check(self) -> None:
        """CaptureError unless every byte that came is accounted for."""
        if self.unaccounted_bytes:
            raise CaptureError(
                "bytes of the capture card do not add up",
                value=self.unaccounted_bytes,
                allowed="0",
                action="this is a defect of the software: report it",
            )


class FrameAssembler:
    """Frames of one card.

    Args:
        frame_bytes: of one frame.
        chirp_bytes: of one chirp; divides ``frame_bytes``.
        sender: IPv4 address of the card, as in memory; 0: any.
        reorder_packets: so many later packets may overtake one.
    Raises:
        ConfigError: sizes that are none.
    """

    def __init__(
        self, frame_bytes: int, chirp_bytes: int, sender: int = 0, reorder_packets: int = REORDER_PACKETS
    ) -> None:
        require(frame_bytes > 0, "frame_bytes", frame_bytes, "above 0")
        require(chirp_bytes > 0 and frame_bytes % chirp_bytes == 0, "chirp_bytes", chirp_bytes, "a part of the frame")
        require(reorder_packets >= 0, "reorder_packets", reorder_packets, "0 or more")
        self.frame_bytes, self.chirp_bytes = frame_bytes, chirp_bytes
        self.recording = 0
        self._sender, self._reorder = np.uint32(sender), reorder_packets * PAYLOAD_BYTES
        frames = max(LEAST_FRAMES, self._reorder // frame_bytes + 3)
        self._ring = np.zeros((frames, frame_bytes), np.uint8)
        self._received, self._arrival = np.zeros(frames, np.int64), np.zeros(frames, np.int64)
        self._got = np.zeros(frames * frame_bytes // PAYLOAD_BYTES + 2 + HISTORY_SLOTS, np.uint16)
        self._state = np.zeros(kernels.STATE_SIZE, np.int64)
        self._counters = np.zeros(kernels.COUNTERS, np.int64)
        self._whole = self._cut = self._missing = self._missing_bytes = 0
        self._restart()

    def feed(self, batch: Batch) -> list[Assembled]:
        """Take a batch.

        Returns:
            Frames that were closed by it, in order.
        """
        closed: list[Assembled] = []
        done = 0
        while True:
            done = kernels.place(
                *(batch.packets, batch.sizes, batch.senders, batch.stamps, done, batch.count, self._sender),
                *(self._reorder, START_PACKETS, self._state, self._counters, self._ring, self._got),
                *(self._received, self._arrival),
            )
            if self._must_close:
                closed.append(self._close())
            elif done < batch.count:
                self._make_room(batch.packets[done], int(batch.sizes[done]), closed)
            else:
                return closed

    def flush(self) -> list[Assembled]:
        """End of what comes: closes every frame of which a byte came, and those before it."""
        closed: list[Assembled] = []
        while self._begin < self._state[kernels.HIGHEST]:
            closed.append(self._close())
        return closed

    def begin(self) -> list[Assembled]:
        """The card begins another recording: bytes count from 0 again; closes what was open."""
        closed = self.flush()
        self.recording += 1
        self._restart()
        return closed

    @property
    def open(self) -> bool:
        """Whether bytes wait for the rest of their frame."""
        return bool(self._begin < self._state[kernels.HIGHEST])

    @property
    def first_arrival_ns(self) -> int:
        """Arrival of the first packet of this recording; 0: none came yet."""
        return int(self._state[kernels.FIRST_NS])

    @property
    def waiting_bytes(self) -> int:
        """Bytes in open frames."""
        return int(self._received.sum())

    @property
    def outside_in_a_row(self) -> int:
        """Latest packets that all belonged to places far away: the card records something else."""
        return int(self._state[kernels.OUTSIDE_IN_A_ROW])

    def account(self) -> Account:
        """Counters of all recordings."""
        c = [int(value) for value in self._counters]
        return Account(
            packets=c[kernels.PACKETS],
            bytes=c[kernels.BYTES],
            header_bytes=c[kernels.HEADERS],
            placed_bytes=c[kernels.PLACED],
            duplicate_packets=c[kernels.DUPLICATE],
            duplicate_bytes=c[kernels.DUPLICATE_BYTES],
            late_packets=c[kernels.LATE],
            late_bytes=c[kernels.LATE_BYTES],
            outside_packets=c[kernels.OUTSIDE],
            outside_bytes=c[kernels.OUTSIDE_BYTES],
            garbage_packets=c[kernels.GARBAGE],
            garbage_bytes=c[kernels.GARBAGE_BYTES],
            foreign_packets=c[kernels.FOREIGN],
            foreign_bytes=c[kernels.FOREIGN_BYTES],
            reordered_packets=c[kernels.REORDERED],
            frames_whole=self._whole,
            frames_cut=self._cut,
            frames_missing=self._missing,
            missing_bytes=self._missing_bytes,
        )

    @property
    def _base(self) -> int:
        return int(self._state[kernels.BASE])

    @property
    def _begin(self) -> int:
        """Position of the oldest open frame."""
        return self._base * self.frame_bytes

    @property
    def _must_close(self) -> bool:
        whole = self._received[self._base % len(self._ring)] == self.frame_bytes
        return bool(whole or self._begin + self.frame_bytes + self._reorder <= self._state[kernels.HIGHEST])

    def _restart(self) -> None:
        self._state[:] = 0
        self._got[:] = 0
        self._state[kernels.TOP_SLOT] = self._top_slot

    @property
    def _top_slot(self) -> int:
        """Last slot that a byte of an open frame can lie in."""
        return ((self._base + len(self._ring)) * self.frame_bytes - 1) // PAYLOAD_BYTES

    def _close(self) -> Assembled:
        """Close the oldest frame."""
        index = self._base
        row, size = index % len(self._ring), self.frame_bytes
        received, arrival = int(self._received[row]), int(self._arrival[row])
        missing = size - received
        chirps = self._whole_chirps(index) if 0 < received < size else None
        data = self._ring[row].copy() if received else None
        if received:
            self._ring[row] = 0
            self._received[row] = self._arrival[row] = 0
        self._whole += not missing
        self._cut += 0 < missing < size
        self._missing += not received
        self._missing_bytes += missing
        self._move_to(index + 1)
        return Assembled(self.recording, index, data, missing, chirps, arrival)

    def _move_to(self, base: int) -> None:
        """Another oldest frame; slots that come into sight have no bytes yet."""
        top = int(self._state[kernels.TOP_SLOT])
        self._state[kernels.BASE] = base
        new = self._top_slot
        if new - top >= len(self._got):
            self._got[:] = 0
        elif new > top:
            self._got[np.arange(top + 1, new + 1) % len(self._got)] = 0
        self._state[kernels.TOP_SLOT] = new

    def _make_room(self, packet: Bytes, nbytes: int, closed: list[Assembled]) -> None:
        """Close frames until the one that a packet ends in can be open; frames of which nothing came count as one."""
        end = int.from_bytes(packet[4:DATA_HEADER_BYTES].tobytes(), "little") + nbytes - DATA_HEADER_BYTES
        last = (end - 1) // self.frame_bytes
        while self.open and self._base + len(self._ring) <= last:
            closed.append(self._close())
        count = last - len(self._ring) + 1 - self._base
        if count > 0:
            closed.append(Assembled(self.recording, self._base, None, self.frame_bytes, None, 0, count))
            self._missing += count
            self._missing_bytes += count * self.frame_bytes
            self._move_to(self._base + count)

    def _whole_chirps(self, index: int) -> NDArray[np.bool_]:
        """bool [chirps] of the oldest frame."""
        start, end = index * self.frame_bytes, (index + 1) * self.frame_bytes
        slots = np.arange(start // PAYLOAD_BYTES, (end - 1) // PAYLOAD_BYTES + 1)
        lost = slots * PAYLOAD_BYTES + self._got[slots % len(self._got)]
        until = np.minimum((slots + 1) * PAYLOAD_BYTES, end)
        lost = np.maximum(lost, start)
        whole = np.ones(self.frame_bytes // self.chirp_bytes, np.bool_)
        for first, last in zip(lost[lost < until] - start, until[lost < until] - start, strict=True):
            whole[first // self.chirp_bytes : (last - 1) // self.chirp_bytes + 1] = False
        return whole


def batch_of(packets: list[bytes], stamps: list[int] | None = None) -> Batch:
    """Packets as a batch: of a file, of a test.

    Args:
        packets: datagrams.
        stamps: their arrivals; None: 0.
    """
    rows = np.zeros((len(packets), DATA_HEADER_BYTES + PAYLOAD_BYTES), np.uint8)
    for row, packet in zip(rows, packets, strict=True):
        kept = packet[: len(row)]
        row[: len(kept)] = np.frombuffer(kept, np.uint8)
    sizes = np.array([len(packet) for packet in packets], np.int32)
    times = np.array(stamps or [0] * len(packets), np.int64)
    return Batch(rows, sizes, np.zeros(len(packets), np.uint32), times, len(packets))
