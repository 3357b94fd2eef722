# SPDX-License-Identifier: Apache-2.0
"""The scene as a model: messages of the stream in, drawables out; bounded, and without any idea of a web page.

Everything is in a local odometry frame: the odometry frame shifted by whole metres to near the first pose, so that
float32 and the browser keep millimetres however far the vehicle drove. ``wall_s`` is the clock of whoever feeds the
scene: the monotonic clock for a live stream, the position of the player for a recording.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field

import numpy as np

from edge.frames import Float32, Float64, Pose, RadarId
from edge.odometry.transforms import rotation_matrix, transform_points
from edge.stream.messages import (
    CloudMessage,
    DetectionsMessage,
    HeartbeatMessage,
    HeatmapMessage,
    Message,
    PoseMessage,
    ShapeMessage,
    StatusMessage,
)
from edge.view.boxes import Box, fit_box
from edge.view.health import Health

MOST_OBJECTS = 64
MOST_WINDOWS = 8
MOST_WINDOW_POINTS = 1 << 15
MOST_PATH_POINTS = 4096
PATH_STEP_M = 0.05
PATH_JUMP_M = 5.0
"""Poses farther apart are another piece of path."""
REWIND_NS = 5_000_000_000
"""Measurements that go back by more than this mean that a recording began again; less: the message is late."""
FADE_SHARE = 2.0 / 3.0
"""Share of its time during which an object keeps its full colour."""
FADE_STEPS = 8
RIG_HEIGHT_M = 0.8
"""Assumed of the rig above the ground until an object, which stands on the ground, says better."""
HEADING_BASE_M = 0.5


@dataclass(frozen=True, slots=True)
class Thing:
    """An object to draw.

    Args:
        identity: of the object.
        class_name, confidence: of its newest shape.
        points_m: float32 [n, 3], the completed shape, relative to ``box.center_m``.
        box: in the local odometry frame.
        age_s: from the first sight of it to its newest shape.
        final: it has left the window.
        t_end_ns: end of the window of its newest shape.
        wall_s: when that shape came.
        version: another for every new shape.
    """

    identity: int
    class_name: str
    confidence: float
    points_m: Float32
    box: Box
    age_s: float
    final: bool
    t_end_ns: int
    wall_s: float
    version: int


@dataclass(frozen=True, slots=True)
class Window:
    """The fused cloud of a window.

    Args:
        number: counts the windows of this scene.
        points_m: float32 [n, 3] relative to ``center_m``.
        center_m: float64 [3], local odometry frame.
        power_db: float32 [n].
        wall_s: when it came.
    """

    number: int
    points_m: Float32
    center_m: Float64
    power_db: Float32
    wall_s: float


@dataclass(frozen=True, slots=True)
class Drawables:
    """What to draw at one instant, local odometry frame.

    Args:
        generation: another after every reset: nothing drawn before is valid.
        vehicle: pose of the rig; None: not known yet.
        heading_rad: of the travel, from x towards y; None: it has not moved.
        path_m: pieces, float32 [n, 3] each.
        windows: fused clouds, oldest first.
        points_m: float32 [n, 3], points of the newest frame.
        things: objects and their strength, 1 fresh .. 0 about to go.
        ground_m: height of the ground.
    """

    generation: int
    vehicle: Pose | None
    heading_rad: float | None
    path_m: list[Float32]
    windows: list[Window]
    points_m: Float32
    things: list[tuple[Thing, float]]
    ground_m: float


@dataclass(slots=True)
class Counts:
    """What the viewer itself noticed.

    Args:
        late: messages dropped because newer ones of their kind had come.
        resets: new starts of the publisher, and recordings that began again.
        thinned: points of windows left out of the picture.
        crowded: objects removed early because there were too many.
    """

    late: int = 0
    resets: int = 0
    thinned: int = 0
    crowded: int = 0


@dataclass(slots=True)
class Scene:
    """Everything that is shown.

    Args:
        keep_s: how long an object or a window stays after its last shape; it fades in the last third.
    """

    keep_s: float = 30.0
    counts: Counts = field(default_factory=Counts)
    health: Health = field(default_factory=Health)
    heatmaps: dict[RadarId, HeatmapMessage] = field(default_factory=dict)
    detections: DetectionsMessage | None = None
    generation: int = 0
    _boot: bytes = b""
    _origin_m: Float64 | None = None
    _pose: Pose | None = None
    _path: deque[Float64] = field(default_factory=lambda: deque(maxlen=MOST_PATH_POINTS))
    _windows: deque[Window] = field(default_factory=lambda: deque(maxlen=MOST_WINDOWS))
    _window_count: int = 0
    _things: OrderedDict[int, Thing] = field(default_factory=OrderedDict)
    _newest_ns: dict[str, int] = field(default_factory=dict)
    _ground_m: float | None = None

    def add(self, message: Message, wall_s: float) -> bool:
        """Take a message.

        Args:
            message: of the stream.
            wall_s: now, on the feeder's clock.
        Returns:
            False when it came too late and was dropped.
        """
        self._meet(message)
        self.health.hear(wall_s)
        if isinstance(message, StatusMessage | HeartbeatMessage):
            self.health.add(message, wall_s)
            return True
        if not (self._shape(message, wall_s) if isinstance(message, ShapeMessage) else self._in_order(message)):
            self.counts.late += 1
            return False
        match message:
            case PoseMessage():
                self._move(message.pose)
            case CloudMessage():
                self._fuse(message, wall_s)
            case HeatmapMessage():
                self.heatmaps[message.radar] = message
            case DetectionsMessage():
                self.detections = message
        return True

    def reset(self) -> None:
        """Forget everything but the counts."""
        self.generation += 1
        self.health, self.heatmaps, self.detections = Health(), {}, None
        self._origin_m = self._pose = self._ground_m = None
        self._path.clear()
        self._windows.clear()
        self._things.clear()
        self._newest_ns.clear()

    def drawables(self, wall_s: float) -> Drawables:
        """What to draw at ``wall_s``; objects and windows whose time is over are removed."""
        for identity, thing in list(self._things.items()):
            if wall_s - thing.wall_s > self.keep_s:
                del self._things[identity]
        while self._windows and wall_s - self._windows[0].wall_s > self.keep_s:
            self._windows.popleft()
        things = [(thing, self._strength(wall_s - thing.wall_s)) for thing in self._things.values()]
        return Drawables(
            self.generation,
            self._pose,
            self._heading_rad(),
            self._pieces(),
            list(self._windows),
            self._frame_points(),
            things,
            self._ground(),
        )

    def _meet(self, message: Message) -> None:
        """A publisher that was started anew, or a recording that began again, begins with an empty scene."""
        head = message.header
        again = isinstance(message, PoseMessage | HeatmapMessage | DetectionsMessage) and (
            head.t_ns < self._newest_ns.get(_kind(message), head.t_ns) - REWIND_NS
        )
        if again or (self._boot and head.boot != self._boot):
            self.counts.resets += 1
            self.reset()
        self._boot = head.boot

    def _in_order(self, message: Message) -> bool:
        """Whether nothing newer of its kind came before; those of one instant are in order."""
        t_ns, kind = message.header.t_ns, _kind(message)
        if t_ns < self._newest_ns.get(kind, t_ns):
            return False
        self._newest_ns[kind] = t_ns
        return True

    def _local(self, pose: Pose) -> Pose:
        """A pose in the local odometry frame, whose origin the first one fixes."""
        if self._origin_m is None:
            self._origin_m = np.round(pose.position_m) * np.array([1.0, 1.0, 0.0])
        return Pose(pose.t_ns, pose.position_m - self._origin_m, pose.quaternion_xyzw)

    def _move(self, pose: Pose) -> None:
        self._pose = self._local(pose)
        if not self._path or np.linalg.norm(self._pose.position_m - self._path[-1]) >= PATH_STEP_M:
            self._path.append(self._pose.position_m)

    def _fuse(self, message: CloudMessage, wall_s: float) -> None:
        cloud = message.cloud
        if not len(cloud):
            return
        step = -(-len(cloud) // MOST_WINDOW_POINTS)
        self.counts.thinned += len(cloud) - len(cloud.xyz_m[::step])
        placed_m = transform_points(self._local(cloud.reference), cloud.xyz_m[::step])
        center_m = placed_m.mean(axis=0)
        self._window_count += 1
        points_m = (placed_m - center_m).astype(np.float32)
        self._windows.append(Window(self._window_count, points_m, center_m, cloud.power_db[::step], wall_s))

    def _shape(self, message: ShapeMessage, wall_s: float) -> bool:
        """Take a shape unless a newer one of the same object is here."""
        before = self._things.get(message.identity)
        if (before is not None and message.t_end_ns < before.t_end_ns) or not len(message.fine_m):
            return False
        pose = self._local(message.pose)
        placed_m = transform_points(pose, message.fine_m)
        box = fit_box(placed_m)
        self._ground_m = float(pose.position_m[2])
        self._things[message.identity] = Thing(
            message.identity,
            message.class_name,
            message.confidence,
            (placed_m - box.center_m).astype(np.float32),
            box,
            message.age_s,
            message.final,
            message.t_end_ns,
            wall_s,
            1 if before is None else before.version + 1,
        )
        self._things.move_to_end(message.identity)
        if len(self._things) > MOST_OBJECTS:
            self._things.popitem(last=False)
            self.counts.crowded += 1
        return True

    def _strength(self, silent_s: float) -> float:
        """1 until two thirds of the time have passed, then down to 0 in steps."""
        left = (1.0 - silent_s / self.keep_s) / (1.0 - FADE_SHARE)
        return float(np.clip(np.ceil(left * FADE_STEPS) / FADE_STEPS, 0.0, 1.0))

    def _heading_rad(self) -> float | None:
        """Direction of the last half metre of travel."""
        if len(self._path) < 2:
            return None
        newest = self._path[-1]
        for earlier in reversed(self._path):
            step = newest - earlier
            if np.hypot(step[0], step[1]) >= HEADING_BASE_M:
                return float(np.arctan2(step[1], step[0]))
        return None

    def _pieces(self) -> list[Float32]:
        if len(self._path) < 2:
            return []
        points = np.array(self._path)
        jumps = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) > PATH_JUMP_M) + 1
        return [piece.astype(np.float32) for piece in np.split(points, jumps) if len(piece) > 1]

    def _frame_points(self) -> Float32:
        """Points of the newest frame at the newest pose."""
        found = self.detections.points if self.detections is not None else None
        if found is None or self._pose is None:
            return np.empty((0, 3), np.float32)
        return transform_points(self._pose, found.xyz_m).astype(np.float32)

    def _ground(self) -> float:
        if self._ground_m is not None:
            return self._ground_m
        return float(self._pose.position_m[2]) - RIG_HEIGHT_M if self._pose is not None else 0.0


def _kind(message: Message) -> str:
    """What is in order among itself: messages of one type, heatmaps of one radar."""
    return message.radar if isinstance(message, HeatmapMessage) else type(message).__name__


def boresight_rad(pose: Pose) -> float:
    """Direction of the rig's x axis on the ground, from x towards y."""
    x, y, _ = rotation_matrix(pose.quaternion_xyzw)[:, 0]
    return float(np.arctan2(y, x))


def object_label(thing: Thing) -> str:
    """Identity, class, confidence and age in one line."""
    tail = ", left" if thing.final else ""
    return f"#{thing.identity}  {thing.class_name}  {100 * thing.confidence:.0f} %  age {thing.age_s:.1f} s{tail}"
