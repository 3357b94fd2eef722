# SPDX-License-Identifier: Apache-2.0
"""Which addresses may be bound: those of this machine always, others only under encryption."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from pathlib import Path

import zmq

from edge.errors import ConfigError

IPC_PATH_LIMIT = 107
_TCP = re.compile(r"tcp://(\[[^\]]+\]|[^:\[\]]+):(\*|\d{1,5})")


def checked_endpoint(endpoint: str, encrypted: bool = False, setting: str = "stream.endpoints") -> str:
    """The address to bind, if it may be bound.

    Args:
        endpoint: ``tcp://127.0.0.1:5600``, ``tcp://[::1]:5600``, ``tcp://localhost:5600`` or ``ipc:///run/name``;
            with keys any numeric address of this machine, or ``*`` for all of them.
        encrypted: there are keys: addresses that other machines reach are allowed.
        setting: where the address comes from, for the error.
    Returns:
        The same; localhost as a number.
    Raises:
        ConfigError: another transport, a host name, or other machines reach the address and there are no keys.
    """
    local = is_local(endpoint)
    if local or (local is not None and encrypted):
        return endpoint.replace("tcp://localhost:", "tcp://127.0.0.1:")
    raise ConfigError(
        f"setting {setting}: address cannot be used",
        value=endpoint,
        allowed="tcp://127.0.0.1:PORT, tcp://[::1]:PORT, ipc:///PATH (up to 107 bytes)"
        + (", tcp://ADDRESS:PORT as a number" if encrypted else ""),
        action="" if encrypted else "other machines may subscribe only with keys: rfconstruct keys, stream.key_folder",
    )


def is_local(endpoint: str) -> bool | None:
    """Whether only this machine reaches an address; None: it is no address that can be bound."""
    path = endpoint.removeprefix("ipc://")
    if path != endpoint:
        return True if 0 < len(os.fsencode(path)) <= IPC_PATH_LIMIT else None
    match = _TCP.fullmatch(endpoint)
    if match is None or (match[2] != "*" and int(match[2]) > 65535):
        return None
    if match[1] in ("localhost", "*"):
        return match[1] == "localhost"
    try:
        return ipaddress.ip_address(match[1].strip("[]")).is_loopback
    except ValueError:
        return None


def bind(sender: zmq.Socket[bytes], endpoint: str, setting: str = "stream.endpoints") -> str:
    """Bind a socket.

    Args:
        sender: socket.
        endpoint: of ``checked_endpoint``.
        setting: where the address comes from, for the error.
    Returns:
        The actual address: a port given as ``*`` is a number here.
    Raises:
        ConfigError: someone else serves the address, a file of that name is no socket, or it cannot be bound.
    """
    path = Path(endpoint.removeprefix("ipc://"))
    if endpoint.startswith("ipc:///") and path.exists() and not path.is_socket():
        raise ConfigError(
            f"setting {setting}: there is a file of this name, and it is no socket",
            value=endpoint,
            action="set another address: binding would delete the file",
        )
    try:
        if endpoint.startswith("ipc://") and is_served(endpoint.removeprefix("ipc://")):
            raise zmq.ZMQError(zmq.EADDRINUSE)
        sender.setsockopt(zmq.IPV6, int("[" in endpoint))
        sender.bind(endpoint)
    except zmq.ZMQError as error:
        raise ConfigError(
            f"setting {setting}: address cannot be bound ({zmq.strerror(error.errno or 0)})",
            value=endpoint,
            action="stop the other publisher or set another address"
            if error.errno == zmq.EADDRINUSE
            else "check that the address and its folder exist and may be used",
        ) from error
    return sender.getsockopt_string(zmq.LAST_ENDPOINT)


def is_served(path: str) -> bool:
    """Whether someone listens at a Unix socket: ZeroMQ would take the path away from them without a word."""
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(("\0" + path[1:]) if path.startswith("@") else path)
        except OSError:
            return False
    return True
