# SPDX-License-Identifier: Apache-2.0
"""Steered sum and Doppler FFT from their definitions in float64: sums over chirps and channels, no FFT, no grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from edge.config import AntennaSettings, HeatmapSettings
from edge.frames import Float64, RadarFrame
from edge.reference.heatmap import antenna_gain, direction_cosines, focused_spectrum, taper
from edge.reference.point_targets import Complex128

if TYPE_CHECKING:
    from edge.rig import Radar

SPEED_OF_LIGHT_M_S = 299_792_458.0


def density_weights(position: Float64, settings: HeatmapSettings) -> Float64:
    """Weights of elements that stand on no grid: inverse density times the taper over the aperture; they sum to 1.

    Density at x counts an element at y by sinc^2(0.75 (x - y)), |x - y| < 4; three rounds of w <- w / (w * density).

    Args:
        position: float64 [n], in elements.
        settings: angle window.
    """
    apart = position[:, None] - position[None, :]
    near = np.where(np.abs(apart) < 4.0, np.square(np.sinc(0.75 * apart)), 0.0)
    weight = np.ones(len(position))
    for _ in range(3):
        weight = weight / (near @ weight)
    low, high = position.min() - 0.5, position.max() + 0.5
    weight = weight * taper(settings, (position - low) / (high - low) - 0.5)
    return np.asarray(weight / weight.sum())


def steered_power(
    radar: Radar,
    frame: RadarFrame,
    settings: HeatmapSettings,
    antenna: AntennaSettings,
    loops: int,
    velocity_m_s: tuple[float, float],
    sectors: Sequence[tuple[float, float, int, int]],
    weights: Sequence[Float64] = (),
) -> Float64:
    """Power over direction cosine and range with the rig's motion undone for a static scene.

    Row b in the sector around u_g sums w exp(j 2 pi (p u_b + 2 (c_g + c'_g (u_b - u_g)) t) / lambda) X over channels
    and loops, c(u) = v_x sqrt(1 - u^2) + v_along u, t from the middle between the row's first and last chirp, with the
    density weights of p + 2 c'_g t; c_g stands in the middle of c's bow, c'' h^2 / 4 off the tangent.

    Args:
        radar, frame, settings, antenna: as for ``range_angle_power``.
        loops: loops that are used.
        velocity_m_s: along boresight and along the array.
        sectors: (centre u_g, half width h, first row, last row + 1).
        weights: [channel] of one loop by sector, slot by slot, in the place of the density weights.
    Returns:
        float64 [angle, range].
    """
    wavelength_m = SPEED_OF_LIGHT_M_S / radar.schedule.profile.center_frequency_hz
    inside = np.asarray(radar.array.position) >= 0
    spectrum, position_m = focused_spectrum(radar, frame, settings, loops)
    used = np.stack([loop[inside] for loop in spectrum])
    slot_s = np.asarray(radar.schedule.transmit_time_s)[np.nonzero(inside)[0]]
    loop_s = radar.schedule.layout.slots * radar.schedule.profile.chirp_time_s * np.arange(loops)
    time_s = slot_s[None, :] + loop_s[:, None]
    time_s = time_s - 0.5 * (time_s.min() + time_s.max())
    p = position_m[inside]
    unit_m = np.diff(np.unique(np.round(p, 7))).min()
    u = direction_cosines(radar, settings)
    power = np.zeros((len(u), spectrum.shape[-1]))
    forward, along = velocity_m_s
    for n, (centre, half_width, first, last) in enumerate(sectors):
        across = np.sqrt(1.0 - centre**2)
        slope, closing = along - forward * centre / across, forward * across + along * centre
        closing -= 0.25 * forward / across**3 * half_width**2
        moved_m = p[None, :] + 2.0 * slope * time_s
        chosen = weights[n] if weights else density_weights(moved_m.ravel() / unit_m, settings)
        weight = (chosen / chosen.sum()).reshape(moved_m.shape)
        rows = u[first:last, None, None]
        path_m = p * rows + 2.0 * (closing + slope * (rows - centre)) * time_s
        steering = weight * np.exp(2j * np.pi / wavelength_m * path_m)
        power[first:last] = np.square(np.abs(np.tensordot(steering, used, axes=2)))
    return np.asarray(antenna_gain(antenna, u)[:, None] * power)


def doppler_spectrum(samples: Complex128, size: int) -> Complex128:
    """Fourier sum over loops, bins centred: S_k = (1 / L) sum_l x_l exp(-j 2 pi k l / size), k = -size/2 .. size/2 - 1.

    Args:
        samples: [loop, ...].
        size: bins.
    Returns:
        complex128 [size, ...].
    """
    k, loop = np.arange(size) - size // 2, np.arange(len(samples))
    kernel = np.exp(-2j * np.pi * np.outer(k, loop) / size) / len(samples)
    return np.asarray(np.tensordot(kernel, samples, axes=1))
