# SPDX-License-Identifier: Apache-2.0
"""Time division multiplexing: how many loops may be summed, and the phase that motion adds from slot to slot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edge.frames import Complex64, Float64, RadarId

COHERENT_SHARE = 0.4
"""Largest radial speed of a coherent sum, as a share of the first null lambda / (2 slots L Tc)."""
FOV_COSINE = math.sqrt(0.5)
"""Cosine and sine of the field of view's edge, 45 degrees."""


def array_axis(radar: RadarId) -> int:
    """Index of the rig axis along the radar's own array: y for the horizontal, z for the vertical."""
    return 1 if radar == "horizontal" else 2


def radial_speed_in_fov_m_s(velocity_rig_m_s: Float64) -> float:
    """Largest radial speed of a static scatterer within 45 degrees of boresight.

    Args:
        velocity_rig_m_s: [3], rig over ground, rig axes.
    Returns:
        |v| sin 45 degrees for travel across the boresight, |v| for travel along it.
    """
    forward, across = abs(velocity_rig_m_s[0]), math.hypot(velocity_rig_m_s[1], velocity_rig_m_s[2])
    if across > forward:
        return float((forward + across) * FOV_COSINE)
    return math.hypot(forward, across)


def coherent_loops(radial_speed_m_s: float, wavelength_m: float, loop_time_s: float, most: int) -> int:
    """Loops that may be summed: v <= 0.4 lambda / (2 L loop_time), at least 1, at most ``most``.

    Args:
        radial_speed_m_s: as ``radial_speed_in_fov_m_s`` gives it.
        wavelength_m: at the middle of the ADC window.
        loop_time_s: slots times chirp time.
        most: loops that were captured or asked for.
    """
    if radial_speed_m_s * most * 2.0 * loop_time_s <= COHERENT_SHARE * wavelength_m:
        return most
    return max(1, int(COHERENT_SHARE * wavelength_m / (2.0 * loop_time_s * radial_speed_m_s)))


def speed_phasors(radial_speed_m_s: float, transmit_time_s: Float64, wavelength_m: float) -> Complex64:
    """Factors that undo a radial speed: exp(-j 4 pi v t_s / lambda), phase grows with range.

    Args:
        radial_speed_m_s: positive away.
        transmit_time_s: [slots] after the first chirp.
        wavelength_m: at the middle of the ADC window.
    Returns:
        complex64 [slots].
    """
    phase = 4.0 * np.pi * radial_speed_m_s * transmit_time_s / wavelength_m
    return np.asarray(np.exp(-1j * phase), dtype=np.complex64)


def doppler_phasors(doppler_bin: float, loops: int, slots: int) -> Complex64:
    """Factors that undo the speed of one bin of the Doppler FFT over loops: exp(-j 2 pi k s / (slots L)).

    Args:
        doppler_bin: centred, -L/2 .. L/2; add multiples of L to try ambiguous speeds; positive away.
        loops: length L of the Doppler FFT.
        slots: chirps of one loop.
    Returns:
        complex64 [slots].
    Source: TI cascade MATLAB example; hardware research section 3.1.
    """
    phase = 2.0 * np.pi * doppler_bin * np.arange(slots) / (slots * loops)
    return np.asarray(np.exp(-1j * phase), dtype=np.complex64)


@dataclass(frozen=True, slots=True)
class Sector:
    """Rows of a heatmap that share one compensation of the rig's motion.

    Args:
        centre: direction cosine that is compensated exactly.
        first, last: rows first <= row < last.
    """

    centre: float
    first: int
    last: int


def divide(direction_cosine: Float64, count: int) -> tuple[Sector, ...]:
    """Divide the field of view, 45 degrees to both sides, into equal sectors; the outer ones reach the axis' ends.

    Args:
        direction_cosine: [angle], ascending.
        count: sectors.
    """
    bounds = np.linspace(-FOV_COSINE, FOV_COSINE, count + 1)
    rows = np.searchsorted(direction_cosine, bounds)
    rows[0], rows[-1] = 0, len(direction_cosine)
    centres = 0.5 * (bounds[1:] + bounds[:-1])
    return tuple(Sector(float(c), int(a), int(b)) for c, a, b in zip(centres, rows[:-1], rows[1:], strict=True))
