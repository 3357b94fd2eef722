# SPDX-License-Identifier: Apache-2.0
"""A capture board that answers whatever a test tells it to, right or wrong, from a list."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import zlib
from collections.abc import Callable

from edge.drivers.tda2.crc import ones_complement
from edge.drivers.tda2.packets import BOARD_SYNC, HOST_SYNC, AckType, Opcode, Packet, PacketReader

Reaction = Callable[[Packet], bytes]
"""Order -> bytes that are sent back."""
SAFETY_S = 20.0


def board(opcode: int, device: int, data: bytes = b"", answers: int = 0) -> bytes:
    """A packet of the board."""
    return Packet(opcode, device, AckType.PROCESSED, data, answers).to_bytes(BOARD_SYNC)


def ack(packet: Packet) -> bytes:
    """What an order is answered when all is well."""
    return board(Opcode.ACK, packet.device, answers=packet.opcode)


def interrupt(device: int) -> bytes:
    """A chip raises its line."""
    return board(Opcode.HOST_IRQ, device)


def chip_message(
    message: int, sequence: int, blocks: tuple[tuple[int, bytes], ...] = (), kind: int = 1, direction: int = 2
) -> bytes:
    """A message of a chip without its sync word."""
    payload = b"".join(struct.pack("<2H", block, 4 + len(data)) + data for block, data in blocks)
    words = (direction | kind << 4 | message << 6, 16 + len(payload), 0x400 | sequence << 12, 0, len(blocks))
    body = struct.pack("<6H", *words, ones_complement(words)) + payload
    return body + struct.pack("<I", zlib.crc32(body))


def reading(raw: bytes, sync: bytes = bytes.fromhex("badccdab")) -> list[Reaction]:
    """Reactions to the orders with which one message is read."""
    parts = [sync, raw[:12], *([raw[12:-4]] if len(raw) > 16 else []), raw[-4:]]

    def part(data: bytes) -> Reaction:
        return lambda packet: board(Opcode.SPI_DATA, packet.device, data, Opcode.SPI_READ)

    return [ack, *(part(data) for data in parts)]


class ScriptedBoard:
    """Serves one connection; the k-th order gets the k-th reaction, further ones nothing.

    Args:
        reactions: see above.
        hang_up: end the connection after the last reaction.
    Attributes:
        orders: packets that came.
    """

    def __init__(self, reactions: list[Reaction], hang_up: bool = False) -> None:
        self.orders: list[Packet] = []
        self._reactions, self._hang_up = reactions, hang_up
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(SAFETY_S)
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> ScriptedBoard:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.join(SAFETY_S)
        self._listener.close()
        assert not self._thread.is_alive()

    def _serve(self) -> None:
        reader = PacketReader(HOST_SYNC)
        with contextlib.suppress(OSError), self._listener.accept()[0] as client:
            client.settimeout(SAFETY_S)
            while data := client.recv(4096):
                for packet in reader.feed(data):
                    self.orders.append(packet)
                    if len(self.orders) <= len(self._reactions):
                        client.sendall(self._reactions[len(self.orders) - 1](packet))
                if self._hang_up and len(self.orders) >= len(self._reactions):
                    return
