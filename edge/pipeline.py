# SPDX-License-Identifier: Apache-2.0
"""The road: raw frames and poses in; heatmaps, detections, fused clouds and completed shapes out.

It wires the stages together and keeps the account of every frame; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

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
from edge.pair_gate import MAX_WAITING_PAIRS as MAX_WAITING_PAIRS
from edge.pair_gate import REFUSED_POSES as REFUSED_POSES
from edge.pair_gate import Faults as Faults
from edge.pair_gate import PairGate
from edge.rig import Rig
from edge.sources.base import Loss
from edge.sources.pairing import FramePair
from edge.timing import StageTimes


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


class Road(Protocol):
    """What this pipeline and the live one (``edge.service.live``) have to show."""

    @property
    def rig(self) -> Rig:
        """Radars, geometry and settings."""

    @property
    def ledgers(self) -> Mapping[RadarId, FrameLedger]:
        """Radar id -> account of its frames."""

    @property
    def times(self) -> StageTimes:
        """Of the stages."""

    @property
    def faults(self) -> Faults:
        """What went wrong apart from lost frames."""

    def rehearse(self, frames: Mapping[RadarId, RadarFrame]) -> None:
        """Image and detect frames that count nowhere."""


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
        self._gate = PairGate(rig, self.faults)
        self.ledgers: dict[RadarId, FrameLedger] = self._gate.ledgers
        self._epoch = 0
        made = imaging or {r: _imaging(rig, r) for r in self.radars}
        self._imagers = {r: made[r][0] for r in self.radars}
        self._detectors = {r: made[r][1] for r in self.radars}
        self._associator = Associator(rig) if len(self.radars) == len(RADARS) else None
        self._fusion = TemporalFusion(settings.fusion)
        self._tracker = ObjectTracker(settings.objects, rig.geometry)

    def feed(self, item: RadarFrame | Pose | Loss) -> None:
        """Take the next frame, pose or loss of a source, in the source's order.

        Raises:
            CaptureError: a radar that the rig does not have, or another layout than its schedule's; nothing was taken.
        """
        self._gate.add(item)
        self._work()

    def new_pose_frame(self) -> None:
        """Poses from now on are in another odometry frame: the window is closed, the track begins anew."""
        self._gate.new_pose_frame()
        self._follow(self._gate.epoch)

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
        self._gate.end()
        self._work(last=True)
        self._close(self._fusion.flush())
        for ledger in self.ledgers.values():
            ledger.check()

    def _work(self, last: bool = False) -> None:
        """Process every pair that is ready."""
        for ready in self._gate.ready(last):
            self._follow(ready.epoch)
            self._process(ready.pair, ready.pose, ready.velocity_m_s)
        self._follow(self._gate.epoch)

    def _follow(self, epoch: int) -> None:
        """Another odometry frame has begun: the window of the old one is closed."""
        if epoch != self._epoch:
            self._epoch = epoch
            self._close(self._fusion.flush())

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
            self._gate.lose(pair, cause, str(error))
            return
        except PoseError as error:
            self._gate.lose(pair, LossCause.BACKWARDS_TIME, str(error))
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
