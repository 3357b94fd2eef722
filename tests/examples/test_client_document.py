# SPDX-License-Identifier: Apache-2.0
"""Every command and every Python block of docs/client.md runs, against a scripted publisher instead of an appliance."""

from __future__ import annotations

import ast
import itertools
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path += [str(ROOT / "tests" / "stream"), str(ROOT / "tests" / "view")]

from stream_sockets import Raw  # noqa: E402
from view_samples import BOOT, drive  # noqa: E402

from edge.stream.wire import Stamp, pack  # noqa: E402

DOCUMENT = (ROOT / "docs" / "client.md").read_text(encoding="utf-8")
SHELL = [line for part in re.findall(r"```sh\n(.*?)```", DOCUMENT, re.DOTALL) for line in part.splitlines()]
PYTHON = re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL)
EXPECTED = {
    "listen": r"^shape ",
    "print_shapes": r"^object +\d+ ",
    "save_ply": r"\.ply$",
    "view": r"^viewer: http://127\.0\.0\.1:\d+ ",
    "ros2": r"^1/(shape|cloud)/.* point_step 1[26] ",
}
WAIT_S = 90.0


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """Address of a publisher that repeats a short drive."""
    done, bound = threading.Event(), threading.Event()
    addresses: list[str] = []

    def publish() -> None:
        sender = Raw()
        addresses.extend(sender.endpoints)
        bound.set()
        drafts = drive(0.5)
        for number in itertools.count():
            for k, draft in enumerate(drafts):
                stamp = Stamp(BOOT, number * len(drafts) + k, draft.t_ns, 0, True, "sim", bytes(8), bytes(8))
                sender.send(pack(draft, stamp))
            sender.heartbeat()
            if done.wait(0.1):
                break
        sender.close()

    thread = threading.Thread(target=publish)
    thread.start()
    assert bound.wait(WAIT_S)
    yield addresses[0]
    done.set()
    thread.join(WAIT_S)


def first_line(words: list[str], pattern: str) -> str:
    """First line of a command's output that matches; the command is interrupted after it, or must end well."""
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    try:
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            if not select.select([process.stdout], [], [], 0.5)[0]:
                continue
            line = process.stdout.readline()
            if re.search(pattern, line):
                process.send_signal(signal.SIGINT)
                process.communicate(timeout=WAIT_S)
                assert process.returncode in (0, 130, -signal.SIGINT)
                return line
            if not line:
                break
        process.kill()
        raise AssertionError(f"{words}: no such line; stderr: {process.communicate()[1][-800:]}")
    finally:
        process.kill()
        process.communicate()


def local(command: str, endpoint: str, folder: Path) -> list[str]:
    """A command of the document for this interpreter, this publisher and a folder of its own."""
    text = command.replace("tcp://127.0.0.1:5600", endpoint).replace("out/ply", str(folder)).replace("8080", "0")
    words = text.split()
    return [sys.executable, *(["-m", "edge"] if words[0] == "rfconstruct" else []), *words[1:]]


@pytest.mark.parametrize("command", [line for line in SHELL if "demo" not in line])
def test_command(command: str, endpoint: str, tmp_path: Path) -> None:
    if " view " in command:
        pytest.importorskip("viser", reason="the viewer needs viser: pip install 'rfconstruct[view]'")
    pattern = next(pattern for key, pattern in EXPECTED.items() if key in command)
    assert first_line(local(command, endpoint, tmp_path), pattern)
    if "ply" in command:
        assert list(tmp_path.glob("*.ply"))


def test_the_command_that_publishes_exists() -> None:
    (command,) = [line for line in SHELL if "demo" in line]
    done = subprocess.run([*local(command, "", ROOT), "--help"], capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode == 0


def test_the_first_python_block_prints_messages(endpoint: str) -> None:
    code = PYTHON[0].replace("tcp://127.0.0.1:5600", endpoint).replace("client.lost)", "client.lost, flush=True)")
    assert first_line([sys.executable, "-c", code], r"^1/(shape/\w+|status)/ \d+ True \{")


def test_every_python_block_is_python() -> None:
    for block in PYTHON:
        ast.parse(block)
