# SPDX-License-Identifier: Apache-2.0
"""What the odometry reports instead of the truth: drift, yaw, pitch and roll, late stamps, mounting.

The frames see the truth; only the reported poses are wrong, and the error begins at the first of them, because an
odometry frame lies where the odometry began.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.config import require
from edge.frames import Float64, Pose
from edge.odometry.transforms import multiply

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """Errors of the reported poses; all zero reports the truth.

    A walk is a Wiener process over the path: its standard deviation after s metres is the setting times sqrt(s / 1 m).

    Args:
        walk_m: of the position, along each horizontal axis, after 1 m of path.
        height_walk_m: of the height, after 1 m.
        yaw_walk_deg: of the heading, after 1 m; the path that follows is turned with it, as dead reckoning does.
        tilt_deg: rms of pitch and of roll, exponentially correlated over ``tilt_s``.
        tilt_s: correlation time of pitch and roll.
        time_offset_s: a pose stamped t is where the rig was at t + time_offset_s.
        mounting_deg: roll, pitch, yaw by which the rig stands otherwise than its configuration says.
        mounting_m: x, y, z (rig axes) by which it does; z also falsifies the configured height above the ground.
    """

    walk_m: float = 0.006
    height_walk_m: float = 0.002
    yaw_walk_deg: float = 0.15
    tilt_deg: float = 0.2
    tilt_s: float = 0.5
    time_offset_s: float = 0.0
    mounting_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mounting_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("walk_m", "height_walk_m", "yaw_walk_deg", "tilt_deg"):
            require(getattr(self, name) >= 0, f"odometry.{name}", getattr(self, name), ">= 0")
        require(self.tilt_s > 0, "odometry.tilt_s", self.tilt_s, "> 0 s")
        require(abs(self.time_offset_s) <= 0.5, "odometry.time_offset_s", self.time_offset_s, "-0.5..0.5 s")

    @classmethod
    def none(cls) -> OdometrySettings:
        """The truth is reported."""
        return cls(walk_m=0.0, height_walk_m=0.0, yaw_walk_deg=0.0, tilt_deg=0.0)


def reported_poses(
    stamps_ns: Sequence[int] | NDArray[np.int64],
    position_m: Float64,
    quaternion_xyzw: Float64,
    settings: OdometrySettings,
    rng: np.random.Generator,
) -> list[Pose]:
    """Poses as the odometry gives them.

    Args:
        stamps_ns: [n] ascending instants that the poses are stamped with.
        position_m: float64 [n, 3], true position of the rig in odom at each stamp plus ``settings.time_offset_s``.
        quaternion_xyzw: float64 [n, 4], true attitude at these instants.
        settings: errors.
        rng: their generator; n and the settings decide how many numbers it gives.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    step_m = np.diff(position_m, axis=0, prepend=position_m[:1])
    scale = np.sqrt(np.linalg.norm(step_m, axis=1))
    yaw_rad = np.radians(settings.yaw_walk_deg) * np.cumsum(scale * rng.standard_normal(len(stamps)))
    sigma_m = np.array([settings.walk_m, settings.walk_m, settings.height_walk_m])
    walk_m = scale[:, None] * sigma_m * rng.standard_normal((len(stamps), 3))
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turned_m = np.column_stack((c * step_m[:, 0] - s * step_m[:, 1], s * step_m[:, 0] + c * step_m[:, 1], step_m[:, 2]))
    position = position_m[:1] + np.cumsum(turned_m + walk_m, axis=0)
    roll_rad, pitch_rad = (_correlated(stamps, settings, rng) for _ in range(2))
    error = _from_angles(roll_rad, pitch_rad, yaw_rad)
    mounting = _from_angles(*(np.full(1, math.radians(angle)) for angle in settings.mounting_deg))
    attitude = multiply(error, multiply(quaternion_xyzw.T, mounting))
    attitude /= np.linalg.norm(attitude, axis=0)
    position += _rotate(attitude, np.asarray(settings.mounting_m, dtype=np.float64))
    return [Pose(int(t), p, q) for t, p, q in zip(stamps, position, np.ascontiguousarray(attitude.T), strict=True)]


def _correlated(stamps_ns: NDArray[np.int64], settings: OdometrySettings, rng: np.random.Generator) -> Float64:
    """A stationary first-order Gauss-Markov angle [n], radians."""
    values = rng.standard_normal(len(stamps_ns))
    keep = np.exp(-np.diff(stamps_ns) / (NS_PER_S * settings.tilt_s))
    for k, share in enumerate(keep, 1):
        values[k] = share * values[k - 1] + math.sqrt(1.0 - share * share) * values[k]
    return np.asarray(math.radians(settings.tilt_deg) * values)


def _from_angles(roll_rad: Float64, pitch_rad: Float64, yaw_rad: Float64) -> Float64:
    """Quaternions [4, n] of Rz(yaw) Ry(pitch) Rx(roll)."""
    turns = []
    for axis, angle in ((2, yaw_rad), (1, pitch_rad), (0, roll_rad)):
        turn = np.zeros((4, len(angle)))
        turn[axis], turn[3] = np.sin(0.5 * angle), np.cos(0.5 * angle)
        turns.append(turn)
    return multiply(turns[0], multiply(turns[1], turns[2]))


def _rotate(quaternion: Float64, vector: Float64) -> Float64:
    """One vector [3] turned by each of the unit quaternions [4, n]; [n, 3]."""
    axis, w = quaternion[:3].T, quaternion[3][:, None]
    cross = np.cross(axis, vector)
    rotated: Float64 = vector + 2.0 * (w * cross + np.cross(axis, cross))
    return rotated
