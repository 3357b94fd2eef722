# SPDX-License-Identifier: Apache-2.0
"""Raw samples of point scatterers straight from the definition, in float64, one scatterer at a time: slow and plain.

Written apart from the synthesis, from the board's tables and the radar's geometry, and shares no code with it:

    x[l, m, n, i] = sum_k a_k exp(j 2 pi (f_c tau + S tau t_i)),  tau = (|p_k(t) - A_m| + |p_k(t) - B_n| - 2 r_0) / c

with t_i = (i - Ns / 2) / fs, p_k(t) = p_k + v_k t, t = (l M + m) Tc the start of the chirp of slot m in loop l, A_m and
B_n the antennas or, for a leg by way of the ground, their mirror images, and r_0 the mounting's range offset; its power
offset lowers a_k.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from edge.frames import Float64
    from edge.rig import Radar
    from train.simulate.scatterers import GroundPlane, Scatterers

C_M_S = 299_792_458.0


def antennas_m(radar: Radar) -> tuple[Float64, Float64]:
    """Transmitters [slots, 3] and receivers [receivers, 3] in the rig frame, from the board's table.

    The phase centre, at the mounting's position, is the middle of the row's virtual elements at (TX + RX) / 2. The
    board's azimuth is rig +y and its elevation rig +z; the vertical board is turned by +90 degrees about x, by which y
    becomes z and z becomes -y; ``array_sign`` -1 turns by 180 degrees more.
    """
    board = radar.array
    unit_m = C_M_S / board.design_frequency_hz / 2.0
    row = np.array(
        [
            a + b
            for a, e in zip(board.tx_azimuth, board.tx_elevation, strict=True)
            for b, f in zip(board.rx_azimuth, board.rx_elevation, strict=True)
            if e + f == 0.0
        ]
    )
    middle = 0.25 * (row.min() + row.max())
    angle = (np.pi / 2.0 if radar.radar == "vertical" else 0.0) + (np.pi if radar.mounting.array_sign < 0 else 0.0)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    placed = []
    for azimuth, elevation in ((board.tx_azimuth, board.tx_elevation), (board.rx_azimuth, board.rx_elevation)):
        flat = np.stack((np.zeros(len(azimuth)), (azimuth - middle) * unit_m, elevation * unit_m), axis=1)
        placed.append(flat @ turn.T + np.array(radar.mounting.position_m))
    return placed[0], placed[1]


def _mirrored(points_m: Float64, ground: GroundPlane | None) -> Float64:
    if ground is None:
        raise ValueError("ground paths without a ground")
    normal = np.asarray(ground.normal, dtype=np.float64)
    reflection = np.eye(3) - 2.0 * np.outer(normal, normal)
    return points_m @ reflection.T - 2.0 * ground.offset_m * normal


def direct_sum(
    radar: Radar, scatterers: Scatterers, ground: GroundPlane | None = None, loops: int | None = None
) -> NDArray[np.complex128]:
    """Beat signal without noise.

    Args:
        radar: board, schedule, mounting.
        scatterers: as the radar sees them in one burst; at any range, what the sampling aliases is aliased.
        ground: mirrors the antennas of ground paths.
        loops: only the first ones; None: the schedule's.
    Returns:
        complex128 [loops, slots, receivers, samples], LSB.
    Raises:
        ValueError: ground paths without a ground.
    """
    profile, layout = radar.schedule.profile, radar.schedule.layout
    count = layout.loops if loops is None else loops
    transmitters_m, receivers_m = antennas_m(radar)
    chirp_s = (np.arange(count)[:, None] * layout.slots + np.arange(layout.slots)) * profile.chirp_time_s
    sample_s = (np.arange(layout.samples) - layout.samples / 2.0) / profile.sample_rate_hz
    level = 10.0 ** (-radar.mounting.power_offset_db / 20.0)
    total = np.zeros((count, layout.slots, len(receivers_m), layout.samples), dtype=np.complex128)
    for k in range(len(scatterers)):
        a = _mirrored(transmitters_m, ground) if scatterers.tx_image[k] else transmitters_m
        b = _mirrored(receivers_m, ground) if scatterers.rx_image[k] else receivers_m
        place_m = scatterers.position_m[k] + scatterers.velocity_m_s[k] * chirp_s[..., None]
        out_m = np.linalg.norm(place_m - a, axis=-1)
        back_m = np.linalg.norm(place_m[:, :, None, :] - b, axis=-1)
        delay_s = (out_m[:, :, None] + back_m - 2.0 * radar.mounting.range_offset_m)[..., None] / C_M_S
        cycles = profile.center_frequency_hz * delay_s + profile.slope_hz_per_s_actual * delay_s * sample_s
        total += level * complex(scatterers.amplitude[k]) * np.exp(2j * np.pi * cycles)
    return total
