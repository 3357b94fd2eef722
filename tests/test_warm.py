# SPDX-License-Identifier: Apache-2.0
"""After the warm-up the first frame makes no table and compiles nothing; the rehearsal counted nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba.core import event

from edge.dsp.ring_tables import RingTables
from edge.frames import RADARS, Pose
from edge.pipeline import FrameResult, Pipeline, WindowResult
from edge.rig import load_rig
from edge.warm import warm_up
from edge.warm_frames import noise_frames

RIG = load_rig("cascade_demo")
PERIOD_NS = 16_666_667


class Results:
    """A sink that keeps what it gets."""

    def __init__(self) -> None:
        self.frames: list[FrameResult] = []

    def frame(self, result: FrameResult) -> None:
        self.frames.append(result)

    def window(self, result: WindowResult) -> None:
        pass


def test_the_first_frame_finds_everything_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    results = Results()
    pipeline = Pipeline(RIG, None, [results])
    longest_ms = warm_up(RIG, pipeline)
    assert {"heatmap", "detect", "associate", "fuse"} <= set(longest_ms)
    for ledger in pipeline.ledgers.values():
        assert ledger.snapshot().frames_in == 0
    assert results.frames == []
    assert pipeline.times.summary() == {}

    def refuse(*_: object) -> None:
        raise AssertionError("a table was made by a real frame")

    monkeypatch.setattr(RingTables, "of", refuse)
    with event.install_recorder("numba:compile") as recorder:
        for number in range(1, 3):
            t_ns = number * PERIOD_NS
            pipeline.feed(Pose(t_ns, np.array([0.01 * number, 0.0, 0.8]), np.array([0.0, 0.0, 0.0, 1.0])))
            for frame in noise_frames(RIG, number, t_ns).values():
                pipeline.feed(frame)
    pipeline.finish()
    assert recorder.buffer == []
    assert len(results.frames) == 2
    assert all(pipeline.ledgers[radar].snapshot().frames_ok == 2 for radar in RADARS)


def test_speeding_up_sideways_makes_no_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 0 to 8 m/s every number of maps occurs, 1 to 33; the factors of each are ready."""
    results = Results()
    pipeline = Pipeline(RIG, None, [results])
    pipeline.rehearse(noise_frames(RIG, 0, 0))

    def refuse(*_: object) -> None:
        raise AssertionError("a table was made by a real frame")

    monkeypatch.setattr(RingTables, "of", refuse)
    maps, left_m = set(), 0.0
    for number in range(1, 35):
        t_ns = number * PERIOD_NS
        left_m += 8.2 * (number - 1) / 33 * PERIOD_NS * 1e-9
        pipeline.feed(Pose(t_ns, np.array([0.0, left_m, 0.8]), np.array([0.0, 0.0, 0.0, 1.0])))
        for frame in noise_frames(RIG, 0, t_ns).values():
            pipeline.feed(replace(frame, number=number))
    pipeline.finish()
    for result in results.frames:
        maps |= {heatmap.maps for heatmap in result.heatmaps.values()}
    assert len(results.frames) >= 33
    assert {1, 3, 5, 15, 31} <= maps


def test_the_same_number_gives_the_same_noise() -> None:
    first, again, other = noise_frames(RIG, 1, 0), noise_frames(RIG, 1, 0), noise_frames(RIG, 2, 0)
    for radar in RADARS:
        np.testing.assert_array_equal(first[radar].adc, again[radar].adc)
        assert (first[radar].adc != other[radar].adc).any()
