# SPDX-License-Identifier: Apache-2.0
"""What the host's network says about a board without asking the board: route, neighbour table, buffers, ports."""

from __future__ import annotations

import ipaddress
import socket
import struct
from pathlib import Path

from edge.errors import LinkError

CONNECT_S = 3.0
RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
ROUTES = Path("/proc/net/route")
NEIGHBOURS = Path("/proc/net/arp")
INCOMPLETE = "0x0"
"""Flags of a neighbour that did not answer ARP."""


def way_to(address: str) -> str:
    """From which of this host's addresses, by which interface, packets go to a board.

    Raises:
        LinkError: the name is not known, there is no route, or it leads through a router instead of a cable.
    """
    try:
        there = socket.gethostbyname(address)
    except OSError as error:
        raise LinkError(
            f"no such address: {address}", value=str(error), action="set radars.<id>.board.address, as numbers"
        ) from error
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((there, 9))
            here = str(probe.getsockname()[0])
    except OSError as error:
        raise LinkError(f"no way to {there}", value=error.strerror, action=_interface_action(there)) from error
    if ipaddress.ip_address(there).is_loopback:
        return f"{there} is this computer"
    interface, router = _route(there)
    if router:
        raise LinkError(
            f"packets to {there} leave through {interface} to a router: no interface is in the board's network",
            value=f"from {here}",
            action=_interface_action(there),
        )
    return f"from {here} by {interface or 'an unknown interface'}"


def tcp_port(address: str, port: int, what: str) -> str:
    """Whether somebody listens.

    Raises:
        LinkError: nobody answers (and whether the address is on the cable at all), or the port is refused.
    """
    try:
        with socket.create_connection((address, port), timeout=CONNECT_S):
            return f"{address}:{port} accepts connections"
    except ConnectionRefusedError as error:
        raise LinkError(
            f"{address} is there, but refuses port {port} ({what})",
            action="the board's software does not run: wait half a minute after power-on; is its SD card in, are the "
            "boot switches right (docs/hardware.md)? or another control_port is meant",
        ) from error
    except OSError as error:
        raise LinkError(
            f"{address} does not answer",
            value=neighbour(address) or str(error.strerror or error),
            action=_power(address),
        ) from error


def neighbour(address: str) -> str:
    """What the neighbour table says: whether any device on the cable has this address; "" unknown."""
    for words in _table(NEIGHBOURS):
        if words[0] == address and len(words) > 3:
            if words[2] == INCOMPLETE:
                return "no device on the cable has this address"
            return f"a device of hardware address {words[3]} has it"
    return ""


def receive_buffer(wanted: int, least: int) -> tuple[bool, str, str]:
    """Whether the kernel gives sockets a receive buffer of ``wanted`` bytes.

    Args:
        wanted: of the settings.
        least: two frames; with less, losses are certain.
    Returns:
        Whether it is enough, what was found, what to do.
    """
    try:
        most = int(RMEM_MAX.read_text())
    except (OSError, ValueError):
        return True, "net.core.rmem_max is not known here", ""
    found = f"net.core.rmem_max is {most} bytes, {wanted} are asked for, two frames are {least}"
    if most >= wanted:
        return True, found, ""
    action = f"sudo sysctl -w net.core.rmem_max={wanted}; for ever: a line in /etc/sysctl.d/90-rfconstruct.conf"
    return most >= least, found, action


def _route(there: str) -> tuple[str, bool]:
    """Interface of the most specific route, and whether it leads to a router."""
    (target,) = struct.unpack("<I", socket.inet_aton(there))
    best: tuple[int, str, bool] = (-1, "", False)
    for words in _table(ROUTES):
        if len(words) < 8:
            continue
        destination, gateway, mask = (int(words[column], 16) for column in (1, 2, 7))
        if target & mask == destination:
            best = max(best, (mask.bit_count(), words[0], gateway != 0))
    return best[1], best[2]


def _table(path: Path) -> list[list[str]]:
    try:
        return [line.split() for line in path.read_text(encoding="ascii", errors="replace").splitlines()[1:] if line]
    except OSError:
        return []


def _interface_action(there: str) -> str:
    network = ".".join(there.split(".")[:3])
    return f"give the board's interface an address in its network: sudo ip address add {network}.30/24 dev NAME"


def _power(address: str) -> str:
    return (
        f"check its supply (12 V or 5 V; without it the Ethernet lights stay dark), the cable, and that {address} is "
        "its address: boards are delivered as 192.168.33.180, a second one must be changed"
    )
