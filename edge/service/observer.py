# SPDX-License-Identifier: Apache-2.0
"""Looks at the live pipeline ten times a second: sheds load, judges the state, feeds the watchdog, collects garbage."""

from __future__ import annotations

import gc
import resource
import threading
import time
from collections.abc import Callable, Mapping

from edge.frames import RADARS
from edge.service.live import LivePipeline
from edge.service.machine import rss_bytes, temperature_c
from edge.service.snapshot import RecordingFigures, Snapshot
from edge.service.states import STUCK_S, Facts, StateMachine, Verdict
from edge.stream.messages import PoseStatus, RadarStatus, State, Status
from edge.timing import StageTime

RATE_S = 1.0
"""Frame rates and the machine's figures are of about the last second."""
COLLECT_S, COLLECT_LATEST_S = 10.0, 60.0
"""Garbage is collected so often when no pair is under way, and at the latest."""


class Observer:
    """Owns what is decided from outside the stages.

    Args:
        pipeline: to look at.
        versions: component -> version, for the status.
        watchdog: called while every stage that has work makes progress; None: nobody wants to know.
        poses_from: name of the pose source.
        counts: more events since the start, code -> count, each a reason while it grows.
        stream_closed: why part of the stream is closed; empty: it is not.
        recording: figures of the recording of the run; None: it is not recorded.
    """

    def __init__(
        self,
        pipeline: LivePipeline,
        versions: Mapping[str, str] | None = None,
        watchdog: Callable[[], None] | None = None,
        poses_from: str = "source",
        counts: Callable[[], Mapping[str, int]] | None = None,
        stream_closed: Callable[[], str] = str,
        recording: Callable[[], RecordingFigures] | None = None,
    ) -> None:
        self._pipeline, self._versions, self._watchdog = pipeline, dict(versions or {}), watchdog
        self._poses_from, self._more_counts, self._stream_closed = poses_from, counts, stream_closed
        self._recording = recording
        self._machine, self._lock = StateMachine(), threading.Lock()
        self._born_ns = time.monotonic_ns()
        self._started_ns: int | None = None
        self._ending, self._source_error = False, ""
        self._rates = _Rates()
        self._collected_ns = self._born_ns
        self._frozen = False

    @property
    def verdict(self) -> Verdict:
        """The newest."""
        return self._machine.verdict

    def live(self) -> None:
        """Kernels are ready, the source begins: what exists is no garbage, and none is looked for while frames run."""
        if not self._frozen:
            self._frozen = True
            gc.collect()
            gc.freeze()
            gc.disable()
        self._started_ns = time.monotonic_ns()

    def ending(self, source_error: str = "") -> None:
        """The source has ended, with an error or without; garbage collection is as before."""
        self._ending, self._source_error = not source_error, source_error
        if self._frozen:
            self._frozen = False
            gc.enable()
            gc.unfreeze()

    def tick(self) -> Verdict:
        """Once in a while, at best ten times a second; any thread."""
        pipeline, now_ns = self._pipeline, time.monotonic_ns()
        with self._lock:
            delay_s, shape_s = pipeline.times.take_least_s("to_points"), pipeline.times.take_least_s("to_shape")
            if not pipeline.patient:
                pipeline.shedder.update(now_ns / 1e9, self._fill(), delay_s, shape_s)
            facts = self._facts(now_ns)
            verdict = self._machine.update(now_ns, facts)
            self._rates.update(now_ns, pipeline)
            for identity in set(pipeline.classes) - set(pipeline.fuser.schedule.identities):
                pipeline.classes.pop(identity, None)
            self._collect(now_ns)
        if self._watchdog is not None and not facts.stuck:
            self._watchdog()
        return verdict

    def status(self, state: State | None = None) -> Status:
        """The status message of the newest verdict; another ``state`` when it is given."""
        pipeline, verdict = self._pipeline, self._machine.verdict
        accounts = {radar: ledger.snapshot() for radar, ledger in pipeline.ledgers.items()}
        return Status(
            state=verdict.state if state is None else state,
            level=verdict.level,
            reasons=verdict.reasons,
            radars={
                radar: RadarStatus(
                    account.frames_in,
                    account.frames_ok,
                    {cause.value: count for cause, count in account.lost.items()},
                    self._rates.fps.get(radar, 0.0),
                )
                for radar, account in accounts.items()
            },
            latency_us={stage: (t.p50_us, t.p99_us, t.max_us) for stage, t in self._rates.summary.items()},
            pose=self._pose_status(),
            system=self._rates.system | {f"queue_{name}": float(count) for name, count in self.queues().items()},
            versions=self._versions,
            uptime_s=(time.monotonic_ns() - self._born_ns) / 1e9,
        )

    def snapshot(self, auth_failures: int = 0) -> Snapshot:
        """Everything the metrics show."""
        pipeline = self._pipeline
        names = [pipeline.classes.get(identity, "unknown") for identity in pipeline.fuser.schedule.identities]
        return Snapshot(
            status=self.status(),
            latency=pipeline.times.histograms(),
            objects={name: names.count(name) for name in names},
            shapes=dict(pipeline.shapes),
            shapes_withheld=pipeline.faults.shapes_withheld,
            auth_failures=auth_failures,
            shed_step=int(pipeline.shedder.step),
            queues=self.queues(),
            rss_bytes=rss_bytes(),
            temperature_c=temperature_c(),
            recording=self._recording() if self._recording is not None else None,
        )

    def queues(self) -> dict[str, int]:
        """Entries that wait, by queue."""
        pipeline = self._pipeline
        return {
            "poses": pipeline.gate.waiting,
            "pairs": len(pipeline.pairs),
            "imaged": len(pipeline.imaged),
            "shapes": len(pipeline.asked),
            "results": len(pipeline.outbox),
        }

    def _fill(self) -> float:
        pipeline = self._pipeline
        return max(len(queue) / queue.capacity for queue in (pipeline.pairs, pipeline.imaged))

    def _facts(self, now_ns: int) -> Facts:
        pipeline, start_ns = self._pipeline, self._started_ns or now_ns
        pose_ns = pipeline.poses.newest_ns
        return Facts(
            started=self._started_ns is not None,
            ending=self._ending,
            silent_s={r: (now_ns - pipeline.arrivals.get(r, start_ns)) / 1e9 for r in pipeline.radars},
            poses_silent_s=(now_ns - (pose_ns or start_ns)) / 1e9 if len(pipeline.radars) == len(RADARS) else None,
            counts=self._counts(),
            shed=pipeline.shedder.step,
            no_shapes=pipeline.no_shapes,
            source_error=self._source_error,
            stream_closed=self._stream_closed(),
            recording_ended=self._recording().ended if self._recording is not None else "",
            stuck=tuple(stage.name for stage in pipeline.stages if stage.busy_s > STUCK_S),
            last_fault=pipeline.faults.last,
        )

    def _counts(self) -> dict[str, int]:
        pipeline, counts = self._pipeline, dict[str, int]()
        for ledger in pipeline.ledgers.values():
            for cause, count in ledger.snapshot().lost.items():
                counts[cause.name] = counts.get(cause.name, 0) + count
        counts["POSE_REFUSED"] = pipeline.faults.poses_refused
        counts["SHAPE_WITHHELD"] = pipeline.faults.shapes_withheld
        counts["SHAPE_SKIPPED"] = pipeline.shapes_skipped
        counts["DEAD_CHANNEL"] = sum(map(len, list(pipeline.faults.dead_channels.values())))
        counts["STAGE_FAILED"] = sum(stage.failures for stage in pipeline.stages)
        counts["SINK_FAILED"] = pipeline.sink_failures
        counts["NOT_SENT"] = pipeline.outbox.dropped
        for code, count in (self._more_counts() if self._more_counts is not None else {}).items():
            counts[code] = counts.get(code, 0) + count
        return counts

    def _pose_status(self) -> PoseStatus | None:
        poses = self._pipeline.poses
        if poses.newest_ns is None:
            return None
        age_ms = (time.monotonic_ns() - poses.newest_ns) / 1e6
        return PoseStatus(age_ms, self._rates.poses_hz, poses.gaps, self._poses_from)

    def _collect(self, now_ns: int) -> None:
        """Collect garbage between two pairs: cyclic garbage is rare, and what was frozen is not looked at."""
        age_s = (now_ns - self._collected_ns) / 1e9
        if self._frozen and age_s > COLLECT_S and (not len(self._pipeline.book) or age_s > COLLECT_LATEST_S):
            gc.collect()
            self._collected_ns = now_ns


class _Rates:
    """Figures of about the last second."""

    def __init__(self) -> None:
        self.fps: dict[str, float] = {}
        self.poses_hz = 0.0
        self.system: dict[str, float] = {}
        self.summary: dict[str, StageTime] = {}
        self._before: tuple[int, dict[str, int], int, float] | None = None

    def update(self, now_ns: int, pipeline: LivePipeline) -> None:
        """Renew the figures when they are a second old."""
        if self._before is not None and now_ns - self._before[0] < RATE_S * 1e9:
            return
        frames: dict[str, int] = {radar: ledger.snapshot().frames_ok for radar, ledger in pipeline.ledgers.items()}
        usage = resource.getrusage(resource.RUSAGE_SELF)
        cpu_s = usage.ru_utime + usage.ru_stime
        if self._before is not None:
            then_ns, then_frames, then_poses, then_cpu_s = self._before
            span_s = (now_ns - then_ns) / 1e9
            self.fps = {radar: (count - then_frames[radar]) / span_s for radar, count in frames.items()}
            self.poses_hz = (pipeline.poses.count - then_poses) / span_s
            self.system["cpu"] = (cpu_s - then_cpu_s) / span_s
        self.system["rss_mb"] = rss_bytes() / 2**20
        heat_c = temperature_c()
        if heat_c is not None:
            self.system["temp_c"] = heat_c
        self.summary = pipeline.times.summary()
        self._before = (now_ns, frames, pipeline.poses.count, cpu_s)
