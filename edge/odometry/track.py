# SPDX-License-Identifier: Apache-2.0
"""The recent poses as a function of time: where the rig was and how it moved at any instant, or why that is unknown."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from edge.config import require
from edge.errors import PoseError
from edge.frames import Float64, Pose
from edge.odometry.transforms import extrapolate, interpolate, rotation_matrix

NS_PER_S = 1_000_000_000
VELOCITY_SPAN_S = 0.05
"""Travel over this span, centred on the instant, gives the velocity: 1 mm of pose noise becomes 3 cm/s, not 14."""


class PoseTrack:
    """Poses in order of time, interpolated; holds the last ``keep_s`` seconds and at most ``capacity`` poses.

    Not locked: the thread that adds is the thread that asks.

    Args:
        max_gap_s: poses further apart are not interpolated between.
        keep_s: poses older than the newest by more than this are forgotten.
        capacity: most poses held; the oldest go first.
        ahead_s: up to this much after the newest pose it is continued at the velocity and the turn rate of the last
            ``VELOCITY_SPAN_S``; 0: not at all.
    Raises:
        ConfigError: a value that cannot work.
    """

    def __init__(self, max_gap_s: float, keep_s: float = 30.0, capacity: int = 16384, ahead_s: float = 0.0) -> None:
        require(0 < max_gap_s < np.inf, "max_gap_s", max_gap_s, "> 0, finite")
        require(max_gap_s <= keep_s < np.inf, "keep_s", keep_s, f">= max_gap_s ({max_gap_s}), finite")
        require(capacity >= 2, "capacity", capacity, ">= 2")
        require(0 <= ahead_s <= max_gap_s, "ahead_s", ahead_s, f"0..max_gap_s ({max_gap_s})")
        self._ahead_ns = round(ahead_s * NS_PER_S)
        self._max_gap_ns = round(max_gap_s * NS_PER_S)
        self._keep_ns = round(keep_s * NS_PER_S)
        self._capacity = capacity
        self._times: list[int] = []
        self._poses: list[Pose] = []

    def __len__(self) -> int:
        return len(self._times)

    def add(self, pose: Pose) -> None:
        """Append a pose.

        Raises:
            PoseError: not later than the newest pose; the track is unchanged.
        """
        t_ns = int(pose.t_ns)
        if self._times and t_ns <= self._times[-1]:
            kind = "of the same instant as" if t_ns == self._times[-1] else "older than"
            raise PoseError(
                f"pose {kind} the newest one",
                value=t_ns,
                allowed=f"> {self._times[-1]} ns",
                action="drop it; if the pose sensor restarted its clock, clear() the track and fuse anew",
            )
        self._times.append(t_ns)
        self._poses.append(pose)
        stale = max(bisect_left(self._times, t_ns - self._keep_ns), len(self._times) - self._capacity)
        del self._times[:stale], self._poses[:stale]

    def clear(self) -> None:
        """Forget all poses: after a restart of the sensor the odometry frame is another one."""
        self._times.clear()
        self._poses.clear()

    def at(self, t_ns: int) -> Pose | None:
        """Pose at an instant: linear in position, slerp in rotation, exact at a sample; None where it is unknown."""
        ends = self._ahead(int(t_ns))
        if ends is not None:
            return extrapolate(*ends, int(t_ns))
        bracket = self._bracket(int(t_ns))
        if isinstance(bracket, str):
            return None
        first, last = bracket
        return self._poses[first] if first == last else interpolate(self._poses[first], self._poses[last], int(t_ns))

    def velocity_rig_m_s(self, t_ns: int) -> Float64 | None:
        """Velocity of the rig's origin over the ground, in the rig frame of that instant.

        Mean over ``VELOCITY_SPAN_S`` centred on the instant; at the ends of the track and beside gaps over the part
        of the span that has poses, and over one pose interval when poses come more rarely.

        Returns:
            float64 [3], m/s; None where the pose is unknown or stands alone between gaps.
        """
        t_ns = int(t_ns)
        pose, ends = self.at(t_ns), self._ahead(t_ns) or self._around(t_ns)
        if pose is None or ends is None:
            return None
        a, b = ends
        velocity_odom_m_s = (b.position_m - a.position_m) * (NS_PER_S / (b.t_ns - a.t_ns))
        return rotation_matrix(pose.quaternion_xyzw).T @ velocity_odom_m_s

    def _around(self, t_ns: int) -> tuple[Pose, Pose] | None:
        """Poses at the ends of the span around an instant, or of the part of it that has poses; None: none."""
        bracket = self._bracket(t_ns)
        if isinstance(bracket, str):
            return None
        half_ns = round(VELOCITY_SPAN_S * NS_PER_S / 2)
        start = self._reach(bracket[0], -1, t_ns - half_ns)
        end = self._reach(bracket[1], +1, t_ns + half_ns)
        if start == end:
            return None
        a = self.at(max(t_ns - half_ns, self._times[start]))
        b = self.at(min(t_ns + half_ns, self._times[end]))
        return None if a is None or b is None else (a, b)

    def _ahead(self, t_ns: int) -> tuple[Pose, Pose] | None:
        """The newest pose and the one ``VELOCITY_SPAN_S`` before it, to be continued to an instant after both.

        None when the instant is not after the newest pose or too far after it, and when that pose stands alone.
        """
        newest = len(self._times) - 1
        if newest < 1 or not 0 < t_ns - self._times[newest] <= self._ahead_ns:
            return None
        before = self._reach(newest, -1, self._times[newest] - round(VELOCITY_SPAN_S * NS_PER_S))
        return (self._poses[before], self._poses[newest]) if before < newest else None

    def why_none(self, t_ns: int) -> str:
        """Reason why ``at(t_ns)`` is None, for a message or a log; empty when it is a pose."""
        bracket = self._bracket(int(t_ns))
        return bracket if isinstance(bracket, str) else ""

    def _bracket(self, t_ns: int) -> tuple[int, int] | str:
        """Indices of the samples around an instant, equal at a sample; or the reason why there are none."""
        times = self._times
        if not times:
            return "no pose yet"
        if t_ns < times[0]:
            return f"{(times[0] - t_ns) / NS_PER_S:.3f} s before first pose"
        if t_ns > times[-1]:
            return f"{(t_ns - times[-1]) / NS_PER_S:.3f} s after last pose"
        after = bisect_left(times, t_ns)
        if times[after] == t_ns:
            return after, after
        gap_ns = times[after] - times[after - 1]
        if gap_ns > self._max_gap_ns:
            return f"gap of {gap_ns / NS_PER_S:.3f} s between poses, more than {self._max_gap_ns / NS_PER_S:.3f} s"
        return after - 1, after

    def _reach(self, index: int, step: int, until_ns: int) -> int:
        """Walk from a sample towards ``until_ns`` to the first sample there or beyond, or to the last before a gap."""
        times = self._times
        while (until_ns - times[index]) * step > 0:
            beyond = index + step
            if not 0 <= beyond < len(times) or abs(times[beyond] - times[index]) > self._max_gap_ns:
                break
            index = beyond
        return index
