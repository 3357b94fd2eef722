# SPDX-License-Identifier: Apache-2.0
"""Where the virtual rig's frames come from: any callable, frames made before and repeated, frames made ahead."""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from edge.errors import CaptureError
from edge.frames import Pose, RadarFrame, RadarId
from edge.odometry.vehicle import rig_in_vehicle
from edge.reference.point_targets import make_frame
from edge.rig import Rig
from train.simulate.threads import join

FrameSupply = Callable[[RadarId, int], RadarFrame]
"""Frame ``number`` of a radar, the same samples whenever it is asked for; CaptureError: there is none."""
EPOCH_NS = 1_000_000_000
"""Instant of the horizontal radar's frame 0; any will do."""
DEPTH = 8
SPEED_M_S, POSE_RATE_HZ, POSES_BEFORE = 0.5, 100.0, 5


def frame_time_ns(rig: Rig, radar: RadarId, number: int) -> int:
    """First chirp of a frame: the vertical radar of two fires half its period after the horizontal one."""
    period_s = rig.radars[radar].schedule.frame_period_s_actual
    late = 0.5 if radar == "vertical" and len(rig.radars) > 1 else 0.0
    return EPOCH_NS + round((number + late) * period_s * 1e9)


class CyclicSupply:
    """Frames made before, again and again, with numbers and times that go on: nothing is computed or copied.

    Args:
        rig: radars and their periods.
        frames: of each radar, at least one.
    Raises:
        CaptureError: a radar of the rig has no frame.
    """

    def __init__(self, rig: Rig, frames: Mapping[RadarId, Sequence[RadarFrame]]) -> None:
        for radar in rig.radars:
            if not frames.get(radar):
                raise CaptureError(f"no frames of the {radar} radar to repeat", allowed="one or more for each radar")
        self._rig, self._frames = rig, {radar: tuple(frames[radar]) for radar in rig.radars}

    def __call__(self, radar: RadarId, number: int) -> RadarFrame:
        """Frame ``number`` modulo those there are."""
        frame = self._frames[radar][number % len(self._frames[radar])]
        return replace(frame, number=number, t_first_chirp_ns=frame_time_ns(self._rig, radar, number))


def targets(
    rig: Rig, count: int = 4, seed: int = 0, noise_lsb: float = 25.0, speed_m_s: float = SPEED_M_S
) -> CyclicSupply:
    """Three standing point targets at 3 to 8 m that are driven past, ``count`` frames of each radar, repeated.

    Args:
        rig: radars; the vehicle drives to the right of what they look at (yaw 90 degrees).
        count: different frames.
        seed: of places and noise.
        noise_lsb: standard deviation of each complex sample.
        speed_m_s: by which the targets pass along +y of the rig.
    """
    rng = np.random.default_rng(seed)
    range_m = rng.uniform(3.0, 8.0, 3)
    lateral, height = rng.uniform(-0.3, 0.3, 3), rng.uniform(-0.1, 0.1, 3)
    made: dict[RadarId, list[RadarFrame]] = {}
    for index, (radar, board) in enumerate(rig.radars.items()):
        made[radar] = []
        for number in range(count):
            passed_m = speed_m_s * 1e-9 * (frame_time_ns(rig, radar, number) - EPOCH_NS)
            places_m = np.stack([range_m, lateral * range_m + passed_m, height * range_m], axis=1)
            noise = np.random.default_rng((seed, index, number))
            made[radar].append(make_frame(board, places_m, 2000.0 / range_m**2, number, 0, None, noise_lsb, noise))
    return CyclicSupply(rig, made)


def rendered(rig: Rig, supply: FrameSupply, count: int) -> CyclicSupply:
    """The first ``count`` frames of each radar, made now and repeated; what is kept in memory is all of them."""
    return CyclicSupply(rig, {radar: [supply(radar, number) for number in range(count)] for radar in rig.radars})


def straight_poses(rig: Rig, speed_m_s: float = SPEED_M_S, rate_hz: float = POSE_RATE_HZ) -> Iterator[Pose]:
    """Endless poses of a vehicle that drives along +x from just before the first frame, without error."""
    position_m, attitude = rig_in_vehicle(rig.geometry)
    for index in itertools.count(-POSES_BEFORE):
        t_s = index / rate_hz
        travelled_m = np.array([speed_m_s * t_s, 0.0, 0.0])
        yield Pose(EPOCH_NS + round(t_s * 1e9), position_m + travelled_m, attitude.copy())


class SupplyClosedError(CaptureError):
    """Asked for a frame after the end."""


class PreparedSupply:
    """Makes the next frames of each radar ahead, on one thread a radar; the supply behind is called by one at a time.

    Args:
        supply: makes the frames.
        depth: frames of a radar that may wait.
    """

    def __init__(self, supply: FrameSupply, depth: int = DEPTH) -> None:
        self._supply, self._depth = supply, depth
        self._lanes: dict[RadarId, _Lane] = {}
        self._one, self._lock = threading.Lock(), threading.Lock()

    def __call__(self, radar: RadarId, number: int) -> RadarFrame:
        """The frame; waits for it when it is not ready. Errors of the supply come with the number they belong to."""
        return self._lane(radar).take(number)

    def prepare(self, radar: RadarId, number: int) -> None:
        """Begin to make frames from ``number`` on."""
        self._lane(radar).begin(number)

    def close(self) -> bool:
        """End the threads; whether they ended."""
        with self._lock:
            lanes = list(self._lanes.values())
        ended = [lane.close() for lane in lanes]
        return all(ended)

    def _lane(self, radar: RadarId) -> _Lane:
        with self._lock:
            if radar not in self._lanes:
                self._lanes[radar] = _Lane(self._make, radar, self._depth)
            return self._lanes[radar]

    def _make(self, radar: RadarId, number: int) -> RadarFrame | CaptureError:
        with self._one:
            try:
                return self._supply(radar, number)
            except CaptureError as error:
                return error


class _Lane:
    """Frames of one radar, made ahead."""

    def __init__(
        self, make: Callable[[RadarId, int], RadarFrame | CaptureError], radar: RadarId, depth: int
    ) -> None:
        self._make, self._radar, self._depth = make, radar, depth
        self._ready: deque[tuple[int, RadarFrame | CaptureError]] = deque()
        self._next, self._closed, self._change = 0, False, threading.Condition()
        self._thread = threading.Thread(target=self._run, name=f"frames {radar}", daemon=True)

    def begin(self, number: int) -> None:
        with self._change:
            self._aim(number)

    def take(self, number: int) -> RadarFrame:
        with self._change:
            self._aim(number)
            while not self._ready or self._ready[0][0] != number:
                if self._closed:
                    raise SupplyClosedError("the frame supply was closed", value=number)
                self._aim(number)
                self._change.wait()
            _, frame = self._ready.popleft()
            self._change.notify_all()
        if isinstance(frame, CaptureError):
            raise frame
        return frame

    def _aim(self, number: int) -> None:
        """What is ready or being made must lead to ``number``; otherwise begin anew there."""
        coming = self._ready[0][0] if self._ready else self._next
        if coming != number:
            self._ready.clear()
            self._next = number
        if self._thread.ident is None:
            self._thread.start()
        self._change.notify_all()

    def close(self) -> bool:
        with self._change:
            self._closed = True
            self._change.notify_all()
        return join(self._thread)

    def _run(self) -> None:
        while True:
            with self._change:
                while not self._closed and len(self._ready) >= self._depth:
                    self._change.wait()
                if self._closed:
                    return
                number = self._next
            frame = self._make(self._radar, number)
            with self._change:
                if number == self._next:
                    self._ready.append((number, frame))
                    self._next = number + 1
                    self._change.notify_all()
