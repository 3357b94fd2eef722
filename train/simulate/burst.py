# SPDX-License-Identifier: Apache-2.0
"""A burst's buffers, and how coarsely the motion in it may be followed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.dsp.buffers import zeros
from edge.frames import Float32, Float64
from train.simulate.kernels_legs import LANES, LEG_PLANES

RESIDUE_RAD = {4: 2e-4, 6: 4e-6}
"""By width of the synthesis: phase by which a chip's receivers may be wrong because they are moved with its middle."""
APART = 80
"""Floats between the planes of the legs, so that they do not compete for the same lines of the cache."""


@dataclass(frozen=True, slots=True)
class Motion:
    """How the paths of one burst change.

    Args:
        span: loops for which one parabola of every path and one tangent of every receiver serve.
        run: chirps for which a receiver's phase from the middle of its chip stands; 0: nothing moves.
    """

    span: int = 1
    run: int = 0


@dataclass(slots=True)
class Work:
    """Buffers of one synthesis, for ``room`` scatterers at most; axes as the kernels name them."""

    room: int
    points: Float64
    velocity: Float64
    bend: Float64
    amplitude: Float32
    out: Float32
    back: Float32
    reach_out: Float64
    reach_back: Float64
    reach_chip: Float64
    re: Float32
    im: Float32
    cell_out: Float32
    base_out: NDArray[np.int32]
    swing: Float32
    swing_step: Float32
    cell_back: Float32
    base_back: NDArray[np.int32]
    legs: Float32
    turn: Float32
    base: NDArray[np.int32]
    plan: Float32
    start: NDArray[np.int32]

    @classmethod
    def make(cls, room: int, slots: int, chips: int) -> Work:
        """Zeroed buffers."""
        f4, f8 = np.float32, np.float64
        span = room * LANES + APART
        return cls(
            room=room,
            points=np.zeros((2, 3, room), f8),
            velocity=np.zeros((2, 3, room), f8),
            bend=np.zeros(room, f8),
            amplitude=np.zeros((2, room), f4),
            out=np.zeros((4, slots, room), f4),
            back=np.zeros((4, chips, room), f4),
            reach_out=np.zeros((2, room), f8),
            reach_back=np.zeros((2, room), f8),
            reach_chip=np.zeros((2, room), f8),
            re=np.zeros((slots, room), f4),
            im=np.zeros((slots, room), f4),
            cell_out=np.zeros((slots, room), f4),
            base_out=np.zeros(room, np.int32),
            swing=zeros((chips, 2 * room)),
            swing_step=zeros((chips, 2 * room)),
            cell_back=np.zeros((2, chips, room), f4),
            base_back=np.zeros(room, np.int32),
            legs=zeros((chips, LEG_PLANES * span), f4),
            turn=zeros((chips, 2 * span), f4),
            base=np.zeros(room, np.int32),
            plan=np.zeros((4, room), f4),
            start=np.zeros(room, np.int32),
        )


def follow_motion(
    work: Work,
    count: int,
    centre_m: Float64,
    loops: int,
    slots: int,
    slot_s: float,
    apart_m: float,
    residue_m: float,
) -> Motion:
    """How the placed scatterers' motion is followed; writes the curvature of their paths to ``work.bend``.

    A receiver ``apart_m`` from the middle of its chip sees a path across whose rate differs by v apart / R and whose
    curvature v^2 / 2 R differs by three times that share.

    Args:
        work: points and velocities as the receivers see them.
        count: scatterers.
        centre_m: float64 [3], phase centre of the board.
        loops, slots, slot_s: of the burst.
        apart_m: of a receiver from the middle of its chip, at most.
        residue_m: path that may be wrong.
    """
    away_m = work.points[1, :, :count] - centre_m[:, None]
    range_m = np.maximum(np.linalg.norm(away_m, axis=0), 1e-3)
    velocity = work.velocity[1, :, :count]
    radial = (velocity * away_m).sum(axis=0) / range_m
    across2 = np.maximum(np.square(velocity).sum(axis=0) - np.square(radial), 0.0)
    work.bend[:count] = 0.5 * across2 / range_m
    fastest2 = float((across2 / np.square(range_m)).max())
    whole = 1.5 * fastest2 * (0.5 * loops * slots * slot_s) ** 2 * apart_m <= residue_m
    drift_m = np.sqrt(fastest2) * apart_m * 0.5 * slot_s
    runs = [run for run in range(1, slots + 1) if slots % run == 0 and (run - 1) * drift_m <= residue_m]
    return Motion(loops if whole else 1, max(runs))
