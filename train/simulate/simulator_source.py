# SPDX-License-Identifier: Apache-2.0
"""The simulator as a source of frames: both radars and poses in time order, in real time or as fast as they are read.

Frames are made ahead on a thread of their own, in a bounded queue. A frame that is not ready at its instant is given
late and counted; a reader that comes late is counted too: nothing becomes slow in silence.
"""

from __future__ import annotations

import heapq
import itertools
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

from edge.errors import CaptureError, RfconstructError
from edge.frames import Pose, RadarFrame, RadarId
from edge.rig import Rig
from edge.sources.base import Loss
from train.simulate.faults import Fault, Faults
from train.simulate.frame_faults import FrameFaults
from train.simulate.pose_stream import WHERE as POSE
from train.simulate.supplies import FrameSupply
from train.simulate.threads import join, wait_until

DEPTH = 32
"""Items; of cascades with 8 loops 50 MB: a quarter of a second in which the machine may do something else."""
LATE_SHARE = 0.25
"""Share of the frame period by which a frame or a reader may be behind before it counts as late."""
_POLL_S = 0.1


_Item: TypeAlias = RadarFrame | Pose | RfconstructError | None


@dataclass(frozen=True, slots=True)
class _Line:
    """Frames and poses on their way; None after the last, an error in its place."""

    ready: queue.Queue[_Item]
    done: threading.Event
    maker: threading.Thread


class SimulatorSource:
    """``edge.sources.base.FrameSource`` of simulated frames.

    Args:
        rig: radars and their periods.
        supply: makes frames; called on the source's thread.
        frames: of each radar; None: endless.
        poses: in order of time, in the time of the frames; read anew by every iteration.
        pace: 1: real time, 2: twice as fast, 0: as fast as they are read.
        depth: items made ahead; the clock begins when so many are there (or all). May be set until iteration begins.
        first_number: of the first frame.
        rebase: times are moved to CLOCK_MONOTONIC, the first item at the start; None: when ``pace`` is 1.
        faults: channels ``<radar>/frames`` and ``pose``.
    Attributes:
        pace, depth: as above.
        late: radar -> frames that were not ready at their instant.
        slow_reads: frames that were ready but asked for late.
    """

    def __init__(
        self,
        rig: Rig,
        supply: FrameSupply,
        frames: int | None = None,
        poses: Iterable[Pose] = (),
        *,
        pace: float = 1.0,
        depth: int = DEPTH,
        first_number: int = 0,
        rebase: bool | None = None,
        faults: Faults | None = None,
    ) -> None:
        if pace < 0 or depth < 1 or (frames is not None and frames < 1):
            raise CaptureError("simulator source", value=(pace, depth, frames), allowed="pace >= 0, others >= 1")
        self.late: Counter[RadarId] = Counter()
        self.slow_reads = 0
        self._rig, self._supply, self._frames, self._poses = rig, supply, frames, poses
        self.depth = depth
        self.pace = pace
        self._first, self._faults = first_number, faults
        self._rebase = pace == 1.0 if rebase is None else rebase
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []
        self._line: _Line | None = None

    @property
    def total_frames(self) -> int | None:
        """Frames of all radars, those that faults will drop included; None: endless."""
        return None if self._frames is None else self._frames * len(self._rig.radars)

    def __iter__(self) -> Iterator[RadarFrame | Pose | Loss]:
        """Frames and poses, each at its instant.

        Raises:
            CaptureError: the supply has no such frame.
        """
        line, self._line = self._line or self._begin(), None
        try:
            yield from self._give(line)
        finally:
            line.done.set()
            join(line.maker)

    def make_ahead(self, stopped: Callable[[], bool]) -> None:
        """Make the frames of the next iteration until ``depth`` items or all are there; ends early when ``stopped``."""
        self._line = self._line or self._begin()
        self._fill(self._line, stopped)

    def _begin(self) -> _Line:
        ready: queue.Queue[_Item] = queue.Queue(self.depth)
        done = threading.Event()
        maker = threading.Thread(target=self._make, args=(ready, done), name="simulator", daemon=True)
        self._threads.append(maker)
        maker.start()
        return _Line(ready, done, maker)

    def _fill(self, line: _Line, stopped: Callable[[], bool]) -> None:
        while not line.ready.full() and line.maker.is_alive() and not stopped():
            if self._closed.wait(1e-3):
                return

    def close(self) -> None:
        """End every iteration and the threads."""
        self._closed.set()
        for thread in self._threads:
            join(thread)

    def _give(self, line: _Line) -> Iterator[RadarFrame | Pose | Loss]:
        ready = line.ready
        if self.pace > 0:  # the clock begins when the queue is full
            self._fill(line, lambda: False)
        period_s = min(radar.schedule.frame_period_s for radar in self._rig.radars.values())
        start_s, first_ns, shift_ns = time.monotonic(), None, 0
        while not self._closed.is_set():
            starved = ready.empty()
            try:
                item = ready.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            if item is None:
                return
            if isinstance(item, RfconstructError):
                raise item
            t_ns = item.t_ns if isinstance(item, Pose) else item.t_first_chirp_ns
            if first_ns is None:
                first_ns, start_s = t_ns, time.monotonic()
                shift_ns = round(start_s * 1e9) - t_ns if self._rebase else 0
            if self.pace > 0:
                due_s = start_s + (t_ns - first_ns) / 1e9 / self.pace
                if isinstance(item, RadarFrame) and time.monotonic() > due_s + LATE_SHARE * period_s / self.pace:
                    self.late[item.radar] += starved
                    self.slow_reads += not starved
                if not wait_until(due_s, self._closed):
                    return
            yield _moved(item, shift_ns)

    def _make(self, ready: queue.Queue[_Item], done: threading.Event) -> None:
        """Fill the queue until the source ends or nobody reads any more."""

        def put(item: _Item) -> bool:
            while not (done.is_set() or self._closed.is_set()):
                try:
                    ready.put(item, timeout=_POLL_S)
                    return True
                except queue.Full:
                    continue
            return False

        try:
            streams: list[Iterator[RadarFrame | Pose]] = [self._make_frames(radar) for radar in self._rig.radars]
            for item in heapq.merge(*streams, self._make_poses(), key=_instant):
                if not put(item):
                    return
        except RfconstructError as error:
            put(error)
            return
        put(None)

    def _make_frames(self, radar: RadarId) -> Iterator[RadarFrame | Pose]:
        faults = FrameFaults(self._faults, radar)
        shift_ns = round(1e9 * faults.late_s())
        last = self._first + (self._frames or 0)
        for number in itertools.count(self._first) if self._frames is None else range(self._first, last):
            if self._faults is not None and self._faults.hit(Fault.UNPLUG, faults.where):
                return
            for frame in faults.of(self._supply(radar, number)):
                yield _moved_frame(frame, shift_ns)
        for frame in faults.flush():
            yield _moved_frame(frame, shift_ns)

    def _make_poses(self) -> Iterator[RadarFrame | Pose]:
        faults, held = self._faults, list[Pose]()
        for pose in self._poses:
            if faults is not None and faults.hit(Fault.UNPLUG, POSE):
                return
            if faults is not None and faults.hit(Fault.DROP, POSE):
                continue
            if faults is not None and not held and faults.hit(Fault.REORDER, POSE):
                held = [pose]
                continue
            yield pose
            if faults is not None and faults.hit(Fault.DUPLICATE, POSE):
                yield pose
            yield from held
            held = []


def _moved_frame(frame: RadarFrame, shift_ns: int) -> RadarFrame:
    return replace(frame, t_first_chirp_ns=frame.t_first_chirp_ns + shift_ns) if shift_ns else frame


def _moved(item: RadarFrame | Pose, shift_ns: int) -> RadarFrame | Pose:
    if isinstance(item, RadarFrame):
        return _moved_frame(item, shift_ns)
    return replace(item, t_ns=item.t_ns + shift_ns)


def _instant(item: RadarFrame | Pose) -> int:
    return item.t_ns if isinstance(item, Pose) else item.t_first_chirp_ns
