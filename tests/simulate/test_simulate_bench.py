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
from train.simulate import bench, bench_command
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
    monkeypatch.setattr(bench, "SCATTERERS", 30)
    rows = bench.errors(RIG)
    assert [(row["scene"], row["width"]) for row in rows][:2] == [("still", 4), ("still", 6)]
    assert all(row["rms_db"] < row["goal_db"] for row in rows)


def test_command_writes_the_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[float] = []

    def run_suite(rig: Any, seconds: float) -> dict[str, Any]:
        calls.append(seconds)
        return result()

    monkeypatch.setattr(bench, "run_suite", run_suite)
    file = tmp_path / "bench.md"
    assert main(["bench", "--seconds", "3", "--markdown", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cases"][0]["goal_ms"] == 1.5
    assert calls == [3.0]
    assert "## Error against the direct sum in float64" in file.read_text()


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
