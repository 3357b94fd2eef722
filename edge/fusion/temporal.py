# SPDX-License-Identifier: Apache-2.0
"""TemporalFusion: gathers the points of a stretch of travel in one frame (paper, temporal fusion; about 3 m).

Points are kept where they are in the odometry frame, in a ring that is never reallocated. A window begins with a frame
and closes

* complete, with the first frame that lies ``travel_m`` of path further;
* incomplete, before a frame later than ``max_time_s`` after its first one (standing, slow), before a frame beyond a
  pose gap or an odometry jump, and at ``flush``.

Windows overlap: the next one begins with the first frame at least ``hop_m`` of path after the beginning of the last
one and young enough; with the current frame when there is none, and after a gap or a jump. A frame closes one window at
most.

Path: chords between anchors; the anchor moves once the rig is ``PATH_STEP_M`` away from it. So the jitter of the
odometry is no travel: a rig that stands covers none, however long it stands.
"""

from __future__ import annotations

import math
from collections import Counter
from enum import StrEnum

import numpy as np

from edge.config import FusionSettings
from edge.errors import CaptureError, PoseError
from edge.frames import Float64, FusedCloud, PointCloud, Pose
from edge.fusion import kernels_temporal as kernels
from edge.odometry.transforms import rotation_matrix

NS_PER_S = 1_000_000_000
PATH_STEP_M = 0.02
PATH_TOLERANCE_M = 1e-6
"""Rounding of a path made of hundreds of chords must not cost a frame."""
MAX_FRAMES = 8192
"""Frames of one window at most: 6.5 s at 1260 frames/s."""


class WindowEnd(StrEnum):
    """Why a window closed."""

    TRAVEL = "travel"
    """The configured travel was covered."""
    TIME = "time"
    """It lasted as long as a window may, or held as many frames as one may."""
    POSE_GAP = "pose_gap"
    """No pose for longer than ``max_pose_gap_s``."""
    POSE_JUMP = "pose_jump"
    """The pose moved or turned faster than the vehicle can."""
    FLUSH = "flush"
    """The stream ended."""


class TemporalFusion:
    """Windows of travel out of single frames.

    Args:
        settings: travel, time, capacity, gaps.
    """

    def __init__(self, settings: FusionSettings) -> None:
        self.settings = settings
        self.overwritten = 0
        """Points that left the ring before their window closed."""
        self.windows: Counter[WindowEnd] = Counter()
        """Closed windows by cause."""
        self._hop_m = settings.hop_m if settings.hop_m > 0 else 0.5 * settings.travel_m
        self._max_time_ns = round(settings.max_time_s * NS_PER_S)
        self._xyz = np.zeros((settings.capacity, 3))
        self._power = np.zeros(settings.capacity, dtype=np.float32)
        self._number = np.zeros(settings.capacity, dtype=np.int64)
        self._t_ns = np.zeros(MAX_FRAMES, dtype=np.int64)
        self._path_m = np.zeros(MAX_FRAMES)
        self._first_point = np.zeros(MAX_FRAMES, dtype=np.int64)
        self._pose = np.zeros((MAX_FRAMES, 7))
        self._points = 0  # ever stored
        self._frames = 0  # ever stored; frame k lies at k % MAX_FRAMES
        self._start = 0  # first frame of the window
        self._oldest = 0  # first point of the window that is still there
        self._cut = 0  # first frame after the last interruption
        self._anchor_m = np.zeros(3)
        self._anchor_path_m = 0.0
        self._last: Pose | None = None

    def add(self, cloud: PointCloud, pose: Pose) -> FusedCloud | None:
        """Take one frame; a frame without points counts as a frame.

        Args:
            cloud: points in the rig frame.
            pose: of the rig at ``cloud.t_ns``.
        Returns:
            The window that closed, if one did.
        Raises:
            PoseError: the pose is of another instant, or time went backwards; nothing was changed.
            CaptureError: a point that is not finite; nothing was changed.
        """
        self._check(cloud, pose)
        cut = self._interruption(pose)
        closed = self._close(cut) if cut else None
        if cut:
            self._begin(self._frames)
            self._cut = self._frames
        path_m = self._advance(pose, restart=cut is not None)
        if self._frames > self._start and self._is_too_old(pose.t_ns):
            closed = self._close(WindowEnd.TIME)
            self._hop(pose.t_ns)
        self._append(cloud, pose, path_m)
        if closed is None and self._travel_m() >= self.settings.travel_m - PATH_TOLERANCE_M:
            closed = self._close(WindowEnd.TRAVEL)
            self._hop(pose.t_ns)
        return closed

    def flush(self) -> FusedCloud | None:
        """The stream has ended: the window under way, incomplete; None when it has no frame. Then all starts anew."""
        closed = self._close(WindowEnd.FLUSH) if self._frames > self._start else None
        self._begin(self._frames)
        self._cut, self._last = self._frames, None
        return closed

    def latest(self) -> FusedCloud | None:
        """The newest ``travel_m`` of travel, whatever window they belong to; nothing is closed or changed.

        It slides with every frame, where the windows of ``add`` hop: what a viewer wants to see now. It reaches back to
        the last frame that lies ``travel_m`` behind, not beyond an interruption, ``max_time_s`` or what the rings hold.

        Returns:
            The cloud; None before the first frame, after ``flush`` and after an interruption.
        """
        if self._frames == self._cut:
            return None
        oldest = max(self._cut, self._frames - MAX_FRAMES)
        slots = np.arange(oldest, self._frames) % MAX_FRAMES
        newest = slots[-1]
        first = int(np.searchsorted(self._t_ns[slots], self._t_ns[newest] - self._max_time_ns))
        behind = self._path_m[slots] <= self._path_m[newest] - self.settings.travel_m + PATH_TOLERANCE_M
        far = int(np.flatnonzero(behind)[-1]) + 1 if behind.any() else 0
        start = oldest + max(first, far - 1)
        first_point = int(self._first_point[start % MAX_FRAMES])
        whole = far > first and self._points - first_point <= self.settings.capacity
        enough = self._frames - start >= self.settings.min_frames
        return self._cloud(start, max(first_point, self._points - self.settings.capacity), whole and enough)

    def _check(self, cloud: PointCloud, pose: Pose) -> None:
        if pose.t_ns != cloud.t_ns:
            raise PoseError(
                f"pose does not belong to frame {cloud.number}",
                value=f"{pose.t_ns} ns",
                allowed=f"the pose at {cloud.t_ns} ns",
                action="interpolate the poses to the frame's instant",
            )
        if self._last is not None and pose.t_ns <= self._last.t_ns:
            raise PoseError(
                f"frame {cloud.number} is not later than the frame before",
                value=f"{pose.t_ns} ns",
                allowed=f"> {self._last.t_ns} ns",
                action="drop it; after a restart of the source, flush() first",
            )
        if not np.isfinite(cloud.xyz_m).all():
            bad = int(np.count_nonzero(~np.isfinite(cloud.xyz_m).all(axis=1)))
            raise CaptureError(f"frame {cloud.number}: points that are not finite", value=bad, allowed="finite metres")

    def _interruption(self, pose: Pose) -> WindowEnd | None:
        """What separates a pose from the frame before."""
        last = self._last
        if last is None:
            return None
        step_s = (pose.t_ns - last.t_ns) / NS_PER_S
        if step_s > self.settings.max_pose_gap_s:
            return WindowEnd.POSE_GAP
        half_cosine = abs(float(pose.quaternion_xyzw @ last.quaternion_xyzw))
        norms = float(np.linalg.norm(pose.quaternion_xyzw) * np.linalg.norm(last.quaternion_xyzw))
        turn_deg = math.degrees(2.0 * math.acos(min(half_cosine / norms, 1.0)))
        travel_m = float(np.linalg.norm(pose.position_m - last.position_m))
        jumped = travel_m > self.settings.max_speed_m_s * step_s or turn_deg > self.settings.max_turn_deg_s * step_s
        return WindowEnd.POSE_JUMP if jumped else None

    def _advance(self, pose: Pose, restart: bool) -> float:
        """Path up to a pose; an interruption is no travel."""
        if restart or self._last is None:
            self._anchor_m[:] = pose.position_m
        self._last = pose
        path_m = self._anchor_path_m + float(np.linalg.norm(pose.position_m - self._anchor_m))
        if path_m - self._anchor_path_m >= PATH_STEP_M:
            self._anchor_m[:], self._anchor_path_m = pose.position_m, path_m
        return path_m

    def _is_too_old(self, t_ns: int) -> bool:
        full = self._frames - self._start >= MAX_FRAMES
        return full or t_ns - int(self._t_ns[self._start % MAX_FRAMES]) > self._max_time_ns

    def _append(self, cloud: PointCloud, pose: Pose, path_m: float) -> None:
        slot = self._frames % MAX_FRAMES
        self._t_ns[slot], self._path_m[slot], self._first_point[slot] = pose.t_ns, path_m, self._points
        self._pose[slot, :3], self._pose[slot, 3:] = pose.position_m, pose.quaternion_xyzw
        self._frames += 1
        self._points = kernels.store(
            *(cloud.xyz_m, cloud.power_db, cloud.number, rotation_matrix(pose.quaternion_xyzw), pose.position_m),
            *(self._points, self._xyz, self._power, self._number),
        )
        lost = self._points - self.settings.capacity - self._oldest
        if lost > 0:
            self.overwritten += lost
            self._oldest += lost

    def _begin(self, frame: int) -> None:
        """The next window's first frame, one that is stored or the next to come."""
        self._start = frame
        first = int(self._first_point[frame % MAX_FRAMES]) if frame < self._frames else self._points
        self._oldest = max(self._oldest, first)

    def _hop(self, t_ns: int) -> None:
        """Begin the next window ``hop_m`` after the beginning of the last."""
        from_m = float(self._path_m[self._start % MAX_FRAMES]) + self._hop_m - PATH_TOLERANCE_M
        frame = self._start + 1
        while frame < self._frames:
            slot = frame % MAX_FRAMES
            if self._path_m[slot] >= from_m and t_ns - int(self._t_ns[slot]) <= self._max_time_ns:
                break
            frame += 1
        self._begin(frame)

    def _travel_m(self, start: int | None = None) -> float:
        """Path from a frame, the window's first one by default, to the last frame."""
        first = self._start if start is None else start
        return max(float(self._path_m[(self._frames - 1) % MAX_FRAMES] - self._path_m[first % MAX_FRAMES]), 0.0)

    def _pose_of(self, frame: int) -> Pose:
        slot = frame % MAX_FRAMES
        return Pose(int(self._t_ns[slot]), self._pose[slot, :3].copy(), self._pose[slot, 3:].copy())

    def _mean_position_m(self, start: int) -> Float64:
        """Mean position of the rig from a frame to the last one, in the odometry frame."""
        mean: Float64 = self._pose[np.arange(start, self._frames) % MAX_FRAMES, :3].mean(axis=0)
        return mean

    def _close(self, end: WindowEnd) -> FusedCloud | None:
        """Everything since the window's first frame, seen from its pose; None when it has no frame."""
        frames = self._frames - self._start
        if frames == 0:
            return None
        self.windows[end] += 1
        whole = self._oldest == int(self._first_point[self._start % MAX_FRAMES])
        complete = end is WindowEnd.TRAVEL and frames >= self.settings.min_frames and whole
        return self._cloud(self._start, self._oldest, complete)

    def _cloud(self, start: int, first_point: int, complete: bool) -> FusedCloud:
        """The points from ``first_point`` on, seen from the pose of frame ``start``."""
        reference, last = self._pose_of(start), self._pose_of(self._frames - 1)
        rotation = rotation_matrix(reference.quaternion_xyzw)
        points = self._points - first_point
        xyz, power = np.empty((points, 3), dtype=np.float32), np.empty(points, dtype=np.float32)
        number = np.empty(points, dtype=np.int64)
        kernels.read(
            *(self._xyz, self._power, self._number, first_point, rotation, reference.position_m, xyz, power, number),
        )
        return FusedCloud(
            *(xyz, power, number, reference, reference.t_ns, last.t_ns, self._travel_m(start), self._frames - start),
            complete=complete,
            sensor_m=(self._mean_position_m(start) - reference.position_m) @ rotation,
            last=last,
        )
