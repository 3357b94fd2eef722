# SPDX-License-Identifier: Apache-2.0
"""A sink that publishes what the pipeline gives; the publisher keeps the rates of the wire format."""

from __future__ import annotations

import resource
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from edge.errors import WireError
from edge.frames import Shape
from edge.pipeline import FrameResult, Road, WindowResult
from edge.stream.messages import LEVELS, RadarStatus, Reason, State, Status
from edge.stream.publisher import Publisher
from edge.stream.wire import STATUS_HZ


class PublishingSink:
    """Publishes detections, points, poses and heatmaps of every frame, windows and shapes, status and heartbeat.

    Args:
        publisher: open.
        version: of the software, for the status message.
    """

    def __init__(self, publisher: Publisher, version: str) -> None:
        self._publisher, self._version = publisher, version
        self.published: Callable[[Sequence[bytes]], object] | None = None
        """Told of every message as it was sent: topic, header, payloads; it must not wait."""
        self._pipeline: Road | None = None
        self._live: Callable[[State | None], Status] | None = None
        self._start_s = time.monotonic()
        self._reasons: dict[str, tuple[int, int, int]] = {}
        """Code -> count, first and last instant."""
        self._unsent = 0
        self._latency_us: dict[str, tuple[float, float, float]] = {}
        self._latency_due_s = 0.0

    def watch(self, pipeline: Road, live: Callable[[State | None], Status] | None = None) -> None:
        """Take the status message's counters from this pipeline.

        Args:
            pipeline: whose counters.
            live: makes the whole status of a live pipeline, in its own state or in the one it is given; ``frame`` then
                gives no signs of life, since the live pipeline calls ``report`` by itself.
        """
        self._pipeline, self._live = pipeline, live

    def frame(self, result: FrameResult) -> None:
        """Publish one frame's results, and the sign of life when it is due."""
        publisher, found = self._publisher, result.detections
        for heatmap in result.heatmaps.values():
            self._send(publisher.heatmap, heatmap)
        self._send(publisher.detections, found.get("horizontal"), found.get("vertical"), result.cloud)
        if result.pose is not None:
            self._send(publisher.pose, result.pose)
        if self._live is None:
            self.report()

    def window(self, result: WindowResult) -> None:
        """Publish a fused window and its shapes."""
        self._send(self._publisher.cloud, result.cloud)
        for shape in result.shapes:
            self.shape(shape)

    def shape(self, shape: Shape) -> None:
        """Publish a shape."""
        self._send(self._publisher.shape, shape)

    def counts(self) -> dict[str, int]:
        """What could not be sent, by reason code."""
        return {"NOT_SENT": self._unsent}

    def closed(self) -> str:
        """Why part of the stream is closed; empty: it is not."""
        return self._publisher.fault

    def auth_failures(self) -> int:
        """Handshakes of subscribers that failed since the start."""
        return self._publisher.auth_failures

    def invite(self, duration_s: float) -> None:
        """Give signs of life until waiting subscribers have joined: what is published before that is lost for them."""
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            self.report("INIT")
            time.sleep(0.02)

    @contextmanager
    def starting(self) -> Iterator[None]:
        """Give signs of life of state INIT from a thread of its own, while this one compiles or loads."""
        done = threading.Event()

        def live() -> None:
            while not done.wait(0.02):
                self.report("INIT")

        thread = threading.Thread(target=live, name="starting", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def report(self, state: State | None = None) -> None:
        """Heartbeat and status, as far as they are due; without ``state`` that of the live pipeline, or RUN."""
        status = self._status(state or "RUN") if self._live is None else self._live(state)
        self._sent(self._publisher.heartbeat(status.state))
        self._sent(self._publisher.status(status))

    def _sent(self, frames: Sequence[bytes]) -> None:
        if self.published is not None:
            self.published(frames)

    def _send(self, send: Callable[..., Sequence[bytes]], *content: object) -> None:
        """Publish; what the wire format cannot express is counted."""
        try:
            self._sent(send(*content))
        except WireError as error:
            self._unsent += 1
            if self._pipeline is not None:
                self._pipeline.faults.last = str(error)

    def _latencies(self, pipeline: Road) -> dict[str, tuple[float, float, float]]:
        """Percentiles, not computed more often than they are published."""
        now_s = time.monotonic()
        if now_s >= self._latency_due_s:
            self._latency_due_s = now_s + 1.0 / STATUS_HZ
            self._latency_us = {s: (t.p50_us, t.p99_us, t.max_us) for s, t in pipeline.times.summary().items()}
        return self._latency_us

    def _status(self, state: State) -> Status:
        pipeline = self._pipeline
        if pipeline is None:
            return Status(state, LEVELS["OK"], versions={"rfconstruct": self._version})
        uptime_s = time.monotonic() - self._start_s
        accounts = {radar: ledger.snapshot() for radar, ledger in pipeline.ledgers.items()}
        reasons = self._update_reasons(pipeline)
        return Status(
            state=state,
            level=LEVELS["WARN"] if reasons else LEVELS["OK"],
            reasons=reasons,
            radars={
                radar: RadarStatus(
                    account.frames_in,
                    account.frames_ok,
                    {cause.value: count for cause, count in account.lost.items()},
                    account.frames_ok / max(uptime_s, 1e-3),
                )
                for radar, account in accounts.items()
            },
            latency_us=self._latencies(pipeline),
            system={"rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0},
            versions={"rfconstruct": self._version},
            uptime_s=uptime_s,
        )

    def _update_reasons(self, pipeline: Road) -> tuple[Reason, ...]:
        """One reason for every cause of loss and every fault that has occurred."""
        counts: dict[str, int] = {}
        for ledger in pipeline.ledgers.values():
            for cause, count in ledger.snapshot().lost.items():
                counts[cause.name] = counts.get(cause.name, 0) + count
        counts["POSE_REFUSED"] = pipeline.faults.poses_refused
        counts["NOT_SENT"] = self._unsent
        counts["SHAPE_WITHHELD"] = pipeline.faults.shapes_withheld
        counts["DEAD_CHANNEL"] = sum(map(len, pipeline.faults.dead_channels.values()))
        now_ns = time.monotonic_ns()
        for code, count in counts.items():
            before = self._reasons.get(code)
            if count and (before is None or before[0] != count):
                self._reasons[code] = (count, before[1] if before else now_ns, now_ns)
        return tuple(Reason(code, *facts) for code, facts in sorted(self._reasons.items()))
