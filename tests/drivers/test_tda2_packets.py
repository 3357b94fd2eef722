# SPDX-License-Identifier: Apache-2.0
"""Packets of the capture board: published vectors in both directions, pieces of any size, and what is no packet."""

from __future__ import annotations

import struct

import pytest

from edge.drivers.tda2.crc import crc16, ones_complement
from edge.drivers.tda2.packets import (
    BOARD,
    BOARD_SYNC,
    HOST_SYNC,
    LARGEST_DATA,
    MASTER,
    SLAVE1,
    SLAVE2,
    SLAVE3,
    AckType,
    Opcode,
    Packet,
    PacketError,
    PacketReader,
    device_name,
    order_name,
)

NOW, LATER = AckType.RECEIVED, AckType.PROCESSED
SOP = struct.pack("<I", 4)
VECTORS = [
    (Packet(Opcode.PING, BOARD, NOW), "10000000 c8a5120000000c00201000000000a695"),
    (Packet(Opcode.VERSION_GET, BOARD, LATER), "10000000 c8a5130000000c00200100000000d838"),
    (
        Packet(Opcode.DEVICE_MAP, BOARD, NOW, bytes.fromhex("0101010104000000")),
        "18000000 c8a51a00000014002010000000000101010104000000 25b9",
    ),
    (Packet(Opcode.CONNECT, MASTER), "10000000 c8a5100000000c00010100000000ef4d"),
    (Packet(Opcode.SET_SOP, MASTER, data=SOP), "14000000 c8a521000000100001010000000004000000fdfd"),
    (Packet(Opcode.SET_SOP, SLAVE1, data=SOP), "14000000 c8a521000000100002010000000004000000324c"),
    (Packet(Opcode.SET_SOP, SLAVE2, data=SOP), "14000000 c8a5210000001000040100000000040000008d3f"),
    (Packet(Opcode.SET_SOP, SLAVE3, data=SOP), "14000000 c8a521000000100008010000000004000000f3d8"),
    (Packet(Opcode.DEVICE_RESET, MASTER), "10000000 c8a5200000000c000101000000001f14"),
    (Packet(Opcode.DEVICE_RESET, SLAVE1), "10000000 c8a5200000000c00020100000000ffda"),
    (Packet(Opcode.DEVICE_RESET, SLAVE2), "10000000 c8a5200000000c000401000000001e57"),
    (Packet(Opcode.DEVICE_RESET, SLAVE3), "10000000 c8a5200000000c00080100000000fd5c"),
    (
        Packet(Opcode.CONFIG_SET, MASTER, data=struct.pack("<2I", 2048, 192)),
        "18000000 c8a514000000140001010000000000080000c0000000f4f6",
    ),
    (
        Packet(Opcode.CONFIG_SET, MASTER, data=struct.pack("<2I", 2048, 96)),
        "18000000 c8a51400000014000101000000000008000060000000821c",
    ),
    (
        Packet(Opcode.FRAME_PERIOD, BOARD, NOW, struct.pack("<I", 100)),
        "14000000 c8a53500000010002010000000006400000062e9",
    ),
    (
        Packet(Opcode.FRAME_PERIOD, BOARD, NOW, struct.pack("<I", 16)),
        "14000000 c8a535000000100020100000000010000000e661",
    ),
    (
        Packet(Opcode.SESSION_DIRECTORY, BOARD, NOW, b"/mnt/ssd/testdir"),
        "20000000 c8a5380000001c002010000000002f6d6e742f7373642f746573746469727cc7",
    ),
    (Packet(Opcode.NUM_FILES, BOARD, NOW, bytes(4)), "14000000 c8a5360000001000201000000000000000000c92"),
    (Packet(Opcode.PACKING, BOARD, NOW, bytes(4)), "14000000 c8a537000000100020100000000000000000283a"),
    (Packet(Opcode.NUM_FRAMES, BOARD, NOW, bytes(4)), "14000000 c8a53900000010002010000000000000000016eb"),
    (
        Packet(Opcode.NUM_FRAMES, BOARD, NOW, struct.pack("<I", 360)),
        "14000000 c8a5390000001000201000000000680100003700",
    ),
    (Packet(Opcode.CREATE_APP, BOARD), "10000000 c8a5180000000c00200100000000ef26"),
    (Packet(Opcode.START_RECORD, BOARD), "10000000 c8a5310000000c002001000000009250"),
    (Packet(Opcode.STOP_RECORD, BOARD), "10000000 c8a5320000000c002001000000000d55"),
    (Packet(Opcode.SPI_READ, MASTER, data=struct.pack("<H", 4)), "12000000 c8a5240000000e00010100000000040082c3"),
    (Packet(Opcode.SPI_READ, MASTER, data=struct.pack("<H", 12)), "12000000 c8a5240000000e000101000000000c002b4a"),
    (Packet(Opcode.SPI_READ, MASTER, data=struct.pack("<H", 36)), "12000000 c8a5240000000e00010100000000240064c5"),
]
FROM_BOARD = [
    (Packet(Opcode.ACK, BOARD, NOW, ack_code=Opcode.PING), "10000000 5a8c810012000c00201000000000d447"),
    (Packet(Opcode.ACK, BOARD, LATER, ack_code=Opcode.START_RECORD), "10000000 5a8c810031000c002001000000001d61"),
    (Packet(Opcode.NACK, BOARD, LATER, ack_code=Opcode.START_RECORD), "10000000 5a8c820031000c002001000000008264"),
    (Packet(Opcode.HOST_IRQ, MASTER), "10000000 5a8c880000000c00010100000000b6cb"),
]
ACK = bytes.fromhex(FROM_BOARD[0][1])


def test_check_sums() -> None:
    assert crc16(b"123456789") == 0x29B1
    assert ones_complement((0x0281, 0x0800, 0x040C, 0x0000, 0x0001)) == 0xF171


@pytest.mark.parametrize(("packet", "text"), VECTORS, ids=lambda value: getattr(value, "opcode", ""))
def test_packets_of_the_host(packet: Packet, text: str) -> None:
    data = bytes.fromhex(text)
    assert packet.to_bytes() == data
    assert PacketReader(HOST_SYNC).feed(data) == [packet]


@pytest.mark.parametrize(("packet", "text"), FROM_BOARD)
def test_packets_of_the_board(packet: Packet, text: str) -> None:
    assert PacketReader().feed(bytes.fromhex(text)) == [packet]
    assert packet.to_bytes(BOARD_SYNC) == bytes.fromhex(text)


@pytest.mark.parametrize("piece", [1, 3, 7, 1000])
def test_pieces(piece: int) -> None:
    stream = b"".join(bytes.fromhex(text) for _, text in FROM_BOARD)
    reader = PacketReader()
    got = [packet for k in range(0, len(stream), piece) for packet in reader.feed(stream[k : k + piece])]
    assert got == [packet for packet, _ in FROM_BOARD]
    assert reader.pending == 0


def test_half_a_packet_waits() -> None:
    reader = PacketReader()
    assert reader.feed(ACK[:-1]) == []
    assert reader.pending == len(ACK) - 1
    assert len(reader.feed(ACK[-1:])) == 1


def changed(place: int, value: int) -> bytes:
    return ACK[:place] + bytes([value]) + ACK[place + 1 :]


def sealed(body: bytes) -> bytes:
    """A packet with a right CRC around any body."""
    return struct.pack("<I", len(body) + 2) + body + struct.pack("<H", crc16(body[2:]))


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (changed(0, 15), "packet of 15 bytes"),
        (changed(3, 0x7F), "packet of 2130706448 bytes"),
        (struct.pack("<I", 16 + LARGEST_DATA + 1) + ACK[4:], "packet of 515 bytes"),
        (changed(4, 0xC8), "sync word"),
        (changed(6, 0x82), "CRC-16"),
        (changed(19, 0), "CRC-16"),
        (sealed(struct.pack("<4H2B4x", BOARD_SYNC, 0x81, 0x12, 13, 32, 1)), "dataLength 13"),
    ],
)
def test_what_is_no_packet(data: bytes, what: str) -> None:
    with pytest.raises(PacketError, match=what):
        PacketReader().feed(data)


def test_longest_packet() -> None:
    packet = Packet(Opcode.SPI_DATA, MASTER, data=bytes(LARGEST_DATA), ack_code=Opcode.SPI_READ)
    assert PacketReader().feed(packet.to_bytes(BOARD_SYNC)) == [packet]
    with pytest.raises(ValueError, match="at most 498"):
        Packet(Opcode.SPI_WRITE, MASTER, data=bytes(LARGEST_DATA + 1)).to_bytes()


def test_names() -> None:
    assert device_name(BOARD) == "board"
    assert device_name(5) == "master+slave2"
    assert device_name(64) == "device 64"
    assert order_name(0x18) == "CREATE_APP"
    assert order_name(0x8D) == "opcode 0x8d"
