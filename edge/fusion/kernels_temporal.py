# SPDX-License-Identifier: Apache-2.0
"""Kernels of the point ring: store a frame's points in the odometry frame, read a window's points in another frame.

Points are counted from the first ever stored; point k lies at ``k % capacity``. Positions are float64: ten kilometres
from the odometry's origin float32 has steps of a millimetre.
"""

from __future__ import annotations

from typing import Any

from numba import float32, float64, int64, njit, types

from edge.kernels_arrays import Float32, Float64, Int64

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "boundscheck": False, "cache": True}


@njit(
    int64(
        *(float32[:, ::1], float32[::1], int64, float64[:, ::1], float64[::1], int64),
        *(float64[:, ::1], float32[::1], int64[::1]),
    ),
    **OPTIONS,
)
def store(
    xyz: Float32,
    power: Float32,
    number: int,
    rotation: Float64,
    origin: Float64,
    head: int,
    ring_xyz: Float64,
    ring_power: Float32,
    ring_number: Int64,
) -> int:
    """Append a frame's points; of a frame larger than the ring only the last ones stay.

    Args:
        xyz: float32 [n, 3], rig frame.
        power: float32 [n].
        number: frame number.
        rotation, origin: float64 [3, 3], [3]: p_odom = rotation p_rig + origin.
        head: points stored so far.
        ring_xyz, ring_power, ring_number: the ring.
    Returns:
        Points stored afterwards.
    """
    capacity = len(ring_power)
    for n in range(max(len(xyz) - capacity, 0), len(xyz)):
        place = (head + n) % capacity
        x, y, z = float64(xyz[n, 0]), float64(xyz[n, 1]), float64(xyz[n, 2])
        for axis in range(3):
            turned = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z
            ring_xyz[place, axis] = turned + origin[axis]
        ring_power[place], ring_number[place] = power[n], number
    return head + len(xyz)


@njit(
    types.void(
        *(float64[:, ::1], float32[::1], int64[::1], int64, float64[:, ::1], float64[::1]),
        *(float32[:, ::1], float32[::1], int64[::1]),
    ),
    **OPTIONS,
)
def read(
    ring_xyz: Float64,
    ring_power: Float32,
    ring_number: Int64,
    first: int,
    rotation: Float64,
    origin: Float64,
    xyz: Float32,
    power: Float32,
    number: Int64,
) -> None:
    """Copy points out of the ring, seen from a pose.

    Args:
        ring_xyz, ring_power, ring_number: the ring.
        first: count of the first point.
        rotation, origin: float64 [3, 3], [3] of the pose: p = rotation^T (p_odom - origin).
        xyz: float32 [n, 3], receives the points; n is how many are read.
        power, number: [n], receive theirs.
    """
    capacity = len(ring_power)
    for n in range(len(xyz)):
        place = (first + n) % capacity
        x, y, z = ring_xyz[place, 0] - origin[0], ring_xyz[place, 1] - origin[1], ring_xyz[place, 2] - origin[2]
        for axis in range(3):
            xyz[n, axis] = rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis] * z
        power[n], number[n] = ring_power[place], ring_number[place]
