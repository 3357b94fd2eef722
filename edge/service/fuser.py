# SPDX-License-Identifier: Apache-2.0
"""Both radars' detections to points, windows and objects, in one thread; asks for shapes while an object is in view."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from edge.errors import CaptureError, PoseError
from edge.frames import RADARS, Detections, FusedCloud, LossCause, ObjectCloud, PointCloud, RadarId
from edge.fusion.association import Associator
from edge.fusion.objects import ObjectTracker
from edge.fusion.temporal import TemporalFusion
from edge.pair_gate import ReadyPair
from edge.pipeline import WindowResult
from edge.rig import Rig
from edge.service.shape_schedule import ShapeSchedule
from edge.service.shedding import Step
from edge.timing import StageTimes


class PairLostError(Exception):
    """A pair became no points.

    Args:
        cause: for the account.
        why: in words.
    """

    def __init__(self, cause: LossCause, why: str) -> None:
        self.cause = cause
        super().__init__(why)


class Fuser:
    """Associates, fuses, segments. Windows that close are given out as they are; the newest travel is segmented too.

    Args:
        rig: geometry and settings.
        times: gets the stages' times.
        give: takes windows that closed, their objects with them; shapes follow by themselves.
        ask: takes objects that are to be completed.
    """

    def __init__(
        self,
        rig: Rig,
        times: StageTimes,
        give: Callable[[WindowResult], None],
        ask: Callable[[ObjectCloud], None],
    ) -> None:
        self._times, self._give, self._ask = times, give, ask
        self._associator = Associator(rig) if len(rig.radars) == len(RADARS) else None
        self._fusion = TemporalFusion(rig.settings.fusion)
        self._tracker = ObjectTracker(rig.settings.objects, rig.geometry)
        self.schedule = ShapeSchedule()
        self._epoch = 0
        self._closed: FusedCloud | None = None

    def fuse(self, ready: ReadyPair, detections: Mapping[RadarId, Detections], shed: Step) -> PointCloud | None:
        """Points of one pair, added to the window; ``segment`` does the rest once the points are on their way.

        Returns:
            None in a rig of one radar, and under load of step DETECTIONS_ONLY.
        Raises:
            PairLostError: bursts too far apart, points that are no numbers, or time that went backwards.
        """
        self._closed = None
        if self._associator is None or shed >= Step.DETECTIONS_ONLY:
            return None
        if ready.epoch != self._epoch:
            self._epoch = ready.epoch
            self.flush()
        cause = LossCause.UNPAIRED
        try:
            with self._times.measure("associate"):
                points = self._associator.process(detections["horizontal"], detections["vertical"], ready.velocity_m_s)
            cause = LossCause.NOT_FINITE
            if ready.pose is not None:
                with self._times.measure("fuse"):
                    self._closed = self._fusion.add(points, ready.pose)
        except CaptureError as error:
            raise PairLostError(cause, str(error)) from error
        except PoseError as error:
            raise PairLostError(LossCause.BACKWARDS_TIME, str(error)) from error
        return points

    def segment(self, t_ns: int, shed: Step) -> None:
        """Segment the window that the pair at ``t_ns`` closed, or the newest travel when it is time again."""
        slower = 2 if shed >= Step.HALF_SHAPES else 1
        if self._closed is not None:
            self._take(self._closed, closed=True, slower=slower)
        elif self._associator is not None and shed < Step.DETECTIONS_ONLY and self.schedule.due(t_ns, slower):
            newest = self._fusion.latest()
            if newest is not None:
                self._take(newest, closed=False, slower=slower)

    def flush(self) -> None:
        """The window under way is cut; every object in view has left."""
        cloud = self._fusion.flush()
        if cloud is not None:
            self._take(cloud, closed=True, slower=1)
        for left in self.schedule.leave():
            self._ask(left)

    def _take(self, cloud: FusedCloud, closed: bool, slower: int) -> None:
        with self._times.measure("objects"):
            objects = self._tracker.process(cloud)
        if closed:
            self._give(WindowResult(cloud, objects, ()))
        for wanted in self.schedule.see(objects, cloud.t_end_ns, slower):
            self._ask(wanted)
