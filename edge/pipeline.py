# SPDX-License-Identifier: Apache-2.0
"""The road: raw frames and poses in; heatmaps, detections, fused clouds and completed shapes out.

It wires the stages together and keeps the account of every frame; nothing is computed here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from edge.accounting import FrameLedger
from edge.completion.model import CompletionModel
from edge.dsp.checks import FrameRejected
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import CaptureError, ModelError, PoseError
from edge.frames import (
    RADARS,
    Detections,
    Float64,
    FusedCloud,
    Heatmap,
    LossCause,
    ObjectCloud,
    PointCloud,
    Pose,
    RadarFrame,
    RadarId,
    Shape,
)
from edge.fusion.association import Associator
from edge.fusion.objects import ObjectTracker
from edge.fusion.temporal import TemporalFusion
from edge.odometry.track import PoseTrack
from edge.rig import Rig
from edge.sources.base import Loss
from edge.sources.pairing import FramePair, FramePairer
from edge.timing import StageTimes

MAX_WAITING_PAIRS = 64
"""Frame pairs that wait for a later pose before the oldest is given up: about a second at 60 frames/s."""
FARTHEST_M = 1e8
"""Positions beyond are no odometry, whatever its origin; arithmetic with them would overflow."""
REFUSED_POSES = 30
"""Poses refused in a row before the pose clock counts as restarted: one stamp of the far future must not end all."""


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What one frame of each radar gave.

    Args:
        number: frame number.
        t_ns: first chirp of the first radar's burst.
        heatmaps: radar id -> heatmap; valid until the pipeline's next frame.
        detections: radar id -> detections.
        cloud: associated 3-D points; None in a rig of one radar.
        pose: of the rig at ``t_ns``; None in a rig of one radar that has no poses.
    """

    number: int
    t_ns: int
    heatmaps: Mapping[RadarId, Heatmap]
    detections: Mapping[RadarId, Detections]
    cloud: PointCloud | None
    pose: Pose | None


@dataclass(frozen=True, slots=True)
class WindowResult:
    """What one window of travel gave.

    Args:
        cloud: all points of the window.
        objects: its objects.
        shapes: their completions; an object without enough points has none.
    """

    cloud: FusedCloud
    objects: Sequence[ObjectCloud]
    shapes: Sequence[Shape]


class Sink(Protocol):
    """Where results go: the publisher, a recorder, pictures."""

    def frame(self, result: FrameResult) -> None:
        """One frame of each radar is done."""

    def window(self, result: WindowResult) -> None:
        """One window of travel is done."""


@dataclass(slots=True)
class Faults:
    """What went wrong apart from lost frames, counted; ``last`` says the newest in words.

    Args:
        poses_refused: poses that were no poses or went backwards in time.
        shapes_withheld: objects whose completion was not finite or failed.
        dead_channels: radar id -> names of channels that gave constant values.
        last: newest message.
    """

    poses_refused: int = 0
    shapes_withheld: int = 0
    dead_channels: dict[RadarId, tuple[str, ...]] = field(default_factory=dict)
    last: str = ""


class Pipeline:
    """All stages of one rig in one thread.

    Args:
        rig: radars, geometry and settings.
        completion: the network; None: fused clouds and objects only.
        sinks: called in order with every result.
        imaging: radar id -> imager and detector that were made before for these radars and settings; None: made here.
    """

    def __init__(
        self,
        rig: Rig,
        completion: CompletionModel | None,
        sinks: Sequence[Sink] = (),
        imaging: Mapping[RadarId, tuple[Imager, Detector]] | None = None,
    ) -> None:
        settings = rig.settings
        self.rig, self.sinks, self._completion = rig, list(sinks), completion
        self.radars: tuple[RadarId, ...] = tuple(radar for radar in RADARS if radar in rig.radars)
        self.times, self.faults = StageTimes(), Faults()
        self._pairer = FramePairer(self.radars)
        self.ledgers: dict[RadarId, FrameLedger] = self._pairer.ledgers
        made = imaging or {r: _imaging(rig, r) for r in self.radars}
        self._imagers = {r: made[r][0] for r in self.radars}
        self._detectors = {r: made[r][1] for r in self.radars}
        self._track = PoseTrack(settings.fusion.max_pose_gap_s)
        self._associator = Associator(rig) if len(self.radars) == len(RADARS) else None
        self._fusion = TemporalFusion(settings.fusion)
        self._tracker = ObjectTracker(settings.objects, rig.geometry)
        self._waiting: deque[FramePair] = deque()
        self._newest_pose_ns: int | None = None
        self._refused_in_a_row = 0

    def feed(self, item: RadarFrame | Pose | Loss) -> None:
        """Take the next frame, pose or loss of a source, in the source's order.

        Raises:
            CaptureError: a radar that the rig does not have, or another layout than its schedule's; nothing was taken.
        """
        if isinstance(item, Pose):
            self._add_pose(item)
        else:
            self._check_layout(item)
            pairs, losses = self._pairer.add(item)
            self._note(losses)
            self._waiting.extend(pairs)
        self._work()

    def rehearse(self, frames: Mapping[RadarId, RadarFrame]) -> None:
        """Image and detect frames that count nowhere; the real ones then find every table and buffer.

        At rest, and at every speed across a radar's array from which another number of maps follows: the threshold
        factors of one number of maps take 10 to 30 ms.

        Args:
            frames: radar id -> any frame of its schedule's layout, noise for example.
        """
        for radar, frame in frames.items():
            imager, detector = self._imagers[radar], self._detectors[radar]
            detector.process(imager.process(frame))
            for velocity_rig_m_s in imager.velocities_to_rehearse(self.rig.settings.fusion.max_speed_m_s):
                detector.process(imager.process(frame, velocity_rig_m_s))

    def finish(self) -> None:
        """The source has ended: what still waits is processed or counted, the last window is closed."""
        self._note(self._pairer.flush())
        self._work(last=True)
        self._close(self._fusion.flush())
        for ledger in self.ledgers.values():
            ledger.check()

    def _check_layout(self, item: RadarFrame | Loss) -> None:
        board = self.rig.radars.get(item.radar)
        if isinstance(item, RadarFrame) and board is not None and item.layout != board.schedule.layout:
            raise CaptureError(
                f"{item.radar} frame {item.number} has another layout than the schedule of rig {self.rig.name}",
                value=item.layout,
                allowed=str(board.schedule.layout),
                action="use the rig that the capture was made with",
            )

    def _add_pose(self, pose: Pose) -> None:
        """Refuse it, or restart the track after so many in a row that the clock or the sensor must have restarted."""
        try:
            if np.abs(pose.position_m).max() > FARTHEST_M:
                raise PoseError(f"pose at {pose.t_ns} ns", value=pose.position_m.tolist(), allowed=f"<= {FARTHEST_M} m")
            self._track.add(pose)
            self._newest_pose_ns, self._refused_in_a_row = pose.t_ns, 0
        except PoseError as error:
            self.faults.poses_refused += 1
            self.faults.last = str(error)
            self._refused_in_a_row += 1
            if self._refused_in_a_row >= REFUSED_POSES:
                self._close(self._fusion.flush())
                self._track.clear()
                self._newest_pose_ns, self._refused_in_a_row = None, 0

    def _note(self, losses: Sequence[Loss]) -> None:
        """Remember the newest loss in words; the pairer has counted it."""
        if losses:
            last = losses[-1]
            self.faults.last = f"{last.radar} frame {last.number}: {last.cause.value}: {last.detail}"

    def _give_up(self, pair: FramePair) -> None:
        """No pose for this pair."""
        why = self._track.why_none(pair.t_ns) or "no other pose near enough to know the velocity"
        self._lose_pair(pair, LossCause.NO_POSE, f"frame {pair.number}: {why}")

    def _lose_pair(self, pair: FramePair, cause: LossCause, why: str) -> None:
        self.faults.last = why
        for radar in pair.frames:
            self.ledgers[radar].lost(cause)

    def _work(self, last: bool = False) -> None:
        """Process every waiting pair whose pose and velocity are known, or known never to come.

        One radar needs no pose, but uses it: while there are poses its frames wait for theirs, too.
        """
        while self._waiting:
            pair = self._waiting[0]
            pose, velocity_m_s = self._track.at(pair.t_ns), self._track.velocity_rig_m_s(pair.t_ns)
            if velocity_m_s is None:
                newest_ns = self._newest_pose_ns
                due = self._associator is not None if newest_ns is None else pair.t_ns >= newest_ns
                if due and not last and len(self._waiting) <= MAX_WAITING_PAIRS:
                    return
            self._waiting.popleft()
            if velocity_m_s is None and self._associator is not None:
                self._give_up(pair)
            else:
                self._process(pair, pose, velocity_m_s)

    def _process(self, pair: FramePair, pose: Pose | None, velocity_m_s: Float64 | None) -> None:
        heatmaps = self._image(pair, velocity_m_s)
        if len(heatmaps) < len(self.radars):
            return
        detections: dict[RadarId, Detections] = {}
        for radar, heatmap in heatmaps.items():
            with self.times.measure("detect"):
                detections[radar] = self._detectors[radar].process(heatmap)
        cause = LossCause.UNPAIRED
        try:
            cloud = self._associate(detections, velocity_m_s)
            cause = LossCause.NOT_FINITE
            fused = self._fuse(cloud, pose)
        except CaptureError as error:
            self._lose_pair(pair, cause, str(error))
            return
        except PoseError as error:
            self._lose_pair(pair, LossCause.BACKWARDS_TIME, str(error))
            return
        for radar in pair.frames:
            self.ledgers[radar].ok()
        result = FrameResult(pair.number, pair.t_ns, heatmaps, detections, cloud, pose)
        for sink in self.sinks:
            sink.frame(result)
        self._close(fused)

    def _image(self, pair: FramePair, velocity_m_s: Float64 | None) -> dict[RadarId, Heatmap]:
        """Heatmaps of all radars; when one frame is refused its partner is lost with it."""
        heatmaps: dict[RadarId, Heatmap] = {}
        causes: dict[RadarId, LossCause] = {}
        for radar, frame in pair.frames.items():
            try:
                with self.times.measure("heatmap"):
                    heatmaps[radar] = self._imagers[radar].process(frame, velocity_m_s)
                self.faults.dead_channels[radar] = self._imagers[radar].last_report.dead
            except FrameRejected as rejected:
                causes[radar] = rejected.cause
                self.faults.last = str(rejected)
        if causes:
            for radar in pair.frames:
                self.ledgers[radar].lost(causes.get(radar, LossCause.UNPAIRED))
            return {}
        return heatmaps

    def _associate(self, detections: Mapping[RadarId, Detections], velocity_m_s: Float64 | None) -> PointCloud | None:
        if self._associator is None:
            return None
        with self.times.measure("associate"):
            return self._associator.process(detections["horizontal"], detections["vertical"], velocity_m_s)

    def _fuse(self, cloud: PointCloud | None, pose: Pose | None) -> FusedCloud | None:
        if cloud is None or pose is None:
            return None
        with self.times.measure("fuse"):
            return self._fusion.add(cloud, pose)

    def _close(self, cloud: FusedCloud | None) -> None:
        """Segment and complete a finished window."""
        if cloud is None:
            return
        with self.times.measure("objects"):
            objects = self._tracker.process(cloud)
        shapes = [shape for shape in map(self._complete, objects) if shape is not None]
        for sink in self.sinks:
            sink.window(WindowResult(cloud, objects, shapes))

    def _complete(self, cloud: ObjectCloud) -> Shape | None:
        if self._completion is None:
            return None
        try:
            with self.times.measure("complete"):
                return self._completion.complete(cloud)
        except ModelError as error:
            self.faults.shapes_withheld += 1
            self.faults.last = str(error)
            return None


def _imaging(rig: Rig, radar: RadarId) -> tuple[Imager, Detector]:
    board, settings = rig.radars[radar], rig.settings
    return Imager(board, settings.heatmap, settings.antenna), Detector(board, settings.cfar)
