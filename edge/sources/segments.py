# SPDX-License-Identifier: Apache-2.0
"""Cascades as a source of frames: arm, start interleaved, record n frames, stop, fetch, read, and again.

The capture board cannot stream; what is recorded in one go is a segment. Frame numbers go on from segment to segment,
times are this host's CLOCK_MONOTONIC: a recording's first frame is where its start command went out, the others
follow by the board's own time stamps. The second radar starts some periods after the first; what one radar records
while the other does not is nobody's, so that frames of one number are half a period apart.
"""

from __future__ import annotations

import heapq
import math
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from edge.drivers.board import Board, StartTimes
from edge.drivers.fetch import Fetcher
from edge.drivers.interleave import Clock, InterleavedStart, InterleaveStarter
from edge.errors import CaptureError, DeviceError, RfconstructError
from edge.frames import RADARS, LossCause, Pose, RadarFrame, RadarId
from edge.odometry.source import PoseEvent
from edge.rig import Rig
from edge.sources.base import Loss
from edge.sources.pose_feed import PoseFeed
from edge.sources.ti_capture import CaptureFolder

MARGIN_S = 0.4
"""Recorded in addition when there are two radars: the second starts by so much later at the most."""
NAP_S = 0.05
FAILURES = 2
"""Segments in a row that may fail entirely; the next failure ends the source."""
SAME_FRAME = 0.25
"""Share of the period by which two measures of a frame's instant may differ to be of one frame."""

Item = RadarFrame | Pose | Loss | PoseEvent


class SegmentBoard(Board, Protocol):
    """A board that records segments.

    Attributes:
        directory: of the present recording on the board, or of the last one.
    """

    directory: str


@dataclass(frozen=True, slots=True)
class SegmentReport:
    """How one segment went.

    Args:
        number: counted from 0.
        start: of both radars; None: one radar, or it never started.
        frames: read, of each radar.
        fetched_s: time that the copy took.
        text: what went wrong; "": nothing.
    """

    number: int
    start: InterleavedStart | None
    frames: Mapping[RadarId, int]
    fetched_s: float
    text: str


class BoardClock:
    """Finds whether the first frames of a segment are missing, by the board's clock, which runs on between segments.

    Args:
        period_s: of the frames.
    """

    def __init__(self, period_s: float) -> None:
        self._period_ns = 1e9 * period_s
        self._last: tuple[int, int] | None = None

    def missing(self, board_ns: int, host_ns: int, most: int) -> int:
        """Frames before the first one that was recorded.

        Args:
            board_ns: stamp of the first recorded frame.
            host_ns: when frames began, by this host.
            most: so many are missing in all.
        Returns:
            0 where the clock does not tell: in the first segment, and after the board's clock was set.
        """
        last, self._last = self._last, (board_ns, host_ns)
        if last is None or most <= 0:
            return 0
        late = ((board_ns - last[0]) - (host_ns - last[1])) / self._period_ns
        count = round(late)
        if not 0 < count <= most or abs(late - count) > SAME_FRAME:
            return 0
        self._last = (board_ns - round(count * self._period_ns), host_ns)
        return count


class SegmentSource:
    """``edge.sources.base.FrameSource`` of one or two cascades.

    Args:
        rig: radars and schedules.
        boards: connected and configured; they stay open when the source is closed.
        fetchers: access to each board's recordings.
        frames: of a segment.
        segments: None: until closed.
        folder: for copies; each is removed when it was played, unless ``keep``.
        poses: None: there are none. Poses come merged with the frames, by time.
        keep: leave recordings on the boards, and copies here.
        stopped: asked again and again; True ends the source after the boards were stopped.
        say: told what is being done.
        clock: of the interleaved start; None: the host's.
    Attributes:
        reports: of every segment.
        frames: of a segment, which both radars have.
        alone: frames of one radar that the other one cannot have, not numbered.
    Raises:
        ConfigError: two radars that cannot be interleaved.
    """

    def __init__(
        self,
        rig: Rig,
        boards: Mapping[RadarId, SegmentBoard],
        fetchers: Mapping[RadarId, Fetcher],
        *,
        frames: int,
        segments: int | None,
        folder: Path,
        poses: PoseFeed | None = None,
        keep: bool = False,
        stopped: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda text: None,
        clock: Clock | None = None,
    ) -> None:
        self.reports: list[SegmentReport] = []
        self._rig, self._boards, self._fetchers = rig, dict(boards), fetchers
        self.frames, self._segments, self._folder, self._poses = frames, segments, folder, poses
        self._keep, self._say, self._closed, self._broken = keep, say, False, False
        self._asked, self._discarded = stopped, set[tuple[RadarId, str]]()
        periods = {radar: x.schedule.frame_period_s_actual for radar, x in rig.radars.items()}
        self._period_s = max(periods.values())
        self._clocks = {radar: BoardClock(period_s) for radar, period_s in periods.items()}
        self.alone: Counter[RadarId] = Counter()
        self._starter: InterleaveStarter | None = None
        self._recorded = frames
        if len(rig.radars) == len(RADARS):
            self._recorded += math.ceil(MARGIN_S / self._period_s)
            self._starter = InterleaveStarter(rig, clock, hold_s=self._recorded * self._period_s)

    @property
    def total_frames(self) -> int | None:
        """Frames of all radars."""
        return None if self._segments is None else self._segments * self.frames * len(self._boards)

    def close(self) -> None:
        """End the iteration."""
        self._closed = True

    def _stopped(self) -> bool:
        return self._closed or self._asked()

    def __iter__(self) -> Iterator[Item]:
        """Frames, poses and losses, segment by segment.

        Raises:
            RfconstructError: what a segment failed with, after three in a row; poses that ended with an error.
        """
        failed_in_a_row = number = 0
        while not self._stopped() and (self._segments is None or number < self._segments):
            start: InterleavedStart | None = None
            try:
                times, start = self._record(number)
            except DeviceError as error:
                failed_in_a_row += 1
                yield from self._fail(number, error)
                if failed_in_a_row > FAILURES:
                    raise
            else:
                if self._stopped():
                    self._remove()
                    return
                failed_in_a_row = 0
                yield from self._play(number, times, start)
            number += 1

    def _record(self, number: int) -> tuple[dict[RadarId, StartTimes], InterleavedStart | None]:
        """One segment onto the boards' disks."""
        if self._broken:
            self._revive()
        self._arm()
        start: InterleavedStart | None = None
        if self._starter is None:
            times = {radar: board.start() for radar, board in self._boards.items()}
        else:
            first, second = (self._boards[radar] for radar in RADARS)
            start = self._starter.start(first, second, self._arm_again)
            times = start.times
        self._say(f"segment {number}: {self.frames} frames{f', {start.text()}' if start else ''}")
        last_ns = max(each.answered_ns for each in times.values())
        end_s = last_ns / 1e9 + self._recorded * self._period_s
        while (rest_s := end_s - time.monotonic()) > 0 and not self._stopped():
            time.sleep(min(rest_s, NAP_S))
        for board in self._boards.values():
            board.stop()
        return times, start

    def _arm(self) -> None:
        for board in self._boards.values():
            board.arm(self._recorded)

    def _arm_again(self) -> None:
        """After a start that missed its window: what was recorded is of no use."""
        self._discard()
        self._arm()

    def _discard(self) -> None:
        self._discarded |= {(radar, Path(board.directory).name) for radar, board in self._boards.items()}

    def _revive(self) -> None:
        """Set the boards up anew, one after the other."""
        for radar, board in self._boards.items():
            self._say(f"{radar}: configured anew")
            board.close()
            board.connect()
            for note in board.configure(lambda what, done, of: None):
                self._say(note)
        self._broken = False

    def _fail(self, number: int, error: DeviceError) -> Iterator[Loss]:
        """Nothing of this segment will come; the boards are set up anew before the next one."""
        self._broken = True
        self._discard()
        self.reports.append(SegmentReport(number, None, {}, 0.0, str(error)))
        self._say(f"segment {number} failed: {error}")
        for radar in self._boards:
            yield self._all_lost(radar, number, str(error))

    def _play(self, number: int, times: Mapping[RadarId, StartTimes], start: InterleavedStart | None) -> Iterator[Item]:
        """Copy, read, give; then remove."""
        begun_s, problems, lanes = time.monotonic(), list[str](), list[Iterator[Item]]()
        counts: dict[RadarId, int] = {}
        for radar in self._boards:
            try:
                capture = self._fetch(radar, times[radar])
            except RfconstructError as error:
                if self._stopped():
                    return
                problems.append(f"{radar}: {error}")
                lanes.append(iter([self._all_lost(radar, number, str(error))]))
            else:
                later_ns = max(each.sent_ns for each in times.values()) - times[radar].sent_ns
                lanes.append(self._number(capture, number, times[radar], int(later_ns / 1e9 // self._period_s), counts))
        fetched_s = time.monotonic() - begun_s
        self._say(f"segment {number}: {'; '.join(problems) or 'fetched'} after {fetched_s:.1f} s")
        if self._poses is not None:
            lanes.append(iter(self._poses.take()))
        yield from heapq.merge(*lanes, key=_instant_ns)
        self.reports.append(SegmentReport(number, start, counts, fetched_s, "; ".join(problems)))
        self._remove()

    def _fetch(self, radar: RadarId, times: StartTimes) -> CaptureFolder:
        session = Path(self._boards[radar].directory).name
        folder = self._fetchers[radar].fetch(session, self._folder / radar, self._stopped)
        capture = CaptureFolder(folder, self._rig, radar, times.sent_ns)
        if capture.total_frames > self._recorded:
            raise CaptureError(
                f"{folder} holds more frames than were asked for",
                value=capture.total_frames,
                allowed=f"{self._recorded}",
                action="the folder was used before: let every recording have its own",
            )
        return capture

    def _number(
        self, capture: CaptureFolder, segment: int, times: StartTimes, alone: int, counts: dict[RadarId, int]
    ) -> Iterator[Item]:
        """The capture's items with the source's numbers; what is missing becomes losses, so that all n are counted.

        Args:
            capture: of one radar.
            segment: its number.
            times: of the radar's start.
            alone: frames that the radar made before the other one ran.
            counts: radar -> frames given, kept up to date.
        """
        radar, base = capture.radar, segment * self.frames
        period_ns, absent = round(1e9 * self._period_s), self._recorded - capture.total_frames
        begin = 0
        if capture.board_start_ns is not None:
            begin = self._clocks[radar].missing(capture.board_start_ns, times.sent_ns, absent)
        expected, t_ns = base, times.sent_ns + alone * period_ns
        for index, item in enumerate(capture):
            if isinstance(item, Pose):
                continue
            number = min(begin + item.number, absent + index) - alone  # a late stamp is no frame more
            if not 0 <= number < self.frames:
                self.alone[radar] += 1
                continue
            number += base
            t_ns = begin * period_ns + (item.t_ns if isinstance(item, Loss) else item.t_first_chirp_ns)
            if number > expected:
                detail = f"segment {segment}: numbers {expected}..{number - 1} were not recorded"
                yield Loss(radar, expected, LossCause.GAP, detail, t_ns, number - expected)
            expected = number + 1
            if isinstance(item, Loss):
                yield Loss(radar, number, item.cause, item.detail, t_ns)
            else:
                counts[radar] = counts.get(radar, 0) + 1
                yield RadarFrame(radar, number, t_ns, item.adc, item.layout)
        rest = base + self.frames - expected
        if rest:
            detail = f"segment {segment}: {rest} frames at its end were not recorded"
            yield Loss(radar, expected, LossCause.GAP, detail, t_ns + period_ns, rest)

    def _all_lost(self, radar: RadarId, segment: int, why: str) -> Loss:
        base = segment * self.frames
        return Loss(radar, base, LossCause.GAP, f"segment {segment}: {why}", time.monotonic_ns(), self.frames)

    def _remove(self) -> None:
        """A segment that was played takes no space, here or there."""
        if self._keep:
            return
        self._discard()
        for radar, session in sorted(self._discarded):
            try:
                if session:
                    self._fetchers[radar].delete(session)
            except DeviceError as error:
                self._say(f"{radar}: {error}")
            shutil.rmtree(self._folder / radar, ignore_errors=True)
        self._discarded.clear()


def _instant_ns(item: Item) -> int:
    return item.t_first_chirp_ns if isinstance(item, RadarFrame) else item.t_ns
