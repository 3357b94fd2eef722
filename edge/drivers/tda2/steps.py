# SPDX-License-Identifier: Apache-2.0
"""What one step of the capture board's host is: an order to the board or a command to radar chips, as plain data.

Every value that depends on the rig comes from the registers of its schedule (edge/waveform.py); the others are those of
TI's script for the cascade and of its Linux port (azinke/mmwave), which agree.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from edge.drivers.tda2.packets import CHIPS, MASTER, SLAVES, AckType, Opcode, device_name
from edge.drivers.tda2.rhcp import Direction, Event
from edge.waveform import Schedule

TX_OF_A_CHIP = 3
RECEIVERS, TRANSMITTERS = 0x000F, 0x0007
MASTER_ROLE, SLAVE_ROLE = 1, 2
CALIBRATIONS_ENABLED = 0x1FF0
ALWAYS_CALIBRATED = 0x000E
"""APLL and both oscillators."""
SOP_FUNCTIONAL = 4
START, STOP = 1, 0

FILE, CRC_TYPE, RADAR_POWER_UP, INITIALISE, TRIGGER, TEMPERATURE = 0x4080, 0x404C, 0x4000, 0x00C0, 0x0140, 0x02EA
MASTER_VERSION, RADAR_VERSION, DIE_ID = 0x40E0, 0x0220, 0x0223


@dataclass(frozen=True, slots=True)
class Order:
    """An order to the capture board.

    Args:
        name: for people.
        opcode: see ``Opcode``.
        data: of the packet.
        ack_type: when it is answered.
        reply: opcode of a good answer.
        wait: field of ``TimeOuts``: how long the answer may take.
        pause: field of ``TimeOuts``: pause afterwards; "": none.
        event: that the chip must send then; None: none.
        event_wait: field of ``TimeOuts`` for it.
    """

    name: str
    opcode: Opcode
    data: bytes = b""
    ack_type: AckType = AckType.PROCESSED
    reply: Opcode = Opcode.ACK
    wait: str = "connect_s"
    pause: str = ""
    event: Event | None = None
    event_wait: str = ""


@dataclass(frozen=True, slots=True)
class Command:
    """A command to radar chips, by SPI.

    Args:
        name: for people.
        block: sub-block; message and direction follow from it.
        data: of the sub-block.
        remaining: chunks that follow.
        event: that each chip must send after its answer; None: none.
        event_wait: field of ``TimeOuts`` for it.
    """

    name: str
    block: int
    data: bytes = field(default=b"", repr=False)
    remaining: int = 0
    event: Event | None = None
    event_wait: str = ""

    @property
    def message(self) -> int:
        """Number of the message that the sub-block belongs to."""
        return self.block >> 5

    @property
    def direction(self) -> Direction:
        """Half of the chip that takes it."""
        return Direction.TO_MASTER if self.message >= 0x200 else Direction.TO_RADAR


@dataclass(frozen=True, slots=True)
class Step:
    """The same for one device after another; commands go to all devices before the answers are read.

    Args:
        phase: which part of the procedure, for people.
        devices: bits of devSelection.
        action: order or command.
    """

    phase: str
    devices: tuple[int, ...]
    action: Order | Command

    @property
    def text(self) -> str:
        """Phase, devices and name in one line."""
        return f"{self.phase}: {self.action.name} ({', '.join(device_name(device) for device in self.devices)})"


def boot_steps(phase: str, device: int) -> list[Step]:
    """Functional mode and reset of one chip."""
    sop = Order("functional mode", Opcode.SET_SOP, struct.pack("<I", SOP_FUNCTIONAL), pause="after_sop_s")
    reset = Order("reset", Opcode.DEVICE_RESET, event=Event.POWERED_UP, event_wait="power_up_s")
    return [Step(phase, (device,), sop), Step(phase, (device,), reset)]


def load_steps(phase: str, devices: tuple[int, ...], chunks: list[bytes]) -> list[Step]:
    """Firmware, CRC type, RF power, versions."""
    firmware = [
        Command(f"firmware {k + 1}/{len(chunks)}", FILE, chunk, len(chunks) - 1 - k) for k, chunk in enumerate(chunks)
    ]
    power_up = Command("RF power-up", RADAR_POWER_UP, event=Event.RADAR_POWERED_UP, event_wait="radar_power_up_s")
    together = [*firmware, Command("CRC-32 in answers", CRC_TYPE, struct.pack("<3I", 1, 0, 0)), power_up]
    alone = (
        Command("version of the master sub-system", MASTER_VERSION),
        Command("version of the radar sub-system", RADAR_VERSION),
        Command("die id", DIE_ID),
    )
    steps = [Step(phase, devices, command) for command in together]
    return steps + [Step(phase, (device,), command) for device in devices for command in alone]


def role_steps(phase: str, devices: tuple[int, ...]) -> list[Step]:
    """Antennas, place in the cascade, ADC format."""
    role = MASTER_ROLE if devices == (MASTER,) else SLAVE_ROLE
    commands = (
        Command("channels", 0x0080, struct.pack("<4H", RECEIVERS, TRANSMITTERS, role, 0)),
        Command("ADC output: 16 bit, complex1x", 0x0082, struct.pack("<4H", 2, 1, 0, 0)),
    )
    return [Step(phase, devices, command) for command in commands]


def common_steps(phase: str, schedule: Schedule) -> list[Step]:
    """All four chips: RF part, initial calibration, CSI-2, profile."""
    commands = (
        Command("RF device", 0x0086, bytes.fromhex("050000000000000001000000")),
        Command("LDO bypass", 0x02CC, struct.pack("<I", 3)),
        Command("data format", 0x4041, struct.pack("<6H", RECEIVERS, 2, 1, 0, 0, 0)),
        Command("low power off", 0x0083, bytes(4)),
        Command("bandwidth of APLL and synthesizer", 0x008D, bytes.fromhex("03082609").ljust(16, b"\0")),
        Command("phase shifters per chirp", 0x0087, struct.pack("<2I", 1, 0)),
        Command("calibrations enabled", 0x0089, struct.pack("<3I", CALIBRATIONS_ENABLED, 0, 0)),
        Command("RF initialisation", INITIALISE, event=Event.CALIBRATED, event_wait="calibration_s"),
        Command("data path: CSI-2", 0x4042, bytes.fromhex("0001000000000000")),
        Command("lane clock: DDR, 600 Mbit/s", 0x4044, bytes.fromhex("01010000")),
        Command("HSI clock", 0x0085, struct.pack("<I", 9)),
        Command("CSI-2 lanes", 0x4047, bytes.fromhex("2154030000000000")),
        Command("profile", 0x0100, schedule.profile.registers.to_bytes()),
    )
    return [Step(phase, CHIPS, command) for command in commands]


def chirp_steps(phase: str, schedule: Schedule) -> list[Step]:
    """Chirp table of each chip: chirp i fires the schedule's transmitter i, on one chip alone."""
    steps = []
    for number, device in enumerate(CHIPS):
        for index, transmitter in enumerate(schedule.transmitters):
            chip, place = divmod(transmitter - 1, TX_OF_A_CHIP)
            mask = 1 << place if chip == number else 0
            data = struct.pack("<4HI4H", index, index, 0, 0, 0, 0, 0, 0, mask)
            name = f"chirp {index}: TX {transmitter}" if mask else f"chirp {index}: silent here"
            steps.append(Step(phase, (device,), Command(name, 0x0101, data)))
    return steps


def frame_steps(phase: str, schedule: Schedule, frames: int) -> list[Step]:
    """Frame of the master, then of the slaves, which wait for its pulses.

    Args:
        phase: for people.
        schedule: of the radar.
        frames: to send; 0: until stopped.
    """
    chirps = schedule.slots * schedule.loops
    half_words = 2 * schedule.profile.samples
    apply = Command("apply the frame", 0x40C0, struct.pack("<I2H", chirps, half_words, 0))
    steps = []
    for devices in ((MASTER,), SLAVES):
        registers = schedule.frame_registers(slave=devices == SLAVES, frames=frames)
        steps += [Step(phase, devices, Command("frame", 0x0102, registers.to_bytes())), Step(phase, devices, apply)]
    return steps


def trigger_step(phase: str, device: int, order: int) -> Step:
    """Start (1) or stop (0) the frames of one chip."""
    name = "start frames" if order == START else "stop frames"
    event = Event.FRAME_STARTED if order == START else Event.FRAME_ENDED
    wait = "frame_started_s" if order == START else "frame_ended_s"
    return Step(phase, (device,), Command(name, TRIGGER, struct.pack("<2H", order, 0), event=event, event_wait=wait))
