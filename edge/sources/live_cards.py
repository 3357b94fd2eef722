# SPDX-License-Identifier: Apache-2.0
"""Frames of one or two single-chip radars as their capture cards deliver them: in order of time, each accounted for.

Both radars are armed, the second one is started into the gaps of the first. Numbers are given when both run: frames
that one radar alone made before that, or after a cut, belong to nobody and are only counted (``alone``).
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping

import numpy as np

from edge.drivers.board import Board
from edge.drivers.dca1000.assembler import Assembled
from edge.drivers.interleave import InterleaveStarter
from edge.drivers.offset import OffsetWatch
from edge.drivers.single_chip import SingleChipDriver
from edge.errors import ConfigError, DeviceError, LinkError
from edge.frames import RADARS, LossCause, Pose, RadarFrame, RadarId
from edge.odometry.source import PoseEvent
from edge.rig import Rig
from edge.sources.base import Loss
from edge.sources.card_lane import Lane, cause_of, time_of
from edge.sources.frame_clock import FrameClock
from edge.sources.pose_feed import PoseFeed

Item = RadarFrame | Pose | Loss | PoseEvent
Starter = Callable[[Board, Board, Callable[[], None]], object]
"""Starts the second of two armed boards into the gaps of the first; the last argument arms both again."""
POLL_S = 0.02
CHECK_S = 0.25
"""Between two looks at what the cards report."""
MEASURE_S = 1.0
SILENT_S = 2.5
"""And three frame periods: without samples for so long the radar is said to be silent."""
HOLD_PERIODS = 2.0
"""A frame waits at most so long for an earlier one of the other radar."""
EARLY_SHARE = 0.9
"""The next frame of a radar is not earlier than this share of a period after the one before."""
STRANGE_PACKETS = 256
"""So many packets in a row of another place in the recording: another program started one."""
RETRIES = 3
BACK_OFF_S = 0.5
GOOD_S = 10.0
"""After so long without a fault the next one is the first again."""
MOST_MISSED = 30_000
"""Frames of one outage that are counted as missing; the numbering must not jump by more than the pairer takes."""


class CardSource:
    """Live frames: a ``FrameSource``.

    Args:
        rig: radars and schedules.
        drivers: one for each radar of the rig, connected and configured; they stay open when the source is closed.
        starter: None: ``InterleaveStarter`` of the rig; a rig of one radar needs none.
        frames: numbers to give; 0: until closed.
        poses: None: there are none. Poses are given as they come.
        watch_offset: re-arm before drift closes the guard between the bursts; not with a hardware trigger.
        keep_missing_share: frames that lack at most this share of their bytes are given, zero where nothing came.
        retries: faults in a row after which the boards are set up anew; the next one is raised.
        stopped: asked again and again; True ends the source after the boards were stopped.
        say: told what happens.
    Attributes:
        alone: frames of one radar that the other one cannot have, not numbered.
        repaired: frames given with zeros in the place of lost bytes.
        restarts, rearms: how often the boards were set up anew after a fault, and started anew because of drift.
    Raises:
        ConfigError: drivers that are not those of the rig.
    """

    def __init__(
        self,
        rig: Rig,
        drivers: Mapping[RadarId, SingleChipDriver],
        *,
        starter: Starter | None = None,
        frames: int = 0,
        poses: PoseFeed | None = None,
        watch_offset: bool = True,
        keep_missing_share: float = 0.0,
        retries: int = RETRIES,
        stopped: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        if set(drivers) != set(rig.radars) or frames < 0:
            raise ConfigError("drivers are not those of the rig", value=sorted(drivers), allowed=", ".join(rig.radars))
        self._radars = [radar for radar in RADARS if radar in rig.radars]
        self._lanes = {radar: self._lane(drivers[radar]) for radar in self._radars}
        pair = len(self._radars) == len(RADARS)
        self._starter = (starter or InterleaveStarter(rig).start) if pair else None
        by_hardware = any(radar.schedule.hardware_trigger for radar in rig.radars.values())
        self.watch = OffsetWatch(rig) if pair and watch_offset and not by_hardware else None
        self._period_s = max(lane.driver.timing.period_s for lane in self._lanes.values())
        self._total, self._keep_share, self._retries = frames, keep_missing_share, retries
        self._poses, self._asked, self._say = poses, stopped, say
        self.alone: Counter[RadarId] = Counter()
        self.repaired: Counter[RadarId] = Counter()
        self.restarts = self.rearms = 0
        self._next, self._limit = 0, frames - 1 if frames else None
        self._closing = threading.Event()
        self._checked_ns = self._measured_ns = self._started_ns = 0

    @property
    def total_frames(self) -> int | None:
        """Frames and losses of all radars; None: endless."""
        return self._total * len(self._radars) or None

    def reception(self) -> dict[RadarId, str]:
        """What each radar's receiver counted since its board was connected last, in words."""
        return {radar: lane.driver.reception() for radar, lane in self._lanes.items()}

    def close(self) -> None:
        """End the iteration; the boards are stopped then."""
        self._closing.set()

    def __iter__(self) -> Iterator[Item]:
        """Frames and losses in order of time; each number once for each radar.

        Raises:
            DeviceError: a board cannot be used, after ``retries`` attempts where that can help.
        """
        faults, running, lost_ns = 0, False, 0
        try:
            while not self._done:
                try:
                    if lost_ns:
                        lost_ns = yield from self._restart(faults, lost_ns)
                    if not running:
                        self._begin()
                        running, lost_ns = True, 0
                    yield from self._run()
                except LinkError as error:
                    now_ns = time.monotonic_ns()
                    faults = 1 if running and now_ns - self._started_ns > 1e9 * GOOD_S else faults + 1
                    running, lost_ns = False, lost_ns or now_ns
                    yield from self._give_up()
                    if faults > self._retries or self._stopped:
                        raise
                    self._say(f"restart {faults} of {self._retries} after: {error}")
        finally:
            self._stop_boards()

    @property
    def _stopped(self) -> bool:
        return self._closing.is_set() or self._asked()

    def _lane(self, driver: SingleChipDriver) -> Lane:
        timing = driver.timing
        return Lane(driver, driver.schedule.layout, FrameClock(timing.period_s, timing.delay_ns))

    @property
    def _done(self) -> bool:
        ended = self._limit is not None and self._total and all(x.reached >= self._limit for x in self._lanes.values())
        return self._stopped or bool(ended and not any(lane.ready for lane in self._lanes.values()))

    # --- boards

    def _begin(self) -> None:
        """Arm all, start all, forget what came before."""
        drivers = [lane.driver for lane in self._lanes.values()]
        self._arm()
        if self._starter is not None:
            first, second = drivers
            result = self._starter(first, second, self._arm)
            self._say(getattr(result, "text", lambda: "both radars started")())
        else:
            drivers[0].start()
        for radar, lane in self._lanes.items():
            assert lane.driver.receiver is not None, "it was armed"
            lane.recording, lane.base, lane.last_t_ns = lane.driver.receiver.recording, None, 0
            lane.clock.clear()
            lane.early.clear()
            if self.watch is not None:
                self.watch.restarted(radar)
        self._started_ns = self._checked_ns = self._measured_ns = time.monotonic_ns()

    def _arm(self) -> None:
        for lane in self._lanes.values():
            lane.driver.arm(self._total)

    def _stop_boards(self) -> None:
        """Second radar first; what fails is said: the boards are set up anew before they are used."""
        for lane in reversed(self._lanes.values()):
            if lane.driver.receiver is not None:
                try:
                    lane.driver.stop()
                except DeviceError as error:
                    self._say(f"stop: {error}")

    def _restart(self, faults: int, lost_ns: int) -> Generator[Loss, None, int]:
        """Set up everything anew after a fault; frames that the outage cost are given as losses.

        Returns:
            Instant up to which the outage is counted.
        """
        self._stop_boards()
        self._closing.wait(BACK_OFF_S * 2 ** (faults - 1))
        self.restarts += 1
        for lane in self._lanes.values():
            lane.driver.close()
            lane.driver.connect()
            for note in lane.driver.configure(lambda what, done, total: None):
                self._say(note)
        now_ns = time.monotonic_ns()
        if self._next:
            self._next += min(round(1e-9 * (now_ns - lost_ns) / self._period_s), MOST_MISSED)
            if self._limit is not None:
                self._next = min(self._next, self._limit + 1)
            yield from self._missing("set up anew", now_ns)
        return now_ns

    def _rearm(self) -> Iterator[Item]:
        """Start both anew, without a hole in the numbers: none above the highest one given is used."""
        limit, self._limit = self._limit, max(lane.reached for lane in self._lanes.values())
        end_s = time.monotonic() + HOLD_PERIODS * self._period_s
        while any(lane.reached < self._limit for lane in self._lanes.values()) and time.monotonic() < end_s:
            yield from self._step()
        self._stop_boards()
        yield from self._give_up()
        self._limit = limit
        self.rearms += 1
        self._begin()

    # --- frames

    def _run(self) -> Iterator[Item]:
        """Until all is done, or a fault."""
        while not self._done:
            yield from self._step()
            now_ns = time.monotonic_ns()
            if now_ns - self._checked_ns > 1e9 * CHECK_S:
                self._checked_ns = now_ns
                self._check(now_ns)
            if self.watch is not None and now_ns - self._measured_ns > 1e9 * MEASURE_S:
                self._measured_ns = now_ns
                self.watch.measure()
                if self.watch.rearm_due:
                    self._say(f"started anew: {self.watch.last.text() if self.watch.last else ''}")
                    yield from self._rearm()

    def _step(self) -> Iterator[Item]:
        """What is there now, or comes within a moment."""
        if self._poses is not None:
            yield from self._poses.take()
        came = [self._take(lane) for lane in self._lanes.values()]
        self._number()
        given = False
        while (item := self._earliest()) is not None:
            given = True
            yield item
        if not given and not any(came):
            slowest = min(self._lanes.values(), key=lambda lane: lane.last_t_ns)
            assert slowest.driver.receiver is not None, "it runs"
            slowest.driver.receiver.wait(POLL_S)

    def _check(self, now_ns: int) -> None:
        """Reports of the cards, silence, strange packets."""
        for lane in self._lanes.values():
            driver = lane.driver
            for note in driver.check():
                self._say(note)
            assert driver.receiver is not None, "it runs"
            silent_s = 1e-9 * (now_ns - max(driver.receiver.last_packet_ns, self._started_ns))
            if silent_s > SILENT_S + 3 * driver.timing.period_s:
                raise driver.no_samples()
            if driver.receiver.outside_in_a_row > STRANGE_PACKETS:
                raise LinkError(
                    f"{driver.radar} card sends another recording than the one that was started",
                    action="end the other program that commands it, or give each card its own address",
                )

    def _take(self, lane: Lane) -> bool:
        """Everything from a receiver to its lane."""
        receiver, some = lane.driver.receiver, False
        assert receiver is not None, "it runs"
        while (item := receiver.get()) is not None:
            some = True
            if item.recording != lane.recording:
                self.alone[lane.driver.radar] += item.count
                continue
            if item.arrival_ns:
                lane.clock.add(item.index, item.arrival_ns)
            if lane.base is None or lane.early or not lane.clock.known:
                lane.early.append(item)
            else:
                self._give_number(lane, item)
        return some

    def _number(self) -> None:
        """Find the bases once both radars have a frame; then number what waits."""
        lanes = list(self._lanes.values())
        if lanes[0].base is None:
            if not all(lane.clock.known and lane.early for lane in lanes):
                return
            first_ns = [lane.clock.at(0) for lane in lanes]
            ahead = [int((max(first_ns) - t_ns) * 1e-9 // self._period_s) for t_ns in first_ns]
            for lane, frames in zip(lanes, ahead, strict=True):
                lane.base = self._next - frames
        for lane in lanes:
            while lane.early:
                self._give_number(lane, lane.early.popleft())

    def _give_number(self, lane: Lane, item: Assembled) -> None:
        """A frame or loss with number and time, unless it is of a time when this radar was alone."""
        assert lane.base is not None, "numbered after alignment"
        radar, size = lane.driver.radar, lane.driver.timing.frame_bytes
        first, last = lane.base + item.index, lane.base + item.index + item.count - 1
        kept_first = max(first, self._next)
        kept_last = last if self._limit is None else min(last, self._limit)
        count = max(0, kept_last - kept_first + 1)
        self.alone[radar] += item.count - count
        if not count:
            return
        t_ns = max(lane.clock.at(kept_first - lane.base), lane.last_t_ns + 1)
        lane.last_t_ns = t_ns if count == 1 else max(t_ns, lane.clock.at(kept_last - lane.base))
        lane.reached = kept_last
        kept: RadarFrame | Loss
        if item.data is not None and item.missing_bytes <= self._keep_share * size:
            adc = item.data.view("<i2").astype(np.int16, copy=False).reshape(lane.layout.shape)
            kept = RadarFrame(radar, kept_first, t_ns, adc, lane.layout)
            self.repaired[radar] += item.missing_bytes > 0
            if self.watch is not None:
                self.watch.add(radar, kept_first, t_ns)
        else:
            kept = Loss(radar, kept_first, *cause_of(item, size), t_ns, count)
        lane.ready.append((kept, time.monotonic_ns()))

    def _earliest(self) -> RadarFrame | Loss | None:
        """The earliest that waits, unless the other radar may still have an earlier one."""
        lanes = [lane for lane in self._lanes.values() if lane.ready]
        if not lanes:
            return None
        lane = min(lanes, key=lambda one: time_of(one.ready[0][0]))
        item, since_ns = lane.ready[0]
        period_ns = 1e9 * self._period_s
        for other in self._lanes.values():
            may_come = not other.ready and other.last_t_ns + EARLY_SHARE * period_ns < time_of(item)
            if other is not lane and may_come and time.monotonic_ns() - since_ns < HOLD_PERIODS * period_ns:
                return None
        lane.ready.popleft()
        return item

    def _give_up(self) -> Iterator[RadarFrame | Loss]:
        """Everything that waits, in order of time; then no number up to the highest one is used again."""
        for lane in self._lanes.values():
            if lane.driver.receiver is not None:
                try:
                    self._take(lane)
                except LinkError as error:
                    self._say(str(error))
        self._number()
        rest = [item for lane in self._lanes.values() for item, _ in lane.ready]
        for lane in self._lanes.values():
            self.alone[lane.driver.radar] += sum(item.count for item in lane.early)
            lane.early.clear()
            lane.ready.clear()
            lane.recording = -1
        yield from sorted(rest, key=time_of)
        self._next = max(self._next, *(lane.reached + 1 for lane in self._lanes.values()))
        yield from self._missing("the other radar ran longer", time.monotonic_ns())

    def _missing(self, why: str, t_ns: int) -> Iterator[Loss]:
        """Losses of all numbers that a radar has not reached and that will not be used again."""
        for radar, lane in self._lanes.items():
            count = self._next - 1 - lane.reached
            if count > 0:
                yield Loss(radar, lane.reached + 1, LossCause.GAP, why, max(t_ns, lane.last_t_ns + 1), count)
                lane.reached = self._next - 1
