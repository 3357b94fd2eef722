# SPDX-License-Identifier: Apache-2.0
"""Datagrams that systemd would receive."""

from __future__ import annotations

import os
import socket
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.service.notify import STATUS_LIMIT, Notifier


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, dict[str, str]]]:
    """A manager's socket, and the environment that it gives to the service."""
    name = f"@rfc-{uuid.uuid4().hex}" if request.param == "abstract" else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind("\0" + name[1:] if name.startswith("@") else name)
        listener.settimeout(5.0)
        yield listener, {"NOTIFY_SOCKET": name}


def test_each_message_is_one_datagram(manager: tuple[socket.socket, dict[str, str]]) -> None:
    listener, environment = manager
    notifier = Notifier(environment)
    assert notifier.present
    assert notifier.ready("waiting for radars")
    assert listener.recv(4096) == b"READY=1\nSTATUS=waiting for radars"
    assert notifier.status("RUN 60.0 fps\nSTOPPING=1")
    assert listener.recv(4096) == b"STATUS=RUN 60.0 fps STOPPING=1"
    assert not notifier.status("RUN 60.0 fps STOPPING=1")
    assert notifier.status("x" * 5000)
    assert len(listener.recv(4096)) == len("STATUS=") + STATUS_LIMIT
    assert notifier.reloading()
    first, second = listener.recv(4096).split(b"\n")
    assert first == b"RELOADING=1"
    assert second.startswith(b"MONOTONIC_USEC=")
    assert notifier.stopping()
    assert listener.recv(4096) == b"STOPPING=1"
    assert notifier.failures == 0


def test_watchdog_is_fed_not_more_often_than_a_quarter_of_its_time(
    manager: tuple[socket.socket, dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    listener, environment = manager
    now = [100.0]
    monkeypatch.setattr("edge.service.notify.time.monotonic", lambda: now[0])
    notifier = Notifier(environment | {"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())})
    assert notifier.watchdog_s == 10.0
    fed = 0
    for _ in range(100):
        fed += notifier.progress()
        now[0] += 0.1
    assert fed == 4
    assert listener.recv(4096) == b"WATCHDOG=1"


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "ten"},
        {"WATCHDOG_USEC": "-5"},
        {"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"},
    ],
)
def test_no_watchdog(environment: dict[str, str]) -> None:
    notifier = Notifier(environment)
    assert notifier.watchdog_s is None
    assert not notifier.progress()


def test_without_a_manager_nothing_happens(tmp_path: Path) -> None:
    notifier = Notifier({})
    assert not notifier.present
    assert not notifier.ready("x")
    assert not notifier.stopping()
    assert notifier.failures == 0
    gone = Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")})
    assert not gone.ready()
    assert gone.failures == 1


def test_a_full_manager_does_not_hold_the_service_up(manager: tuple[socket.socket, dict[str, str]]) -> None:
    _, environment = manager
    notifier = Notifier(environment)
    for number in range(2000):
        notifier.status(f"state {number}")
    assert notifier.failures > 0
