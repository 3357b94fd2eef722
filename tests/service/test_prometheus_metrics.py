# SPDX-License-Identifier: Apache-2.0
"""Metrics: what a strict parser of the format reads, and visitors who do not behave."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import stat
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from edge.errors import ConfigError
from edge.service.machine import rss_bytes, temperature_c
from edge.service.metrics import REQUEST_LIMIT_BYTES, VISITOR_LIMIT, Metrics
from edge.service.metrics_text import CONTENT_TYPE, exposition
from edge.service.snapshot import Snapshot
from edge.stream.messages import PoseStatus, RadarStatus, Reason, Status
from edge.timing import BOUNDS_US, StageTimes

Key = tuple[str, frozenset[tuple[str, str]]]
WAIT_S = 10.0


def snapshot() -> Snapshot:
    times = StageTimes()
    for duration_us in (5.0, 15.0, 15.0, 6e6):
        times.record("imaging", duration_us)
    status = Status(
        "DEGRADED",
        1,
        (Reason("GAP", 3, 1, 2, "x"),),
        {
            "horizontal": RadarStatus(103, 100, {"gap": 2, "overflow": 1}, 59.9),
            "vertical": RadarStatus(103, 103, {}, 60.0),
        },
        pose=PoseStatus(12.5, 100.0, 4, "external"),
        versions={"rfconstruct": '1.0"\\\n'},
        uptime_s=7.5,
    )
    return Snapshot(
        status, times.histograms(), {"car": 2}, {"car": 17, "unknown": 1}, 3, 5, 2, {"pairs": 1}, 2**28, 61.5
    )


def parsed(text: str) -> tuple[dict[Key, float], dict[str, str]]:
    """Samples and types; as strict as the format's description (name, label and value syntax, one group a family)."""
    samples: dict[Key, float] = {}
    types: dict[str, str] = {}
    assert text.endswith("\n")
    for line in text.splitlines():
        if line.startswith("# HELP "):
            continue
        if line.startswith("# TYPE "):
            _, _, name, kind = line.split(" ")
            assert name not in types
            assert kind in ("counter", "gauge", "histogram")
            types[name] = kind
            continue
        match = re.fullmatch(r"([a-zA-Z_:][a-zA-Z0-9_:]*)(?:\{(.*)\})? (\S+)", line)
        assert match, line
        family = next((n for n in types if match[1] in (n, f"{n}_bucket", f"{n}_sum", f"{n}_count")), None)
        assert family == list(types)[-1], line
        found = re.findall(r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\\n]|\\["\\n])*)"', match[2] or "")
        assert ",".join(f'{k}="{v}"' for k, v in found) == (match[2] or "")
        key = match[1].removeprefix("rfconstruct_"), frozenset(found)
        assert key not in samples
        samples[key] = float(match[3])
    return samples, types


def test_every_figure_of_the_snapshot() -> None:
    samples, types = parsed(exposition(snapshot()))

    def value(name: str, **labels: str) -> float:
        return samples[name, frozenset((k.rstrip("_"), v) for k, v in labels.items())]

    for radar, lost in (("horizontal", 3), ("vertical", 0)):
        total = sum(
            v for (name, labels), v in samples.items() if name == "frames_lost_total" and ("radar", radar) in labels
        )
        assert total == lost
        assert value("frames_in_total", radar=radar) == value("frames_ok_total", radar=radar) + total
    assert value("frames_lost_total", radar="horizontal", cause="gap") == 2
    assert value("state", state="DEGRADED") == 1
    assert sum(v for (name, _), v in samples.items() if name == "state") == 1
    assert value("reason", code="GAP") == 3
    assert value("auth_failures_total") == 5
    assert value("objects", class_="car") == 2
    assert value("shapes_total", class_="car") == 17
    assert value("resident_memory_bytes") == 2**28
    assert value("temperature_celsius") == 61.5
    assert value("pose_age_seconds") == 0.0125
    assert value("build_info", version='1.0\\"\\\\\\n') == 1
    assert all(kind == "counter" for name, kind in types.items() if name.endswith("_total"))
    assert all(name.endswith("_total") for name, kind in types.items() if kind == "counter")


def test_histogram_is_cumulative_and_complete() -> None:
    samples, _ = parsed(exposition(snapshot()))
    buckets = {
        dict(labels)["le"]: v for (name, labels), v in samples.items() if name == "stage_duration_seconds_bucket"
    }
    assert len(buckets) == len(BOUNDS_US) + 1
    assert [buckets[bound] for bound in ("1e-05", "2e-05", "5", "+Inf")] == [1, 3, 3, 4]
    stage = frozenset([("stage", "imaging")])
    assert samples["stage_duration_seconds_count", stage] == 4
    assert samples["stage_duration_seconds_sum", stage] == pytest.approx(6.000035)


def test_an_empty_snapshot_is_valid() -> None:
    samples, _ = parsed(exposition(Snapshot(Status("INIT"))))
    assert samples["state", frozenset([("state", "INIT")])] == 1
    assert not any(name == "temperature_celsius" for name, _ in samples)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[Metrics, Path]]:
    path = tmp_path / "metrics.sock"
    with Metrics(path) as metrics:
        metrics.update(snapshot())
        yield metrics, path


def ask(path: Path, request: bytes) -> tuple[int, dict[str, str], bytes]:
    """Status, fields and body of the answer."""
    with socket.socket(socket.AF_UNIX) as visitor:
        visitor.settimeout(WAIT_S)
        visitor.connect(str(path))
        visitor.sendall(request)
        return received(visitor)


def received(visitor: socket.socket) -> tuple[int, dict[str, str], bytes]:
    content = b""
    while part := visitor.recv(65536):
        content += part
    head, body = content.split(b"\r\n\r\n", 1)
    first, *fields = head.decode().split("\r\n")
    return int(first.split(" ")[1]), dict(field.split(": ", 1) for field in fields), body


GET = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n"


def test_a_request_is_answered_and_the_socket_is_private(server: tuple[Metrics, Path]) -> None:
    metrics, path = server
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    code, fields, body = ask(path, GET)
    assert code == 200
    assert fields["Content-Type"] == CONTENT_TYPE
    assert int(fields["Content-Length"]) == len(body)
    assert body.decode() == exposition(snapshot())
    metrics.update(replace(snapshot(), auth_failures=99))
    assert b"rfconstruct_auth_failures_total 99\n" in ask(path, b"GET /metrics?x=1 HTTP/1.0\n\n")[2]
    code, fields, body = ask(path, b"HEAD /metrics HTTP/1.1\r\n\r\n")
    assert (code, body) == (200, b"")
    assert int(fields["Content-Length"]) > 1000


@pytest.mark.parametrize(
    ("request_bytes", "code"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", 404),
        (b"GET /metrics/../etc HTTP/1.1\r\n\r\n", 404),
        (b"POST /metrics HTTP/1.1\r\n\r\n", 405),
        (b"GET /metrics\r\n\r\n", 400),
        (b"GET http://x/metrics HTTP/1.1\r\n\r\n", 400),
        (b"\x16\x03\x01\xff\xfe\n\n", 400),
        (b"\n\n", 400),
        (b"GET /metrics HTTP/1.1\r\nX: " + b"y" * REQUEST_LIMIT_BYTES, 431),
    ],
)
def test_other_requests_are_refused(server: tuple[Metrics, Path], request_bytes: bytes, code: int) -> None:
    assert ask(server[1], request_bytes)[0] == code


def test_before_the_first_snapshot(tmp_path: Path) -> None:
    with Metrics(tmp_path / "s") as _:
        assert ask(tmp_path / "s", GET)[0] == 503


def test_visitors_who_say_nothing_are_sent_away_and_do_not_keep_others_out(server: tuple[Metrics, Path]) -> None:
    _, path = server
    with contextlib.ExitStack() as stack:
        silent = []
        for _ in range(3 * VISITOR_LIMIT):
            visitor = stack.enter_context(socket.socket(socket.AF_UNIX))
            visitor.settimeout(WAIT_S)
            visitor.connect(str(path))
            with contextlib.suppress(BrokenPipeError):
                visitor.send(b"GET /metr")
            silent.append(visitor)
        assert ask(path, GET)[0] == 200
        for visitor in silent:
            with contextlib.suppress(ConnectionError):
                assert visitor.recv(100) == b""


def test_visitors_who_do_not_read_or_leave_early_change_nothing(server: tuple[Metrics, Path]) -> None:
    metrics, path = server
    big = {f"class{number}": number for number in range(20_000)}
    metrics.update(replace(snapshot(), shapes=big))
    deaf = socket.socket(socket.AF_UNIX)
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    deaf.connect(str(path))
    deaf.sendall(GET)
    for _ in range(5):
        with socket.socket(socket.AF_UNIX) as hasty:
            hasty.connect(str(path))
            hasty.sendall(GET)
    code, _, body = ask(path, GET)
    assert code == 200
    assert len(parsed(body.decode())[0]) > 20_000
    deaf.close()


def test_random_bytes_change_nothing(server: tuple[Metrics, Path]) -> None:
    _, path = server
    for size in (1, 100, 100_000):
        with socket.socket(socket.AF_UNIX) as visitor, contextlib.suppress(ConnectionError):
            visitor.settimeout(WAIT_S)
            visitor.connect(str(path))
            visitor.sendall(os.urandom(size))
    assert ask(path, GET)[0] == 200


def test_a_port_of_this_machine(tmp_path: Path) -> None:
    with Metrics(None, 0) as metrics:
        metrics.update(snapshot())
        assert metrics.port
        with socket.create_connection(("127.0.0.1", metrics.port), WAIT_S) as visitor:
            visitor.sendall(GET)
            assert received(visitor)[0] == 200
        with pytest.raises(ConfigError, match="bound"):
            Metrics(tmp_path / "s", metrics.port)
        assert not (tmp_path / "s").exists()


def test_addresses_that_are_taken_or_stale(server: tuple[Metrics, Path], tmp_path: Path) -> None:
    _, path = server
    with pytest.raises(ConfigError, match="bound"):
        Metrics(path)
    assert ask(path, GET)[0] == 200
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigError, match="bound"):
        Metrics(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"
    stale = socket.socket(socket.AF_UNIX)
    stale.bind(str(tmp_path / "stale"))
    stale.close()
    with Metrics(tmp_path / "stale"):
        assert ask(tmp_path / "stale", GET)[0] == 503
    assert not (tmp_path / "stale").exists()


def test_close_ends_while_a_visitor_is_there(tmp_path: Path) -> None:
    metrics = Metrics(tmp_path / "s")
    with socket.socket(socket.AF_UNIX) as visitor:
        visitor.connect(str(tmp_path / "s"))
        time.sleep(0.01)
        metrics.close()
        assert visitor.recv(10) == b""


def test_machine_figures(tmp_path: Path) -> None:
    assert 2**20 < rss_bytes() < 2**40
    assert temperature_c(tmp_path) is None
    for number, text in enumerate(("45000", "61500", "garbage", "999999999")):
        (tmp_path / f"thermal_zone{number}").mkdir()
        (tmp_path / f"thermal_zone{number}" / "temp").write_text(text)
    assert temperature_c(tmp_path) == 61.5
