# SPDX-License-Identifier: Apache-2.0
"""The simulator as a frame source: order, numbers, times, faults, errors, late frames counted; supplies."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from edge.errors import CaptureError
from edge.frames import RADARS, LossCause, Pose, RadarFrame, RadarId
from edge.rig import Rig, load_rig
from edge.sources.base import FrameSource
from edge.sources.pairing import FramePairer
from train.simulate.faults import Faults
from train.simulate.simulator_source import SimulatorSource
from train.simulate.supplies import EPOCH_NS, CyclicSupply, PreparedSupply, frame_time_ns, targets

PERIOD_NS = 16_667_000


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("awr1843_pair")


@pytest.fixture(scope="module")
def supply(rig: Rig) -> CyclicSupply:
    return targets(rig, count=2)


def poses(count: int, step_ns: int = 5_000_000) -> list[Pose]:
    turn = np.array([0.0, 0.0, 0.0, 1.0])
    return [Pose(EPOCH_NS - 1_000_000 + k * step_ns, np.array([0.01 * k, 0.0, 0.8]), turn) for k in range(count)]


def times(items: list[object]) -> list[int]:
    return [x.t_ns if isinstance(x, Pose) else x.t_first_chirp_ns for x in items if isinstance(x, Pose | RadarFrame)]


def frames_of(items: list[object], radar: str | None = None) -> list[RadarFrame]:
    return [x for x in items if isinstance(x, RadarFrame) and radar in (None, x.radar)]


def test_everything_in_time_order(rig: Rig, supply: CyclicSupply) -> None:
    source = SimulatorSource(rig, supply, frames=5, poses=poses(20), pace=0)
    assert isinstance(source, FrameSource)
    assert source.total_frames == 10
    for _ in range(2):
        items: list[object] = list(source)
        assert len(items) == 30
        assert times(items) == sorted(times(items))
        assert [f.number for f in frames_of(items, "horizontal")] == [0, 1, 2, 3, 4]
        for horizontal, vertical in zip(frames_of(items, "horizontal"), frames_of(items, "vertical"), strict=True):
            assert vertical.t_first_chirp_ns - horizontal.t_first_chirp_ns == pytest.approx(PERIOD_NS / 2, abs=1)
    assert source.late.total() == source.slow_reads == 0
    source.close()
    assert list(source) == []


def test_real_time_gives_the_clock(rig: Rig, supply: CyclicSupply) -> None:
    source = SimulatorSource(rig, supply, frames=3, poses=poses(4), pace=1.0)
    items: list[object] = list(source)
    steps = np.diff(times(frames_of(items, "horizontal")))  # type: ignore[arg-type]
    assert steps.tolist() == [PERIOD_NS, PERIOD_NS]
    assert min(times(items)) > EPOCH_NS, "CLOCK_MONOTONIC of this machine"
    assert [f.number for f in frames_of(items)] == [0, 0, 1, 1, 2, 2]
    source.close()


def test_slow_supply_is_counted(rig: Rig, supply: CyclicSupply) -> None:
    """Frame 3 is not made before the reader waits for it: late, and nothing is lost."""
    gate = threading.Event()

    def gated(radar: RadarId, number: int) -> RadarFrame:
        if number == 3:
            gate.wait(0.2)
        return supply(radar, number)

    source = SimulatorSource(rig, gated, frames=6, pace=20.0, depth=2)
    items: list[object] = list(source)
    assert len(frames_of(items)) == 12
    assert source.late.total() >= 1
    source.close()


def test_frames_made_ahead_come_first_and_the_wait_can_be_ended(rig: Rig, supply: CyclicSupply) -> None:
    made = list[int]()

    def counted(radar: RadarId, number: int) -> RadarFrame:
        made.append(number)
        return supply(radar, number)

    source = SimulatorSource(rig, counted, frames=4, pace=1.0, depth=100)
    source.make_ahead(lambda: False)
    assert sorted(made) == [0, 0, 1, 1, 2, 2, 3, 3], "all of them, and nobody has asked for one"
    assert [frame.number for frame in frames_of(list(source))] == [0, 0, 1, 1, 2, 2, 3, 3]
    source.close()
    endless = SimulatorSource(rig, supply, depth=10**6)
    endless.make_ahead(lambda: True)
    endless.close()


def test_slow_reader_is_counted(rig: Rig, supply: CyclicSupply) -> None:
    source = SimulatorSource(rig, supply, frames=20, pace=50.0, depth=4)
    pause = threading.Event()
    count = 0
    for _ in source:
        pause.wait(0.004)
        count += 1
    assert count == 40
    assert source.slow_reads >= 1
    source.close()


def test_endless_and_closed_from_another_thread(rig: Rig, supply: CyclicSupply) -> None:
    source = SimulatorSource(rig, supply, pace=0)
    assert source.total_frames is None
    assert len(list(islice(source, 50))) == 50
    got: list[object] = []
    reader = threading.Thread(target=lambda: got.extend(source), daemon=True)
    reader.start()
    while len(source._threads) < 2:
        pass
    source.close()
    reader.join(10)
    assert not reader.is_alive()


@pytest.mark.parametrize("depth", [1, 8])
def test_end_of_the_supply_is_an_error_at_its_place(rig: Rig, supply: CyclicSupply, depth: int) -> None:
    def ends(radar: RadarId, number: int) -> RadarFrame:
        if number == 2:
            raise CaptureError("no frame 2")
        return supply(radar, number)

    source = SimulatorSource(rig, ends, pace=0, depth=depth)
    got = []
    with pytest.raises(CaptureError, match="no frame 2"):
        got.extend(iter(source))
    iterator = iter(source)
    assert [next(iterator).number for _ in range(3)] == [0, 0, 1]  # type: ignore[union-attr]
    source.close()


def run_pairer(items: list[object]) -> tuple[int, dict[LossCause, int]]:
    pairer, pairs, losses = FramePairer(RADARS), 0, dict[LossCause, int]()
    for item in items:
        if isinstance(item, RadarFrame):
            made, lost = pairer.add(item)
            pairs += len(made)
            for loss in lost:
                losses[loss.cause] = losses.get(loss.cause, 0) + loss.count
    for loss in pairer.flush():
        losses[loss.cause] = losses.get(loss.cause, 0) + loss.count
    return pairs, losses


@pytest.mark.parametrize(
    ("fault", "pairs", "losses"),
    [
        ("drop", 19, {LossCause.GAP: 1, LossCause.UNPAIRED: 1}),
        ("duplicate", 20, {LossCause.BACKWARDS_TIME: 1}),
        ("reorder", 19, {LossCause.GAP: 1, LossCause.BACKWARDS_TIME: 1, LossCause.UNPAIRED: 1}),
        ("unplug", 5, {LossCause.UNPAIRED: 15}),
    ],
)
def test_faults_end_in_exact_accounts(
    rig: Rig, supply: CyclicSupply, fault: str, pairs: int, losses: dict[LossCause, int]
) -> None:
    faults = Faults()
    faults.set(fault, "vertical/frames", skip=5, times=1)
    source = SimulatorSource(rig, supply, frames=20, pace=0, faults=faults)
    assert run_pairer(list(source)) == (pairs, losses)
    source.close()


def test_late_radar_two(rig: Rig, supply: CyclicSupply) -> None:
    faults = Faults()
    faults.set("late", "vertical/frames", value=0.011)
    items: list[object] = list(SimulatorSource(rig, supply, frames=3, pace=0, faults=faults))
    first = {f.radar: f.t_first_chirp_ns for f in frames_of(items)[:3] if f.number == 0}
    assert times(items) == sorted(times(items))
    assert first["vertical"] - first["horizontal"] == pytest.approx(PERIOD_NS / 2 + 11_000_000, abs=1)
    assert [(f.radar[0], f.number) for f in frames_of(items)][:3] == [("h", 0), ("h", 1), ("v", 0)]


def test_faults_of_samples_and_poses(rig: Rig, supply: CyclicSupply) -> None:
    faults = Faults(seed=4)
    faults.set("dead", "horizontal/frames", value=2)
    faults.set("stuck", "horizontal/frames", value=1)
    faults.set("garble", "vertical/frames", value=3, times=1)
    faults.set("drop", "pose", skip=2, times=1)
    faults.set("duplicate", "pose", skip=4, times=1)
    items: list[object] = list(SimulatorSource(rig, supply, frames=2, poses=poses(8), pace=0, faults=faults))
    for frame in frames_of(items, "horizontal"):
        clean = supply("horizontal", frame.number).adc
        assert not frame.adc[:, :, 2].any()
        assert (frame.adc[:, :, 1] == frame.adc[0, 0, 1, 0]).all()
        assert np.array_equal(frame.adc[:, :, [0, 3]], clean[:, :, [0, 3]])
    garbled, whole = frames_of(items, "vertical")
    difference = garbled.adc.view(np.uint16) ^ supply("vertical", 0).adc.view(np.uint16)
    assert int(np.bitwise_count(difference).sum()) == 3
    assert np.array_equal(whole.adc, supply("vertical", 1).adc)
    got = [round((p.t_ns - EPOCH_NS) / 1e6) for p in items if isinstance(p, Pose)]
    assert got == [-1, 4, 14, 19, 24, 24, 29, 34]


# --- supplies


def test_cyclic_frames_share_their_samples(rig: Rig, supply: CyclicSupply) -> None:
    assert supply("vertical", 7).adc is supply("vertical", 1).adc
    assert supply("vertical", 7).t_first_chirp_ns == frame_time_ns(rig, "vertical", 7)
    assert not np.array_equal(supply("vertical", 0).adc, supply("vertical", 1).adc)
    with pytest.raises(CaptureError, match="no frames of the vertical radar"):
        CyclicSupply(rig, {"horizontal": [supply("horizontal", 0)]})


def counting(supply: CyclicSupply) -> tuple[Callable[[RadarId, int], RadarFrame], list[int]]:
    asked: list[int] = []

    def one(radar: RadarId, number: int) -> RadarFrame:
        asked.append(number)
        if number == 9:
            raise CaptureError("the drive is over", value=number)
        return supply(radar, number)

    return one, asked


def test_prepared_frames(rig: Rig, supply: CyclicSupply) -> None:
    one, asked = counting(supply)
    prepared = PreparedSupply(one, depth=3)
    prepared.prepare("horizontal", 2)
    assert [prepared("horizontal", n).number for n in (2, 3, 4)] == [2, 3, 4]
    assert prepared("horizontal", 0).number == 0, "another place: begun anew"
    assert prepared("vertical", 0).radar == "vertical"
    assert [prepared("horizontal", n).number for n in range(1, 9)] == list(range(1, 9))
    with pytest.raises(CaptureError, match="the drive is over"):
        prepared("horizontal", 9)
    assert prepared("horizontal", 10).number == 10
    assert prepared.close()
    assert max(asked) <= 10 + 3 + 1
    with pytest.raises(CaptureError, match="was closed"):
        prepared("vertical", 5)


def test_prepared_is_stopped_while_somebody_waits(supply: CyclicSupply) -> None:
    hold = threading.Event()

    def never(radar: RadarId, number: int) -> RadarFrame:
        hold.wait(5)
        return supply(radar, number)

    prepared = PreparedSupply(never)
    errors: list[CaptureError] = []

    def take() -> None:
        try:
            prepared("horizontal", 0)
        except CaptureError as error:
            errors.append(error)

    waiting = threading.Thread(target=take, daemon=True)
    waiting.start()
    threading.Timer(0.05, hold.set).start()
    assert prepared.close()
    waiting.join(10)
    assert not waiting.is_alive()


def test_targets_are_found_where_they_are(tmp_path: Path) -> None:
    """Range spectrum of the supply's frames: the strongest bin is one of the targets' ranges."""
    rig = load_rig("cascade_demo")
    rig = replace(rig, radars={"horizontal": rig.radars["horizontal"]})
    supply = targets(rig, count=1, seed=1, noise_lsb=0.0)
    frame = supply("horizontal", 0)
    profile = rig.radars["horizontal"].schedule.profile
    signal = frame.adc[0, 0, 0, :, 0, 0] + 1j * frame.adc[0, 0, 0, :, 0, 1]
    spectrum = np.abs(np.fft.fft(signal * np.hanning(len(signal))))
    range_m = np.random.default_rng(1).uniform(3.0, 8.0, 3)
    found_m = float(np.argmax(spectrum)) * profile.range_bin_m
    assert np.abs(range_m - found_m).min() < 1.5 * profile.range_bin_m
