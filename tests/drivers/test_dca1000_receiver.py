# SPDX-License-Identifier: Apache-2.0
"""The receiving thread on real sockets: arrival times, the kernel's drops, full queues, silence, strangers."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dca1000_wire import PAYLOAD, packets_of, pcap_payloads

from edge.drivers.dca1000.assembler import Assembled, FrameAssembler
from edge.drivers.dca1000.receiver import BATCH, CardReceiver, PacketSocket
from edge.errors import LinkError

SAFETY_S = 30.0
SIZE = 8 * PAYLOAD


class Wire:
    """A sender and a receiver of frames."""

    def __init__(self, size: int = SIZE, start: bool = True, **options: Any) -> None:
        self.packets = PacketSocket("127.0.0.1", 0, options.pop("buffer_bytes", 1 << 21))
        self.assembler = FrameAssembler(size, size // 8, options.pop("sender", 0))
        self.receiver = CardReceiver(self.packets, self.assembler, "test", **options)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(self.packets.address)
        if start:
            self.receiver.start()

    def send(self, packets: list[bytes]) -> None:
        for packet in packets:
            self.socket.send(packet)

    def take(self, count: int) -> list[Assembled]:
        found: list[Assembled] = []
        while sum(item.count for item in found) < count:
            item = self.receiver.get(SAFETY_S)
            assert item is not None
            found.append(item)
        return found

    def close(self) -> None:
        self.receiver.close()
        self.socket.close()


@pytest.fixture
def wires() -> Iterator[Any]:
    made: list[Wire] = []

    def make(*arguments: Any, **options: Any) -> Wire:
        made.append(Wire(*arguments, **options))
        return made[-1]

    yield make
    for wire in made:
        wire.close()
    assert not [t for t in threading.enumerate() if t.name.endswith("samples")]


def stream_of(frames: int, size: int = SIZE) -> bytes:
    return np.random.default_rng(frames).integers(1, 256, frames * size, dtype=np.uint8).tobytes()


def test_real_packets_through_a_socket(wires: Any, radar_data: Path) -> None:
    real = pcap_payloads(radar_data / "dca1000_pcap" / "test_one_frame.pcap")
    packets = [p for p in real if len(p) > 8]
    wire = wires(16_384)
    wire.send(packets)
    (frame,) = wire.take(1)
    assert frame.data is not None
    assert frame.data.tobytes() == b"".join(p[10:] for p in packets)


def test_frames_and_arrival_times(wires: Any) -> None:
    stream = stream_of(20)
    wire = wires()
    wire.receiver.begin()
    assert wire.receiver.wait_first(0.0) is None
    before_ns = time.monotonic_ns()
    wire.send(packets_of(stream))
    items = wire.take(20)
    after_ns = time.monotonic_ns()
    assert b"".join(item.data.tobytes() for item in items) == stream
    arrivals = [item.arrival_ns for item in items]
    assert before_ns - 1_000_000 <= arrivals[0]
    assert arrivals == sorted(arrivals)
    assert arrivals[-1] <= after_ns + 1_000_000
    assert wire.receiver.wait_first(SAFETY_S) == arrivals[0]
    counters = wire.receiver.counters()
    counters.account.check()
    assert (counters.account.packets, counters.kernel_drops, counters.overflow_frames) == (160, 0, 0)
    assert wire.receiver.get() is None


def test_the_kernel_says_what_it_dropped(wires: Any) -> None:
    """More than the buffer holds, while nobody reads: kernel drops and missing bytes are the same packets."""
    wire = wires(start=False, buffer_bytes=1 << 16)
    sent = packets_of(stream_of(60))
    wire.send(sent)
    wire.receiver.start()
    items = wire.take(1)
    wire.send(packets_of(stream_of(1), start=len(sent)))
    while items[-1].index < 60:
        items += wire.take(1)
    account = wire.receiver.counters().account
    drops = wire.receiver.counters().kernel_drops
    assert drops > 0
    assert account.packets + drops == len(sent) + 8
    assert sum(item.missing_bytes * item.count for item in items) == drops * PAYLOAD


def test_more_than_a_batch(wires: Any) -> None:
    wire = wires(start=False)
    frames = BATCH // 8 + 10
    stream = stream_of(frames)
    wire.send(packets_of(stream))
    wire.receiver.begin()
    assert wire.receiver.counters().account.packets == 8 * frames, "begin takes what is left in the socket"
    wire.receiver.start()
    assert wire.receiver.get() is not None


def test_slow_reader_loses_the_oldest(wires: Any) -> None:
    """Four frames may wait; losses in a row become one."""
    stream = stream_of(30)
    wire = wires(keep=4)
    wire.send(packets_of(stream))
    wire.assembler_done = lambda: wire.receiver.counters().account.frames_whole == 30
    end_s = time.monotonic() + SAFETY_S
    while not wire.assembler_done() and time.monotonic() < end_s:
        time.sleep(0.002)
    items = wire.take(30)
    assert [(item.index, item.count, item.overflow) for item in items] == [
        *((0, 26, True), (26, 1, False), (27, 1, False), (28, 1, False), (29, 1, False))
    ]
    assert b"".join(item.data.tobytes() for item in items[1:]) == stream[26 * SIZE :]
    assert wire.receiver.counters().overflow_frames == 26


def test_silence_closes_the_open_frame(wires: Any) -> None:
    wire = wires(flush_s=0.01)
    wire.send(packets_of(stream_of(2))[:13])
    items = wire.take(2)
    assert [item.missing_bytes for item in items] == [0, 3 * PAYLOAD]
    wire.send(packets_of(stream_of(2))[13:14])
    end_s = time.monotonic() + SAFETY_S
    while not wire.receiver.counters().account.late_packets and time.monotonic() < end_s:
        time.sleep(0.002)
    assert wire.receiver.counters().account.late_bytes == PAYLOAD


def test_finish_takes_what_is_there(wires: Any) -> None:
    wire = wires(start=False)
    wire.send(packets_of(stream_of(1))[:5])
    wire.receiver.finish()
    (item,) = wire.take(1)
    assert item.missing_bytes == 3 * PAYLOAD
    wire.receiver.start()


def test_odd_packets(wires: Any) -> None:
    """Empty, short, long, foreign: counted, nothing else."""
    sender = int.from_bytes(socket.inet_aton("127.0.0.1"), "little")
    wire = wires(sender=sender)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.9", 0))
        stranger.sendto(packets_of(stream_of(1))[0], wire.packets.address)
        wire.send([b"", b"x", bytes(10), bytes(1467), bytes(9000)])
        wire.send(packets_of(stream_of(1)))
        (frame,) = wire.take(1)
    assert frame.missing_bytes == 0
    account = wire.receiver.counters().account
    account.check()
    assert (account.garbage_packets, account.foreign_packets) == (5, 1)
    assert wire.receiver.counters().text() == "14 packets, 1 from elsewhere, 5 garbage, 1 frames whole"
    assert account.garbage_bytes == 1 + 10 + 1467 + 9000


def test_small_buffer_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    packets = PacketSocket("127.0.0.1", 0, 1 << 18)
    assert packets.notes == []
    assert packets.buffer_bytes >= 1 << 18
    packets.close()
    real = socket.socket.setsockopt

    def refuse(self: socket.socket, level: int, option: int, value: Any) -> None:
        if option == 33:
            raise PermissionError
        real(self, level, option, min(value, 1 << 16) if option == socket.SO_RCVBUF else value)

    monkeypatch.setattr(PacketSocket, "_set", lambda self, option, value: refuse(self._socket, 1, option, value))
    packets = PacketSocket("127.0.0.1", 0, 1 << 18)
    assert "sysctl -w net.core.rmem_max=262144" in packets.notes[0]
    packets.close()


def test_port_is_taken() -> None:
    packets = PacketSocket("127.0.0.1", 0, 1 << 18)
    with pytest.raises(LinkError, match="another program has this port"):
        PacketSocket("127.0.0.1", packets.address[1], 1 << 18)
    packets.close()
    with pytest.raises(LinkError, match="no socket for the card's samples"):
        PacketSocket("no.such", 0, 1 << 18)


def test_broken_socket_is_a_named_error(wires: Any) -> None:
    wire = wires()
    wire.packets._socket.close()
    with pytest.raises(LinkError, match="samples"):
        wire.receiver.get(SAFETY_S)
