# SPDX-License-Identifier: Apache-2.0
"""Frames of a rig's boards through the unmodified drivers and sources; results of the unmodified pipeline."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from edge.board_settings import CascadeBoard
from edge.commands.hardware import configure, make_boards
from edge.drivers.fetch import fetcher_for
from edge.drivers.single_chip import SingleChipDriver
from edge.drivers.tda2.cascade import CascadeDriver
from edge.frames import Pose, RadarFrame
from edge.odometry.source import PoseEvent, make_pose_source
from edge.pipeline import FrameResult, Pipeline, WindowResult
from edge.rig import Rig
from edge.sources.base import Loss
from edge.sources.live_cards import CardSource
from edge.sources.pose_feed import PoseFeed
from edge.sources.segments import SegmentSource

Item = RadarFrame | Pose | Loss


@dataclass
class Results:
    """A sink that keeps everything."""

    frames: list[FrameResult] = field(default_factory=list)
    windows: list[WindowResult] = field(default_factory=list)

    def frame(self, result: FrameResult) -> None:
        self.frames.append(result)

    def window(self, result: WindowResult) -> None:
        self.windows.append(result)


def from_boards(rig: Rig, frames: int, folder: Path) -> list[Item]:
    """Frames, poses and losses as the boards of a rig give them."""
    boards = make_boards(rig)
    cascades = {radar: board for radar, board in boards.items() if isinstance(board, CascadeDriver)}
    singles = {radar: board for radar, board in boards.items() if isinstance(board, SingleChipDriver)}
    with ExitStack() as stack:
        for board in boards.values():
            stack.callback(board.close)
        poses = make_pose_source(rig)
        feed = PoseFeed(poses) if poses is not None else None
        if feed is not None:
            stack.callback(feed.close)
        configure(boards, lambda text: None, lambda: False)
        source: SegmentSource | CardSource
        if cascades:
            settings = {radar: board for radar, board in rig.boards.items() if isinstance(board, CascadeBoard)}
            fetchers = {radar: fetcher_for(board) for radar, board in settings.items()}
            source = SegmentSource(rig, cascades, fetchers, frames=frames, segments=1, folder=folder, poses=feed)
        else:
            source = CardSource(rig, singles, frames=frames, poses=feed)
        return [item for item in source if not isinstance(item, PoseEvent)]


def through_pipeline(rig: Rig, items: Iterable[Item]) -> tuple[Results, Pipeline]:
    """What the pipeline makes of them; the accounts are checked."""
    results = Results()
    pipeline = Pipeline(rig, None, [results])
    for item in items:
        pipeline.feed(item)
    pipeline.finish()
    return results, pipeline
