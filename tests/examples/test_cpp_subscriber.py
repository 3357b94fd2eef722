# SPDX-License-Identifier: Apache-2.0
"""The C++ subscriber, written from docs/wire_format.md alone, reads what a publisher sends and the page's vectors."""

from __future__ import annotations

import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tests" / "stream"))

from stream_samples import STAMP, pose, shape  # noqa: E402
from stream_sockets import WAIT_S, Raw  # noqa: E402

from edge.stream.convert import encode_heartbeat, encode_pose, encode_shape  # noqa: E402
from edge.stream.wire import pack  # noqa: E402

HEADERS = ("zmq.hpp", "zmq_addon.hpp", "msgpack.hpp")
COMPILE_S = 280.0


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The subscriber, compiled with the command of docs/client.md."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ here: apt-get install g++ libzmq3-dev cppzmq-dev libmsgpack-cxx-dev")
    for name in HEADERS:
        probe = f"#if !__has_include(<{name}>)\n#error {name}\n#endif\n"
        done = subprocess.run([compiler, "-E", "-xc++", "-"], input=probe, capture_output=True, text=True, timeout=60)
        if done.returncode:
            pytest.skip(f"no {name} here: apt-get install libzmq3-dev cppzmq-dev libmsgpack-cxx-dev")
    command = re.search(r"^g\+\+ .*$", (ROOT / "docs" / "client.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert command is not None
    words = command[0].split()
    out = tmp_path_factory.mktemp("cpp") / "subscriber"
    words[words.index("-o") + 1] = str(out)
    subprocess.run([*words, "-Wall", "-Wextra", "-Werror"], cwd=ROOT, check=True, timeout=COMPILE_S)
    return out


@pytest.fixture
def sender() -> Iterator[Raw]:
    one = Raw()
    yield one
    one.close()


def lines(program: Path, sender: Raw, messages: list[list[bytes]]) -> list[str]:
    """What the program prints for these messages, heartbeats of the time before it had joined left out."""
    process = subprocess.Popen([program, sender.endpoints[0], "-1"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline and not _readable(process):
            sender.heartbeat()
            time.sleep(0.01)
        for message in messages:
            sender.send(message)
        sender.send(pack(encode_heartbeat("STOP", 1), replace(STAMP, sequence=10_000)))
        found = []
        for line in process.stdout:
            if "state STOP" in line:
                return found
            if not line.startswith("1/hb/"):
                found.append(line.rstrip("\n"))
        raise AssertionError("the subscriber ended")
    finally:
        process.kill()
        process.wait(10)
        process.stdout.close()


def _readable(process: subprocess.Popen[str]) -> bool:
    return bool(select.select([process.stdout], [], [], 0)[0])


def test_it_reads_shapes_of_every_encoding(program: Path, sender: Raw) -> None:
    thing = shape()
    sent = [pack(encode_shape(thing, enc), replace(STAMP, sequence=k)) for k, enc in enumerate(("f4", "f2", "i2"))]
    tail = "id 5 class car confidence 0.50 points 2 first 0.500 -1.000 0.250"
    assert lines(program, sender, sent) == [f"1/shape/car/ seq {k} lost 0 {tail}" for k in range(3)]


def test_it_counts_losses_and_forgives_a_new_start(program: Path, sender: Raw) -> None:
    draft = encode_pose(pose())
    sent = [pack(draft, replace(STAMP, sequence=number)) for number in (3, 4, 8, 2)]
    sent.append(pack(draft, replace(STAMP, sequence=90, boot=bytes(16))))
    assert [line.split("lost ")[1] for line in lines(program, sender, sent)] == ["0", "0", "3", "0", "0"]


def test_it_refuses_what_is_not_the_format(program: Path, sender: Raw) -> None:
    good = pack(encode_shape(shape()), STAMP)
    broken = [*good[:2], good[2][:-1] + b"\xff", good[3]]
    other_version = [good[0], good[1].replace(b"\x92\x01", b"\x92\x02", 1), *good[2:]]
    sent = [broken, good[:3], other_version, [b"1/pose/", b"\xc1"], [b"1/pose/", b"\x80"], good]
    found = lines(program, sender, sent)
    assert [line.startswith("refused: ") for line in found] == [True] * 5 + [False]
    assert "check sum" in found[0]
    assert "another major version" in found[2]


def test_it_reads_the_vectors_of_the_document(program: Path, sender: Raw) -> None:
    from test_wire_vectors import frames

    found = lines(program, sender, [frames("pose"), frames("shape"), frames("shape in millimetres")])
    assert found[0].startswith("1/pose/ seq 7")
    assert all("points 2 first 0.500 -1.000 0.250" in line for line in found[1:])


def test_it_is_short() -> None:
    assert len((ROOT / "examples" / "cpp" / "subscriber.cpp").read_text(encoding="utf-8").splitlines()) <= 100
