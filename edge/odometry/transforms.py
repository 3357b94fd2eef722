# SPDX-License-Identifier: Apache-2.0
"""Rigid-body algebra of poses: rotation matrices, unit quaternions, slerp, composition, inversion.

Quaternions are scalar-last (x, y, z, w), Hamilton convention, and rotate vectors actively: for a ``Pose`` they carry
rig vectors into the odometry frame (REP-103, REP-105). q and -q are the same rotation. All arithmetic is float64;
absolute times stay integers, only differences of times become floating point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.errors import PoseError
from edge.frames import Float64, Pose

_ORTHOGONALITY_TOLERANCE = 1e-3
_LERP_COSINE = 1.0 - 1e-9  # closer rotations: sin(angle) loses digits and the chord equals the arc to 1e-10


def _normalised(q: Float64) -> Float64:
    """Unit quaternion of the same direction."""
    norm = float(np.linalg.norm(q))
    if not 0.0 < norm < np.inf:
        raise PoseError("quaternion has no direction", value=q.tolist(), allowed="finite, not all zero")
    return q / norm


def rotation_matrix(quaternion_xyzw: Float64) -> Float64:
    """Rotation matrix of a quaternion; its norm is divided out.

    Args:
        quaternion_xyzw: float64 [4].
    Returns:
        float64 [3, 3], proper orthogonal: ``R @ v`` turns a column vector.
    Raises:
        PoseError: all zero or not finite.
    Source:
        Kuipers, Quaternions and Rotation Sequences, equation 5.11 (active form).
    """
    x, y, z, w = _normalised(quaternion_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ],
        dtype=np.float64,
    )


def quaternion(matrix: Float64) -> Float64:
    """Unit quaternion of a rotation matrix, with w >= 0.

    Args:
        matrix: float64 [3, 3], proper orthogonal within 1e-3.
    Returns:
        float64 [4], x, y, z, w.
    Raises:
        PoseError: the matrix is no rotation (mirrored, scaled, not finite or of another shape).
    Source:
        Shepperd 1978: divide by the largest of the four components, so no cancellation occurs at any angle.
    """
    proper = matrix.shape == (3, 3) and bool(np.isfinite(matrix).all())
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max()) if proper else np.inf
    if error > _ORTHOGONALITY_TOLERANCE or np.linalg.det(matrix) < 0:
        raise PoseError(
            "matrix is no rotation",
            value=matrix.tolist(),
            allowed=f"[3, 3], R R^T = 1 within {_ORTHOGONALITY_TOLERANCE}, determinant +1",
            action="check for a mirrored axis, a scale factor or a transposed 4x4 pose",
        )
    m = matrix
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    # Row k holds 4 q_k q: all four are the same quaternion, the one of the largest q_k is the most accurate.
    rows = np.array(
        [
            [1 + 2 * m[0, 0] - trace, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
            [m[0, 1] + m[1, 0], 1 + 2 * m[1, 1] - trace, m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 + 2 * m[2, 2] - trace, m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1 + trace],
        ]
    )
    q = _normalised(rows[int(np.argmax(np.diag(rows)))])
    return -q if q[3] < 0 else q


def multiply(a_xyzw: Float64, b_xyzw: Float64) -> Float64:
    """Hamilton product: the rotation b followed by the rotation a, ``R(a b) = R(a) R(b)``; float64 [4]."""
    ax, ay, az, aw = a_xyzw
    bx, by, bz, bw = b_xyzw
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        dtype=np.float64,
    )


def slerp(q0_xyzw: Float64, q1_xyzw: Float64, share: float) -> Float64:
    """Rotation at ``share`` of the way from q0 to q1 at constant angular rate, the short way round.

    Args:
        q0_xyzw, q1_xyzw: float64 [4], of either sign.
        share: 0 gives q0, 1 gives q1 (as rotations); more than 1 turns on at the same rate.
    Returns:
        float64 [4], unit, on q0's side of the sphere.
    Source:
        Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
    """
    q0, q1 = _normalised(q0_xyzw), _normalised(q1_xyzw)
    cosine = float(q0 @ q1)
    if cosine < 0.0:  # -q1 is the same rotation, nearer
        q1, cosine = -q1, -cosine
    if cosine > _LERP_COSINE:
        return _normalised(q0 + share * (q1 - q0))
    half_angle = np.arccos(cosine)
    return _normalised(np.sin((1 - share) * half_angle) * q0 + np.sin(share * half_angle) * q1)


def interpolate(a: Pose, b: Pose, t_ns: int) -> Pose:
    """Pose at ``t_ns`` between two poses: position linear, rotation slerp; exact at both ends.

    Args:
        a, b: poses with a.t_ns < b.t_ns.
        t_ns: instant, a.t_ns <= t_ns <= b.t_ns.
    Raises:
        PoseError: the instant lies outside the two poses, or they are of one instant or in the wrong order.
    """
    if not (a.t_ns < b.t_ns and a.t_ns <= t_ns <= b.t_ns):
        raise PoseError(
            "cannot interpolate between these poses",
            value=t_ns,
            allowed=f"an instant in {a.t_ns} .. {b.t_ns} ns, first pose earlier than the second",
        )
    if t_ns == a.t_ns:
        return a
    if t_ns == b.t_ns:
        return b
    share = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)  # integer differences: exact for absolute times beyond 2^53
    position_m = a.position_m + share * (b.position_m - a.position_m)
    return Pose(t_ns, position_m, slerp(a.quaternion_xyzw, b.quaternion_xyzw, share))


def extrapolate(a: Pose, b: Pose, t_ns: int) -> Pose:
    """Pose at ``t_ns`` after two poses, at the velocity and the turn rate between them.

    Args:
        a, b: poses with a.t_ns < b.t_ns.
        t_ns: instant, b.t_ns <= t_ns.
    Raises:
        PoseError: the instant lies before b, or the poses are of one instant or in the wrong order.
    """
    if not a.t_ns < b.t_ns <= t_ns:
        raise PoseError(
            "cannot extrapolate from these poses", value=t_ns, allowed=f"an instant >= {b.t_ns} ns, first pose earlier"
        )
    share = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)
    position_m = a.position_m + share * (b.position_m - a.position_m)
    return Pose(t_ns, position_m, slerp(a.quaternion_xyzw, b.quaternion_xyzw, share))


def compose(a: Pose, b: Pose) -> Pose:
    """``a`` after ``b``: with a = frame B in A and b = frame C in B, the result is frame C in A, at b's instant."""
    position_m = a.position_m + rotation_matrix(a.quaternion_xyzw) @ b.position_m
    return Pose(b.t_ns, position_m, _normalised(multiply(a.quaternion_xyzw, b.quaternion_xyzw)))


def inverse(pose: Pose) -> Pose:
    """The opposite transform, at the same instant: ``compose(inverse(p), p)`` is the identity."""
    conjugate = pose.quaternion_xyzw * np.array([-1.0, -1.0, -1.0, 1.0])
    return Pose(pose.t_ns, -(rotation_matrix(conjugate) @ pose.position_m), _normalised(conjugate))


def transform_points(pose: Pose, xyz_m: NDArray[np.floating]) -> Float64:
    """Points from the pose's own frame into its parent frame.

    Args:
        pose: the point frame in the parent frame.
        xyz_m: [n, 3], float32 or float64.
    Returns:
        float64 [n, 3]; float64 because odometry coordinates may be kilometres.
    """
    return np.asarray(xyz_m, np.float64) @ rotation_matrix(pose.quaternion_xyzw).T + pose.position_m
