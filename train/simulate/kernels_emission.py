# SPDX-License-Identifier: Apache-2.0
"""Kernel from scattering amplitudes to the scatterers of one radar: place, ranges, pattern, ground, link budget."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge.frames import Complex64, Float32, Float64
from train.objects.sampling import Int32
from train.simulate.ground import mirror
from train.simulate.kernels_optics import DIRECT, GROUND, MIXED, UInt8

NEAREST_M = 0.1
"""Scatterers nearer to the board's phase centre are left out."""


@njit(cache=True, nogil=True, error_model="numpy")
def _loss_db(y: float, z: float, pattern: Float64) -> float:  # pragma: no cover - compiled
    """One-way pattern loss towards a unit vector's y and z in rig axes; see ``edge.dsp.antenna``.

    ``pattern``: array axis (1 = y, 2 = z), along edge deg, along loss, across edge deg, across loss, most dB.
    """
    along, across = (y, z) if pattern[0] == 1.0 else (z, y)
    along_deg = math.degrees(math.asin(min(max(along, -1.0), 1.0)))
    across_deg = math.degrees(math.asin(min(max(across, -1.0), 1.0)))
    along_db: float = min(pattern[2] * (along_deg / pattern[1]) ** 2, pattern[5])
    across_db: float = min(pattern[4] * (across_deg / pattern[3]) ** 2, pattern[5])
    return along_db + across_db


@njit(cache=True, nogil=True, error_model="numpy")
def _legs(
    x: float, y: float, z: float, path: int, ground: Float64, pattern: Float64
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Amplitude of both legs of a path, pattern and ground included, and half its length (infinite: no such path).

    ``x, y, z`` is the scatterer from the board's phase centre, rig axes; ``ground``, ``pattern`` are those of ``emit``.
    """
    direct = math.sqrt(x * x + y * y + z * z)
    if x <= 0.0 or direct < NEAREST_M:
        return 0.0, np.inf
    leg = 0.0
    if path != GROUND:
        leg = 10.0 ** (-_loss_db(y / direct, z / direct, pattern) / 20.0) / direct
        if path == DIRECT:
            return leg * leg, direct
    height = ground[3]
    above = ground[0] * x + ground[1] * y + ground[2] * z + height
    mx, my, mz = x - 2.0 * above * ground[0], y - 2.0 * above * ground[1], z - 2.0 * above * ground[2]
    if mx <= 0.0 or above <= 0.0:
        return 0.0, np.inf
    image = math.sqrt(mx * mx + my * my + mz * mz)
    sine = (above + height) / image
    gamma = mirror(sine, abs(ground[4]), ground[4] < 0.0, ground[5])
    mirrored = gamma * 10.0 ** (-_loss_db(my / image, mz / image, pattern) / 20.0) / image
    if path == MIXED:
        return leg * mirrored, 0.5 * (direct + image)
    return mirrored * mirrored, image


@njit(cache=True, nogil=True, error_model="numpy")
def emit(
    position: Float32,
    weight: Complex64,
    board: Float32,
    path: UInt8,
    owner: Int32,
    placing: Float64,
    centre: Float64,
    ground: Float64,
    pattern: Float64,
    limits: Float64,
    out_position: Float64,
    out_velocity: Float64,
    out_amplitude: Complex64,
    out_image: NDArray[np.bool_],
) -> int:  # pragma: no cover - compiled
    """Scatterers of one radar; returns how many, two for every MIXED entry.

    Args:
        position: float32 [k, 3], object frame.
        weight: complex64 [k], sqrt(sigma) exp(j phase), m.
        board: float32 [k], amplitude factor on this board.
        path: uint8 [k], DIRECT, MIXED or GROUND.
        owner: int32 [k], row of ``placing``.
        placing: float64 [objects, 5, 3], rows 0..2 rotation object to rig, 3 origin in the rig frame, 4 velocity
            relative to the rig in rig axes.
        centre: float64 [3], the board's phase centre in the rig frame.
        ground: float64 [6], unit normal in the rig frame, height of the phase centre, permittivity (field in the
            ground's plane: negative), (2 pi s / lambda)^2.
        pattern: see ``_loss_db``.
        limits: float64 [3], longest half path, LSB of sigma 1 m^2 at 1 m, least |amplitude| in LSB.
        out_position, out_velocity: float64 [n, 3], out.
        out_amplitude: complex64 [n], out.
        out_image: bool [2, n], out: transmitter, receiver.
    """
    count = 0
    for i in range(len(path)):
        place = placing[owner[i]]
        px, py, pz = np.float64(position[i, 0]), np.float64(position[i, 1]), np.float64(position[i, 2])
        x = place[0, 0] * px + place[0, 1] * py + place[0, 2] * pz + place[3, 0]
        y = place[1, 0] * px + place[1, 1] * py + place[1, 2] * pz + place[3, 1]
        z = place[2, 0] * px + place[2, 1] * py + place[2, 2] * pz + place[3, 2]
        legs, half_path = _legs(x - centre[0], y - centre[1], z - centre[2], path[i], ground, pattern)
        size = limits[1] * board[i] * legs
        if half_path >= limits[0] or abs(weight[i]) * abs(size) < limits[2]:
            continue
        for turn in range(2 if path[i] == MIXED else 1):
            out_position[count, 0], out_position[count, 1], out_position[count, 2] = x, y, z
            for k in range(3):
                out_velocity[count, k] = place[4, k]
            out_amplitude[count] = weight[i] * np.float32(size)
            out_image[0, count] = path[i] == GROUND or (path[i] == MIXED and turn == 0)
            out_image[1, count] = path[i] == GROUND or (path[i] == MIXED and turn == 1)
            count += 1
    return count
