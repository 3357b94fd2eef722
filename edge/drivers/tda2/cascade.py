# SPDX-License-Identifier: Apache-2.0
"""One cascade radar on its capture board: configured, armed, started, stopped; errors are named or tried again."""

from __future__ import annotations

import contextlib
import logging
import time
from dataclasses import replace
from pathlib import Path

from edge.board_settings import CascadeBoard
from edge.config import require
from edge.drivers.board import Progress, StartTimes
from edge.drivers.tda2 import rhcp
from edge.drivers.tda2 import steps as s
from edge.drivers.tda2.chips import Chips, CommandRefusedError
from edge.drivers.tda2.firmware import IMAGE_BYTES, chunks, load_image
from edge.drivers.tda2.link import AnswerTimeoutError, Link, LinkLostError
from edge.drivers.tda2.packets import BOARD, CHIPS, MASTER, AckType, Opcode, Packet, device_name
from edge.drivers.tda2.plan import STOP_ORDER, Plan, describe, describe_reading, order_packet
from edge.drivers.tda2.reports import boot_note, check_calibration, chip_notes, temperatures
from edge.drivers.tda2.rhcp import Event
from edge.drivers.tda2.steps import Command, Order, Step
from edge.drivers.tda2.timeouts import CONFIGURE_TRIES, CONNECT_TRIES, TimeOuts
from edge.errors import DeviceError, FirmwareError, RefusalError, RfconstructError
from edge.frames import RadarId
from edge.waveform import Schedule

MOST_FRAMES = 65535
_LOG = logging.getLogger(__name__)
_SLAVES_PHASE = 1


class CascadeDriver:
    """A cascade (TI MMWCAS-RF-EVM) and its recorder (MMWCAS-DSP-EVM), by TCP. Follows ``edge.drivers.board.Board``.

    After an error of ``arm`` or ``start``: ``stop``, then ``arm`` again, or ``configure`` when that fails too. After a
    LinkLostError: ``connect`` and ``configure``. Boards are configured one after the other: two at once were seen to
    run into time-outs.

    Args:
        radar: which one of the rig.
        schedule: what it sends.
        board: where it is.
        rig_directory: where a relative path of the firmware image starts.
        timeouts: waits.
    Attributes:
        directory: of the present or last capture on the board; "": none yet.
        version: of the capture board's software, once connected.
    Raises:
        ConfigError: a schedule of another device, or a storage folder that no order can carry.
    """

    def __init__(
        self,
        radar: RadarId,
        schedule: Schedule,
        board: CascadeBoard,
        rig_directory: Path,
        timeouts: TimeOuts | None = None,
    ) -> None:
        require(schedule.is_cascade, f"radars.{radar}: device", schedule.profile.chip.name, "the cascade (AWR2243)")
        storage = board.storage
        require(storage.isascii() and len(storage) <= 200, "board.storage", storage, "at most 200 ASCII characters")
        self.radar: RadarId = radar
        self.directory = self.version = ""
        self._board, self._rig_directory, self._timeouts = board, rig_directory, timeouts or TimeOuts()
        self._plan = Plan(schedule, board, [], board.segment_frames)
        self._link = Link(radar, board.address, board.control_port, self._timeouts)
        self._chips = Chips(radar, self._link, self._timeouts)
        self._answers: dict[tuple[int, int], bytes] = {}
        self._programmed: int | None = None
        self._frames, self._began_ns, self._recording = 0, 0, False
        self._started: list[int] = []

    def plan(self) -> list[str]:
        """Every packet from connect to close in order, as hexadecimal bytes; waits and pauses between them."""
        board = self._board
        lines = [f"{self.radar} radar: cascade with capture board at {board.address}:{board.control_port}"]
        try:
            image = load_image(board.firmware, self._rig_directory)
        except FirmwareError as error:
            image = bytes(IMAGE_BYTES)
            lines.append(f"firmware image not at hand, its bytes are shown as 00: {error}")
        plan, frames = replace(self._plan, chunks=chunks(image)), board.segment_frames
        parts = [
            *plan.connect(int(time.time())),
            *plan.master(),
            *plan.slaves(),
            *plan.common(),
            *plan.record(self._new_directory(), frames),
            *plan.start(),
            *(replace(step, phase="early") for step in plan.stop()),
            plan.stop_record(),
            *plan.disconnect(),
        ]
        lines.append("trace file and directory carry the time, so their bytes differ from run to run")
        lines.append(f'the chips stop by themselves after {frames} frames; lines "early" are sent only before that')
        return lines + describe_reading() + describe(parts, self._timeouts)

    def connect(self) -> None:
        """Open the connection and greet the board; within 2 x 15 s.

        Raises:
            LinkError: nothing answers, or another host is being served; tried twice.
            RefusalError: the board refused an order.
        """
        for attempt in range(CONNECT_TRIES):
            self._link.open()
            self._forget_capture()
            try:
                for step in self._plan.connect(int(time.time())):
                    self._do(step)
                return
            except (AnswerTimeoutError, LinkLostError) as error:
                self._link.close()
                if attempt + 1 == CONNECT_TRIES:
                    raise
                _LOG.warning("%s; connecting again", error)
                time.sleep(self._timeouts.before_reconnect_s)
            except DeviceError:
                self._link.close()
                raise

    def configure(self, progress: Progress) -> list[str]:
        """Firmware, RF part, calibration, profile, chirps and frame of all four chips; about 40 s on a real board.

        What does not answer, answers garbage or NACK, or reports a fault is reset and configured anew, the slaves alone
        when the master is up; a broken connection is made again. Three tries in all: a board that falls silent is
        named within 10 s, one that is off within 4 s, a chip that stays silent within 10 s. A chip's refusal of a value
        is final.

        Args:
            progress: called before each step.
        Returns:
            Versions, result of the initial calibration and temperature of each chip.
        Raises:
            FirmwareError: before anything is sent.
            LinkError, RefusalError, ChipFaultError: what went wrong in the last try.
        """
        image = load_image(self._board.firmware, self._rig_directory)
        plan = replace(self._plan, chunks=chunks(image))
        phases = (plan.master(), plan.slaves(), plan.common())
        self._programmed, first, tries = None, 0, 0
        while True:
            tries += 1
            failed = 0
            try:
                for failed in range(first, len(phases)):
                    self._do_phase(phases, failed, progress)
                break
            except DeviceError as error:
                if isinstance(error, CommandRefusedError) and error.code not in rhcp.TRANSIENT:
                    raise
                if tries == CONFIGURE_TRIES:
                    what = f"{error.what} ({tries} tries)"
                    raise type(error)(what, value=error.value, allowed=error.allowed, action=error.action) from error
                _LOG.warning("%s; configuring again", error)
                first = _SLAVES_PHASE if failed == _SLAVES_PHASE else 0
                if isinstance(error, LinkLostError):
                    first = 0
                    time.sleep(self._timeouts.before_reconnect_s)
                    self.connect()
        self._programmed = self._plan.frames
        return self._notes()

    def arm(self, frames: int) -> None:
        """Recorder on, slaves waiting for the master; about 3 s. The capture goes to a new ``directory``.

        Args:
            frames: to send and record; 0: until stopped.
        Raises:
            ConfigError: more frames than the chips can count.
            DeviceError: see the class.
        """
        require(0 <= frames <= MOST_FRAMES, "frames of a capture", frames, f"0..{MOST_FRAMES}")
        if frames != self._programmed:
            self._programmed = None
            for step in self._plan.reprogram(frames):
                self._do(step)
            self._programmed = frames
        self._forget_capture()
        self._frames = frames
        try:
            self._start_record()
        except RefusalError as error:
            _LOG.warning("%s; a recording of an earlier host may be open: it is stopped", error)
            self._recording = False
            with contextlib.suppress(RefusalError):
                self._do(self._plan.stop_record())
            self._start_record()
        for step in self._plan.start()[:-1]:
            self._started += step.devices
            self._do(step)

    def start(self) -> StartTimes:
        """Start the master, and with it all frames.

        Returns:
            answered_ns: the board's acknowledgement that it has the command; frame_ready_ns: the interrupt of the
            chip's report, None when the trigger is external and no report came.
        """
        if not self._recording:
            raise DeviceError(f"{self.radar} radar was started before it was armed", action="arm it first")
        command = self._plan.start()[-1].action
        assert isinstance(command, Command), "frames are started by a command"
        self._started.append(MASTER)
        answer = self._chips.run((MASTER,), command)[MASTER]
        self._began_ns = answer.acknowledged_ns
        ready_ns: int | None = None
        try:
            ready_ns = self._chips.event(MASTER, Event.FRAME_STARTED, self._timeouts.frame_started_s).t_ns
        except AnswerTimeoutError:
            if not self._plan.schedule.hardware_trigger:
                raise
        return StartTimes(answer.sent_ns, answer.acknowledged_ns, ready_ns)

    def wait_ended(self, timeout_s: float) -> bool:
        """Wait until all chips have reported the end of a given number of frames; whether they have."""
        end_s = time.monotonic() + timeout_s
        for device in list(self._started):
            try:
                self._chips.event(device, Event.FRAME_ENDED, max(0.0, end_s - time.monotonic()))
            except AnswerTimeoutError:
                return False
            self._started.remove(device)
        return True

    def stop(self) -> None:
        """End frames and recording, whatever state they are in; within 25 s.

        When the frames must be over by themselves, their end is waited for. All chips and the recorder are told even
        if one of them does not answer; the first error is raised afterwards.
        """
        errors: list[DeviceError] = []
        try:
            self._end_frames(errors)
        except DeviceError as error:
            errors.append(error)
        if self._recording:
            try:
                self._do(self._plan.stop_record())
            except DeviceError as error:
                errors.append(error)
        self._forget_capture()
        if errors:
            raise errors[0]

    def temperatures(self) -> dict[str, dict[str, int]]:
        """Chip -> sensor -> degrees Celsius; ask only while no frames run."""
        read = self._chips.run(CHIPS, Command("temperatures", s.TEMPERATURE))
        return {device_name(device): temperatures(self._name(device), got.data) for device, got in read.items()}

    def close(self) -> None:
        """Stop what runs, say goodbye, end the connection; a board that does not answer is left after 3 s."""
        if self._link.is_open:
            try:
                if self._recording or self._started:
                    ping = Packet(Opcode.PING, BOARD, AckType.RECEIVED)
                    self._link.order(ping, Opcode.ACK, self._timeouts.spi_s, "ping")
                    self.stop()
                for step in self._plan.disconnect():
                    self._do(step)
            except RfconstructError as error:
                _LOG.info("%s board was left without goodbye: %s", self.radar, error)
        self._link.close()
        self._forget_capture()

    # --- steps

    def _do_phase(self, phases: tuple[list[Step], ...], phase: int, progress: Progress) -> None:
        before, total = sum(len(steps) for steps in phases[:phase]), sum(len(steps) for steps in phases)
        for number, step in enumerate(phases[phase]):
            progress(step.text, before + number, total)
            self._do(step)
        progress(f"{self.radar} radar: {phases[phase][-1].phase} done", before + len(phases[phase]), total)

    def _do(self, step: Step) -> None:
        action = step.action
        if isinstance(action, Order):
            for device in step.devices:
                self._order(device, action)
        else:
            for device, answer in self._chips.run(step.devices, action).items():
                self._answers[device, action.block] = answer.data
        if action.event is not None:
            for device in step.devices:
                event = self._chips.event(device, action.event, getattr(self._timeouts, action.event_wait))
                self._answers[device, action.event] = event.data
                if action.event == Event.CALIBRATED:
                    check_calibration(self._name(device), event.data)
        if isinstance(action, Order) and action.pause:
            time.sleep(getattr(self._timeouts, action.pause))

    def _order(self, device: int, order: Order) -> None:
        if order.opcode == Opcode.DEVICE_RESET:
            self._chips.forget(device)
        wait_s = getattr(self._timeouts, order.wait)
        answer = self._link.order(order_packet(device, order), order.reply, wait_s, order.name)
        if order.opcode == Opcode.VERSION_GET:
            self.version = answer.data.rstrip(b"\0").decode("ascii", "replace")

    def _start_record(self) -> None:
        self.directory = self._new_directory()
        for step in self._plan.record(self.directory, self._frames):
            self._recording |= isinstance(step.action, Order) and step.action.opcode == Opcode.START_RECORD
            self._do(step)

    def _end_frames(self, errors: list[DeviceError]) -> None:
        if self._frames and MASTER in self._started:
            period_s = self._plan.schedule.frame_period_s_actual
            left_s = self._frames * period_s - 1e-9 * (time.monotonic_ns() - self._began_ns)
            if left_s < 0.5 * period_s:
                self.wait_ended(max(0.0, left_s) + self._timeouts.frame_ended_s)
        for device in [device for device in STOP_ORDER if device in self._started]:
            try:
                self._end_chip(device)
            except LinkLostError:
                raise
            except DeviceError as error:
                errors.append(error)
        self._started.clear()

    def _end_chip(self, device: int) -> None:
        self._chips.poll(device)
        if self._chips.take(device, Event.FRAME_ENDED):
            return
        try:
            command = s.trigger_step("stop", device, s.STOP).action
            assert isinstance(command, Command), "frames are stopped by a command"
            self._chips.run((device,), command)
            self._chips.event(device, Event.FRAME_ENDED, self._timeouts.frame_ended_s)
        except CommandRefusedError as error:
            if error.code != rhcp.ALREADY_STOPPED:
                raise

    def _forget_capture(self) -> None:
        self._started, self._recording = [], False

    def _new_directory(self) -> str:
        """A name that was not used before: an old one would be written to with a suffix."""
        while True:
            now_ms = time.time_ns() // 1_000_000
            stamp = time.strftime("%Y%m%d_%H%M%S", time.gmtime(now_ms // 1000))
            name = f"{self._board.storage.rstrip('/')}/{self.radar}_{stamp}_{now_ms % 1000:03d}"
            if name != self.directory:
                return name
            time.sleep(1e-3)

    def _notes(self) -> list[str]:
        boots = {device: self._chips.take(device, Event.BOOT_STATUS) for device in CHIPS}
        boot_notes = [boot_note(self._name(device), event.data) for device, event in boots.items() if event]
        counts = (
            (self._chips.repeated, "commands repeated after NACK"),
            (self._chips.spurious, "interrupts with nothing to read"),
            (self._link.strays, "answers that fitted no order"),
        )
        return [
            f"{self.radar} capture board: {self.version or 'no version text'}",
            *chip_notes(self.radar, self._answers),
            *filter(None, boot_notes),
            *(f"{self.radar} radar: {count} {what}" for count, what in counts if count),
        ]

    def _name(self, device: int) -> str:
        return f"{self.radar} radar, {device_name(device)}"
