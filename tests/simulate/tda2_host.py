# SPDX-License-Identifier: Apache-2.0
"""A host for the capture board, written from the hardware notes alone: it shares no code with the emulator."""

from __future__ import annotations

import socket
import struct
import zlib
from dataclasses import dataclass, field

SAFETY_S = 20.0
ACK, NACK, VERSION, HOST_IRQ, SPI_DATA = 0x81, 0x82, 0x83, 0x88, 0x89
READ_REQUEST = bytes.fromhex("78566587") + b"\xff" * 12


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
            crc &= 0xFFFF
    return crc


def packet(opcode: int, device: int, ack_type: int, data: bytes = b"", sync: int = 0xA5C8, ack_code: int = 0) -> bytes:
    head = struct.pack("<HHHBB4x", opcode, ack_code, 12 + len(data), device, ack_type)
    body = struct.pack("<H", sync) + head + data + struct.pack("<H", crc16(head + data))
    return struct.pack("<I", len(body)) + body


def ones_complement(words: tuple[int, ...]) -> int:
    total = sum(words)
    total = (total & 0xFFFF) + (total >> 16)
    return ~((total & 0xFFFF) + (total >> 16)) & 0xFFFF


Blocks = list[tuple[int, bytes]]


def rhcp(
    direction: int, message: int, sequence: int, blocks: Blocks, remaining: int = 0, flags: int = 0x0400
) -> bytes:
    payload = b"".join(struct.pack("<HH", block, 4 + len(data)) + data for block, data in blocks)
    payload += b"\xff" * (-len(payload) % 4)
    words = (direction | message << 6, 16 + len(payload), flags | sequence << 12, remaining, len(blocks))
    body = struct.pack("<6H", *words, ones_complement(words)) + payload
    return bytes.fromhex("34122143") + body + struct.pack("<I", zlib.crc32(body))


@dataclass
class Received:
    """One message of a chip, checked."""

    direction: int
    kind: int
    message: int
    sequence: int
    blocks: list[tuple[int, bytes]]
    raw: bytes

    @property
    def refusal(self) -> tuple[int, int] | None:
        if self.kind == 1 and self.message == 0:
            code, block = struct.unpack("<HH", self.blocks[0][1])
            return code, block
        return None


@dataclass
class Host:
    """One connection to a board."""

    address: tuple[str, int]
    interrupts: dict[int, int] = field(default_factory=dict)
    events: list[tuple[int, int, bytes]] = field(default_factory=list)
    sequence: dict[int, int] = field(default_factory=dict)
    before_sync: bytes = b""
    """What a chip sent before the sync word of its last message."""

    def __post_init__(self) -> None:
        self.socket = socket.create_connection(self.address, timeout=SAFETY_S)

    def __enter__(self) -> Host:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.socket.recv(count - len(data))
            if not part:
                raise ConnectionError("the board closed the connection")
            data += part
        return data

    def receive(self) -> bytes:
        """Next packet with its length; checked."""
        length = self._exactly(4)
        body = self._exactly(int.from_bytes(length, "little"))
        sync, _opcode, _code, counted = struct.unpack_from("<4H", body)
        assert sync == 0x8C5A
        assert counted == len(body) - 4
        assert int.from_bytes(body[-2:], "little") == crc16(body[2:-2])
        return length + body

    def answer(self) -> tuple[int, int, int, bytes]:
        """Next packet that is no interrupt: opcode, ackCode, device, data. Interrupts are counted."""
        while True:
            body = self.receive()[4:]
            opcode, code = struct.unpack_from("<2H", body, 2)
            device = body[8]
            if opcode != HOST_IRQ:
                return opcode, code, device, body[14:-2]
            self.interrupts[device] = self.interrupts.get(device, 0) + 1

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def order(self, opcode: int, device: int = 32, data: bytes = b"", ack_type: int = 1) -> int:
        """Send, and the opcode of the answer."""
        self.send(packet(opcode, device, ack_type, data))
        answer, code, from_device, _ = self.answer()
        assert (code, from_device) == (opcode, device)
        return answer

    def wait_interrupt(self, device: int) -> None:
        while not self.interrupts.get(device):
            body = self.receive()[4:]
            opcode = int.from_bytes(body[2:4], "little")
            assert opcode == HOST_IRQ, f"answer 0x{opcode:02x} that nobody asked for"
            self.interrupts[body[8]] = self.interrupts.get(body[8], 0) + 1
        self.interrupts[device] -= 1

    def spi_read(self, device: int, count: int) -> bytes:
        self.send(packet(0x24, device, 1, struct.pack("<H", count)))
        opcode, code, from_device, data = self.answer()
        assert (opcode, code, from_device) == (SPI_DATA, 0x24, device)
        return data

    def read(self, device: int) -> Received:
        """One message of a chip: interrupt, CNYS, sync, header, payload, CRC."""
        self.wait_interrupt(device)
        assert self.order(0x23, device, READ_REQUEST) == ACK
        self.before_sync = self.spi_read(device, 4)
        while not self.before_sync.endswith(bytes.fromhex("badccdab")):
            self.before_sync += self.spi_read(device, 1)
        self.before_sync = self.before_sync[:-4]
        header = self.spi_read(device, 12)
        opcode, length, flags, _, count, check = struct.unpack("<6H", header)
        assert check == ones_complement(struct.unpack("<5H", header[:10]))
        assert flags & 0x0F00 in (0, 0x0400), "CRC-16 or CRC-32"
        size = 4 if flags & 0x0400 else 2
        payload = self.spi_read(device, length - 12 - size) if length > 12 + size else b""
        crc = self.spi_read(device, size)
        assert int.from_bytes(crc, "little") == (zlib.crc32 if size == 4 else crc16)(header + payload)
        blocks, rest = [], payload
        for _ in range(count):
            block, size = struct.unpack_from("<HH", rest)
            blocks.append((block, rest[4:size]))
            rest = rest[size:]
        return Received(opcode & 15, opcode >> 4 & 3, opcode >> 6, flags >> 12, blocks, header + payload + crc)

    def read_answer(self, device: int) -> Received:
        """Next message that is no event; events go to ``events``."""
        while True:
            got = self.read(device)
            if got.kind != 3:
                return got
            self.events += [(device, block, data) for block, data in got.blocks]

    def event(self, device: int, block: int) -> bytes:
        """Data of the event with this sub-block, kept or read now."""
        while True:
            for index, (from_device, got, data) in enumerate(self.events):
                if (from_device, got) == (device, block):
                    del self.events[index]
                    return data
            message = self.read(device)
            assert message.kind == 3, f"{message} instead of event 0x{block:04x}"
            self.events += [(device, got, data) for got, data in message.blocks]

    def spi(self, device: int, message: bytes) -> None:
        assert self.order(0x23, device, message, 0x10) == ACK

    def command(
        self, device: int, direction: int, message: int, block: int, data: bytes = b"", remaining: int = 0
    ) -> Received:
        """Send with the device's next sequence number; the answer."""
        sequence = self.sequence.get(device, 0)
        self.sequence[device] = (sequence + 1) % 16
        self.spi(device, rhcp(direction, message, sequence, [(block, data)], remaining))
        return self.read_answer(device)

    def good(
        self, device: int, direction: int, message: int, block: int, data: bytes = b"", remaining: int = 0
    ) -> Received:
        """``command``, accepted."""
        got = self.command(device, direction, message, block, data, remaining)
        assert got.refusal is None, f"0x{block:04x} refused: {got.refusal}"
        assert (got.kind, got.message, got.direction) == (1, message, direction + 1)
        assert got.sequence == (self.sequence[device] - 1) % 16
        return got


MASKS = ((8, 4), (8, 2), (8, 1), (4, 4), (4, 2), (4, 1), (2, 4), (2, 2), (2, 1), (1, 4), (1, 2), (1, 1))
"""Chirp -> (device, transmitter mask): chirp i fires TX 12 - i."""
PROFILE_A = bytes.fromhex(
    "00000200e4388e55f401000058020000a00f00000000000000000000650600000001401f0000000030000000"
)


def small_profile(samples: int) -> bytes:
    """Profile A with fewer samples."""
    return PROFILE_A[:32] + struct.pack("<H", samples) + PROFILE_A[34:]


def frame(loops: int, samples: int, trigger: int, frames: int, period_5ns: int = 3_333_333) -> bytes:
    return struct.pack("<6HI2HI", 0, 0, 11, loops, frames, 2 * samples, period_5ns, trigger, 0, 0)


def connect(host: Host) -> None:
    """1.3 of the notes."""
    assert host.order(0x12, ack_type=0x10) == ACK
    assert host.order(0x16, data=b"Trace_TDA_[1].txt") == ACK
    assert host.order(0x13) == VERSION
    assert host.order(0x1A, data=struct.pack("<4BI", 1, 1, 1, 1, 4), ack_type=0x10) == ACK
    assert host.order(0x10, 1) == ACK


def boot(host: Host, device: int) -> None:
    """Steps 1 and 2: SOP, reset, firmware in 35 chunks."""
    assert host.order(0x21, device, struct.pack("<I", 4)) == ACK
    assert host.order(0x20, device) == ACK
    host.event(device, 0x5000)
    host.sequence[device] = 0
    load_firmware(host, device)


def load_firmware(host: Host, device: int) -> None:
    image = struct.pack("<II", 0, 7936) + b"MSTR" + bytes(7932)
    for index in range(35):
        host.good(device, 5, 0x204, 0x4080, image[232 * index : 232 * (index + 1)], 34 - index)
    assert host.event(device, 0x5005) == bytes(24), "boot status: no fault"


def configure(host: Host, device: int, loops: int, samples: int, frames: int, profile: bytes | None = None) -> None:
    """Steps 3 to 23 for one chip."""
    host.good(device, 5, 0x202, 0x404C, bytes.fromhex("010000000000000000000000"))
    host.good(device, 5, 0x200, 0x4000)
    host.event(device, 0x5001)
    host.good(device, 5, 0x207, 0x40E0)
    host.good(device, 1, 0x11, 0x0220)
    host.good(device, 1, 0x11, 0x0223)
    cascade = 1 if device == 1 else 2
    host.good(device, 1, 0x04, 0x0080, struct.pack("<4H", 15, 7, cascade, 0))
    for direction, message, block, data in (
        (1, 0x04, 0x0082, "0200010000000000"),
        (1, 0x04, 0x0086, "050000000000000001000000"),
        (1, 0x16, 0x02CC, "03000000"),
        (5, 0x202, 0x4041, "0f0002000100000000000000"),
        (1, 0x04, 0x0083, "00000000"),
        (1, 0x04, 0x008D, "03082609000000000000000000000000"),
        (1, 0x04, 0x0087, "0100000000000000"),
        (1, 0x04, 0x0089, "f01f00000000000000000000"),
        (1, 0x06, 0x00C0, ""),
        (5, 0x202, 0x4042, "0001000000000000"),
        (5, 0x202, 0x4044, "01010000"),
        (1, 0x04, 0x0085, "09000000"),
        (5, 0x202, 0x4047, "2154030000000000"),
    ):
        host.good(device, direction, message, block, bytes.fromhex(data))
    host.event(device, 0x1004)
    host.good(device, 1, 0x08, 0x0100, profile or small_profile(samples))
    for chirp, (owner, mask) in enumerate(MASKS):
        data = struct.pack("<4HI4H", chirp, chirp, 0, 0, 0, 0, 0, 0, mask if owner == device else 0)
        host.good(device, 1, 0x08, 0x0101, data)
    host.good(device, 1, 0x08, 0x0102, frame(loops, samples, 1 if device == 1 else 2, frames))
    host.good(device, 5, 0x206, 0x40C0, struct.pack("<IHH", 12 * loops, 2 * samples, 0))


def arm(host: Host, loops: int, samples: int, session: str, frames: int) -> None:
    """1.6 of the notes up to the record start."""
    for device in (1, 2, 4, 8):
        assert host.order(0x14, device, struct.pack("<II", 8 * samples, 12 * loops)) == ACK
    assert host.order(0x35, data=struct.pack("<I", 16), ack_type=0x10) == ACK
    assert host.order(0x38, data=f"/mnt/ssd/{session}".encode(), ack_type=0x10) == ACK
    assert host.order(0x36, data=bytes(4), ack_type=0x10) == ACK
    assert host.order(0x37, data=bytes(4), ack_type=0x10) == ACK
    assert host.order(0x39, data=struct.pack("<I", frames), ack_type=0x10) == ACK
    assert host.order(0x18) == ACK
    assert host.order(0x31) == ACK


def trigger(host: Host, device: int, order: int) -> Received:
    return host.command(device, 1, 0x0A, 0x0140, struct.pack("<HH", order, 0))
