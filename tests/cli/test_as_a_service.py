# SPDX-License-Identifier: Apache-2.0
"""A live replay under a service manager: what systemd hears from start to end, and metrics that add up."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from pathlib import Path

from cli_run import RIG, SCENE, write_recording

WAIT_S = 120.0


def metrics(path: Path) -> str:
    with socket.socket(socket.AF_UNIX) as visitor:
        visitor.settimeout(WAIT_S)
        visitor.connect(str(path))
        visitor.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        content = b""
        while part := visitor.recv(65536):
            content += part
    return content.decode()


def test_what_a_service_manager_hears_and_what_the_metrics_say(tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "drive.mcap")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(WAIT_S)
        environment = {
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "RUNTIME_DIRECTORY": str(tmp_path),
            "WATCHDOG_USEC": "200000",
            "PATH": "/usr/bin:/bin",
            "HOME": str(Path.home()),
        }
        verb = ["replay", str(recording), "--live", "--speed", "0.1", "--endpoint", f"ipc://{tmp_path}/pub"]
        command = [sys.executable, "-m", "edge", *verb]
        with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
            rescue = threading.Timer(WAIT_S, process.kill)
            rescue.start()
            said = [manager.recv(4096).decode()]
            text = metrics(tmp_path / "metrics.sock")
            while not said[-1].startswith("STOPPING=1"):
                said.append(manager.recv(4096).decode())
            _, errors = process.communicate(timeout=WAIT_S)
            rescue.cancel()
        assert process.returncode == 0, errors.decode()
    first = [line.split("\n")[0] for line in said]
    assert "READY=1" in first
    assert "WATCHDOG=1" in first
    assert first[-1] == "STOPPING=1"
    ready = next(line for line in said if line.startswith("READY=1"))
    assert "\nSTATUS=" in ready
    assert " 200 OK" in text
    assert 'rfconstruct_state{state="' in text
    assert all(f'rfconstruct_frames_in_total{{radar="{radar}"}}' in text for radar in RIG.radars)
    assert not (tmp_path / "metrics.sock").exists()
    assert SCENE.frames
