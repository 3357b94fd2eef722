# SPDX-License-Identifier: Apache-2.0
"""One radar chip of the cascade board as its host sees it over SPI: messages in, answers and events out, all states."""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from train.simulate import chip_commands as c
from train.simulate.faults import Fault, Faults
from train.simulate.rhcp import (
    BadMessageError,
    CommandRefusedError,
    Direction,
    Kind,
    Message,
    Refusal,
    SubBlock,
    parse_header,
    sub_blocks,
)

SOP_FUNCTIONAL = 4
_INIT_BASE = 0x000E
"""APLL and both oscillators: calibrated at every initialisation."""
_INIT_MASK = 0x1FFE


@dataclass(frozen=True, slots=True)
class ChipDelays:
    """How long the chip takes; zero: at once. ``real`` is what the notes give.

    Args:
        power_up_s: reset to the power-up event.
        rf_power_up_s: RF power-up command to its event.
        rf_init_s: RF initialisation to its event.
        answer_s: any command to its answer.
        frame_ready_s: frame start to its event.
    """

    power_up_s: float = 0.0
    rf_power_up_s: float = 0.0
    rf_init_s: float = 0.0
    answer_s: float = 0.0
    frame_ready_s: float = 0.0

    @staticmethod
    def real() -> ChipDelays:
        """Orders of magnitude of real boards; the notes give only time-outs and sums."""
        return ChipDelays(0.3, 0.1, 0.3, 0.01, 0.05)


class CascadeChip:
    """State of one AWR2243.

    Args:
        number: 0 master, 1..3 slaves.
        where: channel of its SPI messages for the faults.
        delays: of its answers.
        faults: rules; None: none.
        later: ``later(delay_s, function)`` calls back under the board's lock.
        signal: called when there is something to read.
        complain: takes every breach of the protocol, in words.
        moved: ``moved(chip)`` when its frames start or stop.
    Attributes:
        settings: sub-block -> data as last accepted, for commands that are not decoded further.
        profiles, chirps, frame: decoded.
        running: frames are started; a slave waits for its master.
        init_status: bits of the initial calibration that the next RF initialisation reports; None: all that are asked.
        outbox: bytes of the messages that wait for the host, sync word not included.
    """

    def __init__(
        self,
        number: int,
        where: str,
        delays: ChipDelays,
        faults: Faults | None,
        later: Callable[[float, Callable[[], None]], None],
        signal: Callable[[], None],
        complain: Callable[[str], None],
        moved: Callable[[CascadeChip], None],
    ) -> None:
        self.number, self.master, self.sop = number, number == 0, 0
        self.temperature_c = 45
        self.init_status: int | None = None
        self.outbox: deque[bytes] = deque()
        self._where, self._delays, self._faults = where, delays, faults
        self._later, self._signal, self._complain, self._moved = later, signal, complain, moved
        self._life = 0
        self._booted_ns = time.monotonic_ns()
        self.running = False
        self._sequence: int | None = None
        self._clear()

    def power_off(self) -> None:
        """No supply: everything is forgotten."""
        self._life += 1
        was_running = self.running
        self._clear()
        if was_running:
            self._moved(self)

    def reset(self) -> None:
        """The reset line: boots by the SOP lines; only functional mode says that it is up."""
        self.power_off()
        self._booted_ns = time.monotonic_ns()
        if self.sop != SOP_FUNCTIONAL:
            self._complain(f"chip {self.number} was reset with SOP {self.sop}, not {SOP_FUNCTIONAL}: it stays silent")
            return

        def up() -> None:
            self.booted = True
            self._event(c.POWER_UP, bytes(32))

        self._after(self._delays.power_up_s, up)

    def receive(self, data: bytes) -> None:
        """One message of the host."""
        if not self.booted:
            self._complain(f"chip {self.number}: message to a chip that is not up")
            return
        try:
            header = parse_header(data)
        except BadMessageError as error:
            self._complain(f"chip {self.number}: {error}")
            if error.header is not None:
                self._sequence = (error.header.sequence + 1) % 16
                self._answer(error.header, Kind.NACK)
            return
        if self._sequence is not None and header.sequence != self._sequence:
            self._complain(f"chip {self.number}: sequence {header.sequence} instead of {self._sequence}")
            self._sequence = (header.sequence + 1) % 16
            self._answer(header, Kind.NACK)
            return
        self._sequence = (header.sequence + 1) % 16
        if self._faults is not None and self._faults.hit(Fault.SPI_NACK, self._where):
            self._answer(header, Kind.NACK)
            return
        try:
            self._obey(header, sub_blocks(data, header))
        except CommandRefusedError as error:
            self._complain(f"chip {self.number}: {error}")
            self._refuse(header, error.code, error.block)

    def end_frames(self) -> None:
        """The programmed number of frames is over."""
        if self.running:
            self.running = False
            self._event(c.FRAME_END, bytes(4))

    def _clear(self) -> None:
        self.outbox.clear()
        self.booted = self.running = self.applied = False
        self.settings: dict[int, bytes] = {}
        self.profiles: dict[int, c.Profile] = {}
        self.chirps: dict[int, c.Chirp] = {}
        self.frame: c.Frame | None = None
        self._done: set[int] = set()
        self._sequence = None
        self._chunks = 0

    def _after(self, delay_s: float, action: Callable[[], None]) -> None:
        """Do it after a delay unless the chip is reset before."""
        if delay_s <= 0:
            action()
            return
        life = self._life

        def act() -> None:
            if life == self._life:
                action()

        self._later(delay_s, act)

    def _post(self, message: Message, delay_s: float = 0.0) -> None:
        def put() -> None:
            self.outbox.append(message.to_bytes(c.CRC_TYPE in self._done))
            self._signal()

        self._after(delay_s, put)

    def _event(self, block: int, data: bytes) -> None:
        mss = block >= 0x4000
        identity = 0x280 if mss else 0x080
        direction = Direction.FROM_MSS if mss else Direction.FROM_BSS
        self._post(Message(direction, Kind.EVENT, identity, 0, (SubBlock(block, data),)))

    def _answer(self, asked: Message, kind: Kind = Kind.RESPONSE, blocks: tuple[SubBlock, ...] = ()) -> None:
        direction = Direction.FROM_MSS if asked.direction == Direction.TO_MSS else Direction.FROM_BSS
        self._post(Message(direction, kind, asked.identity, asked.sequence, blocks), self._delays.answer_s)

    def _refuse(self, asked: Message, code: int, block: int) -> None:
        direction = Direction.FROM_MSS if asked.direction == Direction.TO_MSS else Direction.FROM_BSS
        refused = SubBlock(0, struct.pack("<2H", code, block))
        self._post(Message(direction, Kind.RESPONSE, 0, asked.sequence, (refused,)), self._delays.answer_s)

    def _obey(self, header: Message, blocks: tuple[SubBlock, ...]) -> None:
        if header.kind != Kind.COMMAND or (header.direction, header.identity) not in c.KNOWN_MESSAGES:
            what = f"direction {header.direction} type {header.kind} message 0x{header.identity:x}"
            raise CommandRefusedError(Refusal.MESSAGE, blocks[0].identity, f"no command: {what}")
        if self._faults is not None and (forced := self._faults.hit(Fault.REFUSE, self._where)):
            raise CommandRefusedError(int(forced.value), blocks[0].identity, "refused on command")
        replies: list[SubBlock] = []
        for block in blocks:
            known = block.identity == c.FILE or block.identity in c.LENGTHS
            if not known or c.message_of(block.identity) != (header.direction, header.identity):
                raise CommandRefusedError(Refusal.SUB_BLOCK, block.identity, "sub-block does not belong here")
            if block.identity != c.FILE and len(block.data) != c.LENGTHS[block.identity]:
                raise CommandRefusedError(Refusal.LENGTH, block.identity, f"{len(block.data)} bytes of data")
            self._require(block.identity)
            reply = self._execute(header, block)
            if reply is not None:
                replies.append(SubBlock(block.identity, reply))
        self._answer(header, Kind.RESPONSE, tuple(replies))
        for block in blocks:
            if block.identity != c.FILE or c.FILE in self._done:  # of a file the last chunk alone
                self._after(self._delays.answer_s, partial(self._follow, block))

    def _require(self, block: int) -> None:
        needed = c.NEEDS.get(block, ())
        if c.message_of(block)[0] == Direction.TO_BSS:
            needed = (c.RF_POWER, *needed)
        missing = [f"0x{n:04x}" for n in needed if n not in self._done]
        if missing:
            code = Refusal.NO_FRAME if block == c.TRIGGER else Refusal.PROCESSING
            raise CommandRefusedError(code, block, f"too early: {', '.join(missing)} must come before")

    def _execute(self, header: Message, block: SubBlock) -> bytes | None:
        """Carry out one sub-block; what it answers, None: nothing."""
        identity, data = block.identity, block.data
        if identity == c.FILE:
            self._take_chunk(header.remaining, data)
            return None
        if header.remaining:
            raise CommandRefusedError(Refusal.PROCESSING, identity, f"{header.remaining} chunks of a short command")
        if identity == c.CHANNELS:
            c.check_channels(data, self.master)
        elif identity == c.ADC_OUT:
            c.check_adc_out(data)
        elif identity == c.CRC_TYPE:
            c.check_crc_type(data)
        elif identity == c.PROFILE:
            profile = c.profile_of(data)
            self.profiles[profile.profile] = profile
        elif identity == c.CHIRP:
            chirp = c.chirp_of(data, self.profiles)
            self.chirps.update(dict.fromkeys(range(chirp.first, chirp.last + 1), chirp))
        elif identity == c.FRAME:
            if self.running:
                raise CommandRefusedError(Refusal.FRAME_RUNNING, identity, "frames are running")
            self.frame, self.applied = c.frame_of(data, self.profiles, self.chirps), False
        elif identity == c.APPLY and self.frame is not None:
            c.check_apply(data, self.frame)
            self.applied = True
        elif identity == c.TRIGGER:
            self._check_trigger(struct.unpack_from("<H", data)[0])
        self.settings[identity] = data
        self._done.add(identity)
        return self._reading(identity)

    def _check_trigger(self, order: int) -> None:
        if order > 4:
            raise CommandRefusedError(Refusal.DATA, c.TRIGGER, f"order {order}")
        if order == 1 and self.running:
            raise CommandRefusedError(Refusal.ALREADY_STARTED, c.TRIGGER, "frames are running")
        if order == 1 and not self.applied:
            raise CommandRefusedError(Refusal.NO_FRAME, c.TRIGGER, "no frame was applied")
        if order != 1 and not self.running:
            raise CommandRefusedError(Refusal.ALREADY_STOPPED, c.TRIGGER, "frames are not running")

    def _reading(self, identity: int) -> bytes | None:
        uptime_ms = (time.monotonic_ns() - self._booted_ns) // 1_000_000 & 0xFFFFFFFF
        if identity in (c.VERSION_MSS, c.VERSION_RF):
            return bytes((1, 2, 2, 2, 2, 2, 0, 6, 6, 20, 2, 2, 20, 6, 6, 0, 0, 0, 0, 0))
        if identity == c.DIE_ID:
            return struct.pack("<8I", 0x2243, 7, 10 + self.number, 20 + self.number, 0, 0, 0, 0)
        if identity == c.TEMPERATURE:
            return struct.pack("<I10h", uptime_ms, *[self.temperature_c] * 10)
        return None

    def _follow(self, block: SubBlock) -> None:
        """What an accepted command sets in motion, after its answer."""
        if block.identity == c.FILE:
            self._event(c.BOOT_STATUS, bytes(24))
        elif block.identity == c.RF_POWER:
            self._after(self._delays.rf_power_up_s, lambda: self._event(c.RF_POWER_UP, bytes(32)))
        elif block.identity == c.INIT:
            asked = struct.unpack_from("<H", self.settings.get(c.CALIBRATIONS, b"\xf0\x1f"))[0]
            status = (asked | _INIT_BASE) & _INIT_MASK if self.init_status is None else self.init_status
            uptime_ms = (time.monotonic_ns() - self._booted_ns) // 1_000_000 & 0xFFFFFFFF
            result = struct.pack("<2I2H2I", status, status, self.temperature_c, 0, uptime_ms, 0)
            self._after(self._delays.rf_init_s, lambda: self._event(c.RF_INIT, result))
        elif block.identity == c.TRIGGER and block.data[0] == 1:
            self.running = True
            self._after(self._delays.frame_ready_s, lambda: self._event(c.FRAME_READY, bytes(4)))
            self._moved(self)
        elif block.identity == c.TRIGGER:
            self.running = False
            self._moved(self)
            self._event(c.FRAME_END, bytes(4))

    def _take_chunk(self, remaining: int, data: bytes) -> None:
        """The firmware image: 35 chunks, the first with type and length, 7936 bytes; its content is not looked at."""
        if self._chunks == 0 or remaining == c.CHUNKS - 1:
            self._chunks = 0
            self._done.discard(c.FILE)
            if len(data) != c.FIRST_CHUNK:
                raise CommandRefusedError(Refusal.LENGTH, c.FILE, f"first chunk of {len(data)} bytes")
            kind, size = struct.unpack_from("<2I", data)
            if kind != 0:
                raise CommandRefusedError(Refusal.FILE_TYPE, c.FILE, f"file type {kind}")
            if size != c.IMAGE_BYTES:
                raise CommandRefusedError(Refusal.DATA, c.FILE, f"image of {size} bytes")
        if remaining != c.CHUNKS - 1 - self._chunks:
            expected = c.CHUNKS - 1 - self._chunks
            self._chunks = 0
            raise CommandRefusedError(Refusal.PROCESSING, c.FILE, f"{remaining} chunks follow, not {expected}")
        last = c.IMAGE_BYTES + 8 - (c.CHUNKS - 1) * c.CHUNK
        if len(data) != (c.CHUNK if remaining else last):
            self._chunks = 0
            raise CommandRefusedError(Refusal.LENGTH, c.FILE, f"chunk of {len(data)} bytes")
        self._chunks += 1
        if remaining == 0:
            self._chunks = 0
            self._done.add(c.FILE)
