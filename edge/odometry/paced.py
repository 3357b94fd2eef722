# SPDX-License-Identifier: Apache-2.0
"""Poses at their own pace from now on: of a file, or of a vehicle that drives straight ahead."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edge.board_settings import PoseSettings
from edge.config import RigGeometry
from edge.errors import PoseError
from edge.frames import Pose
from edge.odometry.recorded import read_poses
from edge.odometry.source import NS_PER_S, Meter, Placement, PoseEvent, PoseHealth

MOST_AT_ONCE = 4096
"""Poses of one poll: a caller that was away for a minute gets them in several."""


class PacedSource:
    """Gives poses when they are due; the first one is due at the start.

    Args:
        name: for messages.
        poses: in order of time, as the sensor gives them; may be endless.
        placement: to poses of the rig.
        timeout_s: of PoseSettings.
    """

    def __init__(self, name: str, poses: Iterator[Pose], placement: Placement, timeout_s: float) -> None:
        self._name, self._poses, self._placement = name, poses, placement
        self._meter = Meter(timeout_s)
        self._shift_ns = 0
        self._next: Pose | None = None
        self._news: list[Pose | PoseEvent] = []
        self._error: PoseError | None = None

    @property
    def name(self) -> str:
        """For messages."""
        return self._name

    @property
    def health(self) -> PoseHealth:
        """Counters and state now."""
        return self._meter.health()

    def start(self) -> None:
        """Move the times so that the first pose is of now.

        Raises:
            PoseError: there is no pose, or the first is none.
        """
        if self._meter.state != "idle":
            return
        self._next = next(self._poses, None)
        if self._next is None:
            raise PoseError(f"{self._name} holds no pose", action="check the file named by pose.file")
        now_ns = time.monotonic_ns()
        self._shift_ns = now_ns - self._next.t_ns
        self._meter.state = "running"
        self._news.append(PoseEvent("started", now_ns, f"{self._name}: first pose"))

    def poll(self, timeout_s: float) -> list[Pose | PoseEvent]:
        """Poses that are due; waits for the next one, at most ``timeout_s``.

        Raises:
            PoseError: a line of the file is no pose.
        """
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        deadline_ns = time.monotonic_ns() + round(timeout_s * NS_PER_S)
        due_ns = deadline_ns if self._next is None else min(deadline_ns, self._next.t_ns + self._shift_ns)
        if not self._news:
            time.sleep(max(0, due_ns - time.monotonic_ns()) / NS_PER_S)
        items, self._news = self._news, []
        now_ns = time.monotonic_ns()
        while self._next is not None and self._next.t_ns + self._shift_ns <= now_ns and len(items) < MOST_AT_ONCE:
            moved = Pose(self._next.t_ns + self._shift_ns, self._next.position_m, self._next.quaternion_xyzw)
            pose = self._placement.rig(moved)
            if self._meter.accept(pose):
                items.append(pose)
            self._next = self._advance(items)
        return items

    def close(self) -> None:
        """No pose from now on."""
        self._next, self._meter.state = None, "ended"

    def _advance(self, items: list[Pose | PoseEvent]) -> Pose | None:
        try:
            following = next(self._poses, None)
        except PoseError as error:  # after the poses before it
            self._error, self._meter.state = error, "ended"
            return None
        if following is None:
            self._meter.state = "ended"
            items.append(PoseEvent("ended", time.monotonic_ns(), f"{self._name}: last pose"))
        return following


def recorded_source(settings: PoseSettings, geometry: RigGeometry, folder: Path) -> PacedSource:
    """Poses of ``settings.file``, relative to ``folder``, moved to now."""
    path = folder / settings.file
    return PacedSource(f"recorded ({path})", read_poses(path), Placement(settings, geometry), settings.timeout_s)


def constant_source(settings: PoseSettings, geometry: RigGeometry) -> PacedSource:
    """A vehicle that drives along x at ``settings.speed_m_s``, ``settings.rate_hz`` poses a second."""
    name = f"constant ({settings.speed_m_s:g} m/s)"
    of_vehicle = PoseSettings()
    return PacedSource(name, straight(settings), Placement(of_vehicle, geometry), settings.timeout_s)


def straight(settings: PoseSettings) -> Iterator[Pose]:
    """Poses of the vehicle from time 0 on, without end; times are rounded to ns, positions are of those times."""
    number = 0
    while True:
        t_ns = round(number * NS_PER_S / settings.rate_hz)
        yield Pose(t_ns, np.array([settings.speed_m_s * t_ns / NS_PER_S, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))
        number += 1
