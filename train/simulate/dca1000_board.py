# SPDX-License-Identifier: Apache-2.0
"""The DCA1000 capture card of one single-chip radar: commands on one UDP port, samples and status to the host.

Source: hardware notes 4.2 and 4.3 and the real replies and packets of the capture that the project's tests use. A real
card answers "ok" to orders in any sequence; what makes no sense is therefore noted in ``violations``, not refused.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

import numpy as np

from edge.frames import Int16, RadarId
from train.simulate.faults import Fault, Faults, FaultyChannel
from train.simulate.threads import Later, join

HEADER, FOOTER = 0xA55A, 0xEEAA
_COMMAND = struct.Struct("<3H")
_REPLY = struct.Struct("<4H")
_PACKET = struct.Struct("<IIH")
"""Sequence number, lower 32 and upper 16 bits of the byte count."""
PAYLOAD_BYTES = 1456
COMMAND_PORT, DATA_PORT = 4096, 4098
PACKET_TIME_S = 11e-6
"""Of one packet besides the delay: with it the rates of the notes come out (706, 545, 325, 193 Mbit/s)."""

RESET_FPGA, RESET_RADAR, CONFIGURE, EEPROM, RECORD_START, RECORD_STOP = 1, 2, 3, 4, 5, 6
ALIVE, ASYNC_STATUS, PACKET_DELAY, FPGA_VERSION = 9, 0xA, 0xB, 0xE
LENGTHS = {CONFIGURE: 6, EEPROM: 18, PACKET_DELAY: 6}
LVDS_LANES = {1: 4, 2: 2}
NO_LVDS_DATA, RECORD_COMPLETED, LVDS_BUFFER_FULL = 1 << 0, 1 << 8, 1 << 9
_LARGEST_COMMAND = 512
_BURST_PACKETS = 16


@dataclass(frozen=True, slots=True)
class Dca1000Settings:
    """How one emulated card behaves.

    Args:
        host: address it lives at.
        command_port: 0: any free one; real cards have 4096.
        data_target: where samples go; None: port 4098 (or the EEPROM's) of whoever sent the last command.
        pace: packet delays are divided by this; 0: none.
        deaf_s: after the FPGA was configured, when it answers nothing.
        flush_s: silence of the radar after which the rest is sent and the recording ends.
        no_data_s: from record start to the status "no LVDS data".
        version: major and minor of the FPGA.
    """

    host: str = "127.0.0.1"
    command_port: int = 0
    data_target: tuple[str, int] | None = None
    pace: float = 1.0
    deaf_s: float = 0.02
    flush_s: float = 2.0
    no_data_s: float = 10.0
    version: tuple[int, int] = (2, 8)


@dataclass(frozen=True, slots=True)
class FpgaConfiguration:
    """Data of command 3: logging 1 raw, 2 multi; lanes; transfer 1 capture; capture 2 Ethernet; format 3 = 16 bit."""

    logging: int
    lanes: int
    transfer: int
    capture: int
    format: int
    timer: int

    @property
    def streams_raw(self) -> bool:
        """Raw 16-bit samples of two lanes to Ethernet: what the radars of the virtual rig send."""
        return (self.logging, self.lanes, self.transfer, self.capture, self.format) == (1, 2, 1, 2, 3)


class Dca1000Board:
    """One card.

    Args:
        radar: which radar of the rig it serves.
        settings: behaviour.
        faults: channels ``<radar>/command`` (replies and status) and ``<radar>/data``.
        reset_radar: pulls the radar's reset line.
        streaming: whether the radar's frames are running.
    Attributes:
        address: of the command port.
        violations: what the host did wrong, in words.
        log: codes in the order they came.
        configuration: as last accepted.
        packet_delay_s: as last accepted; None: never set.
        recording: between start and stop.
        sent_bytes: of the present or last recording.
        packets: of the present or last recording.
        eeprom: data of command 4; None: never written.
    """

    def __init__(
        self,
        radar: RadarId,
        settings: Dca1000Settings | None = None,
        faults: Faults | None = None,
        reset_radar: Callable[[], None] = lambda: None,
        streaming: Callable[[], bool] = lambda: False,
    ) -> None:
        self.radar, self.settings = radar, settings or Dca1000Settings()
        self.violations: list[str] = []
        self.log: list[int] = []
        self.configuration: FpgaConfiguration | None = None
        self.packet_delay_s: float | None = None
        self.recording, self.sent_bytes, self.packets = False, 0, 0
        self.eeprom: bytes | None = None
        self.data_target = self.settings.data_target
        """Where samples go; None: port 4098 (or the EEPROM's) of whoever sent the last command."""
        self._data_port = DATA_PORT
        self._faults, self._reset_radar, self._streaming = faults, reset_radar, streaming
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((self.settings.host, self.settings.command_port))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2**21)
        self.address: tuple[str, int] = self._socket.getsockname()
        self._peer: tuple[str, int] | None = None
        self._later, self._lock = Later(f"{radar} card"), threading.RLock()
        self._replies = FaultyChannel(faults, f"{radar}/command", self._send_reply, self._later, self.unplug)
        self._data = FaultyChannel(faults, f"{radar}/data", self._send_data, self._later, self.unplug)
        self._carry = b""
        self._deaf_until_s = self._last_data_s = self._started_s = 0.0
        self._watching = self._full = self._misaligned = self._closing = False
        self._powered = True
        self._thread = threading.Thread(target=self._run, name=f"{radar} card commands", daemon=True)

    def start(self) -> Dca1000Board:
        """Listen."""
        self._thread.start()
        return self

    def stop(self) -> bool:
        """Close; whether all threads ended."""
        self._closing = True
        with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as waker:
            waker.sendto(b"", self.address)
        ended = [join(self._thread), self._later.close()]
        self._socket.close()
        return all(ended)

    def __enter__(self) -> Dca1000Board:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def unplug(self) -> None:
        """Power cut: no reply, no data; everything configured is lost."""
        with self._lock:
            self._powered = False
            self._clear()

    def plug(self) -> None:
        """Power again; a data port written to the EEPROM counts from now on."""
        with self._lock:
            if self.eeprom is not None:
                (self._data_port,) = struct.unpack_from("<H", self.eeprom, 16)
            self._powered = True

    def lvds(self, samples: bytes | memoryview, period_s: float) -> None:
        """One frame of the radar's samples; sends what fills whole packets, and keeps the rest for the next frame.

        Args:
            samples: bytes as they come over the lanes.
            period_s: frame period, to see whether the packet delay lets them pass.
        """
        with self._lock:
            self._last_data_s = time.monotonic()
            if not self.recording or not self._powered:
                return
            if self.configuration is None or not self.configuration.streams_raw:
                self._complain("samples come while the card is not configured for raw 16 bit, 2 lanes, Ethernet")
                return
            interval_s = PACKET_TIME_S + (self.packet_delay_s or 0.0)
            if len(samples) / PAYLOAD_BYTES * interval_s > period_s and not self._full:
                self._full = True
                self._complain("the packet delay is too long for this data rate")
                self._status(LVDS_BUFFER_FULL)
            if self._misaligned:
                self._misaligned, samples = False, samples[len(samples) // 3 & ~1 :]
            self._watch()
            self._packetize(samples, interval_s / self.settings.pace if self.settings.pace > 0 else 0.0)

    # --- data

    def _packetize(self, samples: bytes | memoryview, interval_s: float) -> None:
        data = memoryview(self._carry + bytes(samples)) if self._carry else memoryview(samples).cast("B")
        whole = len(data) // PAYLOAD_BYTES
        start_s = time.monotonic()
        for index in range(whole):
            self._put(data[index * PAYLOAD_BYTES : (index + 1) * PAYLOAD_BYTES])
            if interval_s and index % _BURST_PACKETS == _BURST_PACKETS - 1:
                ahead_s = start_s + (index + 1) * interval_s - time.monotonic()
                if ahead_s > 0.2e-3:
                    time.sleep(ahead_s)
        self._carry = bytes(data[whole * PAYLOAD_BYTES :])

    def _put(self, payload: memoryview | bytes) -> None:
        """One packet."""
        self.packets += 1
        head = _PACKET.pack(self.packets, self.sent_bytes & 0xFFFFFFFF, self.sent_bytes >> 32)
        self.sent_bytes += len(payload)
        if self._data.quiet:
            target = self._target()
            if target is not None:
                with contextlib.suppress(OSError):
                    self._socket.sendmsg([head, payload], (), 0, target)
        else:
            self._data.send(head + bytes(payload))

    def _watch(self) -> None:
        """See to it that the rest is sent when the radar falls silent."""
        if not self._watching:
            self._watching = True
            self._later.call(self.settings.flush_s, self._silence)

    def _silence(self) -> None:
        with self._lock:
            self._watching = False
            if not self.recording:
                return
            rest_s = self._last_data_s + self.settings.flush_s - time.monotonic()
            if rest_s > 0:
                self._watching = True
                self._later.call(rest_s, self._silence)
                return
            self._complete()

    def _complete(self) -> None:
        """Send the rest, say that the recording is complete."""
        if self._carry:
            self._put(self._carry)
            self._carry = b""
        self.recording = False
        self._status(RECORD_COMPLETED)

    def _no_data(self, started_s: float) -> None:
        with self._lock:
            if self.recording and self._started_s == started_s and not self.packets and not self._carry:
                self._status(NO_LVDS_DATA)

    # --- commands

    def _run(self) -> None:
        while not self._closing:
            try:
                command, peer = self._socket.recvfrom(_LARGEST_COMMAND)
            except OSError:
                continue  # an ICMP error of an earlier packet
            if self._closing:
                return
            if self._powered and time.monotonic() >= self._deaf_until_s:
                self._handle(command, peer)

    def _handle(self, command: bytes, peer: tuple[str, int]) -> None:
        if len(command) < _COMMAND.size + 2:
            self._complain(f"{len(command)} bytes are no command")
            return
        header, code, length = _COMMAND.unpack_from(command)
        data, footer = command[_COMMAND.size : -2], int.from_bytes(command[-2:], "little")
        if header != HEADER or footer != FOOTER or length != len(data):
            self._complain(f"malformed command {command[:20].hex()}")
            return
        self._peer = peer
        self.log.append(code)
        forced = self._faults is not None and self._faults.hit(Fault.NACK, f"{self.radar}/command", code)
        with self._lock:
            status = 1 if forced else self._obey(code, data)
            self._replies.send(_REPLY.pack(HEADER, code, status, FOOTER))
            if status == 0 or code == FPGA_VERSION:
                self._follow(code)

    def _obey(self, code: int, data: bytes) -> int:
        """Carry out a command; its status."""
        if len(data) != LENGTHS.get(code, 0) or code not in _KNOWN:
            self._complain(f"command 0x{code:x} with {len(data)} bytes")
            return 1
        if code == CONFIGURE:
            fields = tuple(data)
            if not (all(1 <= value <= 2 for value in fields[:4]) and 1 <= fields[4] <= 3):
                self._complain(f"FPGA configuration {data.hex()}")
                return 1
            self.configuration = FpgaConfiguration(fields[0], LVDS_LANES[fields[1]], *fields[2:])
        elif code == PACKET_DELAY:
            size, ticks, zero = struct.unpack("<3H", data)
            if size != 1470 or zero != 0 or not 5 * 125 <= ticks <= 500 * 125:
                self._complain(f"packet delay {data.hex()}")
                return 1
            self.packet_delay_s = ticks / 125 * 1e-6
        elif code == EEPROM:
            self.eeprom = data
        elif code == FPGA_VERSION:
            return self.settings.version[0] | self.settings.version[1] << 7
        elif code == RESET_FPGA:
            self._clear()
        elif code == RESET_RADAR:
            self._reset_radar()
        elif code == RECORD_START:
            return self._record()
        return 0

    def _record(self) -> int:
        """Begin a recording; its status."""
        if self.recording:
            self._complain("record start while it records")
            return 1
        if self.configuration is None or self.packet_delay_s is None:
            self._complain("record start without configuration or packet delay")
        self._started_s = time.monotonic()
        self._misaligned = self._streaming()
        if self._misaligned:
            self._complain("record start while the radar sends: the byte count is not aligned to frames")
        self.recording, self.sent_bytes, self.packets, self._carry, self._full = True, 0, 0, b"", False
        self._later.call(self.settings.no_data_s, self._no_data, self._started_s)
        return 0

    def _follow(self, code: int) -> None:
        """What comes after the reply."""
        if code == CONFIGURE:
            self._deaf_until_s = time.monotonic() + self.settings.deaf_s
        elif code == RECORD_STOP and self.recording:
            self._complete()

    def _clear(self) -> None:
        self.recording, self._carry = False, b""
        self.configuration, self.packet_delay_s = None, None

    def _status(self, bits: int) -> None:
        """Asynchronous status to the host."""
        self._replies.send(_REPLY.pack(HEADER, ASYNC_STATUS, bits, FOOTER))

    def _send_reply(self, packet: bytes) -> None:
        if self._peer is not None and self._powered:
            with contextlib.suppress(OSError):
                self._socket.sendto(packet, self._peer)

    def _target(self) -> tuple[str, int] | None:
        if self.data_target is not None:
            return self.data_target
        return (self._peer[0], self._data_port) if self._peer is not None else None

    def _send_data(self, packet: bytes) -> None:
        target = self._target()
        if target is not None and self._powered:
            with contextlib.suppress(OSError):
                self._socket.sendto(packet, target)

    def _complain(self, what: str) -> None:
        if what not in self.violations[-1:]:
            self.violations.append(what)


_KNOWN = {
    *(RESET_FPGA, RESET_RADAR, CONFIGURE, EEPROM, RECORD_START, RECORD_STOP),
    *(ALIVE, ASYNC_STATUS, PACKET_DELAY, FPGA_VERSION),
}


def adc_bytes(samples: Int16) -> memoryview:
    """Samples as they cross the lanes: little endian int16, in the capture's order."""
    return np.ascontiguousarray(samples, dtype="<i2").data.cast("B")
