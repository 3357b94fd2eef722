# SPDX-License-Identifier: Apache-2.0
"""Recorded frames through the emulated wire and the unmodified runtime give what the same frames give from memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hil_runs import Item, Results, from_boards, through_pipeline

from edge.drivers.offset import window_of
from edge.frames import RADARS, LossCause, Pose, RadarFrame, RadarId
from edge.recording.reader import RecordingReader
from edge.recording.writer import RecordingWriter
from edge.rig import Rig, load_rig
from edge.sources.base import Loss
from train.simulate.boards_file import data_targets, write_boards
from train.simulate.rig import VirtualRig, VirtualRigSettings
from train.simulate.supplies import CyclicSupply, straight_poses, targets

RECORDED = 6
FRAMES = {"awr1843_pair": 60, "awr2944_pair": 60, "cascade_pair": 12}


def recorded_frames(rig: Rig, path: Path) -> dict[RadarId, list[RadarFrame]]:
    """Frames written to a recording and read back from it."""
    supply = targets(rig, RECORDED)
    with RecordingWriter(path, rig) as writer:
        for number in range(RECORDED):
            for radar in RADARS:
                writer.frame(supply(radar, number))
    found: dict[RadarId, list[RadarFrame]] = {radar: [] for radar in RADARS}
    with RecordingReader(path) as reader:
        for item in reader:
            if isinstance(item, RadarFrame):
                found[item.radar].append(item)
    return found


@pytest.fixture(params=sorted(FRAMES))
def played(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Iterator[tuple[Rig, dict[RadarId, list[RadarFrame]], list[Item]]]:
    """The rig, the recorded frames, and what came of them over the wire."""
    plain = load_rig(request.param)
    frames = recorded_frames(plain, tmp_path / "frames.mcap")
    settings = VirtualRigSettings(data_targets=data_targets(plain))
    demo = replace(settings.demo, start_s=0.0, restart_s=0.0, boot_s=0.0)
    settings = replace(settings, demo=demo, card=replace(settings.card, deaf_s=0.0))
    with VirtualRig(plain, CyclicSupply(plain, frames), tmp_path / "disks", straight_poses(plain), settings) as virtual:
        boards = tmp_path / "boards.toml"
        write_boards(boards, virtual)
        rig = load_rig(request.param, boards)
        items = from_boards(rig, FRAMES[request.param], tmp_path / "copies")
        assert not [text for texts in virtual.violations().values() for text in texts]
        yield rig, frames, items


def from_memory(items: list[Item], frames: dict[RadarId, list[RadarFrame]]) -> list[Item]:
    """The same numbers and times with the recorded samples; AssertionError: a frame that is none of them."""
    place = {radar: {frame.adc.tobytes(): k for k, frame in enumerate(own)} for radar, own in frames.items()}
    before: dict[RadarId, int] = {}
    found: list[Item] = []
    for item in items:
        if not isinstance(item, RadarFrame):
            found.append(item)
            continue
        index = place[item.radar][item.adc.tobytes()]
        assert index == (before.get(item.radar, index - 1) + 1) % RECORDED, "frames come in their order, none twice"
        before[item.radar] = index
        found.append(replace(item, adc=frames[item.radar][index].adc))
    return found


def same(first: Results, second: Results) -> None:
    """Bit for bit."""
    assert len(first.frames) == len(second.frames)
    for a, b in zip(first.frames, second.frames, strict=True):
        assert (a.number, a.t_ns) == (b.number, b.t_ns)
        assert a.cloud is not None
        assert b.cloud is not None
        for name in ("xyz_m", "power_db", "range_horizontal_m", "range_vertical_m"):
            assert np.array_equal(getattr(a.cloud, name), getattr(b.cloud, name))
    for a_, b_ in zip(first.windows, second.windows, strict=True):
        assert np.array_equal(a_.cloud.xyz_m, b_.cloud.xyz_m)


def test_points_from_the_wire_are_those_from_memory(
    played: tuple[Rig, dict[RadarId, list[RadarFrame]], list[Item]],
) -> None:
    rig, frames, items = played
    count = FRAMES[rig.name]
    assert not [item for item in items if isinstance(item, Loss)]
    for radar in RADARS:
        own = [item.number for item in items if isinstance(item, RadarFrame) and item.radar == radar]
        assert own == list(range(count))
    wire, pipeline = through_pipeline(rig, items)
    memory, _ = through_pipeline(rig, from_memory(items, frames))
    same(wire, memory)
    for ledger in pipeline.ledgers.values():
        account = ledger.snapshot()
        assert account.frames_in == count
        assert set(account.lost) <= {LossCause.NO_POSE, LossCause.UNPAIRED}
    assert any(len(result.cloud or ()) for result in wire.frames)
    check_times(rig, items)


def check_times(rig: Rig, items: list[Item]) -> None:
    """Frames are a period apart, radar two lies in the gaps of radar one, poses are in order."""
    period_ns = 1e9 * rig.radars["horizontal"].schedule.frame_period_s_actual
    times = {r: [i.t_first_chirp_ns for i in items if isinstance(i, RadarFrame) and i.radar == r] for r in RADARS}
    for own in times.values():
        assert (np.diff(own) > 0).all()
        assert np.median(np.diff(own)) == pytest.approx(period_ns, rel=1e-2)
    offset_s = float(np.median(np.array(times["vertical"]) - np.array(times["horizontal"]))) / 1e9
    window = window_of(rig, hold_s=0.0)
    assert window.earliest_s <= offset_s % window.period_s <= window.latest_s
    poses = [item.t_ns for item in items if isinstance(item, Pose)]
    assert (np.diff(poses) > 0).all()


def test_real_boards(device_rig: Rig, tmp_path: Path) -> None:
    """Two seconds of the boards given with --device: complete, alive, in turn, and through the pipeline."""
    period_s = device_rig.radars["horizontal"].schedule.frame_period_s_actual
    items = from_boards(device_rig, round(2.0 / period_s), tmp_path)
    assert not [item for item in items if isinstance(item, Loss)]
    for item in items:
        if isinstance(item, RadarFrame):
            spread = item.adc.astype(np.float32).std()
            assert 1.0 < spread < 8000.0, "neither silent nor saturated"
    check_times(device_rig, items)
    _, pipeline = through_pipeline(device_rig, items)
    for ledger in pipeline.ledgers.values():
        assert set(ledger.snapshot().lost) <= {LossCause.NO_POSE, LossCause.UNPAIRED}
