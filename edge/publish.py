# SPDX-License-Identifier: Apache-2.0
"""A sink that publishes what the pipeline gives, at the rates of the wire format."""

from __future__ import annotations

import time

from edge.pipeline import FrameResult, Pipeline, WindowResult
from edge.stream.publisher import Publisher

HEATMAP_PERIOD_NS = 100_000_000
HEARTBEAT_PERIOD_NS = 100_000_000
STATUS_PERIOD_NS = 1_000_000_000


class PublishingSink:
    """Publishes detections, points and poses of every frame, heatmaps 10 times and status once a second at most.

    Args:
        publisher: open.
        pipeline: whose counters the status message carries; set by ``watch``.
    """

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self._pipeline: Pipeline | None = None
        self._due_ns = {"heatmap": 0, "heartbeat": 0, "status": 0}

    def watch(self, pipeline: Pipeline) -> None:
        """Take the status message's counters from this pipeline."""
        self._pipeline = pipeline

    def frame(self, result: FrameResult) -> None:
        """Publish one frame's results."""
        publisher = self._publisher
        if self._is_due("heatmap", HEATMAP_PERIOD_NS):
            for heatmap in result.heatmaps.values():
                publisher.heatmap(heatmap)
        if result.cloud is not None:
            publisher.detections(result.cloud)
        if result.pose is not None:
            publisher.pose(result.pose)
        self.tick("run")

    def window(self, result: WindowResult) -> None:
        """Publish a fused window and its shapes."""
        self._publisher.cloud(result.cloud)
        for shape in result.shapes:
            self._publisher.shape(shape)

    def tick(self, state: str) -> None:
        """Heartbeat and status when they are due."""
        if self._is_due("heartbeat", HEARTBEAT_PERIOD_NS):
            self._publisher.heartbeat(state)
        if self._is_due("status", STATUS_PERIOD_NS):
            self.status(state)

    def status(self, state: str) -> None:
        """Publish the counters now."""
        raise NotImplementedError

    def _is_due(self, what: str, period_ns: int) -> bool:
        now_ns = time.monotonic_ns()
        if now_ns < self._due_ns[what]:
            return False
        self._due_ns[what] = now_ns + period_ns
        return True
