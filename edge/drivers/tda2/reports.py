# SPDX-License-Identifier: Apache-2.0
"""What the radar chips report about themselves, decoded: versions, initial calibration, temperatures."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from edge.drivers.tda2 import steps as s
from edge.drivers.tda2.chips import ChipAnswerError, ChipFaultError
from edge.drivers.tda2.packets import CHIPS, device_name
from edge.drivers.tda2.rhcp import CALIBRATIONS, Event

TEMPERATURE_SENSORS = ("RX0", "RX1", "RX2", "RX3", "TX0", "TX1", "TX2", "PM", "DIG0", "DIG1")
_RESULT = struct.Struct("<2Ih")
"""Status, update, degrees Celsius; what follows is not needed."""
_TEMPERATURES = struct.Struct("<I10h")


def check_calibration(name: str, data: bytes) -> None:
    """Look at the result of an initial calibration.

    Args:
        name: of the chip, for messages.
        data: of the event.
    Raises:
        ChipFaultError: one of the calibrations that were asked for failed.
        ChipAnswerError: too few bytes.
    """
    if len(data) < _RESULT.size:
        raise ChipAnswerError(f"{name} reports its calibration in {len(data)} bytes")
    status = _RESULT.unpack_from(data)[0]
    asked = s.CALIBRATIONS_ENABLED | s.ALWAYS_CALIBRATED
    failed = [text for bit, text in CALIBRATIONS.items() if asked >> bit & 1 and not status >> bit & 1]
    if failed:
        raise ChipFaultError(
            f"{name}: initial calibration failed: {', '.join(failed)}",
            value=f"0x{status:04x}",
            allowed=f"0x{asked:04x}",
            action="configure it anew; if it stays, check the supply of the RF board",
        )


def chip_notes(owner: str, answers: Mapping[tuple[int, int], bytes]) -> list[str]:
    """A line for each chip with versions, die, calibration and temperature, and one when their versions differ.

    Args:
        owner: whose chips.
        answers: (device, sub-block) -> data of what each chip answered and reported.
    """
    notes, versions = [], set()
    for device in CHIPS:
        master, radar = (version_text(answers.get((device, b), b"")) for b in (s.MASTER_VERSION, s.RADAR_VERSION))
        versions.add((master, radar))
        status, _, temperature_c = _RESULT.unpack_from(answers[device, Event.CALIBRATED])
        die = answers.get((device, s.DIE_ID), b"").hex() or "unknown"
        notes.append(
            f"{owner} radar, {device_name(device)}: master sub-system {master}, radar sub-system {radar}, die {die}, "
            f"calibrated (0x{status:04x}), {temperature_c} °C"
        )
    return notes + ([f"{owner} radar: its chips run different firmware"] if len(versions) > 1 else [])


def temperatures(name: str, data: bytes) -> dict[str, int]:
    """Sensor -> degrees Celsius. ChipAnswerError: too few bytes."""
    if len(data) < _TEMPERATURES.size:
        raise ChipAnswerError(f"{name} answers temperatures with {len(data)} bytes")
    return dict(zip(TEMPERATURE_SENSORS, _TEMPERATURES.unpack_from(data)[1:], strict=True))


def boot_note(name: str, data: bytes) -> str:
    """What a chip's boot status says after the firmware image; "": all is well, or nothing came."""
    status = int.from_bytes(data[4:12], "little")
    return f"{name}: boot status 0x{status:x}, 0 is good" if status else ""


def version_text(data: bytes) -> str:
    """Version of a chip's firmware and of its patch (mmwavelink: 3 bytes of hardware, 7 of ROM, 6 of patch)."""
    if len(data) < 16:
        return "unknown"
    patch = (data[10], data[11], data[15] >> 4, data[15] & 15)
    return f"{'.'.join(map(str, data[3:7]))} patch {'.'.join(map(str, patch))}"
