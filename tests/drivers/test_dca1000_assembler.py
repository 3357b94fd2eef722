# SPDX-License-Identifier: Apache-2.0
"""Frames from packets: the real frame, and any loss, order, repetition and cut: each byte in its place, all counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dca1000_wire import PAYLOAD, packets_of, pcap_payloads
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.drivers.dca1000.assembler import START_PACKETS, Assembled, FrameAssembler, batch_of
from edge.errors import ConfigError
from edge.frames import Layout


def stream_of(frames: int, size: int, seed: int = 0) -> bytes:
    """Sample bytes, none of them zero."""
    return np.random.default_rng(seed).integers(1, 256, frames * size, dtype=np.uint8).tobytes()


def check(assembler: FrameAssembler, closed: list[Assembled], stream: bytes) -> None:
    """All that must hold whatever came: places, masks, order, counts."""
    size, chirp = assembler.frame_bytes, assembler.chirp_bytes
    expected, placed = 0, 0
    for item in closed:
        assert item.index == expected, "in order, without holes"
        expected += item.count
        if item.data is None:
            assert item.missing_bytes == size
            continue
        assert item.count == 1
        truth = np.frombuffer(stream[item.index * size : (item.index + 1) * size].ljust(size, b"\0"), np.uint8)
        came = item.data != 0
        assert np.array_equal(item.data[came], truth[came])
        assert item.missing_bytes == size - came.sum()
        placed += int(came.sum())
        whole = came.reshape(-1, chirp).all(axis=1)
        assert np.array_equal(whole, np.ones_like(whole) if item.whole_chirps is None else item.whole_chirps)
    account = assembler.account()
    account.check()
    assert account.placed_bytes == placed + assembler.waiting_bytes
    assert account.frames == expected
    assert account.missing_bytes == sum(item.missing_bytes * item.count for item in closed)


def test_the_real_frame(radar_data: Path) -> None:
    """16 chirps of 256 complex samples, Q before I, with the samples that the recording's own tests state."""
    packets = [p for p in pcap_payloads(radar_data / "dca1000_pcap" / "test_one_frame.pcap") if len(p) > 8]
    assembler = FrameAssembler(16_384, 1024)
    (frame,) = assembler.feed(batch_of(packets, list(range(100, 112))))
    assert frame.data is not None
    assert (frame.missing_bytes, frame.whole_chirps, frame.arrival_ns, frame.index) == (0, None, 100, 0)
    layout = Layout("dca1000", 1, 16, 1, 256, 1, "QI")
    adc = frame.data.view(np.int16).reshape(layout.shape)
    samples = (adc[..., 2:] + 1j * adc[..., :2]).reshape(-1)
    stated = {4065: 223 + 120j, 3293: -90 - 615j, 415: -88 + 193j, 1255: 366 - 21j, 671: -55 + 205j, 1262: 582 + 30j}
    stated |= {1736: -127 - 238j, 3474: 268 - 48j, 2394: 745 - 301j}
    assert {k: samples[k] for k in stated} == stated
    assert assembler.account().packets == 12


@pytest.mark.parametrize("size", [16_384, 139_776, 10 * PAYLOAD + 48, 1000, 1456, 96])
def test_frames_across_packet_borders(size: int) -> None:
    stream = stream_of(7, size)
    assembler = FrameAssembler(size, size // 8)
    packets = packets_of(stream)
    closed = [item for k in range(0, len(packets), 5) for item in assembler.feed(batch_of(packets[k : k + 5]))]
    assert b"".join(item.data.tobytes() for item in closed if item.data is not None) == stream
    check(assembler, closed, stream)
    assert not assembler.open


@st.composite
def deliveries(draw: st.DrawFn) -> tuple[int, int, list[int], dict[int, int], list[int], int]:
    size = draw(st.sampled_from([96, 1000, 1456, 4368, 16_384, 14_608]))
    frames = draw(st.integers(1, 12))
    count = -(-size * frames // PAYLOAD)
    keys = draw(st.lists(st.integers(0, 40), min_size=count, max_size=count))
    order = sorted(range(count), key=lambda k: k + keys[k])  # each at most 40 places away
    fate = draw(st.lists(st.sampled_from("ooooooooolldg"), min_size=count, max_size=count))
    order = [k for k in order for _ in range({"l": 0, "d": 2}.get(fate[k], 1))]
    cuts = draw(st.dictionaries(st.integers(0, count - 1), st.integers(1, PAYLOAD), max_size=3))
    garbage = [n for n, k in enumerate(order) if fate[k] == "g"]
    return size, frames, order, cuts, garbage, draw(st.integers(1, 50))


@settings(max_examples=80, deadline=None)
@given(deliveries())
def test_any_delivery(delivery: tuple[int, int, list[int], dict[int, int], list[int], int]) -> None:
    size, frames, order, cuts, garbage, per_batch = delivery
    stream = stream_of(frames, size)
    packets = packets_of(stream)
    sent = [packets[k][: 10 + cuts.get(k, PAYLOAD)] for k in order]
    for n in reversed(garbage):
        sent.insert(n, b"\1" * (n % 1500))
    assembler = FrameAssembler(size, size // 8)
    closed: list[Assembled] = []
    for k in range(0, len(sent), per_batch):
        closed += assembler.feed(batch_of(sent[k : k + per_batch]))
    closed += assembler.flush()
    assert not assembler.open
    assert assembler.waiting_bytes == 0
    check(assembler, closed, stream)
    account = assembler.account()
    assert account.bytes == sum(map(len, sent))
    assert account.packets == len(sent)
    assert account.garbage_packets == len(garbage)
    whole_order = order == list(range(len(packets))) and not cuts
    if whole_order:
        assert account.frames_whole == frames


def test_a_lost_packet_spoils_its_chirps_only() -> None:
    size, chirp = 8 * 2912, 2912
    stream = stream_of(3, size)
    packets = packets_of(stream)
    del packets[5]  # second half of chirp 2 of frame 0
    assembler = FrameAssembler(size, chirp, reorder_packets=8)
    closed = assembler.feed(batch_of(packets))
    assert [item.missing_bytes for item in closed] == [PAYLOAD, 0, 0]
    assert closed[0].whole_chirps is not None
    assert np.flatnonzero(~closed[0].whole_chirps).tolist() == [2]
    check(assembler, closed, stream)


def test_window_of_reordering() -> None:
    """A packet may be overtaken by so many bytes behind its frame, and comes too late after that."""
    size = 4 * PAYLOAD
    stream = stream_of(6, size)
    packets = packets_of(stream)
    for overtaken, frames_whole, late_bytes in ((8, 6, 0), (9, 5, PAYLOAD)):
        assembler = FrameAssembler(size, PAYLOAD, reorder_packets=6)
        moved = packets[1 : overtaken + 1] + packets[:1] + packets[overtaken + 1 :]
        closed = assembler.feed(batch_of(moved))
        check(assembler, closed, stream)
        account = assembler.account()
        assert (account.frames_whole, account.late_bytes) == (frames_whole, late_bytes)
        assert (account.reordered_packets, account.late_packets) == ((1, 0) if frames_whole == 6 else (0, 1))


def test_duplicates_of_closed_frames_are_known() -> None:
    size = 4 * PAYLOAD
    packets = packets_of(stream_of(4, size))
    assembler = FrameAssembler(size, PAYLOAD)
    assembler.feed(batch_of([*packets, *packets, *packets]))
    account = assembler.account()
    assert (account.duplicate_packets, account.duplicate_bytes) == (32, 32 * PAYLOAD)
    assert (account.frames, account.late_packets) == (4, 0)


def test_long_gap_is_one_loss() -> None:
    size = 3 * PAYLOAD
    before, after = packets_of(stream_of(2, size)), packets_of(stream_of(2, size, 1), start=3 * 1_000_000)
    assembler = FrameAssembler(size, PAYLOAD)
    closed = assembler.feed(batch_of(before + after)) + assembler.flush()
    assert [(item.index, item.count) for item in closed if item.data is not None] == [
        *((0, 1), (1, 1), (1_000_000, 1), (1_000_001, 1))
    ]
    assert sum(item.count for item in closed if item.data is None) == 999_998
    assert len(closed) < 100
    assert assembler.account().frames_missing == 999_998


def test_byte_count_beyond_32_bits() -> None:
    """Sequence numbers start again after 2^32 packets, the byte count has 48 bits."""
    size = 2 * PAYLOAD
    assembler = FrameAssembler(size, PAYLOAD)
    assembler.feed(batch_of(packets_of(stream_of(1, size))))
    for start in (2**22, 2**32 - 2, 2**36):
        stream = stream_of(3, size, start)
        closed = assembler.feed(batch_of(packets_of(stream, start=start))) + assembler.flush()
        data = b"".join(item.data.tobytes() for item in closed if item.data is not None)
        assert data == stream
    assert assembler.account().garbage_packets == 0


def test_contradicting_headers_are_garbage() -> None:
    packets = packets_of(stream_of(1, 4 * PAYLOAD))
    for place, bit in ((0, 1), (3, 0x80), (4, 1), (9, 1)):
        bad = bytearray(packets[1])
        bad[place] ^= bit
        assembler = FrameAssembler(4 * PAYLOAD, PAYLOAD)
        assert assembler.feed(batch_of([packets[0], bytes(bad), *packets[2:]])) == []
        assert assembler.account().garbage_packets == 1
        (frame,) = assembler.feed(batch_of(packets[1:2]))
        assert frame.missing_bytes == 0


def test_foreign_sender() -> None:
    batch = batch_of(packets_of(stream_of(1, PAYLOAD)))
    assembler = FrameAssembler(PAYLOAD, PAYLOAD, sender=7)
    batch.senders[:] = 8
    assert assembler.feed(batch) == []
    batch.senders[:] = 7
    assert len(assembler.feed(batch)) == 1
    account = assembler.account()
    account.check()
    assert (account.foreign_packets, account.foreign_bytes) == (1, PAYLOAD + 10)


def test_packets_of_another_recording() -> None:
    """What is left of the recording before does not open frames a thousand numbers ahead."""
    size = 2 * PAYLOAD
    assembler = FrameAssembler(size, PAYLOAD)
    old = packets_of(stream_of(2, size), start=START_PACKETS)
    assert assembler.feed(batch_of(old)) == []
    assert assembler.outside_in_a_row == 4
    stream = stream_of(3, size)
    closed = assembler.feed(batch_of(packets_of(stream)))
    assert assembler.outside_in_a_row == 0
    check(assembler, closed, stream)
    assert assembler.account().outside_packets == 4


def test_begin_counts_anew() -> None:
    size = 4 * PAYLOAD
    stream = stream_of(2, size)
    packets = packets_of(stream)
    assembler = FrameAssembler(size, PAYLOAD)
    assembler.begin()
    assert assembler.first_arrival_ns == 0
    closed = assembler.feed(batch_of(packets[:6], [11, 12, 13, 14, 15, 16]))
    assert (assembler.first_arrival_ns, closed[0].arrival_ns) == (11, 11)
    (rest,) = assembler.begin()
    assert (rest.recording, rest.index, rest.missing_bytes, rest.arrival_ns) == (1, 1, 2 * PAYLOAD, 15)
    again = assembler.feed(batch_of(packets, list(range(20, 28))))
    assert [(item.recording, item.index, item.arrival_ns) for item in again] == [(2, 0, 20), (2, 1, 24)]
    assert assembler.account().duplicate_packets == 0


@pytest.mark.parametrize("sizes", [(0, 1, 0), (10, 3, 0), (10, 0, 0), (10, 5, -1)])
def test_bad_sizes(sizes: tuple[int, int, int]) -> None:
    with pytest.raises(ConfigError):
        FrameAssembler(sizes[0], sizes[1], reorder_packets=sizes[2])
