# SPDX-License-Identifier: Apache-2.0
"""Raw frames and poses of a rig's boards to a recording, without the pipeline."""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import cast

from edge.commands.hardware import make_boards
from edge.commands.live_road import CardRoad, Limits, Road, SegmentRoad
from edge.commands.record_progress import Progress
from edge.commands.session import Session
from edge.drivers.single_chip import SingleChipDriver
from edge.drivers.tda2.cascade import CascadeDriver
from edge.frames import RADARS, LossCause, RadarId
from edge.odometry.source import PoseEvent, make_pose_source
from edge.recording.recorder import Recorder
from edge.rig import load_rig
from edge.sources.base import Loss
from edge.sources.pose_feed import PoseFeed


class LiveRecording:
    """The boards of a rig as the roads of ``run`` bring them up; what they give is recorded.

    Args:
        args: of the verb: rig, boards, seconds, json.
        stopped: asked again and again; True ends it in order.
    Attributes:
        lost: radar -> cause -> frames that never came.
        faults, notes: for the report.
    Raises:
        ConfigError: the rig, or where its boards are.
    """

    def __init__(self, args: argparse.Namespace, stopped: Callable[[], bool]) -> None:
        self.rig = load_rig(args.rig, args.boards)
        self.notes: list[str] = []
        self.faults: list[str] = []
        self.lost: dict[RadarId, Counter[LossCause]] = {radar: Counter() for radar in self.rig.radars}
        self._quiet, self._seconds, self._asked = args.json, args.seconds, stopped
        self._recorder: Recorder | None = None

    def say(self, text: str) -> None:
        """As ``Session.say``."""
        if not self._quiet:
            print(text, flush=True)

    def stopped(self) -> bool:
        """As ``Session.stopped``; a full disk ends the run too."""
        return self._asked() or (self._recorder is not None and self._recorder.failure is not None)

    def run(self, recorder: Recorder, progress: Progress) -> None:
        """Configure, start, record until the end.

        Raises:
            DeviceError: a board cannot be used.
        """
        self._recorder = recorder
        with ExitStack() as stack:
            road = self._road(stack)
            road.prepare()
            for item in road.items():
                if isinstance(item, PoseEvent):
                    self.say(f"poses: {item.detail}")
                    if item.new_frame:
                        self.notes.append(f"poses begin anew in another frame: {item.detail}")
                    continue
                if isinstance(item, Loss):
                    self.lost[item.radar][item.cause] += item.count
                recorder.put(item)
                progress.update()
            self.notes += road.finish()
            self.faults += road.faults

    def _road(self, stack: ExitStack) -> Road:
        boards = make_boards(self.rig)
        for board in boards.values():
            stack.callback(board.close)
        desk, limits, poses = cast(Session, self), self._limits(), self._poses(stack)
        cascades = {radar: board for radar, board in boards.items() if isinstance(board, CascadeDriver)}
        singles = {radar: board for radar, board in boards.items() if isinstance(board, SingleChipDriver)}
        if cascades:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rfconstruct-")))
            return SegmentRoad(self.rig, cascades, limits, folder, False, poses, desk)
        return CardRoad(self.rig, singles, limits, poses, desk)

    def _limits(self) -> Limits:
        period_s = max(radar.schedule.frame_period_s_actual for radar in self.rig.radars.values())
        return Limits(None if self._seconds is None else max(1, math.ceil(self._seconds / period_s)), None)

    def _poses(self, stack: ExitStack) -> PoseFeed | None:
        source = make_pose_source(self.rig)
        if source is None:
            if len(self.rig.radars) == len(RADARS):
                self.notes.append('no poses (pose.kind = "none"): nothing can be fused from this recording')
            return None
        feed = PoseFeed(source)
        stack.callback(feed.close)
        return feed
