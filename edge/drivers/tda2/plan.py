# SPDX-License-Identifier: Apache-2.0
"""All orders that set up a cascade, record and stop, as plain data: the driver carries them out, a dry run prints them.

Order of the steps: TI's script for the cascade and its Linux port (azinke/mmwave).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from edge.board_settings import CascadeBoard
from edge.drivers.tda2 import rhcp
from edge.drivers.tda2 import steps as s
from edge.drivers.tda2.packets import BOARD, CHIPS, MASTER, SLAVES, AckType, Opcode, Packet, device_name
from edge.drivers.tda2.steps import Command, Order, Step
from edge.drivers.tda2.timeouts import TimeOuts
from edge.waveform import Schedule

FRAME_LSB_PER_MS = 200_000
STOP_ORDER = START_ORDER = (*reversed(SLAVES), MASTER)
"""Slaves first: they must wait when the master's first pulse comes. TI stops in the same order."""
_SPI_PARTS = (("sync word", 4), ("header", rhcp.HEADER_BYTES), ("CRC", 4))


@dataclass(frozen=True)
class Plan:
    """Steps for one cascade.

    Args:
        schedule: of the radar.
        board: its capture board.
        chunks: of the firmware image.
        frames: that the configuration programs; 0: until stopped.
    """

    schedule: Schedule
    board: CascadeBoard
    chunks: list[bytes]
    frames: int

    def connect(self, epoch_s: int) -> list[Step]:
        """First orders on a new connection.

        Args:
            epoch_s: goes into the name of the board's trace file.
        """
        trace = Order("trace start", Opcode.TRACE_START, f"Trace_TDA_[{epoch_s}].txt".encode())
        device_map = struct.pack("<4BI", 1, 1, 1, 1, len(CHIPS))
        orders = [
            (BOARD, Order("ping", Opcode.PING, ack_type=AckType.RECEIVED)),
            *([(BOARD, trace)] if self.board.trace else []),
            (BOARD, Order("version", Opcode.VERSION_GET, reply=Opcode.VERSION)),
            (
                BOARD,
                Order("device map", Opcode.DEVICE_MAP, device_map, AckType.RECEIVED, pause="after_map_s"),
            ),
            (MASTER, Order("connect", Opcode.CONNECT)),
        ]
        return [Step("connect", (device,), order) for device, order in orders]

    def master(self) -> list[Step]:
        """The master alone: its clock is the slaves'."""
        return [
            *s.boot_steps("master", MASTER),
            *s.load_steps("master", (MASTER,), self.chunks),
            *s.role_steps("master", (MASTER,)),
        ]

    def slaves(self) -> list[Step]:
        """The slaves: reset one after another, then together."""
        return [
            *(step for slave in SLAVES for step in s.boot_steps("slaves", slave)),
            *s.load_steps("slaves", SLAVES, self.chunks),
            *s.role_steps("slaves", SLAVES),
        ]

    def common(self) -> list[Step]:
        """All chips, then chirps and frames."""
        return [
            *s.common_steps("all", self.schedule),
            *s.chirp_steps("chirps", self.schedule),
            *s.frame_steps("frames", self.schedule, self.frames),
        ]

    def reprogram(self, frames: int) -> list[Step]:
        """Another number of frames."""
        return s.frame_steps("frames", self.schedule, frames)

    def record(self, directory: str, frames: int) -> list[Step]:
        """From the size of a frame to the start of the recorder.

        Args:
            directory: of the capture on the board, a new one each time.
            frames: to record; 0: until stopped.
        """
        period = self.schedule.frame_registers().period
        size = struct.pack("<2I", 8 * self.schedule.profile.samples, self.schedule.slots * self.schedule.loops)
        numbers = (
            ("frame period, whole ms", Opcode.FRAME_PERIOD, _u32(period // FRAME_LSB_PER_MS)),
            ("directory", Opcode.SESSION_DIRECTORY, directory.encode("ascii")),
            ("files made in advance", Opcode.NUM_FILES, _u32(0)),
            ("packing", Opcode.PACKING, _u32(int(self.schedule.packed_12_bit))),
            ("frames to record", Opcode.NUM_FRAMES, _u32(frames)),
        )
        settings = [Order(name, opcode, data, AckType.RECEIVED) for name, opcode, data in numbers]
        application = Order("capture application", Opcode.CREATE_APP, wait="create_s")
        start = Order("record start", Opcode.START_RECORD, pause="after_record_s")
        return [
            Step("record", CHIPS, Order("size of a frame", Opcode.CONFIG_SET, size)),
            *(Step("record", (BOARD,), order) for order in (*settings, application, start)),
        ]

    def start(self) -> list[Step]:
        """Frames: slaves, then the master."""
        return [s.trigger_step("start", device, s.START) for device in START_ORDER]

    def stop(self) -> list[Step]:
        """Frames; left out after a given number of them."""
        return [s.trigger_step("stop", device, s.STOP) for device in STOP_ORDER]

    def stop_record(self) -> Step:
        """The recorder."""
        return Step("stop", (BOARD,), Order("record stop", Opcode.STOP_RECORD, wait="stop_record_s"))

    def disconnect(self) -> list[Step]:
        """Last orders on a connection."""
        trace = Order("trace stop", Opcode.TRACE_STOP, reply=Opcode.TRACE, pause="before_close_s")
        end = Order("disconnect", Opcode.DISCONNECT, ack_type=AckType.RECEIVED)
        last = [Step("close", (BOARD,), trace)] if self.board.trace else []
        return [Step("close", (MASTER,), end), *last]


def order_packet(device: int, order: Order) -> Packet:
    """The packet of an order."""
    return Packet(order.opcode, device, order.ack_type, order.data)


def command_packet(device: int, command: Command, sequence: int) -> Packet:
    """The packet that brings a command to a chip.

    Args:
        device: bit of devSelection.
        command: what it is told.
        sequence: the chip's next number, 0..15.
    """
    message = rhcp.encode(
        command.direction, command.message, sequence, [(command.block, command.data)], command.remaining
    )
    return Packet(Opcode.SPI_WRITE, device, AckType.RECEIVED, message)


def read_packets(device: int, payload_bytes: int) -> list[tuple[str, Packet]]:
    """Names and packets with which one message of a chip is read after its interrupt."""
    parts = [*_SPI_PARTS[:2], *([("payload", payload_bytes)] if payload_bytes else []), _SPI_PARTS[2]]
    request = Packet(Opcode.SPI_WRITE, device, AckType.PROCESSED, rhcp.READ_REQUEST)
    reads = [(name, Packet(Opcode.SPI_READ, device, data=struct.pack("<H", size))) for name, size in parts]
    return [("read request", request), *reads]


def numbered(steps: Iterable[Step]) -> Iterator[tuple[Step, int, Packet]]:
    """Step, device and packet of everything that is sent when every answer is good at once, in order."""
    sequences: dict[int, int] = dict.fromkeys(CHIPS, 0)
    for step in steps:
        for device in step.devices:
            if isinstance(step.action, Order):
                if step.action.opcode == Opcode.DEVICE_RESET:
                    sequences[device] = 0
                yield step, device, order_packet(device, step.action)
            else:
                yield step, device, command_packet(device, step.action, sequences[device])
                sequences[device] = (sequences[device] + 1) % rhcp.SEQUENCES


def describe(steps: Iterable[Step], timeouts: TimeOuts) -> list[str]:
    """One line a packet: number, phase, device, name, bytes as they are sent; waits and pauses between them."""
    lines: list[str] = []
    last: Step | None = None
    for number, (step, device, packet) in enumerate(numbered(steps), 1):
        if last is not None and step is not last:
            lines += _waits(last, timeouts)
        last = step
        name = f"{order_text(packet)} {step.action.name}"
        lines.append(f"{number:5d}  {step.phase:8} {device_name(device):7} {name:48} {packet.to_bytes().hex()}")
    return lines + (_waits(last, timeouts) if last is not None else [])


def describe_reading() -> list[str]:
    """How answers and events of the chips are read: the packets for each chip and a payload of 36 bytes."""
    lines = ["each answer or event of a chip is read after its interrupt (HOST_IRQ) by:"]
    for device in CHIPS:
        for name, packet in read_packets(device, 36):
            full = f"{order_text(packet)} {name}"
            lines.append(f"{'':5}  {'read':8} {device_name(device):7} {full:48} {packet.to_bytes().hex()}")
    return lines


def order_text(packet: Packet) -> str:
    """Name of a packet's opcode."""
    return Opcode(packet.opcode).name


def _waits(step: Step, timeouts: TimeOuts) -> list[str]:
    action = step.action
    lines = []
    if action.event is not None:
        within_s = getattr(timeouts, action.event_wait)
        lines.append(f"{'':5}  wait for event {action.event.name} (0x{action.event:04x}), at most {within_s:g} s")
    if isinstance(action, Order) and action.pause:
        lines.append(f"{'':5}  pause {getattr(timeouts, action.pause):g} s")
    return lines


def _u32(value: int) -> bytes:
    return struct.pack("<I", value)
