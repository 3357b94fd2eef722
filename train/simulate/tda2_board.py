# SPDX-License-Identifier: Apache-2.0
"""A cascade radar with its capture board on a TCP port: answers, refuses and records as the hardware notes say.

Every breach of the protocol is refused as the board would, or noted where it could not notice; ``violations`` lists
both. Nothing here knows a driver: it is written from the description of the bytes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType

import numpy as np

from edge.errors import CaptureError
from edge.frames import RadarFrame, RadarId
from train.simulate.capture_writer import ROLL_OVER_BYTES
from train.simulate.cascade_checks import start_notes
from train.simulate.cascade_chip import CascadeChip, ChipDelays
from train.simulate.chip_commands import CHANNELS, MASTER
from train.simulate.faults import Fault, Faults, FaultyChannel
from train.simulate.frame_faults import FrameFaults
from train.simulate.rhcp import CHIP_SYNC, READ_SYNC
from train.simulate.supplies import FrameSupply, SupplyClosedError
from train.simulate.tcp_server import OneClientServer
from train.simulate.tda2_orders import ORDERS, check_target
from train.simulate.tda2_protocol import AckType, FramingError, NackError, Opcode, Packet, PacketReader
from train.simulate.tda2_recorder import Recorder
from train.simulate.threads import Bursts, Later

FRAME_LSB_NS = 5
MOST_BABBLE = 100
"""Bytes of a chip before its sync word."""


@dataclass(frozen=True, slots=True)
class Tda2Settings:
    """How one emulated board behaves.

    Args:
        host, port: address; port 0: any free one.
        pace: speed of its frames, 1: real time, 2: twice as fast, 0: as fast as they are written.
        roll_over_bytes: size at which a data file is followed by the next.
        capacity_bytes: of its disk.
        chip_delays: of the radar chips.
        create_s: time CREATE_APP takes.
        stop_s: time STOP_RECORD takes.
        start_latency_s: from the master's start command to its first chirp.
        clock_us: of the board's clock when it is made.
        clock_ppm: by which its clock, and so its frames, run fast.
        version: text of its version.
    """

    host: str = "127.0.0.1"
    port: int = 0
    pace: float = 1.0
    roll_over_bytes: int = ROLL_OVER_BYTES
    capacity_bytes: int = 8 * 2**30
    chip_delays: ChipDelays = field(default_factory=ChipDelays)
    create_s: float = 0.0
    stop_s: float = 0.0
    start_latency_s: float = 0.0
    clock_us: int = 100_000_000
    clock_ppm: float = 0.0
    version: str = "Virtual TDA2 capture board 1.0"


class Tda2Board:
    """Server, four radar chips and recorder of one radar.

    Args:
        radar: which radar of the rig it is.
        supply: its frames, in the layout that the host configures; called on a thread of the board.
        root: folder that stands for the board's /mnt/ssd.
        settings: behaviour.
        faults: channels ``<radar>/control`` (answers), ``/irq``, ``/spi`` (chips), ``/frames``.
    Attributes:
        chips: master, slave1..3, with their decoded configuration.
        recorder: settings and files.
        violations: what the host did wrong, in words.
        log: opcodes in the order they came, with devSelection.
        next_number: frame that the next burst shows.
    """

    def __init__(
        self,
        radar: RadarId,
        supply: FrameSupply,
        root: Path,
        settings: Tda2Settings | None = None,
        faults: Faults | None = None,
    ) -> None:
        self.radar, self.settings, self.faults = radar, settings or Tda2Settings(), faults
        self.violations: list[str] = []
        self.log: list[tuple[int, int]] = []
        self.next_number = self.bursts = 0
        self.first_number: Callable[[], int] | None = None
        """Asked for the number of the next frame when frames start; None: numbers go on where they stopped."""
        self.trace = b""
        self.gpio: dict[tuple[int, int], int] = {}
        self.connected, self.mapped = False, set[int]()
        self._supply, self._born_ns = supply, time.monotonic_ns()
        self._lock, self._closing = threading.RLock(), threading.Event()
        self._later, self._frame_faults = Later(f"{radar} board"), FrameFaults(faults, radar)
        self._running: Bursts | None = None
        self._ended_bursts: list[Bursts] = []
        self._run = self._dry_run = self._first_us = 0
        self._silent = False
        self._reader = PacketReader()
        self._control = FaultyChannel(faults, f"{radar}/control", self._write, self._later, self.unplug)
        self._irq = FaultyChannel(faults, f"{radar}/irq", self._write, self._later, self.unplug)
        self._lines, self._reading = [False] * 4, [b""] * 4
        s = self.settings
        self.recorder = Recorder(root, s.roll_over_bytes, s.capacity_bytes, self.complain)
        self.chips = tuple(self._chip(number) for number in range(4))
        self._server = OneClientServer(
            s.host, s.port, f"{radar} host", self._session, self._host_gone, lambda: self.complain("client refused")
        )
        self.address = self._server.address

    def start(self) -> Tda2Board:
        """Listen."""
        self._server.start()
        return self

    def stop(self) -> bool:
        """End connection, frames and threads; whether all threads ended."""
        self._closing.set()
        with self._lock:
            self._halt_bursts()
        ended = [self._server.stop(), self._later.close(), *(bursts.stop() for bursts in self._ended_bursts)]
        with self._lock:
            self.recorder.abandon()
        return all(ended)

    def __enter__(self) -> Tda2Board:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def late(self) -> int:
        """Bursts that began more than half a period late because the frames were made too slowly."""
        present = [self._running] if self._running is not None else []
        return sum(bursts.late for bursts in [*self._ended_bursts, *present])

    def complain(self, what: str) -> None:
        """Note a breach of the protocol."""
        self.violations.append(what)

    def unplug(self, silent: bool = False) -> None:
        """Power cut: frames end in the middle of one, everything configured is lost.

        Args:
            silent: the connection stays open but dead, as when a cable is pulled.
        """
        with self._lock:
            self._halt_bursts()
            self._silent, self._server.accepting = True, False
            self.recorder.abandon(cut=True)
            self.connected, self.mapped, self._lines, self._reading = False, set(), [False] * 4, [b""] * 4
            for chip in self.chips:
                chip.power_off()
                chip.sop = 0
        if not silent:
            self._server.hang_up()

    def plug(self) -> None:
        """Power again: the board accepts connections, with nothing configured."""
        self._server.hang_up()
        self._silent, self._server.accepting = False, True

    def pulse(self) -> None:
        """A trigger pulse on SYNC_IN, for a master whose frames start by hardware."""
        if self._running is not None:
            self._running.pulse()

    def clock_us(self) -> int:
        """The recorder's clock now."""
        elapsed_us = (time.monotonic_ns() - self._born_ns) / 1000.0
        return self.settings.clock_us + round(elapsed_us * (1.0 + 1e-6 * self.settings.clock_ppm))

    # --- connection

    def feed(self, data: bytes) -> bool:
        """Bytes of the host."""
        try:
            packets = self._reader.feed(data)
        except FramingError as error:
            self.complain(f"byte stream lost: {error}")
            return False
        for packet in packets:
            if not self._silent:
                self._handle(packet)
        return True

    def _session(self) -> Tda2Board:
        self._reader = PacketReader()
        return self

    def _host_gone(self) -> None:
        self.connected = False

    def _write(self, packet: bytes) -> None:
        split = self.faults.hit(Fault.SPLIT, f"{self.radar}/control") if self.faults is not None else None
        if not self._silent:
            self._server.send(packet, int(split.value) if split else 0)

    # --- orders

    def _handle(self, packet: Packet) -> None:
        self.log.append((packet.opcode, packet.device))
        where = f"{self.radar}/control"
        if self.faults is not None and self.faults.hit(Fault.HANG_UP, where):
            self._server.hang_up()
            return
        forced = self.faults is not None and self.faults.hit(Fault.NACK, where, packet.opcode)
        try:
            if packet.fault:
                raise NackError(packet.fault)
            if forced:
                raise NackError("refused on command")
            order = ORDERS.get(packet.opcode)
            if order is None:
                raise NackError("unknown opcode")
            check_target(order, packet, self.connected, self.mapped)
            with self._lock:
                delay_s, answer = order.carry_out(self, packet)
        except NackError as error:
            self.complain(f"NACK to 0x{packet.opcode:02x} for device {packet.device}: {error}")
            self._reply(packet.answer(Opcode.NACK))
            return
        if packet.ack_type != AckType.RECEIVED and delay_s > 0:
            self._closing.wait(delay_s)
        self._reply(answer or packet.answer(Opcode.ACK))
        with self._lock:
            order.follow(self, packet)

    def _reply(self, packet: Packet) -> None:
        if packet.ack_type != AckType.NONE:
            self._control.send(packet.to_bytes())

    # --- radar chips

    def _chip(self, number: int) -> CascadeChip:
        def later(delay_s: float, action: Callable[[], None]) -> None:
            def locked() -> None:
                with self._lock:
                    action()

            self._later.call(delay_s, locked)

        where = f"{self.radar}/spi"
        delays = self.settings.chip_delays
        return CascadeChip(
            number, where, delays, self.faults, later, lambda: self._raise_line(number), self.complain, self._moved
        )

    def restart_chip(self, number: int) -> None:
        """The reset line of a chip; what was being read from it is gone."""
        if number and CHANNELS not in self.chips[0].settings:
            self.complain(f"chip {number} was reset before the master had its channels: slaves live on its clock")
        self._lines[number], self._reading[number] = False, b""
        self.chips[number].reset()

    def stop_record(self) -> None:
        """Close the recording; a frame that waits to be overtaken is written first. NackError: none is open."""
        for frame in self._frame_faults.flush():
            self._record(frame, self.clock_us())
        if any(chip.running for chip in self.chips):
            self.complain("record stop while frames run")
        self.recorder.stop()

    def spi_write(self, number: int, data: bytes) -> None:
        """What the host clocks into one chip: a message, or the pattern that asks to read."""
        chip = self.chips[number]
        if data == READ_SYNC:
            if not self._lines[number] or not chip.outbox:
                self.complain(f"chip {number}: read request without interrupt")
            if self._reading[number]:
                self.complain(f"chip {number}: {len(self._reading[number])} bytes of the message before were not read")
            self._lines[number] = False
            self._reading[number] = self._babble() + CHIP_SYNC + chip.outbox.popleft() if chip.outbox else b""
        else:
            chip.receive(data)

    def _babble(self) -> bytes:
        """What the chip sends before its sync word, where a fault wants it."""
        other = self.faults.hit(Fault.BABBLE, f"{self.radar}/spi") if self.faults is not None else None
        if not other:
            return b""
        return other.rng.integers(0x20, 0x7F, min(int(other.value), MOST_BABBLE), dtype=np.uint8).tobytes()

    def spi_read(self, number: int, count: int) -> bytes:
        """The next bytes of the message that is being read; FF where there is none."""
        waiting = self._reading[number]
        if len(waiting) < count:
            self.complain(f"chip {number}: {count} bytes read, {len(waiting)} are there")
        self._reading[number] = waiting[count:]
        if not self._reading[number]:
            self._later.call(0.0, self._raise_line, number)
        return waiting[:count].ljust(count, b"\xff")

    def _raise_line(self, number: int) -> None:
        """Interrupt when a message waits and none is being read."""
        with self._lock:
            if self._lines[number] or self._reading[number] or not self.chips[number].outbox:
                return
            self._lines[number] = True
        self._irq.send(Packet(Opcode.HOST_IRQ, 1 << number).to_bytes())

    # --- frames

    def _moved(self, chip: CascadeChip) -> None:
        """Frames of a chip were started or stopped."""
        if not chip.master:
            return
        if not chip.running:
            self._halt_bursts()
            return
        for note in start_notes([own for own in self.chips if own.number in self.mapped], self.recorder):
            self.complain(note)
        frame = chip.frame
        assert frame is not None, "frames start only with a frame command"
        if self.first_number is not None:
            self.next_number = self.first_number()
        s = self.settings
        period_s = frame.period * FRAME_LSB_NS * 1e-9
        first_s = s.start_latency_s + self._frame_faults.late_s()
        self._first_us = self.clock_us() + round(first_s * 1e6)
        wall_s = period_s / (1.0 + 1e-6 * s.clock_ppm) / s.pace if s.pace > 0 else 0.0
        first_s = first_s / s.pace if s.pace > 0 else 0.0
        self._run += 1
        self._running = Bursts(
            partial(self._burst, self._run), wall_s, frame.frames, first_s, self._all_sent, frame.trigger != MASTER
        )
        self._running.start()

    def _burst(self, run: int, k: int) -> None:
        """Burst k since start number ``run``, on the thread of the bursts."""
        if self.faults is not None and self.faults.hit(Fault.UNPLUG, self._frame_faults.where):
            self.unplug()
            return
        number = self.next_number
        try:
            frames = self._frame_faults.of(self._supply(self.radar, number))
        except SupplyClosedError:
            return
        except CaptureError as error:
            if self._dry_run != run:
                self.complain(f"no frame {number}: {error}")
            self._dry_run, frames = run, []
        with self._lock:
            master = self.chips[0]
            if master.frame is None or self._running is None or run != self._run:
                return
            t_us = self._first_us + round(k * master.frame.period * FRAME_LSB_NS / 1000)
            self.next_number += 1
            self.bursts += 1
            for frame in frames:
                self._record(frame, t_us)

    def _record(self, frame: RadarFrame, t_us: int) -> None:
        chips = [chip.number for chip in self.chips if chip.running and chip.number < len(frame.adc)]
        self.recorder.take(frame, t_us, chips)

    def _all_sent(self) -> None:
        with self._lock:
            for chip in self.chips:
                chip.end_frames()

    def _halt_bursts(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            running.halt()
            self._ended_bursts.append(running)
