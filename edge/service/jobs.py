# SPDX-License-Identifier: Apache-2.0
"""A frame pair on its way through the threads, and the book in which every one of its frames is closed exactly once."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field

from edge.accounting import FrameLedger
from edge.frames import Detections, Heatmap, LossCause, RadarId
from edge.pair_gate import ReadyPair


@dataclass(frozen=True, slots=True)
class Part:
    """What one radar's frame of a pair gave.

    Args:
        detections: of the frame.
        heatmap: a copy; None when nobody wants to see it.
    """

    detections: Detections
    heatmap: Heatmap | None


@dataclass(slots=True, eq=False)
class Job:
    """A pair under way.

    Args:
        ready: frames, pose, velocity.
        arrived_ns: CLOCK_MONOTONIC when the last of its frames was whole.
        show: whether its heatmaps are kept for the viewer.
        begun: radars whose imager has taken it (written by the queue).
        parts, causes: what became of each radar's frame (written by the book).
        closed: nothing that still comes counts (written by the book).
    """

    ready: ReadyPair
    arrived_ns: int
    show: bool = False
    begun: set[RadarId] = field(default_factory=set)
    parts: dict[RadarId, Part] = field(default_factory=dict)
    causes: dict[RadarId, LossCause] = field(default_factory=dict)
    closed: bool = False


class JobBook:
    """Opens and closes pairs; any thread may write. A pair that is closed stays so, whatever a late stage says.

    Args:
        ledgers: radar id -> account of its frames, which counted the frames in.
    """

    def __init__(self, ledgers: Mapping[RadarId, FrameLedger]) -> None:
        self._ledgers = ledgers
        self._open: set[Job] = set()
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._open)

    def open(self, job: Job) -> None:
        """A pair is under way."""
        with self._changed:
            self._open.add(job)

    def imaged(self, job: Job, radar: RadarId, outcome: Part | LossCause) -> bool:
        """One radar's frame is done. True: so is the other's, and both are good; who is told so goes on with the pair.

        When one frame is lost its partner is lost with it.
        """
        with self._changed:
            if job.closed:
                return False
            if isinstance(outcome, Part):
                job.parts[radar] = outcome
            else:
                job.causes[radar] = outcome
            if len(job.parts) + len(job.causes) < len(job.ready.pair.frames):
                return False
            if job.causes:
                self._lose(job, job.causes)
                return False
            return True

    def ok(self, job: Job) -> bool:
        """Both frames became a result; False: the pair was given up before."""
        with self._changed:
            if job.closed:
                return False
            self._close(job)
            for radar in job.ready.pair.frames:
                self._ledgers[radar].ok()
            return True

    def lose(self, job: Job, cause: LossCause) -> bool:
        """Both frames are lost by one cause; False: they were closed before."""
        with self._changed:
            if job.closed:
                return False
            self._lose(job, dict.fromkeys(job.ready.pair.frames, cause))
            return True

    def give_up(self, cause: LossCause) -> int:
        """Close everything that is still under way; returns how many pairs that were."""
        with self._changed:
            left = list(self._open)
            for job in left:
                self._lose(job, dict.fromkeys(job.ready.pair.frames, cause))
            return len(left)

    def wait_below(self, count: int, timeout_s: float) -> bool:
        """Wait until fewer than ``count`` pairs are under way; False: they were not, for so long."""
        with self._changed:
            return self._changed.wait_for(lambda: len(self._open) < count, timeout_s)

    def _lose(self, job: Job, causes: Mapping[RadarId, LossCause]) -> None:
        self._close(job)
        for radar in job.ready.pair.frames:
            self._ledgers[radar].lost(causes.get(radar, LossCause.UNPAIRED))

    def _close(self, job: Job) -> None:
        job.closed = True
        self._open.discard(job)
        self._changed.notify_all()
