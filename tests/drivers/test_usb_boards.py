# SPDX-License-Identifier: Apache-2.0
"""Boards on USB from listings as Linux gives them, the reset of a hung debugger, and the udev rules. No hardware."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import usb.core

from edge.drivers import usb as boards_on_usb
from edge.drivers.usb import (
    MODELS,
    UsbBoard,
    cli_port,
    data_port,
    find_boards,
    identify,
    reset,
    usb_devices,
    usb_report,
)
from edge.errors import DependencyError, LinkError

RULES = Path(__file__).parents[2] / "systemd" / "udev" / boards_on_usb.RULES_FILE


@dataclass
class Port:
    """A serial port as pyserial lists it."""

    device: str
    vid: int | None = None
    pid: int | None = None
    serial_number: str | None = None
    location: str | None = None


class Device:
    """A device as pyusb lists it."""

    def __init__(self, vid: int, pid: int, place: str, serial: object = "", error: Exception | None = None) -> None:
        self.idVendor, self.idProduct, self._serial, self._error = vid, pid, serial, error
        bus, ports = place.split("-")
        self.bus, self.address = int(bus), 250
        self.port_numbers = tuple(map(int, ports.split(".")))
        self.resets = self.disposals = 0
        self._ctx = self  # what usb.util.dispose_resources looks for

    def dispose(self, device: object, close_handle: bool = True) -> None:
        self.disposals += 1

    @property
    def serial_number(self) -> object:
        if isinstance(self._serial, Exception):
            raise self._serial
        return self._serial

    def reset(self) -> None:
        self.resets += 1
        if self._error is not None:
            raise self._error


def xds110(number: int, serial: str, place: str, pid: int = 0xBEF3) -> list[Port]:
    """Both ports of one radar board; the data port is listed first, to be sure that order does not matter."""
    return [
        Port(f"/dev/ttyACM{number + 1}", 0x0451, pid, serial, f"{place}:1.3"),
        Port(f"/dev/ttyACM{number}", 0x0451, pid, serial, f"{place}:1.0"),
    ]


CP2105 = [
    Port("/dev/ttyUSB7", 0x10C4, 0xEA70, "00CAFE", "3-4:1.0"),
    Port("/dev/ttyUSB6", 0x10C4, 0xEA70, "00CAFE", "3-4:1.1"),
]
OTHERS = [Port("/dev/ttyS0"), Port("/dev/ttyUSB0", 0x1A86, 0x7523, None, "1-9"), Port("/dev/rfcomm0", None, 5)]
TWO_RADARS = [*xds110(2, "R0001", "1-1.2"), *xds110(0, "R0002", "1-1.4", 0xBEF4), *OTHERS]


@pytest.mark.parametrize(
    ("vid", "pid", "kind"),
    [
        (0x0451, 0xBEF3, "xds110"),
        (0x0451, 0xBEF4, "xds110"),
        (0x1CBE, 0x00FF, "xds110_dfu"),
        (0x10C4, 0xEA70, "cp2105"),
        (0x0451, 0xFD03, "devpack"),
        (0x0403, 0x6010, "console"),
        (0x03E7, 0x2485, "oak"),
        (0x03E7, 0xF63B, "oak"),
        (0x0403, 0x6011, None),
        (0x0451, 0x0001, None),
    ],
)
def test_ids_of_the_hardware_notes(vid: int, pid: int, kind: str | None) -> None:
    model = identify(vid, pid)
    assert (model.kind if model else None) == kind


def test_two_radars_are_told_apart_by_serial_number_whatever_their_tty() -> None:
    found = find_boards(TWO_RADARS, [])
    assert len(found) == 4
    assert cli_port("R0001", found) == "/dev/ttyACM2"
    assert data_port("R0001", found) == "/dev/ttyACM3"
    assert cli_port("R0002", found) == "/dev/ttyACM0"
    assert data_port("R0002", found) == "/dev/ttyACM1"


def test_enhanced_port_of_a_cp2105_is_the_command_line() -> None:
    found = find_boards(CP2105, [])
    assert cli_port("00CAFE", found) == cli_port("", found) == "/dev/ttyUSB7"
    assert data_port("", found) == "/dev/ttyUSB6"


def test_no_board_lists_what_is_there() -> None:
    with pytest.raises(LinkError, match="no board on USB") as caught:
        cli_port("R0001", find_boards(OTHERS, []))
    assert "R0001" in caught.value.what
    with pytest.raises(LinkError, match=r"R0002 cli port: /dev/ttyACM0.*check USB cable"):
        cli_port("R0003", find_boards(TWO_RADARS, []))


def test_two_boards_without_a_serial_number_given_are_ambiguous() -> None:
    with pytest.raises(LinkError, match=r"several cli ports.*R0001.*R0002.*radars.<id>.board.serial_number"):
        cli_port("", find_boards(TWO_RADARS, []))
    twins = find_boards([*xds110(0, "00000000", "1-1"), *xds110(2, "00000000", "1-2")], [])
    with pytest.raises(LinkError, match=r"board\.port"):
        cli_port("00000000", twins)


def test_missing_rights_name_the_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boards_on_usb.os.path, "exists", lambda path: True)
    monkeypatch.setattr(boards_on_usb.os, "access", lambda path, mode: False)
    with pytest.raises(LinkError, match=r"no right to open /dev/ttyACM2.*60-rfconstruct\.rules.*dialout"):
        cli_port("R0001", find_boards(TWO_RADARS, []))


def test_devices_without_ports_come_from_libusb_and_none_twice() -> None:
    devices = [
        Device(0x0451, 0xBEF3, "1-1.2", "R0001"),  # has ports already
        Device(0x03E7, 0x2485, "2-1", "14442C10D13EABCE00"),
        Device(0x0451, 0xFD03, "1-5", ValueError("The device has no langid")),
        Device(0x1CBE, 0x00FF, "1-6", usb.core.USBError("Pipe error", errno=32)),
        Device(0x1D6B, 0x0002, "1-0", "hub"),
    ]
    found = find_boards(xds110(0, "R0001", "1-1.2"), devices)
    assert Counter(board.kind for board in found) == {"xds110": 2, "oak": 1, "devpack": 1, "xds110_dfu": 1}
    oak = next(board for board in found if board.kind == "oak")
    assert (oak.serial_number, oak.location, oak.path, oak.role) == ("14442C10D13EABCE00", "2-1", "", "")


def test_dfu_mode_is_said_when_the_command_line_is_missed() -> None:
    with pytest.raises(LinkError, match=r"DFU mode.*xdsdfu"):
        cli_port("R0001", find_boards([], [Device(0x1CBE, 0x00FF, "1-6", "R0001")]))


class Bus:
    """A debugger that is still listed at first after its reset, gone for some looks, and back under another name."""

    def __init__(self, gone_for: int = 5, error: Exception | None = None) -> None:
        self.device, self.gone_for, self.looks = Device(0x0451, 0xBEF3, "1-1.2", "R0001", error), gone_for, 0

    def look(self) -> list[UsbBoard]:
        if not self.device.resets:
            return find_boards(TWO_RADARS, [])
        self.looks += 1
        if self.looks <= 2:
            return find_boards(TWO_RADARS, [])
        return find_boards(TWO_RADARS[2:] if self.looks <= self.gone_for else xds110(8, "R0001", "1-1.2"), [])

    def devices(self) -> list[object]:
        return [Device(0x03E7, 0x2485, "1-1.2"), self.device]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boards_on_usb, "REENUMERATION_STEP_S", 0.001)


@pytest.mark.usefixtures("quick")
def test_reset_waits_until_the_port_is_back_under_its_new_name() -> None:
    bus = Bus()
    assert reset("R0001", 10.0, bus.look, bus.devices) == "/dev/ttyACM8"
    assert (bus.device.resets, bus.device.disposals) == (1, 1)


@pytest.mark.usefixtures("quick")
def test_a_board_that_does_not_come_back_is_named() -> None:
    bus = Bus(gone_for=10**9)
    with pytest.raises(LinkError, match=r"R0001 did not come back.*unplug"):
        reset("R0001", 0.05, bus.look, bus.devices)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (usb.core.USBError("Access denied", errno=13), "60-rfconstruct.rules"),
        (usb.core.USBError("No such device", errno=19), "unplug"),
        (NotImplementedError(), "unplug"),
    ],
)
def test_a_reset_that_fails_says_what_to_do(error: Exception, words: str) -> None:
    bus = Bus(error=error)
    with pytest.raises(LinkError, match=words):
        reset("R0001", 1.0, bus.look, bus.devices)


def test_only_a_board_that_is_there_is_reset() -> None:
    bus = Bus()
    with pytest.raises(LinkError, match="R0009"):
        reset("R0009", 1.0, bus.look, bus.devices)
    with pytest.raises(LinkError, match=r"does not see the device at 1-1\.2"):
        reset("R0001", 1.0, bus.look, list)
    assert bus.device.resets == 0


def test_without_libusb_ports_are_found_and_devices_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(**_: object) -> None:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", none)
    with pytest.raises(DependencyError, match="libusb"):
        usb_devices()
    with pytest.raises(DependencyError, match="libusb"):
        reset("R0001", 1.0, lambda: find_boards(TWO_RADARS, []))
    assert len(find_boards(TWO_RADARS)) == 4
    assert usb_report()[0].name == "libusb"


def test_report_names_each_trouble_and_its_next_step() -> None:
    good = find_boards(xds110(0, "R0001", "1-1.2"), [])
    dfu = find_boards([], [Device(0x1CBE, 0x00FF, "1-6", "R0002")])
    console = find_boards([Port("/dev/ttyUSB0", 0x0403, 0x6010, "FT1", "1-7:1.0")], [])
    locked = [replace(good[0], accessible=False)]
    findings = usb_report([*good, *dfu, *console, *locked], rules_installed=False, modem_manager=True)
    assert [f.outcome for f in findings] == ["ok", "ok", "fails", "note", "fails", "note", "fails"]
    assert all(f.action for f in findings if f.outcome == "fails")
    assert "maybe" in findings[3].found
    assert findings[-1].name == "ModemManager"
    assert [f.name for f in usb_report([], True, True)] == ["USB boards"]


def test_report_of_this_machine_never_raises() -> None:
    assert usb_report()


def rule_lines() -> list[str]:
    text = RULES.read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def ids(pattern: str) -> set[tuple[str, str]]:
    found = set()
    for line in rule_lines():
        vid = re.search(rf'{pattern}{{idVendor}}=="(\w+)"', line)
        pid = re.search(rf'{pattern}{{idProduct}}=="(\w+)"', line)
        if vid:
            found.add((vid[1], pid[1] if pid else "*"))
    return found


def test_rules_cover_exactly_the_known_ids() -> None:
    known = {(f"{m.vid:04x}", f"{pid:04x}") for m in MODELS for pid in m.pids}
    known |= {(f"{m.vid:04x}", "*") for m in MODELS if not m.pids}
    without_port = {(f"{m.vid:04x}", "*") for m in MODELS if m.kind == "oak"} | {("1cbe", "00ff")}
    assert ids("ATTR") == known
    assert ids("ATTRS") == known - without_port


def test_every_rule_is_a_list_of_known_keys_and_every_label_is_there() -> None:
    key = r"(ACTION|SUBSYSTEMS?|ATTRS?\{\w+\}|ENV\{\w+\}|MODE|GROUP|TAG|SYMLINK|IMPORT\{\w+\}|GOTO|LABEL)"
    for line in rule_lines():
        assert re.fullmatch(rf'{key}(==|=|\+=)"[^"]*"(, {key}(==|=|\+=)"[^"]*")*', line), line
    text = "\n".join(rule_lines())
    assert set(re.findall(r'GOTO="(\w+)"', text)) == set(re.findall(r'LABEL="(\w+)"', text))


def test_rules_give_rights_tell_modem_manager_off_and_name_ports_by_serial_number() -> None:
    granting = [line for line in rule_lines() if "MODE=" in line]
    assert all('MODE="0660", GROUP="dialout"' in line for line in granting)
    assert all("ID_MM_DEVICE_IGNORE" in line or "03e7" in line for line in granting)
    links = dict(re.findall(r'ID_USB_INTERFACE_NUM}=="(\d\d)", SYMLINK\+="rfconstruct/(\S+)"', "\n".join(rule_lines())))
    assert all("$env{ID_SERIAL_SHORT}" in name for name in links.values())
    for model in MODELS:
        for number, role in model.roles:
            rule = f'=="{number:02d}", SYMLINK+="rfconstruct/{model.kind}-$env{{ID_SERIAL_SHORT}}-{role}"'
            assert any(rule in line for line in rule_lines()), rule


@pytest.mark.skipif(shutil.which("udevadm") is None, reason="no udevadm on this machine")
def test_udevadm_accepts_the_rules() -> None:
    done = subprocess.run(["udevadm", "verify", str(RULES)], capture_output=True, text=True, timeout=30, check=False)
    if "Unknown command" in done.stderr or "unrecognized" in done.stderr:
        pytest.skip("this udevadm has no verify")
    assert done.returncode == 0, done.stdout + done.stderr
