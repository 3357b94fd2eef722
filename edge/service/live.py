# SPDX-License-Identifier: Apache-2.0
"""The live pipeline: the stages of the road on threads of their own, with bounded queues and an exact account.

    feed ─► pairs, poses ─► [PairQueue] ─► imager ×2 ─► [DropQueue] ─► fusion ─┬─► [Outbox] ─► sinks
                                                                              └─► [ShapeQueue] ─► completion ─► [Outbox]

``feed`` never waits for a stage (but in a patient pipeline). A stage that raises loses its item and goes on. At any
moment ``frames_in = frames_ok + lost + under way`` for each radar, and nothing is under way after ``finish``.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from edge.accounting import FrameLedger
from edge.completion.model import CompletionModel
from edge.dsp.checks import FrameRejected
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.errors import ModelError, RfconstructError
from edge.frames import Heatmap, LossCause, ObjectCloud, Pose, RadarFrame, RadarId, Shape
from edge.pair_gate import Faults, PairGate, ReadyPair
from edge.pipeline import FrameResult, Sink
from edge.rig import Rig
from edge.service.fuser import Fuser, PairLostError
from edge.service.jobs import Job, JobBook, Part
from edge.service.outbox import Outbox, Result, ShapeSink
from edge.service.queues import DropQueue, PairQueue, ShapeQueue
from edge.service.shared_times import SharedTimes
from edge.service.shedding import LoadShedder, Step
from edge.service.stage import Stage
from edge.sources.base import Loss

QUEUED_PAIRS = 16
"""Before the imagers and before fusion: a quarter of a second each at 60 frames/s; 50 MB of cascades of 8 loops."""
QUEUED_SHAPES = 16
POSE_AHEAD_S = 0.04
"""Poses are continued so far, so that points need not wait for the next one: at an acceleration of 3 m/s^2 that is off
by 2.4 mm at most, a few hundredths of a range bin."""
SHOW_HZ = 10.0
"""Heatmaps that are copied for the sinks."""
BEAT_S = 0.02
"""The sinks' thread gives its signs of life at least so often."""
PATIENCE_S = 5.0
DRAIN_S, SHAPES_S, SINKS_S = 10.0, 10.0, 5.0
"""How long ``finish`` waits for frames, shapes and sinks."""
REMEMBERED = 256
"""Arrival times of frames that wait for their partner or a pose."""


class LivePipeline:
    """All stages of one rig on threads; the same interface as ``edge.pipeline.Pipeline``.

    Args:
        rig: radars, geometry and settings.
        completion: the network; None: points and objects only.
        sinks: called with every result, in one thread; those with a method ``shape`` get shapes as they come.
        no_shapes: why ``completion`` is None, for the status.
        patient: ``feed`` waits while the pipeline is full: for sources that give frames faster than they were taken,
            such as segments. Nothing is shed then.
        imaging: radar id -> imager and detector that were made before; None: made here.
        times: takes the stages' times; None: made here.
    Attributes:
        beats: called again and again by the sinks' thread: signs of life.
        shedder: decides what is left out (asked by ``edge.service.observer``).
    """

    def __init__(
        self,
        rig: Rig,
        completion: CompletionModel | None,
        sinks: Sequence[Sink] = (),
        *,
        no_shapes: str = "",
        patient: bool = False,
        imaging: Mapping[RadarId, tuple[Imager, Detector]] | None = None,
        times: SharedTimes | None = None,
    ) -> None:
        self.rig, self.sinks, self.patient = rig, list(sinks), patient
        self.no_shapes = no_shapes if completion is None and no_shapes else ("" if completion else "no model is loaded")
        self.beats: list[Callable[[], None]] = []
        self.times, self.faults, self.shedder = times or SharedTimes(), Faults(), LoadShedder()
        self.gate = PairGate(rig, self.faults, min(POSE_AHEAD_S, rig.settings.fusion.max_pose_gap_s))
        self.radars = self.gate.radars
        self.ledgers: dict[RadarId, FrameLedger] = self.gate.ledgers
        self.book = JobBook(self.ledgers)
        self.pairs, self.imaged = PairQueue(self.radars, QUEUED_PAIRS), DropQueue[Job](QUEUED_PAIRS)
        self.asked, self.outbox = ShapeQueue(QUEUED_SHAPES), Outbox()
        self.shapes: Counter[str] = Counter()
        self.classes: dict[int, str] = {}
        """Identity -> class of its newest shape, of objects in view."""
        self.shapes_skipped = self.sink_failures = 0
        self.arrivals: dict[RadarId, int] = {}
        """Radar -> CLOCK_MONOTONIC of its newest frame or loss."""
        self.poses = PoseArrivals(rig.settings.fusion.max_pose_gap_s)
        self._completion = completion
        self._imaging = dict(imaging) if imaging else {r: _imaging(rig, r) for r in self.radars}
        self.fuser = Fuser(rig, self.times, self.outbox.put, self._ask)
        self._arrived_ns: dict[int, int] = {}
        self._shown_ns: int | None = None
        self._feeding, self._ended = threading.Lock(), False
        self._imagers = [self._imager(radar) for radar in self.radars]
        self._fusing = Stage[Job]("fusion", self.imaged.take, self._fuse, self._fuse_failed)
        self._completing = Stage[tuple[ObjectCloud, int]](
            "completion", self.asked.take, self._complete, self._complete_failed
        )
        self._sending = Stage[Result](
            "sinks", self.outbox.take, self._deliver, self._deliver_failed, self._beat, BEAT_S
        )
        self._started, self._beaten_s = False, 0.0

    @property
    def stages(self) -> tuple[Stage[Job] | Stage[tuple[ObjectCloud, int]] | Stage[Result], ...]:
        """All threads."""
        return (*self._imagers, self._fusing, self._completing, self._sending)

    @property
    def ended(self) -> bool:
        """Whether ``finish`` was called."""
        return self._ended

    def start(self) -> None:
        """Start the threads; the first ``feed`` does it otherwise."""
        if not self._started and not self._ended:
            self._started = True
            for stage in self.stages:
                stage.start()

    def rehearse(self, frames: Mapping[RadarId, RadarFrame]) -> None:
        """As ``Pipeline.rehearse``; before the first frame."""
        for radar, frame in frames.items():
            imager, detector = self._imaging[radar]
            detector.process(imager.process(frame))
            for velocity_rig_m_s in imager.velocities_to_rehearse(self.rig.settings.fusion.max_speed_m_s):
                detector.process(imager.process(frame, velocity_rig_m_s))

    def feed(self, item: RadarFrame | Pose | Loss) -> None:
        """Take the next frame, pose or loss of a source, in the source's order; one thread at a time.

        Raises:
            CaptureError: a radar that the rig does not have, or another layout than its schedule's; nothing was taken.
            RfconstructError: the pipeline has ended.
        """
        with self._feeding:
            if self._ended:
                raise RfconstructError("the live pipeline has ended", action="stop the source before finish()")
            self.start()
            now_ns = time.monotonic_ns()
            self.gate.add(item)
            if isinstance(item, Pose):
                self.poses.add(item, now_ns)
            else:
                self.arrivals[item.radar] = now_ns
                self._arrived_ns[item.number] = now_ns
                while len(self._arrived_ns) > REMEMBERED:
                    del self._arrived_ns[next(iter(self._arrived_ns))]
            for ready in self.gate.ready():
                self._dispatch(ready)

    def new_pose_frame(self) -> None:
        """Poses from now on are in another odometry frame; called where ``feed`` is."""
        with self._feeding:
            self.gate.new_pose_frame()

    def finish(self) -> None:
        """The source has ended: what is under way is processed, objects in view get their final shape, threads end.

        A stage that hangs is left behind after some seconds and its frames are lost by cause ``failed``.

        Raises:
            RfconstructError: the account does not add up: a defect.
        """
        with self._feeding:
            if self._ended:
                return
            self.start()
            self._ended = True
            self.gate.end()
            for ready in self.gate.ready(last=True):
                self.book.wait_below(QUEUED_PAIRS, PATIENCE_S)
                self._dispatch(ready)
        self.book.wait_below(1, DRAIN_S)
        self.book.give_up(LossCause.FAILED)
        for imager in self._imagers:
            imager.end(1.0)
        if self._fusing.end(1.0):
            try:
                self.fuser.flush()
            except Exception as error:  # whatever a stage raises, the account is given
                self._note(error)
        self._completing.end(SHAPES_S)
        self._sending.end(SINKS_S)
        for ledger in self.ledgers.values():
            ledger.check()

    def under_way(self) -> dict[str, int]:
        """Frames of all radars that are in and not yet closed, by where they are."""
        pending = sum(ledger.snapshot().pending for ledger in self.ledgers.values())
        dispatched = len(self.book) * len(self.radars)
        return {"waiting for partner or pose": max(pending - dispatched, 0), "in the stages": dispatched}

    def _imager(self, radar: RadarId) -> Stage[Job]:
        work, failed = partial(self._image, radar), partial(self._image_failed, radar)
        return Stage[Job](f"image-{radar}", partial(self.pairs.take, radar), work, failed)

    def _dispatch(self, ready: ReadyPair) -> None:
        pair, step = ready.pair, self.shedder.step
        arrived_ns = self._arrived_ns.pop(pair.number, None) or time.monotonic_ns()
        if step >= Step.HALF_PAIRS and pair.number % 2:
            self.gate.lose(pair, LossCause.SHED, f"frame {pair.number}: left out, the machine is overloaded")
            return
        if self.patient:
            self.book.wait_below(QUEUED_PAIRS, PATIENCE_S)
        self.times.record("pose_wait", (time.monotonic_ns() - arrived_ns) / 1e3)
        job = Job(ready, arrived_ns, show=step < Step.VIEWER and self._show(pair.t_ns))
        self.book.open(job)
        self._overflowed(self.pairs.put(job))

    def _show(self, t_ns: int) -> bool:
        """Whether this frame's heatmaps are kept."""
        if self._shown_ns is not None and 0 <= t_ns - self._shown_ns < 0.95e9 / SHOW_HZ:
            return False
        self._shown_ns = t_ns
        return True

    def _overflowed(self, job: Job | None) -> None:
        if job is not None and self.book.lose(job, LossCause.OVERFLOW):
            self.faults.last = f"frame {job.ready.pair.number}: overflow: a queue was full"

    def _image(self, radar: RadarId, job: Job) -> None:
        if job.closed:
            return
        imager, detector = self._imaging[radar]
        outcome: Part | LossCause
        try:
            with self.times.measure("heatmap"):
                heatmap = imager.process(job.ready.pair.frames[radar], job.ready.velocity_m_s)
            self.faults.dead_channels[radar] = imager.last_report.dead
            with self.times.measure("detect"):
                found = detector.process(heatmap)
            outcome = Part(found, _kept(heatmap) if job.show else None)
        except FrameRejected as rejected:
            outcome, self.faults.last = rejected.cause, str(rejected)
        if self.book.imaged(job, radar, outcome):
            self._overflowed(self.imaged.put(job))

    def _image_failed(self, radar: RadarId, job: Job, error: Exception) -> None:
        self._note(error)
        self.book.imaged(job, radar, LossCause.FAILED)

    def _fuse(self, job: Job) -> None:
        if job.closed:
            return
        ready, step = job.ready, self.shedder.step
        detections = {radar: job.parts[radar].detections for radar in self.radars}
        try:
            points = self.fuser.fuse(ready, detections, step)
        except PairLostError as lost:
            self.faults.last = str(lost)
            self.book.lose(job, lost.cause)
            return
        if not self.book.ok(job):
            return
        self.times.record("to_points", (time.monotonic_ns() - job.arrived_ns) / 1e3)
        number, t_ns = ready.pair.number, ready.pair.t_ns
        heatmaps = {radar: part.heatmap for radar, part in job.parts.items() if part.heatmap is not None}
        if step < Step.VIEWER or number % 4 == 0:
            self.outbox.put(FrameResult(number, t_ns, heatmaps, detections, points, ready.pose))
        self.fuser.segment(t_ns, step)

    def _fuse_failed(self, job: Job, error: Exception) -> None:
        self._note(error)
        self.book.lose(job, LossCause.FAILED)

    def _ask(self, cloud: ObjectCloud) -> None:
        if self._completion is not None and self.asked.put(cloud) is not None:
            self.shapes_skipped += 1

    def _complete(self, asked: tuple[ObjectCloud, int]) -> None:
        cloud, asked_ns = asked
        if self._completion is None:
            return
        try:
            with self.times.measure("complete"):
                shape = self._completion.complete(cloud)
        except ModelError as error:
            self._complete_failed(asked, error)
            return
        if shape is None:
            return
        waited_us = (time.monotonic_ns() - asked_ns) / 1e3
        self.times.record("to_shape", waited_us)
        self.shapes[shape.class_name] += 1
        self.classes[shape.identity] = shape.class_name
        self.outbox.put(replace(shape, latency_us={**shape.latency_us, "asked": round(waited_us)}))

    def _complete_failed(self, asked: tuple[ObjectCloud, int], error: Exception) -> None:
        self.faults.shapes_withheld += 1
        self.faults.last = str(error)

    def _deliver(self, result: Result) -> None:
        with self.times.measure("sinks"):
            for sink in self.sinks:
                try:
                    _give(sink, result)
                except Exception as error:  # one sink's trouble is not the next one's
                    self._deliver_failed(result, error)
        self._beat()

    def _deliver_failed(self, result: Result, error: Exception) -> None:
        self.sink_failures += 1
        self._note(error)

    def _beat(self) -> None:
        """Signs of life, however fast results come."""
        now_s = time.monotonic()
        if now_s - self._beaten_s < BEAT_S:
            return
        self._beaten_s = now_s
        for beat in self.beats:
            beat()

    def _note(self, error: Exception) -> None:
        self.faults.last = f"{type(error).__name__}: {error}"


class PoseArrivals:
    """When poses came.

    Args:
        max_gap_s: poses further apart are a gap.
    Attributes:
        count, gaps: since the start.
        newest_ns: CLOCK_MONOTONIC of the newest; None: none yet.
    """

    def __init__(self, max_gap_s: float) -> None:
        self._max_gap_ns = round(max_gap_s * 1e9)
        self.count = self.gaps = 0
        self.newest_ns: int | None = None
        self._last_ns: int | None = None

    def add(self, pose: Pose, now_ns: int) -> None:
        """A pose came at ``now_ns``."""
        if self._last_ns is not None and pose.t_ns - self._last_ns > self._max_gap_ns:
            self.gaps += 1
        self.count, self.newest_ns, self._last_ns = self.count + 1, now_ns, pose.t_ns


def _give(sink: Sink, result: Result) -> None:
    if isinstance(result, FrameResult):
        sink.frame(result)
    elif not isinstance(result, Shape):
        sink.window(result)
    elif isinstance(sink, ShapeSink):
        sink.shape(result)


def _kept(heatmap: Heatmap) -> Heatmap:
    """A copy that outlives the imager's next frame, without the Doppler maps, which would not."""
    return replace(heatmap, power=heatmap.power.copy(), doppler=None)


def _imaging(rig: Rig, radar: RadarId) -> tuple[Imager, Detector]:
    board, settings = rig.radars[radar], rig.settings
    return Imager(board, settings.heatmap, settings.antenna), Detector(board, settings.cfar)
