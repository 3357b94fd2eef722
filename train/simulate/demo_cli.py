# SPDX-License-Identifier: Apache-2.0
"""A single-chip radar with TI's demo: its command line on a pseudo-terminal, its samples to a capture card.

Source: hardware notes 4.1. The terminal is raw: what the firmware echoes, the terminal does not. Baud rate and the data
port of the demo are not emulated.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from edge.devices import DEVICES
from edge.errors import CaptureError
from edge.frames import RadarFrame, RadarId
from train.simulate.dca1000_board import adc_bytes
from train.simulate.demo_firmware import DemoConfiguration, DemoFirmware
from train.simulate.faults import Fault, Faults, FaultyChannel
from train.simulate.frame_faults import FrameFaults
from train.simulate.supplies import FrameSupply, SupplyClosedError
from train.simulate.threads import JOIN_S, Bursts, Later, join

PROMPT = "mmwDemo:/>"
LONGEST_LINE = 256
_RULE = "*" * 42
Lvds = Callable[[memoryview, float], None]
"""Takes one frame's bytes and the frame period in seconds."""


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """How one emulated radar behaves.

    Args:
        device: AWR1843, IWR6843 or AWR2944.
        link: a symbolic link that always leads to the terminal; None: none.
        pace: speed of its frames, 1: real time, 0: as fast as they are sent.
        start_s: time sensorStart takes; real boards need 1 to 3 s.
        restart_s: time ``sensorStart 0`` takes.
        boot_s: from reset to the banner.
        line_end: of what it writes.
        clock_ppm: by which its clock, and so its frames, run fast.
    """

    device: str = "AWR1843"
    link: Path | None = None
    pace: float = 1.0
    start_s: float = 1.0
    restart_s: float = 0.05
    boot_s: float = 0.2
    line_end: str = "\r\n"
    clock_ppm: float = 0.0


class DemoRadar:
    """One radar.

    Args:
        radar: which radar of the rig it is.
        supply: its frames, in the layout that the host configures; called on a thread of the radar.
        lvds: takes the samples, usually ``Dca1000Board.lvds``.
        settings: behaviour.
        faults: channels ``<radar>/cli`` and ``<radar>/frames``.
    Attributes:
        firmware: state and decoded configuration.
        lines: every line that came.
        next_number: frame that the next burst shows.
        bursts: sent since it was made.
    Raises:
        CaptureError: a device that this demo does not run on.
    """

    def __init__(
        self,
        radar: RadarId,
        supply: FrameSupply,
        lvds: Lvds,
        settings: DemoSettings | None = None,
        faults: Faults | None = None,
    ) -> None:
        self.radar, self.settings, self._faults = radar, settings or DemoSettings(), faults
        if self.settings.device not in ("AWR1843", "IWR6843", "AWR2944"):
            known = "AWR1843, IWR6843, AWR2944"
            raise CaptureError("no demo for this device", value=self.settings.device, allowed=known)
        device = DEVICES[self.settings.device]
        self.firmware, self.lines = DemoFirmware(device, self._begin, self._end), list[str]()
        self.next_number = self.bursts = 0
        self.first_number: Callable[[], int] | None = None
        """Asked for the number of the next frame when frames start; None: numbers go on where they stopped."""
        self.port = ""
        """Path of the terminal; "" while it is unplugged."""
        self._supply, self._lvds, self._frame_faults = supply, lvds, FrameFaults(faults, radar)
        self._later, self._closing = Later(f"{radar} radar"), threading.Event()
        self._channel = FaultyChannel(faults, f"{radar}/cli", self._emit, self._later, self._pull)
        self._lock = threading.RLock()
        self._running: Bursts | None = None
        self._dry: Bursts | None = None
        self._ended: list[Bursts] = []
        self._pending = b""
        self._master, self._slave = -1, -1
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK)
        self._pulled = self._reset_asked = self._lost_power = False
        self._thread = threading.Thread(target=self._run, name=f"{radar} cli", daemon=True)
        self._open()

    def start(self) -> DemoRadar:
        """Power on: banner and prompt."""
        self._boot()
        self._thread.start()
        return self

    def stop(self) -> bool:
        """Power off for good; whether all threads ended."""
        self._closing.set()
        self._wake()
        with self._lock:
            self._end()
        ended = [join(self._thread), self._later.close(), *(bursts.stop() for bursts in self._ended)]
        self._close()
        for handle in (self._wake_read, self._wake_write):
            if handle >= 0:
                os.close(handle)
        self._wake_read = self._wake_write = -1
        return all(ended)

    def __enter__(self) -> DemoRadar:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def streaming(self) -> bool:
        """Frames are running."""
        running = self._running
        return running is not None and running.alive

    @property
    def late(self) -> int:
        """Bursts that began more than half a period late because the frames were made or sent too slowly."""
        present = [self._running] if self._running is not None else []
        return sum(bursts.late for bursts in [*self._ended, *present])

    def reset(self) -> None:
        """The reset line: everything configured is lost, banner and prompt come again."""
        with self._lock:
            self._end()
            self.firmware.reset()
            self._reset_asked = True
        self._wake()

    def unplug(self) -> None:
        """USB and supply gone: the terminal disappears under the reader, the frames end."""
        with self._lock:
            self._end()
            self.firmware.reset()
            self._lost_power = True
        self._pull()
        for _ in range(int(JOIN_S / 0.005)):
            if not self.port or threading.current_thread() is self._thread:
                return
            self._closing.wait(0.005)

    def plug(self) -> None:
        """A new terminal, usually of another name; ``link`` leads to it."""
        with self._lock:
            if not self.port:
                self._pulled = False
                self._open()
                if self._lost_power:
                    self._lost_power = False
                    self._boot()
        self._wake()

    def pulse(self) -> None:
        """A trigger pulse on SYNC_IN, for frames that start by hardware."""
        if self._running is not None:
            self._running.pulse()

    # --- terminal

    def _open(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        link = self.settings.link
        if link is not None:
            link.parent.mkdir(parents=True, exist_ok=True)
            link.unlink(missing_ok=True)
            link.symlink_to(self.port)

    def _close(self) -> None:
        for handle in (self._master, self._slave):
            if handle >= 0:
                os.close(handle)
        self._master = self._slave = -1
        self.port, self._pending = "", b""
        if self.settings.link is not None:
            self.settings.link.unlink(missing_ok=True)

    def _pull(self) -> None:
        self._pulled = True
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"x")

    def _run(self) -> None:
        while not self._closing.is_set():
            with self._lock:
                if self._pulled and self._master >= 0:
                    self._close()
                if self._reset_asked:
                    self._reset_asked, self._pending = False, b""
                    self._boot()
                handles = [self._wake_read, *([self._master] if self._master >= 0 else [])]
            ready, _, _ = select.select(handles, [], [], 1.0)
            if self._wake_read in ready:
                with contextlib.suppress(BlockingIOError):
                    os.read(self._wake_read, 64)
            elif ready:
                self._read()

    def _read(self) -> None:
        try:
            data = os.read(self._master, 1024)
        except (BlockingIOError, OSError):
            return
        end = self.settings.line_end.encode()
        self._emit(data.replace(b"\r", b"").replace(b"\n", end))
        self._pending += data
        *lines, self._pending = self._pending.replace(b"\r", b"").split(b"\n")
        self._pending = self._pending[-LONGEST_LINE - 1 :]
        for line in lines:
            if self._reset_asked or self._pulled or self._closing.is_set():
                return
            self._line(line[: LONGEST_LINE + 1].decode("ascii", "replace"))

    def _line(self, line: str) -> None:
        self.lines.append(line)
        refused = self._faults is not None and self._faults.hit(Fault.NACK, f"{self.radar}/cli")
        with self._lock:
            starts = self.firmware.starts
            if refused:
                answer = ["Error -1"]
            elif len(line) > LONGEST_LINE:
                answer = [f"'{line[:20]}' is not recognized as a CLI command"]
            else:
                answer = self.firmware.execute(line)
            started = self.firmware.starts > starts
        if started:
            again = line.split()[1:] == ["0"]
            if self._closing.wait(self.settings.restart_s if again else self.settings.start_s) or self._reset_asked:
                return
        self._say(answer)

    def _boot(self) -> None:
        banner = [_RULE, f"{self.settings.device} mmWave demo, emulated", _RULE]
        self._later.call(self.settings.boot_s, self._say, banner)

    def _say(self, lines: list[str]) -> None:
        text = "".join(line + self.settings.line_end for line in lines) + PROMPT
        self._channel.send(text.encode())

    def _emit(self, data: bytes) -> None:
        """Write to the terminal; what a full terminal does not take is lost, as on a serial line."""
        if self._master >= 0:
            with contextlib.suppress(OSError):
                os.write(self._master, data)

    # --- frames

    def _begin(self, configuration: DemoConfiguration) -> None:
        """Frames start, under the lock of the command line."""
        frame = configuration.frame
        assert frame is not None, "the firmware starts only a complete configuration"
        if self.first_number is not None:
            self.next_number = self.first_number()
        s = self.settings
        period_s = 1e-3 * frame.period_ms / (1.0 + 1e-6 * s.clock_ppm)
        wall_s = period_s / s.pace if s.pace > 0 else 0.0
        first_s = self._frame_faults.late_s() / s.pace if s.pace > 0 else 0.0
        running = Bursts(lambda _: self._burst(running), wall_s, frame.frames, first_s, None, frame.trigger == 2)
        self._running = running
        running.start()

    def _end(self) -> None:
        running, self._running = self._running, None
        if running is not None:
            running.halt()
            self._ended.append(running)

    def _burst(self, bursts: Bursts) -> None:
        if self._faults is not None and self._faults.hit(Fault.UNPLUG, self._frame_faults.where):
            self.unplug()
            return
        configuration = self.firmware.configuration
        number = self.next_number
        try:
            frames = self._frame_faults.of(self._supply(self.radar, number))
        except SupplyClosedError:
            return
        except CaptureError as error:
            if self._dry is not bursts:
                self.firmware.violations.append(f"no frame {number}: {error}")
            self._dry, frames = bursts, []
        if self._running is not bursts or configuration.frame is None:
            return
        self.next_number += 1
        self.bursts += 1
        for frame in frames:
            self._stream(frame, configuration)

    def _stream(self, frame: RadarFrame, configuration: DemoConfiguration) -> None:
        _, header, kind, software = configuration.values["lvdsStreamCfg"]
        swap = configuration.values["adcbufCfg"][2]
        if kind != 1 or header or software:
            self._note("LVDS without raw samples, or with header or software data: nothing is streamed")
        elif frame.adc.nbytes != configuration.frame_bytes:
            self._note(f"{configuration.frame_bytes} bytes a frame configured, {frame.adc.nbytes} came")
        else:
            wanted, complex_ = "QI" if swap else "IQ", frame.layout.kind == "dca1000"
            as_is = not complex_ or frame.layout.iq_order == wanted
            adc = frame.adc if as_is else np.ascontiguousarray(frame.adc[..., [2, 3, 0, 1]])
            assert configuration.frame is not None, "checked by the caller"
            self._lvds(adc_bytes(adc), 1e-3 * configuration.frame.period_ms)

    def _note(self, what: str) -> None:
        if what not in self.firmware.violations:
            self.firmware.violations.append(what)
