# SPDX-License-Identifier: Apache-2.0
"""The benchmark compares like with like, gives everyone the same time, and says where we lose."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.bench import cases, suite
from edge.bench.array_peers import NumpyPeer, ScipyPeer, ScipyRankPeer
from edge.bench.cases import Road, Scene
from edge.bench.ceilings import ceilings, heatmap_work
from edge.bench.measure import FEWEST, measure
from edge.bench.package_peers import MmwcorePeer
from edge.bench.peer import Row, covered
from edge.bench.report import document, lines, misses
from edge.bench.startup import Start, resident_bytes, start
from edge.cli import main
from edge.dsp.imager import Imager
from edge.errors import DependencyError, ExitCode, RfconstructError
from edge.frames import RADARS, RadarId
from edge.rig import load_rig
from edge.two_cores import TwoCores

RIG = load_rig("cascade_demo")
SCENE = Scene(RIG, 1)
ROAD = Road(SCENE, "ca")


@pytest.mark.parametrize("radar", RADARS)
@pytest.mark.parametrize("peer_class", [NumpyPeer, ScipyPeer])
def test_array_peers_make_the_same_heatmap_and_detections(radar: RadarId, peer_class: type[NumpyPeer]) -> None:
    heatmap, cfar = SCENE.settings("ca")
    peer = peer_class(SCENE.rig.radars[radar], heatmap, RIG.settings.antenna, cfar)
    frame = SCENE.frames[radar]
    ours, power = ROAD.imagers[radar].process(frame), peer.image(frame)
    assert ours.response is not None
    received = ours.power / ours.response.gain[:, None]
    np.testing.assert_allclose(power, received, rtol=2e-3, atol=1e-5 * float(power.max()))
    decided = ROAD.detectors[radar].decisions(ours)
    assert np.mean(decided != peer.decided(power)) < 1e-4
    found, theirs = ROAD.one(radar), peer.detect(frame)
    assert covered(ours, found, theirs) == len(found) >= 10  # the peer also has sidelobes, which we leave out


def test_the_ordered_statistic_of_scipy_decides_alike_away_from_the_ends_of_range() -> None:
    radar, cfar = RADARS[0], SCENE.settings("os")[1]
    board = SCENE.rig.radars[radar]
    road = Road(SCENE, "os")
    peer = ScipyRankPeer(board, SCENE.settings("os")[0], RIG.settings.antenna, cfar)
    heatmap = road.imagers[radar].process(SCENE.frames[radar])
    decided, theirs = road.detectors[radar].decisions(heatmap), peer.decided(peer.image(SCENE.frames[radar]))
    inner = slice(peer.first + cfar.train_range, peer.points - cfar.train_range)
    assert decided[:, inner].any()
    assert np.mean(decided[:, inner] != theirs[:, inner]) < 1e-4


def test_the_row_of_a_plane_wave_is_a_plane_wave() -> None:
    board = RIG.radars["horizontal"]
    row = Row(Imager(board, replace(RIG.settings.heatmap, focus=False), RIG.settings.antenna))
    position = np.asarray(board.array.position, dtype=np.float64)[row.slot, row.receiver]
    filled = row.fill(np.exp(0.3j * position)[:, None])
    turn = filled[1:, 0] / filled[:-1, 0]
    np.testing.assert_allclose(np.angle(turn), board.mounting.array_sign * 0.3, atol=1e-3)
    assert np.abs(filled[:, 0]).sum() == pytest.approx(1.0, rel=1e-4)


def test_reflectors_are_found_by_every_road() -> None:
    assert SCENE.found(ROAD()) >= 10
    moving = Scene(RIG, 2, np.array([0.0, 3.0, 0.0]))
    assert moving.found(Road(moving, "ca")()) >= 10


def test_two_cores_give_the_same_points_and_pass_errors_on() -> None:
    with TwoCores() as cores:
        alone, together = ROAD(), ROAD.threaded(cores)
        np.testing.assert_array_equal(alone.xyz_m, together.xyz_m)
        with pytest.raises(ZeroDivisionError):
            cores.both(lambda: None, lambda: 1 / 0)
        with pytest.raises(KeyError):
            cores.both(lambda: {}["x"], lambda: None)
        assert cores.both(lambda: 1, lambda: 2) == (1, 2)
    with pytest.raises(RuntimeError, match="closed"):
        cores.both(lambda: 1, lambda: 2)


def test_every_call_gets_the_same_time_and_slow_ones_three_turns() -> None:
    timings = measure({"fast": lambda: time.sleep(0.001), "slow": lambda: time.sleep(0.03)}, budget_s=0.2)
    assert timings["slow"].repetitions >= FEWEST
    assert timings["fast"].repetitions > timings["slow"].repetitions
    for timing in timings.values():
        assert timing.p99_ms >= timing.median_ms
        assert timing.wall_p99_ms >= timing.wall_ms > timing.median_ms  # sleeping takes no CPU
        assert timing.by_wall().median_ms == timing.wall_ms


def test_ceilings_and_work_are_positive_and_counted() -> None:
    top = ceilings()
    assert min(top.cache_gb_s, top.memory_gb_s, top.gflop_s) > 0.1
    one, eight = (heatmap_work(Scene(RIG, n).rig.radars["horizontal"], RIG.settings.heatmap, 256) for n in (1, 8))
    assert eight.bytes - one.bytes == 7 * RIG.radars["horizontal"].schedule.layout.nbytes
    assert eight.flops > one.flops


def test_a_start_is_measured_from_outside() -> None:
    measured = start("cascade_demo", "kernels")
    assert 30 < measured.resident_mb < 1000
    assert measured.seconds > 0.1
    assert measured.cpu_s > 0.1
    assert resident_bytes() > 30e6
    with pytest.raises(RfconstructError, match="a start of kernels failed"):
        start("no such rig", "kernels")


def test_a_package_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mmwcore._native", None)
    settings = SCENE.settings("ca")
    with pytest.raises(DependencyError, match=r"mmwcore is not installed.*rfconstruct\[peers\]"):
        MmwcorePeer(SCENE.rig.radars["horizontal"], settings[0], RIG.settings.antenna, settings[1])


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    """A real result, made in a hurry."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "PEERS_OF", {"ca": ((NumpyPeer, None), (ScipyPeer, 1e6), (MmwcorePeer, 20.0)), "os": ()})
        patch.setattr(cases, "STAGE_PEERS", ((NumpyPeer, "ca"), (ScipyPeer, "ca")))
        patch.setattr(suite, "start", lambda rig, part, cold=False: Start(99.0 if cold else 1.0, 0.9, 260.0))
        patch.setitem(sys.modules, "mmwcore._native", None)
        return suite.run_suite(RIG, 0.1, cold=True)


def test_the_result_is_complete(result: dict[str, Any]) -> None:
    names = [frame["name"] for frame in result["frames"]]
    assert names[0] == "one loop, CA"
    assert {"one loop, OS", "8 loops summed, CA", "one loop, CA, two cores"} <= set(names)
    for frame in result["frames"]:
        assert frame["median_ms"] > 0
        assert frame["found"] >= 10
    peers = {peer["name"]: peer for peer in result["frames"][0]["peers"]}
    ours = result["frames"][0]["median_ms"]
    for peer in peers.values():
        assert peer["ratio"] == pytest.approx(peer["median_ms"] / ours)
        assert peer["covered"] == peer["ours"] > 20
    assert list(result["not_measured"]) == ["Mmwcore"]
    assert {stage["name"] for stage in result["stages"]} >= {"heatmap", "association", "CFAR OS with peaks"}
    assert [work["stage"] for work in result["work"]] == ["heatmap", "CFAR CA with peaks"]
    assert [entry["cold"] for entry in result["starts"]] == [False, False, True]


def test_every_missed_goal_and_every_faster_peer_is_told(result: dict[str, Any]) -> None:
    told = "\n".join(misses(result))
    assert "one loop, CA: " in told  # a million times faster than SciPy is not reached
    assert "goal 1000000" in told
    assert "no compiled kernels: ready after 99.0 s (0.9 s of CPU), goal 20 s" in told
    assert "260 MB, goal 250 MB" in told
    first = dict(result["frames"][0], median_ms=1.0, p99_ms=1.5, goal_ms=0.5)
    first["peers"] = [dict(first["peers"][0], ratio=0.5, found=first["found"] + 1)]
    told = list(misses({**result, "frames": [first], "stages": [], "starts": []}))
    assert told[0] == "one loop, CA: 1.000 ms, goal 0.500 ms."
    assert "is 2.0 times faster than we are" in told[1]
    assert "reflectors, we find" in told[2]


def test_the_document_names_command_machine_and_what_was_not_measured(result: dict[str, Any]) -> None:
    text = document(result, "rfconstruct bench --markdown FILE")
    assert text.startswith("# Benchmarks\n")
    assert "rfconstruct bench --markdown FILE" in text
    assert result["machine"]["processor"] in text
    assert "* Not measured: Mmwcore: peer mmwcore is not installed" in text
    tables = [line for line in lines(result) if line.startswith("|")]
    assert {len(line) for line in tables if "case: peer" in line or "numpy float32" in line} != set()
    assert max(map(len, tables)) < 160


def test_the_command_writes_the_document(
    result: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(suite, "run_suite", lambda rig, seconds, cold: result)
    path = tmp_path / "benchmarks.md"
    assert main(["bench", "--json", "--seconds", "1", "--cold", "--markdown", str(path)]) == ExitCode.OK
    assert json.loads(capsys.readouterr().out)["machine"]["rig"] == "cascade_demo"
    assert f"rfconstruct bench --rig cascade_demo --seconds 1 --cold --markdown {path}" in path.read_text()
    assert main(["bench"]) == ExitCode.OK
    assert "## Where we lose or miss a goal" in capsys.readouterr().out
