# SPDX-License-Identifier: Apache-2.0
"""When systemd hears what, and what the metrics show, as the state goes on."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from edge.service.snapshot import Snapshot
from edge.service.supervision import Supervision, summary
from edge.stream.messages import RadarStatus, Reason, State, Status


def snapshot(state: State) -> Snapshot:
    radars = {"horizontal": RadarStatus(10, 8, {"gap": 2}, 59.94), "vertical": RadarStatus(10, 10, {}, 60.0)}
    return Snapshot(Status(state, radars=radars), objects={"car": 2, "unknown": 1})


@pytest.fixture
def now_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [50.0]
    monkeypatch.setattr("edge.service.supervision.time.monotonic", lambda: now[0])
    return now


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(0.2)
        yield listener


def heard(manager: socket.socket) -> list[str]:
    """All that was said since the last call, by its first word."""
    found = []
    try:
        while True:
            found.append(manager.recv(4096).decode())
    except TimeoutError:
        return [text.split("\n")[0].split("=")[0] for text in found]


def test_a_life(manager: socket.socket, tmp_path: Path, now_s: list[float]) -> None:
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "RUNTIME_DIRECTORY": f"{tmp_path}:/elsewhere"}
    supervision = Supervision.of_environment(environment=environment)
    path = tmp_path / "metrics.sock"
    assert path.is_socket()
    states: tuple[State, ...] = ("INIT", "INIT", "WAIT", "RUN", "RUN")
    said = []
    for state in states:
        supervision.show(lambda state=state: snapshot(state))  # type: ignore[misc]
        supervision.show(lambda: pytest.fail("too early"))
        said.append(heard(manager))
        now_s[0] += 1.5
    assert said == [["STATUS"], [], ["READY"], ["STATUS"], []]
    with socket.socket(socket.AF_UNIX) as visitor:
        visitor.settimeout(10.0)
        visitor.connect(str(path))
        visitor.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        assert b" 200 OK" in visitor.recv(100)
    supervision.close()
    assert heard(manager) == ["STOPPING"]
    assert not path.exists()


def test_without_supervisors_nothing_happens(now_s: list[float]) -> None:
    with Supervision.of_environment(environment={}) as supervision:
        supervision.progress()
        supervision.show(lambda: snapshot("RUN"))


def test_the_line_for_systemctl() -> None:
    taken = snapshot("DEGRADED")
    taken = replace(taken, status=replace(taken.status, reasons=(Reason("GAP", 2, 1, 2),)))
    assert summary(taken) == "DEGRADED GAP, horizontal 59.9 fps, vertical 60.0 fps, 2 frames lost, 3 objects"
