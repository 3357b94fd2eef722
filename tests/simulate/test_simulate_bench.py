# SPDX-License-Identifier: Apache-2.0
"""The benchmark: the restated peer is right, the report says what was measured and where a goal is missed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.bench.measure import Timing
from edge.reference.point_targets import unpack
from edge.rig import load_rig
from train.cli import main
from train.simulate import bench, bench_command, bench_drive
from train.simulate.bench_peer import direct_delays, direct_frame
from train.simulate.bench_report import document, lines, misses
from train.simulate.oracle import direct_sum

RIG = load_rig("cascade_pair")
ONE = bench.with_loops(RIG.radars["horizontal"], 1)


def result(**changes: Any) -> dict[str, Any]:
    time = {"median_ms": 1.0, "p99_ms": 1.2, "after_others_ms": 1.1, "wall_ms": 1.0, "wall_p99_ms": 1.2}
    whole = {
        "machine": {"processor": "X", "cores": 2, "load": 0.1, "rig": "r", "python": "3", "numpy": "2"},
        "cases": [{"name": bench.PEER_CASE, "goal_ms": 1.5, **time}],
        "peer": {"name": bench.PEER, **time, "ratio": 900.0, "error_db": -200.0},
        "errors": [{"scene": "still", "width": 4, "rms_db": -85.0, "largest_db": -79.0, "goal_db": -75.0}],
        "memory": {"frames": 3, "before_mb": 100.0, "after_mb": 101.0},
    }
    return {**whole, **changes}


def drive_result(after_mb: float = 301.0) -> dict[str, Any]:
    rows = [{"stage": "optics", "calls": 600, "call_ms": 0.5, "total_ms": 300.0}]
    memory = {"drives": 6, "before_mb": 300.0, "after_mb": after_mb}
    return {"frames": 300, "scatterers": 611.0, "stages": rows, "third": rows, "memory": memory}


def test_the_restated_method_is_the_definition() -> None:
    points = bench.scene(ONE, 20)
    expected = direct_sum(ONE, points)[0]
    assert np.abs(direct_delays(ONE, points) - expected).max() < 1e-6 * np.abs(expected).max()
    noisy = unpack(direct_frame(ONE, points, 25.0, np.random.default_rng(0)), ONE.schedule.layout)[0]
    assert np.sqrt(np.mean(np.abs(noisy - expected) ** 2)) == pytest.approx(25.0, rel=0.02)


def test_goals_met_and_missed() -> None:
    assert list(misses(result())) == []
    slow = [{**result()["cases"][0], "median_ms": 1.6}]
    wrong = [{**result()["errors"][0], "largest_db": -70.0}]
    leaking = {"frames": 3, "before_mb": 100.0, "after_mb": 160.0}
    found = list(misses(result(cases=slow, errors=wrong, memory=leaking)))
    assert [text.split(":")[0] for text in found] == [
        bench.PEER_CASE,
        "still, width 4",
        "Memory grows from 100 to 160 MB.",
    ]
    assert "Nowhere in this run." in "\n".join(lines(result()))
    assert "rfconstruct-train bench" in document(result(), "rfconstruct-train bench")


def test_errors_are_measured_for_every_width_and_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SCATTERERS", 32)
    rows = bench.errors(RIG)
    assert [(row["scene"], row["width"]) for row in rows][:2] == [("still", 4), ("still", 6)]
    assert all(row["rms_db"] < row["goal_db"] for row in rows)
    assert [row["scene"] for row in rows if row["width"] == 4][-1] == "4 at 3 m/s, 8 loops"


def test_command_writes_the_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[float] = []

    def run_suite(rig: Any, seconds: float, builders: Any) -> dict[str, Any]:
        calls.append(seconds)
        assert builders == (bench_drive.drive_cases,)
        return result()

    monkeypatch.setattr(bench, "run_suite", run_suite)
    monkeypatch.setattr(bench_drive, "drive_report", lambda rig: drive_result())
    file = tmp_path / "bench.md"
    assert main(["bench", "--seconds", "3", "--markdown", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cases"][0]["goal_ms"] == 1.5
    assert calls == [3.0]
    assert "## Error against the direct sum in float64" in file.read_text()
    assert "| optics" in file.read_text()


def test_drive_bys_that_leak_are_told() -> None:
    assert list(misses(result(drive=drive_result()))) == []
    assert list(misses(result(drive=drive_result(400.0)))) == ["Memory grows from 300 to 400 MB."]


def test_a_drive_by_is_taken_apart_into_its_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six frames: each stage as often as it must be, the parts make the whole, the same drive-by is not repeated."""
    monkeypatch.setattr(bench_drive, "FRAMES", 6)
    monkeypatch.setattr(bench_drive, "WARM_DRIVES", 1)
    monkeypatch.setattr(bench_drive, "MEMORY_DRIVES", 1)
    found = bench_drive.drive_report(RIG)
    for key, frames in (("stages", 6), ("third", 2)):
        rows = {row["stage"]: row for row in found[key]}
        assert rows["scene"]["calls"] == 1
        assert rows["optics"]["calls"] == rows["synthesis"]["calls"] == rows["heatmap"]["calls"] == 2 * frames
        parts_ms = sum(row["total_ms"] for stage, row in rows.items() if stage != "together")
        assert parts_ms == pytest.approx(rows["together"]["total_ms"])
    assert 300 < found["scatterers"] < 900
    json.dumps(found, allow_nan=False)
    cases = bench_drive.drive_cases(RIG)
    assert [case.goal_ms for case in cases] == [4000.0, None, None, 6.0, None, None]
    cases[4].call()


@pytest.mark.parametrize("arguments", [["--rig", "awr1843_pair"], ["--seconds", "0"]])
def test_what_cannot_be_benched_is_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *arguments]) == 5
    assert "rfconstruct-train: " in capsys.readouterr().err


def test_the_whole_suite_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SCATTERERS", 8)
    monkeypatch.setattr(bench, "MEMORY_FRAMES", 2)
    monkeypatch.setattr(bench, "measure", _once)
    extra = bench.Case("extra", lambda: None, 1.0)
    found = bench.run_suite(RIG, 0.1, (lambda rig: [extra],))
    assert found["cases"][-1]["name"] == "extra"
    assert found["peer"]["error_db"] < -150
    json.dumps(found, allow_nan=False)
    assert bench_command.ONE_THREAD


def _once(calls: Any, seconds: float) -> dict[str, Timing]:
    for call in calls.values():
        call()
    return dict.fromkeys(calls, Timing(1.0, 1.0, 1.0, 1.0, 1.0, 1))
