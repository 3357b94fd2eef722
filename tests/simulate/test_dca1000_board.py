# SPDX-License-Identifier: Apache-2.0
"""The emulated capture card against the real card's bytes: replies, status, packets, carried bytes, faults."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from train.simulate.dca1000_board import Dca1000Board, Dca1000Settings
from train.simulate.faults import Faults

SAFETY_S = 20.0
PERIOD_S = 1 / 60
DELAY_25_US, DELAY_5_US = bytes.fromhex("be05350c0000"), bytes.fromhex("be0571020000")
TWO_LANES = bytes.fromhex("01020102031e")


class Peer:
    """A host's two sockets."""

    def __init__(self) -> None:
        self.command = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.command.bind(("127.0.0.1", 0))
        self.command.settimeout(SAFETY_S)
        self.data = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.data.bind(("127.0.0.1", 0))
        self.data.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
        self.data.settimeout(SAFETY_S)
        self.address: tuple[str, int] = ("", 0)

    def close(self) -> None:
        self.command.close()
        self.data.close()

    def send(self, code: int, data: bytes = b"") -> None:
        packet = struct.pack("<3H", 0xA55A, code, len(data)) + data + struct.pack("<H", 0xEEAA)
        self.command.sendto(packet, self.address)

    def ask(self, code: int, data: bytes = b"") -> bytes:
        self.send(code, data)
        return self.command.recv(64)

    def status(self) -> int:
        packet = self.command.recv(64)
        header, code, bits, footer = struct.unpack("<4H", packet)
        assert (header, code, footer) == (0xA55A, 0x0A, 0xEEAA)
        return int(bits)

    def packet(self) -> tuple[int, int, bytes]:
        """Sequence number, byte count, payload."""
        packet = self.data.recv(4096)
        return struct.unpack_from("<I", packet)[0], int.from_bytes(packet[4:10], "little"), packet[10:]

    def silent(self, which: socket.socket) -> bool:
        which.settimeout(0.05)
        try:
            which.recv(4096)
        except TimeoutError:
            return True
        finally:
            which.settimeout(SAFETY_S)
        return False

    def arm(self) -> None:
        """In the notes' order up to the record start."""
        for code, data in ((6, b""), (2, b""), (9, b""), (0x0E, b""), (0x0B, DELAY_5_US), (3, TWO_LANES)):
            self.ask(code, data)
        for _ in range(30):
            self.command.settimeout(0.1)
            try:
                if self.ask(9):
                    break
            except TimeoutError:
                continue
        self.command.settimeout(SAFETY_S)
        assert self.ask(5) == reply(5)


def reply(code: int, status: int = 0) -> bytes:
    return struct.pack("<4H", 0xA55A, code, status, 0xEEAA)


Make = Callable[..., tuple[Dca1000Board, Peer]]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[tuple[Dca1000Board, Peer]] = []

    def make_card(faults: Faults | None = None, **settings: Any) -> tuple[Dca1000Board, Peer]:
        peer = Peer()
        chosen = {"data_target": peer.data.getsockname(), "pace": 0.0, "deaf_s": 0.0, "flush_s": 60.0, **settings}
        card = Dca1000Board("horizontal", Dca1000Settings(**chosen), faults).start()
        peer.address = card.address
        made.append((card, peer))
        return card, peer

    yield make_card
    for card, peer in made:
        peer.close()
        assert card.stop(), "threads that do not end"


def pcap_payloads(path: Path) -> list[bytes]:
    """UDP payloads of a capture of Ethernet frames."""
    content, place, found = path.read_bytes(), 24, []
    while place < len(content):
        (length,) = struct.unpack_from("<I", content, place + 8)
        frame = content[place + 16 : place + 16 + length]
        place += 16 + length
        found.append(frame[42 : 34 + struct.unpack_from(">H", frame, 38)[0]])
    return found


def test_real_replies(make: Make, radar_data: Path) -> None:
    """The ten orders whose real replies were captured, in their order."""
    real = pcap_payloads(radar_data / "dca1000_pcap" / "test_cmd.pcap")
    _, peer = make()
    eeprom = bytes((30, 33, 168, 192, 180, 33, 168, 192)) + bytes(6) + struct.pack("<HH", 4096, 4098)
    data = {0x0B: DELAY_25_US, 3: TWO_LANES, 4: eeprom}
    codes = [struct.unpack_from("<H", packet, 2)[0] for packet in real]
    assert codes == [1, 2, 5, 6, 0x0B, 3, 4, 9, 0x0A, 0x0E]
    replies = []
    for code in codes:
        answer = peer.ask(code, data.get(code, b""))
        if code == 6:
            assert peer.status() == 1 << 8, "the recording that order 5 began is completed"
        replies.append(answer)
    assert replies == real
    assert replies[-1].hex() == "5aa50e000204aaee", "version 2.8"


def test_real_frame_is_cut_into_the_real_packets(make: Make, radar_data: Path) -> None:
    real = pcap_payloads(radar_data / "dca1000_pcap" / "test_one_frame.pcap")
    packets = [payload for payload in real if len(payload) > 8]
    samples = b"".join(packet[10:] for packet in packets)
    assert len(samples) == 16_384
    card, peer = make(flush_s=0.03)
    peer.arm()
    card.lvds(samples, 0.1)
    got = [peer.data.recv(4096) for _ in packets]
    assert got == packets, "eleven full packets, then the rest after the silence"
    assert peer.command.recv(64) == real[-1] == bytes.fromhex("5aa50a000001aaee")
    assert not card.recording


def test_byte_count_runs_over_frames(make: Make) -> None:
    """48 bytes of each frame wait for the next one, until they fill a packet of their own (as in 196,608 = D)."""
    size = 10 * 1456 + 48
    assert 196_608 % 1456 == 48
    card, peer = make()
    peer.arm()
    stream = np.random.default_rng(0).integers(0, 256, 32 * size, dtype=np.uint8).tobytes()
    received = b""
    for k in range(32):
        card.lvds(stream[k * size : (k + 1) * size], PERIOD_S)
        whole = (k + 1) * size // 1456
        while len(received) < whole * 1456:
            sequence, count, payload = peer.packet()
            assert (sequence, count) == (len(received) // 1456 + 1, len(received))
            received += payload
        assert card.packets == whole == 10 * (k + 1) + (k >= 30)
        assert received == stream[: len(received)]
    assert peer.ask(6) == reply(6)
    assert peer.packet() == (322, 321 * 1456, stream[321 * 1456 :])
    assert peer.status() == 1 << 8
    assert peer.ask(5) == reply(5)
    card.lvds(bytes(1456), PERIOD_S)
    assert peer.packet()[:2] == (1, 0), "a new recording counts anew"
    assert card.violations == []


def test_byte_count_has_48_bits(make: Make) -> None:
    card, peer = make()
    peer.arm()
    with card._lock:
        card.sent_bytes = 2**40 + 5
    card.lvds(bytes(1456), PERIOD_S)
    assert peer.packet()[:2] == (1, 2**40 + 5)


def test_order_of_start_matters(make: Make) -> None:
    card, peer = make()
    card._streaming = lambda: True
    peer.arm()
    card.lvds(b"\1" * 14_560, PERIOD_S)
    peer.ask(6)
    received = b""
    while len(received) % 1456 == 0:
        received += peer.packet()[2]
    assert len(received) == 14_560 - 4852, "the first frame lacks its beginning"
    assert any("not aligned" in text for text in card.violations)


def test_no_lvds_data(make: Make) -> None:
    card, peer = make(no_data_s=0.02)
    peer.arm()
    assert peer.status() == 1
    assert card.recording
    four_lanes = bytes.fromhex("01010102031e")
    peer.ask(3, four_lanes)
    card.lvds(bytes(2912), PERIOD_S)
    assert peer.silent(peer.data)
    assert any("not configured for raw" in text for text in card.violations)


def test_wrong_commands(make: Make) -> None:
    card, peer = make()
    for code, data in (
        (3, bytes.fromhex("03020102031e")),
        (3, bytes.fromhex("01020102041e")),
        (3, b"\1"),
        (0x0B, bytes.fromhex("be0500000000")),
        (0x0B, bytes.fromhex("bf05350c0000")),
        (7, b""),
        (9, b"\0"),
    ):
        assert peer.ask(code, data) == reply(code, 1)
    for packet in (b"", b"\x5a\xa5", b"\x5a\xa5\x09\x00\x01\x00\xaa\xee", b"\x5a\xa4\x09\x00\x00\x00\xaa\xee"):
        peer.command.sendto(packet, card.address)
    peer.command.sendto(bytes.fromhex("5aa509000000aaef"), card.address)
    assert peer.ask(9) == reply(9), "what is malformed is not answered"
    assert peer.ask(5) == reply(5)
    assert peer.ask(5) == reply(5, 1)
    assert card.log == [3, 3, 3, 0x0B, 0x0B, 7, 9, 9, 5, 5]


def test_any_bytes_leave_the_card_alive(make: Make) -> None:
    rng = np.random.default_rng(1)
    card, peer = make()
    for k in range(300):
        data = rng.integers(0, 256, int(rng.integers(0, 30)), dtype=np.uint8).tobytes()
        code = int(rng.integers(0, 16))
        whole = struct.pack("<3H", 0xA55A, code, len(data)) + data + b"\xaa\xee"
        peer.command.sendto(whole if k % 2 else data, card.address)
    peer.command.settimeout(0.05)
    answers = 0
    try:
        while peer.command.recv(64):
            answers += 1
    except TimeoutError:
        peer.command.settimeout(SAFETY_S)
    assert answers >= 100
    assert peer.ask(9) == reply(9)


def test_deaf_after_configuration(make: Make) -> None:
    _, peer = make(deaf_s=0.05)
    assert peer.ask(3, TWO_LANES) == reply(3)
    peer.command.settimeout(0.01)
    answers = 0
    for _ in range(30):
        try:
            peer.ask(9)
        except TimeoutError:
            answers += 1
            continue
        break
    assert answers >= 1


def test_delay_too_long_for_the_rate(make: Make) -> None:
    card, peer = make()
    peer.arm()
    peer.ask(0x0B, DELAY_25_US)
    card.lvds(bytes(1456), 30e-6)
    assert peer.status() == 1 << 9
    assert card.packet_delay_s == pytest.approx(25e-6)


def test_paced_packets_take_their_time_and_lose_nothing(make: Make) -> None:
    card, peer = make(pace=1.0)
    peer.arm()
    card.lvds(bytes(1456 * 48), 1.0)
    assert [peer.packet()[0] for _ in range(48)] == list(range(1, 49))


def test_reset_and_unplug(make: Make) -> None:
    resets: list[int] = []
    card, peer = make()
    card._reset_radar = lambda: resets.append(1)
    peer.arm()
    assert len(resets) == 1
    assert peer.ask(1) == reply(1)
    assert (card.configuration, card.recording) == (None, False)
    peer.arm()
    card.unplug()
    peer.send(9)
    card.lvds(bytes(2912), PERIOD_S)
    assert peer.silent(peer.command)
    assert peer.silent(peer.data)
    card.plug()
    assert peer.ask(9) == reply(9)
    assert card.configuration is None


@pytest.mark.parametrize("kind", ["drop", "duplicate", "reorder", "garble", "truncate"])
def test_data_faults_repeat_with_their_seed(make: Make, kind: str) -> None:
    runs = []
    for _ in range(2):
        faults = Faults(seed=5)
        faults.set(kind, "horizontal/data", share=0.2, value=8 if kind in ("garble", "truncate") else None)
        card, peer = make(faults)
        peer.arm()
        card.lvds(bytes(1456 * 40), PERIOD_S)
        peer.ask(6)
        assert peer.status() == 1 << 8
        time.sleep(0.06)  # what waits to be overtaken is sent
        peer.data.setblocking(False)
        got = []
        try:
            while True:
                got.append(peer.data.recv(4096))
        except BlockingIOError:
            runs.append(got)
    assert runs[0] == runs[1]
    sequence = [struct.unpack_from("<I", packet)[0] for packet in runs[0] if len(packet) >= 4]
    struck = faults.struck
    assert sum(struck.values()) >= 2
    number = sum(struck.values())
    expected = {"drop": 40 - number, "duplicate": 40 + number}.get(kind, 40)
    assert len(runs[0]) == expected
    if kind == "reorder":
        assert sequence != sorted(sequence)
        assert sorted(sequence) == list(range(1, 41))
    if kind == "truncate":
        assert sum(len(packet) == 1458 for packet in runs[0]) == number
    if kind == "garble":
        clean = [struct.pack("<IIH", k + 1, k * 1456, 0) + bytes(1456) for k in range(40)]
        flips = [
            sum(bin(a ^ b).count("1") for a, b in zip(x, y, strict=True)) for x, y in zip(runs[0], clean, strict=True)
        ]
        assert sorted(set(flips)) == [0, 8]
        assert flips.count(8) == number


def test_command_faults(make: Make) -> None:
    faults = Faults()
    card, peer = make(faults)
    faults.set("nack", "*/command", times=1, value=3)
    assert peer.ask(9) == reply(9)
    assert peer.ask(3, TWO_LANES) == reply(3, 1)
    assert card.configuration is None
    faults.set("drop", "*/command", times=1)
    peer.send(9)
    assert peer.silent(peer.command)
    faults.set("duplicate", "*/command", times=1)
    assert peer.ask(9) == peer.command.recv(64) == reply(9)
    faults.set("delay", "*/command", times=1, value=0.02)
    peer.send(9)
    assert peer.ask(0x0E) == reply(0x0E, 0x0402), "the later order is answered first"
    assert peer.command.recv(64) == reply(9)
    faults.set("unplug", "*/command", times=1)
    peer.send(9)
    assert peer.silent(peer.command)
