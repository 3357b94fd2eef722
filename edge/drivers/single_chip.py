# SPDX-License-Identifier: Apache-2.0
"""Driver of a single-chip radar on a capture card: the demo's command line and the DCA1000 as one board.

Order (mmwave-capture-std, xwr): record stop, radar reset, card configured, radar configured; the record start comes
before frames start, otherwise the count of bytes is not aligned to frames. The first ``sensorStart`` calibrates for
seconds; it is given, and ended, while the radar is configured, so that the start that is timed is ``sensorStart 0``.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import time
from dataclasses import dataclass

from edge.board_settings import CaptureCardBoard
from edge.cli_text import cli_lines
from edge.constraints import DCA1000_PAYLOAD_BYTES
from edge.drivers.board import Progress, StartTimes
from edge.drivers.dca1000.assembler import FrameAssembler
from edge.drivers.dca1000.control import CaptureCard
from edge.drivers.dca1000.packets import Code, Status, command, fpga_configuration, packet_delay
from edge.drivers.dca1000.receiver import CardReceiver, PacketSocket
from edge.drivers.demo_cli import DemoCli, find_cli_port
from edge.errors import DeviceError, LinkError
from edge.frames import RadarId
from edge.waveform import Schedule

FIRST_FRAME_S = 2.0
"""And three frame periods: from the answer to sensorStart to the first packet, or there are no frames."""
COMPLETED_S = 1.0
"""From record stop to the report that the recording is complete."""
LAST_PACKETS_S = 0.02
"""After that report: what is still on its way through the host."""
AGAIN = "sensorStart 0"
STOP = "sensorStop"


@dataclass(frozen=True, slots=True)
class Timing:
    """Bytes and times of one schedule on a capture card.

    Args:
        frame_bytes, chirp_bytes: of one frame, of one chirp.
        first_chirps: chirps that are over before the packet with a frame's first byte can leave.
        chirp_s: chirp to chirp.
        period_s: frame to frame.
    """

    frame_bytes: int
    chirp_bytes: int
    first_chirps: int
    chirp_s: float
    period_s: float

    @classmethod
    def of(cls, schedule: Schedule) -> Timing:
        """Of a single-chip schedule."""
        nbytes = schedule.frame_bytes
        chirp_bytes = nbytes // (schedule.loops * schedule.slots)
        chirps = -(-min(DCA1000_PAYLOAD_BYTES, nbytes) // chirp_bytes)
        return cls(nbytes, chirp_bytes, chirps, schedule.profile.chirp_time_s, schedule.frame_period_s_actual)

    @property
    def delay_ns(self) -> int:
        """From the first chirp to the packet with the frame's first byte, at the least."""
        return round(1e9 * self.first_chirps * self.chirp_s)

    @property
    def waiting_bytes(self) -> int:
        """Bytes of the first frame that do not fill a packet: they wait for the next frame's."""
        return self.frame_bytes % DCA1000_PAYLOAD_BYTES

    def wait_text(self) -> str:
        """What of a frame waits for the next one, for people."""
        size, payload = self.frame_bytes, DCA1000_PAYLOAD_BYTES
        if not self.waiting_bytes:
            return f"a frame fills {size // payload} packets, nothing waits for the next frame"
        return (
            f"a frame is {size} bytes, of which up to {payload - 1} ({self.waiting_bytes} of the first frame's) wait "
            f"{1e3 * self.period_s:.1f} ms for the next frame; those of the last frame for the record stop"
        )


class SingleChipDriver:
    """One radar: a ``Board``.

    Args:
        radar: which one.
        schedule: of a single-chip radar.
        board: where it is reached.
        keep_frames: frames that may wait in the receiver for whoever takes them.
    Attributes:
        receiver: frames as they come; None before ``connect``.
        card, cli: None before ``connect``.
        timing: bytes and times of the schedule.
        frames: as ``arm`` was told; the one who takes frames counts them, the radar goes on until ``stop``.
    """

    def __init__(self, radar: RadarId, schedule: Schedule, board: CaptureCardBoard, keep_frames: int = 64) -> None:
        self.radar, self.schedule, self.board = radar, schedule, board
        self.timing, self.frames, self._keep = Timing.of(schedule), 0, keep_frames
        self._lines = cli_lines(schedule)
        self.card = CaptureCard(board, f"{radar} card")
        self.cli: DemoCli | None = None
        self.receiver: CardReceiver | None = None

    def plan(self) -> list[str]:
        """Every command to the card as hex, every line to the radar, in order; and what waits for the next frame."""
        b, timing = self.board, self.timing
        port = b.port or f"USB serial number {b.serial_number}" if b.port or b.serial_number else "the only one on USB"
        delay, fpga = packet_delay(self.schedule.packet_delay_s), fpga_configuration(self.schedule.lvds_lanes)
        first = (Code.RECORD_STOP, Code.RESET_RADAR, Code.SYSTEM_ALIVE, Code.FPGA_VERSION)
        return [
            f"{self.radar}: commands UDP {b.host_address}:{b.command_port} -> {b.card_address}:{b.command_port}, "
            f"samples to {b.host_address}:{b.data_port}, receive buffer {b.receive_buffer_bytes} bytes",
            f"{self.radar}: command line on {port}, {b.baud_rate} baud",
            f"{self.radar}: {timing.wait_text()}",
            *(self._udp(code) for code in first),
            self._udp(Code.PACKET_DELAY, delay),
            self._udp(Code.CONFIGURE_FPGA, fpga),
            f"{self._udp(Code.SYSTEM_ALIVE)}, up to 30 times",
            *(self._line(line) for line in [*self._lines, STOP]),
            self._udp(Code.RECORD_START),
            self._line(AGAIN),
            f"{self.radar}: frames of {timing.frame_bytes} bytes every {1e3 * timing.period_s:.3f} ms",
            self._line(STOP),
            self._udp(Code.RECORD_STOP),
        ]

    def connect(self) -> None:
        """Open sockets and serial port, and see that the card answers.

        Raises:
            LinkError: nothing answers, or an address or port is not to be had.
        """
        self.close()
        name = f"{self.radar} radar"
        try:
            self.card.open()
            self.card.request(Code.SYSTEM_ALIVE)
            port = self.board.port or find_cli_port(self.board.serial_number, name)
            self.cli = DemoCli(port, name, self.board.baud_rate)
            packets = PacketSocket(self.board.host_address, self.board.data_port, self._buffer_bytes)
            assembler = FrameAssembler(self.timing.frame_bytes, self.timing.chirp_bytes, self._sender())
            self.receiver = CardReceiver(packets, assembler, self.radar, self._keep).start()
        except BaseException:
            self.close()
            raise

    def configure(self, progress: Progress) -> list[str]:
        """Reset the radar, write all settings to card and radar, let it calibrate.

        Returns:
            Version of the card, what the radar said besides Done, notes of the host.
        Raises:
            RefusalError: of card or radar.
            LinkError: no answer, and again none after another reset of the radar.
        """
        try:
            return self._configure(progress)
        except LinkError:
            return self._configure(progress)

    def arm(self, frames: int) -> None:
        """Start the recording. LinkError, RefusalError: of the card."""
        self.card.poll()
        self._receiver.begin()
        self.card.record()
        self.frames = frames

    def start(self) -> StartTimes:
        """``sensorStart 0``.

        Returns:
            ``frame_ready_ns`` is the arrival of the first packet; None: frames wait for pulses.
        Raises:
            LinkError: no answer, or no frames.
            RefusalError: of the radar.
        """
        sent_ns = self._cli.send(AGAIN)
        self._cli.answer(AGAIN)
        answered_ns = time.monotonic_ns()
        if self.schedule.hardware_trigger:
            return StartTimes(sent_ns, answered_ns)
        first_ns = self._receiver.wait_first(FIRST_FRAME_S + 3 * self.timing.period_s)
        if first_ns is None:
            raise self.no_samples()
        return StartTimes(sent_ns, answered_ns, first_ns)

    def stop(self) -> None:
        """End frames and recording; every byte that the card still has comes. LinkError, RefusalError."""
        try:
            self._cli.command(STOP)
        finally:
            self.card.stop()
            self.card.wait_status(Status.RECORD_COMPLETED, COMPLETED_S)
            time.sleep(LAST_PACKETS_S)
            self._receiver.finish()
            self.card.poll()

    def reception(self) -> str:
        """What the receiver counted since ``connect``, for people; "" before."""
        return "" if self.receiver is None else self.receiver.counters().text()

    def close(self) -> None:
        """Give everything back; never raises."""
        if self.receiver is not None:
            with contextlib.suppress(DeviceError, OSError):
                self.receiver.close()
        if self.cli is not None:
            self.cli.close()
        self.card.close()
        self.cli = self.receiver = None

    def check(self) -> list[str]:
        """What the card reported since the last call, in words; to be called now and then while it records.

        Raises:
            LinkError: no samples reach the card, or it ended the recording because none came.
        """
        notes = []
        for report in self.card.poll():
            if Status.NO_LVDS_DATA in report.status:
                raise self.no_samples()
            if Status.RECORD_COMPLETED in report.status:
                raise self.ended()
            notes.append(f"{self.card.name}: {report.status.text()}")
        return notes

    def ended(self) -> LinkError:
        """The card ended the recording by itself."""
        return LinkError(
            f"{self.radar} radar stopped sending: its card ended the recording",
            action="the radar restarted or hangs: check its supply (5 V, 2.5 A); configure it again",
        )

    def no_samples(self) -> LinkError:
        """The card receives nothing from the radar, or this host nothing from the card."""
        return LinkError(
            f"no samples of the {self.radar} radar",
            value=f"{self.card.counts[Status.NO_LVDS_DATA]} reports NO_LVDS_DATA",
            allowed="packets on UDP port " + str(self.board.data_port),
            action="does the radar run (queryDemoStatus)? is the 60-pin cable to the card in place, lvdsStreamCfg on? "
            "is UDP let through by the firewall? with a hardware trigger: do pulses come?",
        )

    def _sender(self) -> int:
        """Address of the card as it lies in memory."""
        try:
            return int.from_bytes(socket.inet_aton(socket.gethostbyname(self.board.card_address)), sys.byteorder)
        except OSError as error:
            raise LinkError(f"{self.card.name} has no address", value=self.board.card_address) from error

    @property
    def _buffer_bytes(self) -> int:
        return max(self.board.receive_buffer_bytes, 2 * self.timing.frame_bytes)

    @property
    def _cli(self) -> DemoCli:
        if self.cli is None:
            raise LinkError(f"{self.radar} radar is not connected", action="call connect first")
        return self.cli

    @property
    def _receiver(self) -> CardReceiver:
        if self.receiver is None:
            raise LinkError(f"{self.radar} card is not connected", action="call connect first")
        return self.receiver

    def _configure(self, progress: Progress) -> list[str]:
        card, total = self.card, len(self._lines) + 2
        progress(f"{self.radar}: reset", 0, total)
        card.stop()
        self._cli.discard()
        card.do(Code.RESET_RADAR)
        card.poll()
        card.wait_alive()
        notes = [f"{card.name}: FPGA version {card.version().text()}", *self._receiver.notes]
        card.configure(self.schedule.packet_delay_s, self.schedule.lvds_lanes)
        progress(f"{self.radar}: card configured", 1, total)
        self._cli.wait_prompt()
        for done, line in enumerate([*self._lines, STOP], 2):
            said = self._cli.command(line)
            notes += [f"{self.radar} radar: {line}: {text}" for text in said if _worth_telling(text)]
            progress(f"{self.radar}: {line.split()[0]}", done, total)
        return notes

    def _udp(self, code: Code, data: bytes = b"") -> str:
        return f"{self.radar}: UDP {command(code, data).hex()} {code.name}"

    def _line(self, line: str) -> str:
        return f"{self.radar}: CLI {line}"


def _worth_telling(text: str) -> bool:
    """Calibration status and warnings, not what every line brings."""
    return text != "Done" and not text.startswith(("Ignored", "Skipped"))
