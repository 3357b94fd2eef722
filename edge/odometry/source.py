# SPDX-License-Identifier: Apache-2.0
"""What every live source of poses gives, and which one a rig asks for.

A source is used from one thread: ``start``, then ``poll`` again and again, then ``close``. Poses are of the rig, in an
odometry frame with z up, on CLOCK_MONOTONIC, strictly later one by one.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

import numpy as np

from edge.board_settings import PoseSettings
from edge.config import RigGeometry
from edge.frames import Pose
from edge.odometry.transforms import compose, inverse
from edge.odometry.vehicle import rig_in_vehicle

if TYPE_CHECKING:
    from edge.rig import Rig

NS_PER_S = 1_000_000_000
RATE_SPAN = 120
"""Poses over which the rate is taken."""
LARGEST_AHEAD_S = 0.05
"""A pose stamped so much after now has a wrong clock."""

EventKind = Literal[
    "started", "silent", "resumed", "died", "restarting", "doubtful", "trusted", "new_clock", "new_frame", "ended"
]
SourceState = Literal["idle", "starting", "running", "silent", "restarting", "ended"]


@dataclass(frozen=True, slots=True)
class PoseEvent:
    """Something that happened to a source of poses.

    Args:
        kind: "started": the first pose comes next. "silent": none for the time-out; "resumed": they come again.
            "died": the process behind the source ended; "restarting": and is started again after a pause. "doubtful":
            the vehicle turns faster than the odometry can follow; "trusted": no longer. "new_clock": the sender's
            clock was set. "new_frame": the sender restarted. "ended": no further pose will come.
        t_ns: when it was noticed.
        detail: one sentence for the log.
        new_frame: poses from now on are in another odometry frame than those before: ``PoseTrack.clear()``.
    """

    kind: EventKind
    t_ns: int
    detail: str
    new_frame: bool = False


@dataclass(frozen=True, slots=True)
class PoseHealth:
    """A source at one instant; counters since the start.

    Args:
        state: what it does.
        poses: given to the caller.
        last_pose_ns: instant of the newest one; None: none yet.
        rate_hz: of the last poses; 0 when they stopped for longer than the time-out.
        restarts: of the process behind it, or of the sender.
        doubtful: poses while the vehicle turned too fast for the odometry.
        time_guessed: poses that came without a usable time.
        refused: messages that were no pose, not later than the one before, or stamped beyond any delay.
        lost: poses that were made but did not come: gaps in their numbers.
    """

    state: SourceState
    poses: int
    last_pose_ns: int | None
    rate_hz: float
    restarts: int
    doubtful: int
    time_guessed: int
    refused: int
    lost: int

    def age_s(self, now_ns: int) -> float:
        """Time since the instant of the newest pose; infinite without one."""
        return math.inf if self.last_pose_ns is None else (now_ns - self.last_pose_ns) / NS_PER_S


@runtime_checkable
class PoseSource(Protocol):
    """Anything poses come from, live."""

    @property
    def name(self) -> str:
        """For messages: kind, and where it comes from."""

    @property
    def health(self) -> PoseHealth:
        """Counters and state now; may be read from any thread."""

    def start(self) -> None:
        """Begin. DependencyError, ConfigError, PoseError: it cannot."""

    def poll(self, timeout_s: float) -> list[Pose | PoseEvent]:
        """What came, in order; waits at most ``timeout_s`` for the first. Empty: nothing came.

        Raises:
            PoseError: "recorded": the file holds a line that is no pose.
        """

    def close(self) -> None:
        """Stop and release everything within a few seconds; never raises; may be called twice."""


class Placement:
    """From poses as the sensor gives them to poses of the rig.

    Args:
        settings: mounting of the sensor in the vehicle frame, and whose poses they are.
        geometry: place of the rig in the vehicle frame.
        from_start: the sensor's odometry frame is level and begins where and how the sensor stood at its start
            (visual-inertial odometry): the vehicle frame of that instant becomes the odometry frame, so that it begins
            on the ground. Otherwise the sensor's odometry frame stays.
    """

    def __init__(self, settings: PoseSettings, geometry: RigGeometry, from_start: bool = False) -> None:
        mounting = RigGeometry(
            yaw_deg=settings.yaw_deg,
            pitch_deg=settings.pitch_deg,
            roll_deg=settings.roll_deg,
            offset_m=settings.position_m,
        )
        level = RigGeometry(yaw_deg=settings.yaw_deg, offset_m=settings.position_m)
        rig = Pose(0, *rig_in_vehicle(geometry))
        self._after: Pose | None = compose(inverse(Pose(0, *rig_in_vehicle(mounting))), rig)
        self._before = Pose(0, *rig_in_vehicle(level)) if from_start else None
        if settings.poses_of == "rig":
            self._after = None

    def rig(self, pose: Pose) -> Pose:
        """Pose of the rig at the same instant."""
        if self._after is None:
            return pose
        after = Pose(pose.t_ns, self._after.position_m, self._after.quaternion_xyzw)
        placed = compose(pose, after)
        return placed if self._before is None else compose(self._before, placed)


class Meter:
    """Counters of a source, and the order of its poses.

    Attributes:
        state, restarts, doubtful, time_guessed, refused, lost: of PoseHealth.
    """

    def __init__(self, timeout_s: float, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.state: SourceState = "idle"
        self.restarts = self.doubtful = self.time_guessed = self.refused = self.lost = self._poses = 0
        self._timeout_ns = round(timeout_s * NS_PER_S)
        self._clock = clock
        self._last_ns: int | None = None
        self._recent: deque[int] = deque(maxlen=RATE_SPAN)
        self._lock = threading.Lock()

    def accept(self, pose: Pose) -> bool:
        """Count a pose; False, and it counts as refused, when it is not later than the last or later than now."""
        early = self._last_ns is not None and pose.t_ns <= self._last_ns
        if early or pose.t_ns > self._clock() + LARGEST_AHEAD_S * NS_PER_S:
            self.refused += 1
            return False
        with self._lock:
            self._last_ns = pose.t_ns
            self._poses += 1
            self._recent.append(pose.t_ns)
        return True

    def health(self) -> PoseHealth:
        """The counters now; from any thread."""
        with self._lock:
            poses, last_ns = self._poses, self._last_ns
            intervals, span_ns = len(self._recent) - 1, self._recent[-1] - self._recent[0] if self._recent else 0
        stopped = last_ns is None or self._clock() - last_ns > self._timeout_ns
        return PoseHealth(
            state=self.state,
            poses=poses,
            last_pose_ns=last_ns,
            rate_hz=0.0 if stopped or not span_ns else intervals * NS_PER_S / span_ns,
            restarts=self.restarts,
            doubtful=self.doubtful,
            time_guessed=self.time_guessed,
            refused=self.refused,
            lost=self.lost,
        )

    def pause(self) -> None:
        """Poses that come after a restart are not of the same rate."""
        with self._lock:
            self._recent.clear()


def make_pose_source(rig: Rig) -> PoseSource | None:
    """The source that ``rig.pose`` names.

    Args:
        rig: its settings, its geometry, and the folder where relative paths begin.
    Returns:
        Not started; None for kind "none".
    """
    settings, geometry = rig.pose, rig.geometry
    if settings.kind == "none":
        return None
    if settings.kind == "oak":
        from edge.odometry.oak import OakSource

        return OakSource(settings, geometry)
    if settings.kind == "zmq":
        from edge.odometry.external import ExternalSource

        return ExternalSource(settings, geometry)
    from edge.odometry.paced import constant_source, recorded_source

    if settings.kind == "constant":
        return constant_source(settings, geometry)
    return recorded_source(settings, geometry, Path(rig.directory))


def quaternion_turn_rad(a: Pose, b: Pose) -> float:
    """Angle of the rotation between two poses, 0..pi."""
    cosine = abs(float(np.dot(a.quaternion_xyzw, b.quaternion_xyzw)))
    return 2.0 * math.acos(min(1.0, cosine))
