# SPDX-License-Identifier: Apache-2.0
"""The doctor's look at what the system lends the pipeline: clock, socket buffers, boards on USB and rights."""

from __future__ import annotations

from collections.abc import Sequence

from edge.commands import network_checks
from edge.commands.checks import Check, Outcome
from edge.drivers.usb import UsbFinding, usb_report
from edge.odometry.host_clock import utc_synchronised

CAPTURE_CARD_BYTES = 16_777_216
"""Receive buffer that a capture card's settings ask for by default (``CaptureCardBoard.receive_buffer_bytes``)."""
WORST_FIRST: tuple[Outcome, ...] = ("fails", "note", "ok")


def clock(synchronised: bool | None = None) -> Check:
    """Whether UTC is kept right; the pipeline itself runs on CLOCK_MONOTONIC.

    Args:
        synchronised: what the kernel says; None: ask it.
    """
    if utc_synchronised() if synchronised is None else synchronised:
        return Check("clock", "ok", "UTC is synchronised")
    action = 'start chrony or ptp4l: poses with clock = "utc" need it; without, messages say utc_ok = false'
    return Check("clock", "note", "nothing keeps this host's UTC right", action)


def buffers() -> Check:
    """Receive buffers that the kernel grants: capture cards need large ones, cascades do not."""
    _, found, action = network_checks.receive_buffer(CAPTURE_CARD_BYTES, 0)
    text = found.partition(",")[0]
    return Check("socket buffers", "note" if action else "ok", text, f"for capture cards: {action}" if action else "")


def devices(findings: Sequence[UsbFinding] | None = None) -> Check:
    """Radar boards on USB, and whether this user may open them; none is no fault.

    Args:
        findings: of ``usb_report``; None: look now.
    """
    seen = usb_report() if findings is None else findings
    boards = [one for one in seen if one.name not in ("USB boards", "udev rules")]
    if not any(one.name.startswith("USB ") for one in boards):
        return Check("devices", "ok", "no radar board on USB")
    outcome = min((one.outcome for one in seen), key=WORST_FIRST.index)
    action = next((one.action for one in seen if one.outcome == outcome and one.action), "")
    return Check("devices", outcome, "; ".join(f"{one.name.removeprefix('USB ')}: {one.found}" for one in seen), action)
