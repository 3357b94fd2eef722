# SPDX-License-Identifier: Apache-2.0
"""Kernels of the capture card's packets: control messages of the socket, and samples into the frames they belong to.

Positions count sample bytes of a recording from 0. Slot s is the payload of packet number s + 1: bytes
[1456 s, 1456 (s + 1)); frame f is bytes [F f, F (f + 1)).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import int32, int64, njit, types, uint8, uint16, uint32

from edge.kernels_arrays import Int32, Int64, UInt8, UInt16, UInt32

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "boundscheck": False, "cache": True}
P = 1456
"""Payload of a full packet, bytes."""
H = 10
"""Its header, bytes."""
SOL_SOCKET, SO_TIMESTAMPNS, SO_RXQ_OVFL = 1, 35, 40
"""Linux, asm-generic."""

BASE, HIGHEST, BEGUN, OUTSIDE_IN_A_ROW, TOP_SLOT, FIRST_NS = 0, 1, 2, 3, 4, 5
"""State: oldest open frame; end of the furthest byte; a packet came; foreign positions in a row; last slot with an
entry in ``got``; arrival of the recording's first packet."""
STATE_SIZE = 6
PACKETS, BYTES, PLACED, DUPLICATE, DUPLICATE_BYTES, LATE, LATE_BYTES = 0, 1, 2, 3, 4, 5, 6
GARBAGE, GARBAGE_BYTES, FOREIGN, FOREIGN_BYTES, OUTSIDE, OUTSIDE_BYTES, REORDERED, HEADERS = 7, 8, 9, 10, 11, 12, 13, 14
COUNTERS = 15
"""Counters: packets and their bytes, sample bytes placed, packets and bytes by what became of them, header bytes."""


@njit(inline="always", **OPTIONS)
def _little(row: UInt8, place: int, size: int) -> int:
    """Little-endian unsigned integer of up to 8 bytes."""
    value = int64(0)
    for k in range(size):
        value |= int64(row[place + k]) << (8 * k)
    return value  # type: ignore[return-value]


@njit(
    types.void(uint8[:, ::1], int64[::1], int64, int64, int64[::1], int64[::1]),
    **OPTIONS,
)
def read_control(control: UInt8, lengths: Int64, count: int, shift_ns: int, stamps: Int64, drops: Int64) -> None:
    """Arrival times and the kernel's count of dropped packets, from the control messages of a batch.

    Args:
        control: uint8 [batch, bytes]: struct cmsghdr {u64 length, i32 level, i32 type} and data, each at 8 k.
        lengths: int64 [batch], bytes in use.
        count: packets of the batch.
        shift_ns: CLOCK_MONOTONIC minus CLOCK_REALTIME.
        stamps: int64 [batch], becomes the arrival on CLOCK_MONOTONIC; unchanged where the kernel gave none.
        drops: int64 [1], becomes the highest count, modulo 2^32 as the kernel counts.
    """
    for n in range(count):
        place = 0
        while place + 16 <= lengths[n]:
            length = _little(control[n], place, 8)
            if length < 16 or place + length > lengths[n]:
                break
            level, kind = _little(control[n], place + 8, 4), _little(control[n], place + 12, 4)
            if level == SOL_SOCKET and kind == SO_TIMESTAMPNS and length >= 32:
                seconds, nanoseconds = _little(control[n], place + 16, 8), _little(control[n], place + 24, 8)
                stamps[n] = seconds * 1_000_000_000 + nanoseconds + shift_ns
            elif level == SOL_SOCKET and kind == SO_RXQ_OVFL and length >= 20:
                drops[0] = _little(control[n], place + 16, 4)
            place += (length + 7) // 8 * 8


@njit(inline="always", **OPTIONS)
def _count(counters: Int64, what: int, size: int) -> None:
    """One more packet, and its bytes in the counter behind."""
    counters[what] += 1
    counters[what + 1] += size


@njit(inline="always", **OPTIONS)
def _position(packet: UInt8, payload: int) -> tuple[int, int]:
    """First byte in the recording and slot of a packet; slot -1: header and length contradict each other."""
    begin, slot = int64(0), int64(-1)
    if 0 < payload <= P:
        begin = _little(packet, 4, 6)
        if begin % P == 0 and (begin // P + 1) & 0xFFFFFFFF == _little(packet, 0, 4):
            slot = begin // P
    return begin, slot  # type: ignore[return-value]


@njit(inline="always", **OPTIONS)
def _without_late(counters: Int64, fresh: int, end: int, floor: int) -> int:
    """First of the bytes [fresh, end) that a frame from byte ``floor`` on still waits for; those before are counted."""
    if fresh < floor:
        late = min(floor, end) - fresh
        _count(counters, LATE, late)
        fresh += late
    return fresh


@njit(inline="always", **OPTIONS)
def _copy(
    packets: UInt8, n: int, begin: int, fresh: int, end: int, stamp: int, ring: UInt8, received: Int64, arrival: Int64
) -> None:
    """Copy bytes [fresh, end) of packet ``n``, which begins at byte ``begin``, to the frames that they belong to."""
    frames, size = ring.shape
    while fresh < end:
        frame = fresh // size
        row, inside = frame % frames, fresh - frame * size
        stop = min(end, (frame + 1) * size)
        ring[row, inside : inside + stop - fresh] = packets[n, H + fresh - begin : H + stop - begin]
        received[row] += stop - fresh
        if inside == 0:
            arrival[row] = stamp
        fresh = stop


@njit(
    int64(
        *(uint8[:, ::1], int32[::1], uint32[::1], int64[::1], int64, int64, uint32, int64, int64),
        *(int64[::1], int64[::1], uint8[:, ::1], uint16[::1], int64[::1], int64[::1]),
    ),
    **OPTIONS,
)
def place(packets: UInt8, sizes: Int32, senders: UInt32, stamps: Int64, first: int, count: int, sender: np.uint32,
          reorder: int, start_slots: int, state: Int64, counters: Int64, ring: UInt8, got: UInt16, received: Int64,
          arrival: Int64) -> int:  # fmt: skip
    """Copy packets of a batch to their frames, until the oldest open frame must be closed or the batch ends.

    Args:
        packets, sizes: uint8 [batch, bytes], int32 [batch].
        senders, sender: uint32 [batch], IPv4 addresses as in memory; the card's, 0: any.
        stamps: int64 [batch], arrivals.
        first, count: packets [first, count) are taken.
        reorder: bytes by which a later packet may overtake one of the oldest frame.
        start_slots: the first packet of a recording must be one of so many.
        state, counters: int64, see above.
        ring: uint8 [frames, frame bytes], frame f in row f % frames, zero where nothing came.
        got: uint16 [slots], bytes that came of slot s, at s % slots.
        received, arrival: int64 [frames]: bytes that came, arrival of the packet with the first byte (0: not yet).
    Returns:
        Packets [0, returned) are done. Less than ``count``: close the oldest frame and call again.
    """
    frames, size = ring.shape
    slots = len(got)
    for n in range(first, count):
        if state[BASE] * size + size + reorder <= state[HIGHEST] or received[state[BASE] % frames] == size:
            return n
        length = int64(sizes[n])
        if sender != 0 and senders[n] != sender:
            _count(counters, PACKETS, length)
            _count(counters, FOREIGN, length)
            continue
        payload = length - H
        begin, slot = _position(packets[n], payload)
        end = begin + payload
        if slot >= 0 and end > (state[BASE] + frames) * size and (state[BEGUN] or slot < start_slots):
            return n
        _count(counters, PACKETS, length)
        if slot < 0:
            _count(counters, GARBAGE, length)
            continue
        counters[HEADERS] += H
        if (slot >= start_slots and not state[BEGUN]) or slot <= state[TOP_SLOT] - slots:
            _count(counters, OUTSIDE, payload)
            state[OUTSIDE_IN_A_ROW] += 1
            continue
        if not state[BEGUN]:
            state[BEGUN], state[FIRST_NS] = 1, stamps[n]
        state[OUTSIDE_IN_A_ROW] = 0
        twice = min(int64(got[slot % slots]), payload)
        counters[DUPLICATE_BYTES] += twice
        counters[DUPLICATE] += twice == payload
        fresh = begin + twice
        if fresh == end:
            continue
        got[slot % slots] = uint16(payload)
        fresh = _without_late(counters, fresh, end, state[BASE] * size)
        counters[REORDERED] += fresh < end and end < state[HIGHEST]
        state[HIGHEST] = max(state[HIGHEST], end)
        counters[PLACED] += end - fresh
        _copy(packets, n, begin, fresh, end, stamps[n], ring, received, arrival)
    return count
