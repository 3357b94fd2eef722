# SPDX-License-Identifier: Apache-2.0
"""``rfconstruct run`` against the virtual rig: every frame accounted for, no breach of a protocol, clean ends."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from cli_run import Outcome, rfconstruct
from virtual_boards import Virtual, virtual_boards

from edge.commands.live_road import Limits
from edge.errors import ExitCode
from edge.rig import load_rig

EDGES = {"no_pose", "unpaired"}


def balanced(outcome: Outcome, frames: int) -> None:
    """Every frame that was asked for came in, and became a result or was lost at the edges of the poses."""
    for account in outcome.json["frames"].values():
        assert account["frames_in"] == frames
        assert account["frames_ok"] + account["frames_lost"] == frames
        assert set(account["lost"]) <= EDGES
        assert account["frames_ok"] >= frames - 30, outcome.out


def nobody(*_: Any, **__: Any) -> None:
    raise AssertionError("a dry run opens nothing")


def test_dry_run_of_cascades(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "socket", nobody)
    outcome = rfconstruct("run", "--rig", "cascade_pair", "--dry-run")
    assert outcome.code == ExitCode.OK
    golden = (  # hardware notes 1.2 and 1.5: ping, 8 loops of 2048 x 96, start of the master
        "10000000c8a5120000000c00201000000000a695",
        "18000000c8a51400000014000101000000000008000060000000821c",
        "00000200e4388e55f401000058020000a00f00000000000000000000650600000001401f0000000030000000",
    )
    for radar in ("horizontal", "vertical"):
        part = outcome.out[outcome.out.index(f"{radar} radar: cascade") :]
        assert all(text in part.replace(" ", "") for text in golden)


def test_dry_run_of_single_chips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "socket", nobody)
    outcome = rfconstruct("run", "--rig", "awr1843_pair", "--dry-run", "--json")
    plan = outcome.json["plan"]
    for radar in ("horizontal", "vertical"):
        text = "\n".join(plan[radar])
        assert "5aa50b000600be05350c0000aaee" in text
        assert "5aa50300060001020102031eaaee" in text
        assert text.index("RECORD_START") < text.index("CLI sensorStart 0")


def test_capture_cards_live(tmp_path: Path) -> None:
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        outcome = rfconstruct(
            "run", "--rig", "awr1843_pair", "--boards", virtual.boards, "--frames", 60, "--no-publish", "--json"
        )
        assert virtual.violations == []
        assert not virtual.parts.radars["horizontal"].streaming
    assert outcome.code in (ExitCode.OK, ExitCode.DEGRADED), outcome.err
    balanced(outcome, 60)


def test_cascades_in_segments(tmp_path: Path) -> None:
    with virtual_boards("cascade_pair", tmp_path, segment_frames=6) as virtual:
        words = ("run", "--rig", "cascade_pair", "--boards", virtual.boards, "--no-publish", "--segments", 2, "--json")
        outcome = rfconstruct(*words)
        assert virtual.violations == []
        assert all(not list(board.recorder.root.iterdir()) for board in virtual.parts.boards.values())
    assert outcome.code == ExitCode.OK, outcome.err
    balanced(outcome, 12)


def test_no_board_there(tmp_path: Path) -> None:
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        virtual.parts.unplug("horizontal")
        outcome = rfconstruct(
            "run", "--rig", "awr1843_pair", "--boards", virtual.boards, "--frames", 5, "--no-publish", "--json"
        )
    assert outcome.code == ExitCode.NO_HARDWARE
    assert "horizontal card does not answer" in outcome.json["error"]["what"]
    assert outcome.json["error"]["action"]


def test_a_board_that_dies_for_good(tmp_path: Path) -> None:
    """Set up anew three times in vain; the frames before are in the account, which is printed."""
    with virtual_boards("awr1843_pair", tmp_path) as virtual:
        watcher = threading.Thread(target=when_frames_run, args=(virtual, lambda: virtual.parts.unplug("vertical")))
        watcher.start()
        outcome = rfconstruct("run", "--rig", "awr1843_pair", "--boards", virtual.boards, "--no-publish")
        watcher.join()
    assert outcome.code == ExitCode.NO_HARDWARE
    assert "the run ends" in outcome.out
    assert "frames in" in outcome.out
    assert "vertical" in outcome.out.partition("the run ends")[2]


def test_two_boards_at_one_address(tmp_path: Path) -> None:
    boards = tmp_path / "boards.toml"
    boards.write_text('[radars.vertical.board]\naddress = "192.168.33.180"\n')
    outcome = rfconstruct("run", "--rig", "cascade_pair", "--boards", boards, "--dry-run")
    assert outcome.code == ExitCode.BAD_CONFIG
    assert "share one control address" in outcome.err


@pytest.mark.parametrize("name", ["awr1843_pair", pytest.param("cascade_pair", marks=pytest.mark.slow)])
def test_an_interrupt_ends_the_run_in_order(name: str, tmp_path: Path) -> None:
    with virtual_boards(name, tmp_path, segment_frames=120) as virtual:
        interrupt = partial(os.kill, os.getpid(), signal.SIGINT)
        watcher = threading.Thread(target=when_frames_run, args=(virtual, interrupt))
        watcher.start()
        outcome = rfconstruct("run", "--rig", name, "--boards", virtual.boards, "--no-publish")
        watcher.join()
        assert virtual.violations == []
        assert not any(radar.streaming for radar in virtual.parts.radars.values())
        assert not any(board.recorder.recording for board in virtual.parts.boards.values())
    assert outcome.code == 130
    assert "ended by SIGINT" in outcome.out
    assert "frames in" in outcome.out


def when_frames_run(virtual: Virtual, act: Callable[[], object]) -> None:
    parts = [*virtual.parts.radars.values(), *virtual.parts.boards.values()]
    end_s = time.monotonic() + 250.0
    while not all(part.bursts > 20 for part in parts) and time.monotonic() < end_s:
        time.sleep(0.02)
    act()


@pytest.mark.parametrize(
    ("frames", "most", "expected"),
    [(3600, 360, (360, 10)), (400, 360, (200, 2)), (5, 360, (5, 1)), (None, 9, (9, None))],
)
def test_equal_segments(frames: int | None, most: int, expected: tuple[int, int | None]) -> None:
    limits = Limits(frames, None)
    each = limits.frames_of(most)
    assert (each, limits.segments_of(each)) == expected
    assert Limits(frames, 1).segments_of(each) == 1


def test_boards_file_of_the_virtual_rig(tmp_path: Path) -> None:
    with virtual_boards("cascade_pair", tmp_path) as virtual:
        rig = load_rig("cascade_pair", virtual.boards)
        assert rig.pose.endpoint == virtual.parts.addresses()["pose"]
        assert rig.boards["vertical"].folder == virtual.parts.addresses()["vertical.ssd"]  # type: ignore[union-attr]
