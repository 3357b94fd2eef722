# SPDX-License-Identifier: Apache-2.0
"""The same frames give the same digest: run after run, in two threads at once, in every pass, on one or two threads."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline_scenes import PERIOD_NS, RIG, Item, frames_of, in_time_order, scene_poses

from edge.completion.manifest import find_model
from edge.completion.model import CompletionModel
from edge.digest import ResultDigest
from edge.frames import Float32, ObjectCloud, Pose
from edge.pipeline import FrameResult, Pipeline, WindowResult
from edge.recording.playback import PASS_GAP_NS, Part, Playback
from edge.recording.reader import RecordingReader
from edge.recording.writer import RecordingWriter

FRAMES = 8


@pytest.fixture(scope="module")
def items() -> list[Item]:
    frames = frames_of(FRAMES)
    return in_time_order(*frames.values(), scene_poses(FRAMES))


def digest(items: Iterable[Item]) -> str:
    found = ResultDigest()
    pipeline = Pipeline(RIG, None, [found])
    for item in items:
        pipeline.feed(item)
    pipeline.finish()
    assert found.messages >= FRAMES
    return found.hexdigest()


def test_two_runs_and_two_threads_agree(items: list[Item]) -> None:
    first = digest(items)
    assert digest(items) == first
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(digest, [items, items])) == [first, first]
    assert digest(items[:-6]) != first


class Numbers:
    """A sink that keeps numbers of detections and points, frame by frame."""

    def __init__(self) -> None:
        self.frames: list[tuple[int, int, bytes]] = []

    def frame(self, result: FrameResult) -> None:
        found = b"".join(one.range_m.tobytes() + one.power_db.tobytes() for one in result.detections.values())
        assert result.cloud is not None
        self.frames.append((result.number, result.t_ns, found + result.cloud.xyz_m.tobytes()))

    def window(self, result: WindowResult) -> None:
        assert result.cloud.t_end_ns - result.cloud.t_start_ns < FRAMES * PERIOD_NS, "no window spans two passes"


def test_every_pass_of_a_loop_finds_the_same(items: list[Item], tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", RIG) as writer:
        for item in items:
            if isinstance(item, Pose):
                writer.pose(item)
            else:
                writer.frame(item)  # type: ignore[arg-type]
    numbers = Numbers()
    pipeline = Pipeline(RIG, None, [numbers])
    with RecordingReader(tmp_path / "a.mcap") as reader:
        for item in Playback(reader, Part(loops=3)):
            pipeline.feed(item)
    pipeline.finish()
    assert all(not ledger.snapshot().lost for ledger in pipeline.ledgers.values())
    assert [number for number, _, _ in numbers.frames] == list(range(3 * FRAMES))
    once = [found for _, _, found in numbers.frames[:FRAMES]]
    assert [found for _, _, found in numbers.frames] == once * 3
    starts = [numbers.frames[n * FRAMES][1] for n in range(3)]
    assert starts[2] - starts[1] == starts[1] - starts[0] > PASS_GAP_NS


def cloud() -> ObjectCloud:
    """A box of points as an object."""
    rng = np.random.default_rng(4)
    xyz: Float32 = (rng.uniform(-1, 1, (400, 3)) * [2.0, 0.8, 0.7] + [0, 0, 0.8]).astype(np.float32)
    place = Pose(9, np.array([1.0, 5.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    return ObjectCloud(1, xyz, np.zeros(400, np.float32), place, 0, 9, 4.0, 80, True, np.array([0.0, -5.0, 0.8]))


def test_one_or_two_threads_of_the_network_agree() -> None:
    settings = RIG.settings.completion
    shapes = []
    for threads in (1, 2, 1):
        model = CompletionModel.load(find_model(settings.model), replace(settings, intra_op_threads=threads))
        shape = model.complete(cloud())
        assert shape is not None
        shapes.append((shape.class_name, shape.confidence, shape.fine_m.tobytes()))
    assert shapes[0] == shapes[2]
    assert shapes[0] == shapes[1]
