# SPDX-License-Identifier: Apache-2.0
"""The camera's process with the real depthai and a host node instead of a camera; skipped where it is not installed.

``RFCONSTRUCT_OAK_PYTHON`` names the interpreter of another environment that has depthai.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from oak_host_graph import FRAME_LEAD_S, RATE_HZ, pose_at
from pose_collecting import collect

from edge.board_settings import PoseSettings
from edge.config import RigGeometry
from edge.odometry.oak import OakSource
from edge.odometry.oak_child import EXIT_ENDED, EXIT_NO_DEVICE, GRAPH_VARIABLE, OFFLINE
from edge.odometry.oak_record import Kind, PoseFlag, PoseRecord, RecordReader, TextRecord

ROOT = Path(__file__).parents[2]
PYTHON = os.environ.get("RFCONSTRUCT_OAK_PYTHON") or (
    sys.executable if importlib.util.find_spec("depthai") is not None else ""
)
NS = 1_000_000_000
IN_PLACE = RigGeometry(yaw_deg=0.0, offset_m=(0.0, 0.0, 0.0))

pytestmark = pytest.mark.skipif(not PYTHON, reason="depthai is not installed; RFCONSTRUCT_OAK_PYTHON names no other")


@pytest.fixture(autouse=True)
def host_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv(GRAPH_VARIABLE, "tests.odometry.oak_host_graph:build")
    monkeypatch.delenv("OAK_TEST_MODE", raising=False)


@pytest.fixture
def source() -> Iterator[OakSource]:
    settings = PoseSettings(kind="oak", vio="rtabmap", timeout_s=10.0)
    made = OakSource(settings, IN_PLACE, (PYTHON, "-m", "edge.odometry.oak_child"))
    made.start()
    yield made
    made.close()


def test_poses_come_through_intact(source: OakSource) -> None:
    got = collect(source, lambda c: len(c.poses) >= 100)
    numbers = [round(pose.position_m[0] * RATE_HZ / 2.0) for pose in got.poses]
    assert numbers == list(range(numbers[-1] + 1))
    for number, pose in zip(numbers, got.poses, strict=True):
        position, turn = pose_at(number)
        np.testing.assert_allclose(pose.position_m, position, rtol=0, atol=1e-6 * (1 + number))  # float32 there
        np.testing.assert_allclose(pose.quaternion_xyzw, turn, atol=1e-6)
    assert "not a camera: tests.odometry.oak_host_graph:build, depthai" in source.name
    health = source.health
    assert (health.lost, health.refused, source.garbage_bytes) == (0, 0, 0)


def test_kill_9_is_survived_and_the_frame_is_new(source: OakSource) -> None:
    got = collect(source, lambda c: len(c.poses) >= 10)
    first = source.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    collect(source, lambda c: c.kinds.count("started") == 2 and len(c.poses) > 30, got)
    assert got.kinds[1:3] == ["died", "restarting"]
    assert got.events[3].new_frame
    assert source.pid != first


def run_child(*wrapper: str, seconds: float = 2.0, graph: bool = True) -> tuple[int, bytes, str]:
    """The child under a wrapper, stopped by the end of its input: exit code, records, text."""
    ours, theirs = os.pipe()
    environment = dict(os.environ) | {"PYTHONPATH": str(ROOT)}
    if not graph:
        environment.pop(GRAPH_VARIABLE)
    for name in OFFLINE:  # the child sets them itself
        environment.pop(name, None)
    child = subprocess.Popen(
        [*wrapper, PYTHON, "-m", "edge.odometry.oak_child", "--records", str(theirs), "--vio", "rtabmap"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        pass_fds=(theirs,),
        env=environment,
        cwd=ROOT,
    )
    os.close(theirs)
    data = b""
    with os.fdopen(ours, "rb", buffering=0) as pipe:
        while chunk := pipe.read(1 << 16):
            data += chunk
            if len(data) > 128 * RATE_HZ * seconds and child.stdin is not None:
                child.stdin.close()
    assert child.stdout is not None
    text = child.stdout.read().decode("utf-8", "replace")
    child.stdout.close()
    if child.stdin is not None:
        child.stdin.close()
    return child.wait(30), data, text


def test_each_pose_has_its_frames_time_and_the_process_stops_cleanly() -> None:
    code, data, text = run_child()
    poses = [record for record in RecordReader().feed(data) if isinstance(record, PoseRecord)]
    assert code == 0, text
    assert len(poses) > 100
    exact = [pose for pose in poses if pose.flags == PoseFlag(0)]
    assert len(exact) > 0.8 * len(poses)  # the rest: the node was interrupted between pose and frame
    leads_ns = sorted(pose.arrival_ns - pose.t_ns for pose in exact)
    assert leads_ns[0] >= FRAME_LEAD_S * NS - 1000


def test_a_lost_camera_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OAK_TEST_MODE", "lost")
    code, data, text = run_child(seconds=60.0)
    records = RecordReader().feed(data)
    assert code == EXIT_ENDED, text
    assert isinstance(records[-1], TextRecord)
    assert "pipeline ended" in records[-1].text


def test_the_child_ends_when_its_parent_is_killed() -> None:
    """Nothing holds the camera after a kill -9 of the main process."""
    code = (
        "import sys; from edge.board_settings import PoseSettings as S; from edge.config import RigGeometry as G\n"
        "from edge.odometry.oak import OakSource\n"
        f"s = OakSource(S(kind='oak'), G(), ({PYTHON!r}, '-m', 'edge.odometry.oak_child')); s.start()\n"
        "while not any(hasattr(i, 'position_m') for i in s.poll(1.0)): pass\n"
        "print(s.pid, flush=True)\n"
        "while True: s.poll(1.0)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=ROOT)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait(30)
    parent.stdout.close()
    deadline_s = time.monotonic() + 30.0
    while Path(f"/proc/{pid}/cmdline").exists() and Path(f"/proc/{pid}/cmdline").read_bytes():
        assert time.monotonic() < deadline_s
        time.sleep(0.05)


SAFE = re.compile(r"AF_(UNIX|LOCAL|NETLINK)|AF_INET6?.*(127\.0\.0\.1|::1)")
CALLS = "connect,sendto,sendmsg,sendmmsg,bind,listen"


@pytest.mark.skipif(shutil.which("strace") is None, reason="no strace on this machine")
@pytest.mark.parametrize("graph", [True, False], ids=["host node", "search for a camera"])
def test_no_packet_leaves_the_machine(tmp_path: Path, graph: bool) -> None:
    trace = tmp_path / "trace"
    wrapper = ("strace", "-f", "-qq", "-o", str(trace), "-e", f"trace={CALLS},socket")
    if subprocess.run([*wrapper, "true"], capture_output=True, check=False, timeout=30).returncode:
        pytest.skip("this machine does not let strace attach")
    code, data, text = run_child(*wrapper, seconds=3.0, graph=graph)
    assert code == (0 if graph else EXIT_NO_DEVICE), text
    assert len(data) > (128 * 100 if graph else 0)
    lines = trace.read_text(encoding="utf-8", errors="replace").splitlines()
    outside = [line for line in lines if "AF_INET" in line and not SAFE.search(line)]
    assert outside == []


def test_the_audit_sees_a_packet_when_there_is_one(tmp_path: Path) -> None:
    """What the audit above would miss, it would miss here too."""
    if shutil.which("strace") is None:
        pytest.skip("no strace on this machine")
    trace = tmp_path / "trace"
    code = "import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).connect(('192.0.2.1', 9))"
    wrapper = ["strace", "-f", "-qq", "-o", str(trace), "-e", f"trace={CALLS},socket", sys.executable, "-c", code]
    subprocess.run(wrapper, capture_output=True, check=False, timeout=30)
    lines = trace.read_text(encoding="utf-8", errors="replace").splitlines()
    if not lines:
        pytest.skip("this machine does not let strace attach")
    assert [line for line in lines if "AF_INET" in line and not SAFE.search(line)]


def test_without_a_camera_the_child_says_so_and_ends() -> None:
    if Path("/dev/bus/usb").exists():
        pytest.skip("there may be a camera")
    code, data, text = run_child(graph=False)
    (record,) = RecordReader().feed(data)
    assert isinstance(record, TextRecord)
    assert (record.kind, record.code, code) == (Kind.ERROR, EXIT_NO_DEVICE, EXIT_NO_DEVICE), text
    assert "no camera" in record.text
