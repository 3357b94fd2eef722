# SPDX-License-Identifier: Apache-2.0
"""Boards on USB: which are there, which serial port is a radar's command line, and a reset for one that hangs.

Ports are found by vendor, product, interface and serial number, never by the number of a ttyACM. Serial ports are known
from sysfs (``serial.tools.list_ports``); devices without one, and resets, need libusb through pyusb.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

from edge.errors import DependencyError, DeviceError, LinkError

UsbKind = Literal["xds110", "xds110_dfu", "cp2105", "devpack", "console", "oak"]
Role = Literal["cli", "data", ""]

RULES_FILE = "60-rfconstruct.rules"
RULES_ACTION = (
    f"install systemd/udev/{RULES_FILE} into /etc/udev/rules.d, run 'udevadm control --reload && udevadm trigger', "
    "and add the user to group dialout (usermod -aG dialout USER, then log in again)"
)
REENUMERATION_LIMIT_S = 10.0
"""After a reset the kernel needs 1-2 s to bind the ports again, udev a moment more for their rights."""
REENUMERATION_STEP_S = 0.1
STEADY_LOOKS = 5
"""So often in a row the port must be there: right after the reset the old one may still be listed."""


@dataclass(frozen=True, slots=True)
class UsbModel:
    """What is known of one kind of device.

    Args:
        kind: short name.
        vid, pids: of USB; no pids: all of the vendor.
        name: for messages.
        roles: interface number -> what its serial port is.
        sure: the ids belong to this board only.
        action: what to do about it, when it should not be seen like this.
    """

    kind: UsbKind
    vid: int
    pids: tuple[int, ...]
    name: str
    roles: tuple[tuple[int, Role], ...] = ()
    sure: bool = True
    action: str = ""


MODELS = (
    UsbModel("xds110", 0x0451, (0xBEF3, 0xBEF4), "radar board (XDS110 debugger)", ((0, "cli"), (3, "data"))),
    UsbModel(
        "xds110_dfu",
        0x1CBE,
        (0x00FF,),
        "XDS110 in DFU mode",
        action="it waits for firmware: unplug it and plug it in again; if it stays so, load its firmware with TI's "
        "xdsdfu (xdsdfu -m, xdsdfu -f firmware.bin -r)",
    ),
    UsbModel("cp2105", 0x10C4, (0xEA70,), "radar board (CP2105 bridge)", ((0, "cli"), (1, "data"))),
    UsbModel("devpack", 0x0451, (0xFD03,), "DCA1000 or DevPack (FT4232H)"),
    UsbModel("console", 0x0403, (0x6010,), "FT2232H, maybe the console of a cascade capture board", sure=False),
    UsbModel("oak", 0x03E7, (), "Luxonis OAK (Movidius)"),
)
"""Ids: hardware.md section 5; those of the console are inferred from its two ports."""


@dataclass(frozen=True, slots=True)
class UsbBoard:
    """One serial port of a board, or a device without any.

    Args:
        kind: which.
        vid, pid: of USB.
        serial_number: empty: it has none, or it cannot be read.
        interface: number of the USB interface of this port; None: no port.
        path: of the port; empty: no port.
        location: bus and ports, as the kernel names the device: "1-1.2".
        accessible: whether this user may open it.
    """

    kind: UsbKind
    vid: int
    pid: int
    serial_number: str
    interface: int | None
    path: str
    location: str
    accessible: bool = True

    @property
    def model(self) -> UsbModel:
        """What is known of the kind."""
        return next(model for model in MODELS if model.kind == self.kind)

    @property
    def role(self) -> Role:
        """What its serial port is."""
        return dict(self.model.roles).get(-1 if self.interface is None else self.interface, "")

    def __str__(self) -> str:
        role = f" {self.role} port" if self.role else ""
        where = f"{self.path or 'no serial port'}" + ("" if self.accessible else " (no right to open it)")
        return f"{self.model.name} {self.serial_number or 'without serial number'}{role}: {where}"


@dataclass(frozen=True, slots=True)
class UsbFinding:
    """A line of a report.

    Args:
        name: what was looked at.
        outcome: "ok"; "note": works, but the reader should know; "fails": something will not run.
        found: what was found.
        action: what to do; empty when nothing needs doing.
    """

    name: str
    outcome: Literal["ok", "note", "fails"]
    found: str
    action: str = ""


class Port(Protocol):
    """A serial port as ``serial.tools.list_ports`` describes it."""

    device: str
    vid: int | None
    pid: int | None
    serial_number: str | None
    location: str | None


def identify(vid: int, pid: int) -> UsbModel | None:
    """The kind of device with these ids; None: none of ours."""
    return next((m for m in MODELS if m.vid == vid and (not m.pids or pid in m.pids)), None)


def find_boards(ports: Iterable[Port] | None = None, devices: Iterable[Any] | None = None) -> list[UsbBoard]:
    """Boards that are plugged in, one entry a serial port, ordered by place, interface and path.

    Args:
        ports: serial ports; None: those of this machine.
        devices: pyusb devices; None: those of this machine, none where libusb is missing, so that only boards with
            serial ports are found.
    """
    if ports is None:
        ports = _serial_ports()
    if devices is None:
        try:
            devices = usb_devices()
        except DependencyError:
            devices = ()
    boards = [board for port in ports if (board := _of_port(port)) is not None]
    with_ports = {board.location for board in boards}
    for device in devices:
        model = identify(device.idVendor, device.idProduct)
        if model is not None and _location(device) not in with_ports:
            boards.append(_of_device(device, model))
    return sorted(boards, key=lambda b: (b.location, -1 if b.interface is None else b.interface, b.path))


def cli_port(serial_number: str = "", boards: Sequence[UsbBoard] | None = None) -> str:
    """Path of a radar's command line port.

    Args:
        serial_number: of the XDS110 or CP2105; empty: the only one.
        boards: of ``find_boards``; None: look now.
    Raises:
        LinkError: there is none, there are several, or this user may not open it; lists what was found.
    """
    return _port("cli", serial_number, boards)


def data_port(serial_number: str = "", boards: Sequence[UsbBoard] | None = None) -> str:
    """Path of a radar's UART data port; as ``cli_port``."""
    return _port("data", serial_number, boards)


def usb_devices() -> list[Any]:
    """All USB devices, as pyusb gives them.

    Raises:
        DependencyError: pyusb or the system's libusb is missing.
        DeviceError: libusb cannot look.
    """
    try:
        import usb.core
    except ImportError as error:
        raise DependencyError("USB needs pyusb", action="pip install pyusb") from error
    try:
        return list(usb.core.find(find_all=True))
    except usb.core.NoBackendError as error:
        raise DependencyError(
            "USB needs the system's libusb 1.0, which is not installed",
            action="apt install libusb-1.0-0 (or the package of that name of your system)",
        ) from error
    except usb.core.USBError as error:
        raise DeviceError("libusb cannot list the devices", value=str(error), action="check /dev/bus/usb") from error


def reset(
    serial_number: str,
    limit_s: float = REENUMERATION_LIMIT_S,
    look: Callable[[], Sequence[UsbBoard]] = find_boards,
    devices: Callable[[], Sequence[Any]] = usb_devices,
) -> str:
    """Reset a radar board's debugger whose serial port hangs, and wait until the port is back.

    Close the port first. The device is found by its place, so that it need not answer.

    Args:
        serial_number: of the XDS110 or CP2105.
        limit_s: longest wait for the port.
        look, devices: listings, for tests.
    Returns:
        Path of the command line port, which may be another one than before.
    Raises:
        LinkError: it is not there, may not be opened, does not take the reset, or does not come back.
        DependencyError: libusb is missing.
    """
    before = [board for board in look() if board.role == "cli" and board.serial_number == serial_number]
    if len(before) != 1:
        raise _missing("cli", serial_number, look())
    board = before[0]
    found = [d for d in devices() if _location(d) == board.location and d.idVendor == board.vid]
    if not found:
        raise LinkError(f"libusb does not see the device at {board.location}", action="check /dev/bus/usb")
    _reset(found[0], board)
    deadline_s, seen = time.monotonic() + limit_s, 0
    while time.monotonic() < deadline_s:
        time.sleep(REENUMERATION_STEP_S)
        back = [b for b in look() if b.role == "cli" and b.serial_number == serial_number and b.accessible]
        seen = seen + 1 if back else 0
        if seen >= STEADY_LOOKS:
            return back[0].path
    raise LinkError(
        f"{board.model.name} {serial_number} did not come back after its reset",
        value=f"{limit_s:g} s",
        action="unplug its USB cable and plug it in again; power-cycle the radar board",
    )


def usb_report(
    boards: Sequence[UsbBoard] | None = None, rules_installed: bool | None = None, modem_manager: bool | None = None
) -> list[UsbFinding]:
    """What is on USB and what hinders it, for ``rfconstruct doctor``; opens no device and never raises.

    Args:
        boards, rules_installed, modem_manager: what is there; None: look now.
    """
    findings: list[UsbFinding] = []
    if boards is None:
        boards = _look(findings)
    findings += [_finding(board) for board in boards]
    if not boards:
        findings.append(
            UsbFinding("USB boards", "note", "none", "plug in the radar boards' USB cables and their power")
        )
    rules = _rules_installed() if rules_installed is None else rules_installed
    if not rules:
        findings.append(UsbFinding("udev rules", "note", f"{RULES_FILE} is not installed", RULES_ACTION))
    if not rules and (_modem_manager_runs() if modem_manager is None else modem_manager):
        text = "runs, and sends AT commands into a radar's command line for 10 s after it is plugged in"
        findings.append(UsbFinding("ModemManager", "fails", text, RULES_ACTION))
    return findings


def _look(findings: list[UsbFinding]) -> list[UsbBoard]:
    """Boards now; a finding where libusb cannot look."""
    try:
        return find_boards(devices=usb_devices())
    except (DependencyError, DeviceError) as error:
        findings.append(UsbFinding("libusb", "note", error.what, error.action))
        return find_boards(devices=())


def _finding(board: UsbBoard) -> UsbFinding:
    name = f"USB {board.location}"
    if not board.accessible:
        return UsbFinding(name, "fails", str(board), RULES_ACTION)
    if board.model.action:
        return UsbFinding(name, "fails", str(board), board.model.action)
    return UsbFinding(name, "ok" if board.model.sure else "note", str(board))


def _port(role: Role, serial_number: str, boards: Sequence[UsbBoard] | None) -> str:
    boards = find_boards() if boards is None else boards
    found = [b for b in boards if b.role == role and (not serial_number or b.serial_number == serial_number)]
    if len(found) != 1:
        raise _missing(role, serial_number, boards)
    if not found[0].accessible:
        raise LinkError(f"no right to open {found[0].path}", value=str(found[0]), action=RULES_ACTION)
    return found[0].path


def _missing(role: Role, serial_number: str, boards: Sequence[UsbBoard]) -> LinkError:
    """Why there is not exactly one such port."""
    of = f" of serial number {serial_number}" if serial_number else ""
    listing = "; ".join(map(str, boards)) or "no board on USB"
    found = [b for b in boards if b.role == role and (not serial_number or b.serial_number == serial_number)]
    if found:
        action = "set radars.<id>.board.serial_number" if not serial_number else "set radars.<id>.board.port"
        return LinkError(f"several {role} ports{of}", value=listing, allowed="one", action=action)
    stuck = next((b.model.action for b in boards if b.kind == "xds110_dfu"), "")
    action = stuck or "check USB cable and power of the radar board, and radars.<id>.board.serial_number"
    return LinkError(f"no {role} port of a radar board{of}", value=listing, action=action)


def _reset(device: Any, board: UsbBoard) -> None:
    import usb.core
    import usb.util

    try:
        device.reset()
    except usb.core.USBError as error:
        forbidden = error.errno == 13
        raise LinkError(
            f"cannot reset {board.model.name} {board.serial_number}",
            value=error.strerror,
            action=RULES_ACTION if forbidden else "unplug its USB cable and plug it in again",
        ) from error
    except NotImplementedError as error:
        raise LinkError(f"libusb cannot reset {board.model.name}", action="unplug it and plug it in again") from error
    finally:
        usb.util.dispose_resources(device)


def _serial_ports() -> list[Port]:
    from serial.tools import list_ports

    return list(list_ports.comports())


def _of_port(port: Port) -> UsbBoard | None:
    """The board of a serial port; None: none of ours."""
    model = None if port.vid is None or port.pid is None else identify(port.vid, port.pid)
    if model is None or port.vid is None or port.pid is None:
        return None
    place = re.fullmatch(r"([^:]*)(?::\d+\.(\d+))?", port.location or "")
    location, interface = (place[1], int(place[2] or 0)) if place else (port.location or "", 0)
    return UsbBoard(
        kind=model.kind,
        vid=port.vid,
        pid=port.pid,
        serial_number=port.serial_number or "",
        interface=interface,
        path=port.device,
        location=location,
        accessible=_may_open(port.device),
    )


def _of_device(device: Any, model: UsbModel) -> UsbBoard:
    """The board of a device without serial port."""
    board = UsbBoard(model.kind, device.idVendor, device.idProduct, "", None, "", _location(device))
    node = f"/dev/bus/usb/{device.bus:03d}/{device.address:03d}"
    if os.path.exists(node) and not _may_open(node):
        return replace(board, accessible=False)
    import usb.core

    try:
        return replace(board, serial_number=device.serial_number or "")
    except (usb.core.USBError, ValueError, NotImplementedError):  # no rights, no string, or it does not answer
        return board


def _location(device: Any) -> str:
    """Place of a pyusb device as the kernel writes it."""
    return f"{device.bus}-{'.'.join(map(str, device.port_numbers or ()))}"


def _may_open(path: str) -> bool:
    """False only where the rights are the reason."""
    return not os.path.exists(path) or os.access(path, os.R_OK | os.W_OK)


def _rules_installed() -> bool:
    folders = ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
    return any(os.path.exists(f"{folder}/{RULES_FILE}") for folder in folders)


def _modem_manager_runs() -> bool:
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                with open(f"/proc/{entry}/comm", encoding="utf-8", errors="replace") as file:
                    if file.read().strip() == "ModemManager":
                        return True
            except OSError:  # it has just ended
                continue
    return False
