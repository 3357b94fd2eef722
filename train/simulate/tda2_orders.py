# SPDX-License-Identifier: Apache-2.0
"""What each opcode of the capture board does: to whom it may go, how long its data are, and when it comes too early."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from train.simulate.rhcp import READ_SYNC
from train.simulate.tda2_protocol import BOARD, NackError, Opcode, Packet

if TYPE_CHECKING:
    from train.simulate.tda2_board import Tda2Board

Target = Literal["board", "master", "chip", "chips"]
Outcome = tuple[float, Packet | None]
"""Seconds it takes, and the answer; None: a plain ACK."""
_LONGEST_READ = 498


def _nothing(_board: Tda2Board, _packet: Packet) -> None:
    """Nothing happens after the answer."""


@dataclass(frozen=True, slots=True)
class Order:
    """One opcode.

    Args:
        target: devSelection: the board itself, the master chip, one chip, one or several chips.
        lengths: bytes of data that are right; None: any.
        connected: needs CONNECT before.
        carry_out: does it, before the answer; raises NackError.
        follow: what happens after the answer.
    """

    target: Target
    lengths: tuple[int, ...] | None
    connected: bool
    carry_out: Callable[[Tda2Board, Packet], Outcome]
    follow: Callable[[Tda2Board, Packet], None] = _nothing


def check_target(order: Order, packet: Packet, connected: bool, mapped: set[int]) -> None:
    """NackError: wrong device, wrong length, or not connected."""
    if order.connected and not connected:
        raise NackError("not connected")
    if order.lengths is not None and len(packet.data) not in order.lengths:
        raise NackError(f"{len(packet.data)} bytes of data")
    chips = chips_of(packet.device)
    good = {
        "board": packet.device == BOARD,
        "master": packet.device == 1,
        "chip": len(chips) == 1 and packet.device < 16,
        "chips": len(chips) >= 1 and packet.device < 16,
    }[order.target]
    if not good:
        raise NackError(f"devSelection is no {order.target}")
    if order.target in ("chip", "chips") and not set(chips) <= mapped:
        raise NackError("chip that the device map does not have")


def chips_of(device: int) -> list[int]:
    """Numbers of the chips in a devSelection."""
    return [number for number in range(4) if device >> number & 1]


def _chip(packet: Packet) -> int:
    return chips_of(packet.device)[0]


def _u32(packet: Packet) -> int:
    return int(struct.unpack("<I", packet.data)[0])


def _ack(_board: Tda2Board, _packet: Packet) -> Outcome:
    return 0.0, None


def _device_map(board: Tda2Board, packet: Packet) -> Outcome:
    *enabled, count = struct.unpack("<4BI", packet.data)
    if any(flag > 1 for flag in enabled) or sum(enabled) != count or not enabled[0]:
        raise NackError(f"device map {enabled} with count {count}")
    board.mapped = {number for number in range(4) if enabled[number]}
    return 0.0, None


def _connect(board: Tda2Board, _packet: Packet) -> Outcome:
    if not board.mapped:
        raise NackError("connect before the device map")
    board.connected = True
    return 0.0, None


def _disconnect(board: Tda2Board, _packet: Packet) -> Outcome:
    board.connected = False
    return 0.0, None


def _version(board: Tda2Board, packet: Packet) -> Outcome:
    return 0.0, packet.answer(Opcode.VERSION, board.settings.version.encode())


def _trace_start(board: Tda2Board, packet: Packet) -> Outcome:
    if not packet.data or b"\0" in packet.data:
        raise NackError("trace without file name")
    board.trace = packet.data
    return 0.0, None


def _trace_fetch(board: Tda2Board, packet: Packet) -> Outcome:
    if not board.trace:
        raise NackError("trace was not started")
    name, board.trace = board.trace, b""
    return 0.0, packet.answer(Opcode.TRACE, name)


def _config_set(board: Tda2Board, packet: Packet) -> Outcome:
    board.recorder.set_size(_chip(packet), *struct.unpack("<2I", packet.data))
    return 0.0, None


def _config_get(board: Tda2Board, packet: Packet) -> Outcome:
    width, height = board.recorder.settings.size.get(_chip(packet), (0, 0))
    return 0.0, packet.answer(Opcode.CONFIG, struct.pack("<2I", width, height))


def _set_sop(board: Tda2Board, packet: Packet) -> Outcome:
    for number in chips_of(packet.device):
        board.chips[number].sop = _u32(packet)
    return 0.0, None


def _get_sop(board: Tda2Board, packet: Packet) -> Outcome:
    return 0.0, packet.answer(Opcode.SOP, struct.pack("<I", board.chips[_chip(packet)].sop))


def _reset(board: Tda2Board, packet: Packet) -> None:
    for number in chips_of(packet.device):
        board.restart_chip(number)


def _spi_write(board: Tda2Board, packet: Packet) -> Outcome:
    if not packet.data:
        raise NackError("nothing to write")
    if packet.data == READ_SYNC:
        for number in chips_of(packet.device):
            board.spi_write(number, packet.data)
    return 0.0, None


def _spi_written(board: Tda2Board, packet: Packet) -> None:
    if packet.data != READ_SYNC:
        for number in chips_of(packet.device):
            board.spi_write(number, packet.data)


def _spi_read(board: Tda2Board, packet: Packet) -> Outcome:
    (count,) = struct.unpack("<H", packet.data)
    if not 0 < count <= _LONGEST_READ:
        raise NackError(f"{count} bytes to read")
    return 0.0, packet.answer(Opcode.SPI_DATA, board.spi_read(_chip(packet), count))


def _gpio_set(board: Tda2Board, packet: Packet) -> Outcome:
    base, pin, value = struct.unpack("<3I", packet.data)
    board.gpio[base, pin] = value
    return 0.0, None


def _gpio_get(board: Tda2Board, packet: Packet) -> Outcome:
    base, pin = struct.unpack_from("<2I", packet.data)
    return 0.0, packet.answer(Opcode.GPIO, struct.pack("<3I", base, pin, board.gpio.get((base, pin), 0)))


def _number(name: str) -> Callable[[Tda2Board, Packet], Outcome]:
    def carry_out(board: Tda2Board, packet: Packet) -> Outcome:
        board.recorder.set_number(name, _u32(packet))
        return 0.0, None

    return carry_out


def _session(board: Tda2Board, packet: Packet) -> Outcome:
    board.recorder.set_session(packet.data)
    return 0.0, None


def _create(board: Tda2Board, _packet: Packet) -> Outcome:
    board.recorder.create(board.mapped)
    return board.settings.create_s, None


def _start(board: Tda2Board, _packet: Packet) -> Outcome:
    board.recorder.start()
    return 0.0, None


def _stop(board: Tda2Board, _packet: Packet) -> Outcome:
    board.stop_record()
    return board.settings.stop_s, None


ORDERS: dict[int, Order] = {
    Opcode.CONNECT: Order("master", (0,), False, _connect),
    Opcode.DISCONNECT: Order("master", (0,), True, _disconnect),
    Opcode.PING: Order("board", (0,), False, _ack),
    Opcode.VERSION_GET: Order("board", (0,), False, _version),
    Opcode.CONFIG_SET: Order("chip", (8,), True, _config_set),
    Opcode.CONFIG_GET: Order("chip", (0,), True, _config_get),
    Opcode.TRACE_START: Order("board", None, False, _trace_start),
    Opcode.TRACE_FETCH: Order("board", None, False, _trace_fetch),
    Opcode.CREATE_APP: Order("board", (0,), True, _create),
    Opcode.STATS_START: Order("board", None, True, _ack),
    Opcode.DEVICE_MAP: Order("board", (8,), False, _device_map),
    Opcode.DEV_RESET: Order("chips", (0,), True, _ack, _reset),
    Opcode.SET_SOP: Order("chips", (4,), True, _set_sop),
    Opcode.GET_SOP: Order("chip", (0,), True, _get_sop),
    Opcode.SPI_WRITE: Order("chips", None, True, _spi_write, _spi_written),
    Opcode.SPI_READ: Order("chip", (2,), True, _spi_read),
    Opcode.GPIO_CONFIGURE: Order("board", (12,), True, _gpio_set),
    Opcode.GPIO_SET: Order("board", (12,), True, _gpio_set),
    Opcode.GPIO_GET: Order("board", (8, 12), True, _gpio_get),
    Opcode.START_RECORD: Order("board", (0,), True, _start),
    Opcode.STOP_RECORD: Order("board", (0,), True, _stop),
    Opcode.FRAME_PERIOD: Order("board", (4,), True, _number("period_ms")),
    Opcode.NUM_FILES: Order("board", (4,), True, _number("files")),
    Opcode.PACKING: Order("board", (4,), True, _number("packing")),
    Opcode.SESSION_DIR: Order("board", None, True, _session),
    Opcode.NUM_FRAMES: Order("board", (4,), True, _number("frames")),
}
