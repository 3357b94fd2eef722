# SPDX-License-Identifier: Apache-2.0
"""Points of messages in the frame of reference that was asked for: over the ground, or from the vehicle."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from edge.config import RigGeometry
from edge.errors import ConfigError, PoseError, RecordingError
from edge.frames import Float32, Pose
from edge.odometry.track import PoseTrack
from edge.odometry.transforms import compose, inverse, transform_points
from edge.odometry.vehicle import rig_in_vehicle
from edge.stream.messages import CloudMessage, DetectionsMessage, Message, PoseMessage, ShapeMessage

FrameName = Literal["odometry", "vehicle", "object"]
FRAME_NAMES: tuple[FrameName, ...] = ("odometry", "vehicle", "object")
LARGEST_POSE_GAP_S = 1.0
HELD = 4096
"""Messages that wait for a pose later than they are; beyond it the oldest goes without."""

Placeable = ShapeMessage | CloudMessage | DetectionsMessage


@dataclass(frozen=True, slots=True)
class Placed:
    """A message and how its own frame lies in the frame that was asked for.

    Args:
        message: shape (object frame), cloud (window frame) or detections (rig frame).
        pose: of that frame; None: its pose is not known.
    """

    message: Placeable
    pose: Pose | None

    def points(self, xyz_m: Float32) -> Float32:
        """Points of the message's own frame, float32 [n, 3], in the frame that was asked for."""
        if self.pose is None:
            raise RecordingError("the pose of these points is not known", value=self.message.header.t_ns)
        return transform_points(self.pose, xyz_m).astype(np.float32)


class Placer:
    """Gives every message its pose, once the poses around it are there.

    Args:
        frame: where the points shall be.
        geometry: of the rig on the vehicle; needed for ``vehicle`` where messages do not say it themselves.
    """

    def __init__(self, frame: FrameName, geometry: RigGeometry | None) -> None:
        self._frame, self._track = frame, PoseTrack(LARGEST_POSE_GAP_S)
        self._rig_in_vehicle: Pose | None = None
        if geometry is not None:
            self._rig_in_vehicle = Pose(0, *rig_in_vehicle(geometry))
        self._newest_ns: int | None = None
        self._waiting: deque[Placeable] = deque()

    def place(self, messages: Iterable[Message]) -> Iterator[Placed | PoseMessage]:
        """Shapes, clouds and detections in their order, and poses as they come."""
        for message in messages:
            if isinstance(message, PoseMessage):
                with contextlib.suppress(PoseError):  # repeated or late
                    self._track.add(message.pose)
                    self._newest_ns = message.pose.t_ns
                yield message
            elif isinstance(message, ShapeMessage | CloudMessage | DetectionsMessage):
                self._waiting.append(message)
            yield from self._ready(last=False)
        yield from self._ready(last=True)

    def _ready(self, last: bool) -> Iterator[Placed]:
        while self._waiting:
            message = self._waiting[0]
            reached = self._newest_ns is not None and self._newest_ns >= message.header.t_ns
            if not (last or reached or len(self._waiting) > HELD or not self._needs_pose(message)):
                return
            self._waiting.popleft()
            yield Placed(message, self._pose(message))

    def _needs_pose(self, message: Placeable) -> bool:
        if isinstance(message, DetectionsMessage):
            return self._frame == "odometry"
        said = isinstance(message, ShapeMessage) and message.pose_vehicle is not None
        return self._frame == "vehicle" and not said

    def _pose(self, message: Placeable) -> Pose | None:
        """Of the message's own frame in the one that was asked for."""
        match message:
            case DetectionsMessage():
                if self._frame == "vehicle":
                    return self._mounting()
                return self._track.at(message.header.t_ns)
            case ShapeMessage():
                if self._frame == "object":
                    return Pose(message.header.t_ns, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
                if self._frame == "vehicle" and message.pose_vehicle is not None:
                    return message.pose_vehicle
                own = message.pose
            case CloudMessage():
                own = message.cloud.reference
        if self._frame == "odometry":
            return own
        rig = self._track.at(message.header.t_ns)
        return None if rig is None else compose(compose(self._mounting(), inverse(rig)), own)

    def _mounting(self) -> Pose:
        if self._rig_in_vehicle is None:
            raise ConfigError(
                "where the rig is on the vehicle is not known: this recording holds results, not the rig",
                value="frame vehicle",
                action="give the rig with --rig NAME",
            )
        return self._rig_in_vehicle


def require_frame(what: str, frame: FrameName) -> None:
    """ConfigError when these points have no frame of that name."""
    if frame == "object" and what in ("clouds", "detections"):
        raise ConfigError(f"{what} have no object frame", value=frame, allowed="odometry, vehicle")
