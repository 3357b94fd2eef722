# SPDX-License-Identifier: Apache-2.0
"""The doctor's look at clock, socket buffers and radar boards on USB: what is found, and what to do."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from edge.board_settings import CaptureCardBoard
from edge.commands import network_checks
from edge.commands.system_checks import CAPTURE_CARD_BYTES, buffers, clock, devices
from edge.drivers.usb import UsbFinding

NONE = UsbFinding("USB boards", "note", "none", "plug in")
NO_RULES = UsbFinding("udev rules", "note", "not installed", "install the rules")


def test_clock() -> None:
    assert (clock(True).outcome, clock(True).action) == ("ok", "")
    check = clock(False)
    assert (check.outcome, "utc_ok = false" in check.action) == ("note", True)


def test_buffers_for_capture_cards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (default,) = [one.default for one in fields(CaptureCardBoard) if one.name == "receive_buffer_bytes"]
    assert default == CAPTURE_CARD_BYTES
    limit = tmp_path / "rmem_max"
    monkeypatch.setattr(network_checks, "RMEM_MAX", limit)
    limit.write_text("33554432\n")
    assert (buffers().outcome, buffers().found, buffers().action) == ("ok", "net.core.rmem_max is 33554432 bytes", "")
    limit.write_text("212992\n")
    assert (buffers().outcome, "sysctl -w net.core.rmem_max=16777216" in buffers().action) == ("note", True)
    limit.unlink()
    assert buffers().outcome == "ok"


def test_devices_and_rights() -> None:
    assert devices([NONE, NO_RULES]).outcome == "ok"
    board = UsbFinding("USB 1-2", "ok", "XDS110 of an AWR1843BOOST")
    assert (devices([board]).outcome, devices([board]).found) == ("ok", "1-2: XDS110 of an AWR1843BOOST")
    assert (devices([board, NO_RULES]).outcome, devices([board, NO_RULES]).action) == ("note", NO_RULES.action)
    locked = UsbFinding("USB 1-3", "fails", "no right to open /dev/ttyACM0", "join group dialout")
    assert (devices([board, NO_RULES, locked]).outcome, devices([locked, board]).action) == ("fails", locked.action)
    missing = UsbFinding("libusb", "note", "libusb is not installed", "apt install libusb-1.0-0")
    assert devices([missing, NONE]).outcome == "ok"
