# SPDX-License-Identifier: Apache-2.0
"""Time division multiplexing: how many loops may be summed, and the phase that motion adds from slot to slot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from edge.config import DopplerChoice
from edge.errors import PoseError
from edge.frames import Complex64, Float64, RadarId

COHERENT_SHARE = 0.4
"""Largest radial speed of a coherent sum, as a share of the first null lambda / (2 slots L Tc)."""
LEAST_FFT_LOOPS = 4
"""Fewer loops tell no speeds apart."""
FOV_COSINE = math.sqrt(0.5)
"""Cosine and sine of the field of view's edge, 45 degrees."""


def array_axis(radar: RadarId) -> int:
    """Index of the rig axis along the radar's own array: y for the horizontal, z for the vertical."""
    return 1 if radar == "horizontal" else 2


def motion_m_s(velocity_rig_m_s: Float64 | None, radar: RadarId) -> tuple[float, float, float]:
    """Speeds of the rig along boresight, along the radar's array and across both; none given: standing still.

    Raises:
        PoseError: the velocity is no number.
    """
    if velocity_rig_m_s is None:
        return 0.0, 0.0, 0.0
    axis = array_axis(radar)
    forward_m_s, along_m_s, across_m_s = (float(velocity_rig_m_s[i]) for i in (0, axis, 3 - axis))
    if not math.isfinite(forward_m_s + along_m_s + across_m_s):
        raise PoseError("velocity of the rig is no number", value=velocity_rig_m_s.tolist(), allowed="finite m/s")
    return forward_m_s, along_m_s, across_m_s


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


def closing_range_m_s(forward_m_s: float, along_m_s: float) -> tuple[float, float]:
    """Smallest and largest v_x sqrt(1 - u^2) + v_along u over the field of view, 45 degrees to both sides."""
    ends = [FOV_COSINE * (forward_m_s + along_m_s), FOV_COSINE * (forward_m_s - along_m_s)]
    if abs(along_m_s) < abs(forward_m_s):
        ends.append(math.copysign(math.hypot(forward_m_s, along_m_s), forward_m_s))
    return min(ends), max(ends)


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


@dataclass(frozen=True, slots=True)
class Choice:
    """What becomes of a burst's loops.

    Args:
        name: "sum", "steer", "fft" or "single".
        loops: loops used.
        reason: why, for people.
    """

    name: DopplerChoice
    loops: int
    reason: str


def choose(
    wish: DopplerChoice,
    most: int,
    coherent: int,
    steerable: int,
    speed_m_s: float | None,
    tried: int = 1,
    sideways: bool = False,
) -> Choice:
    """What becomes of the loops; coherent sums only where they cannot cancel.

    Args:
        wish: the setting.
        most: loops that were captured or asked for.
        coherent: loops whose plain sum cannot cancel at this speed (``coherent_loops``).
        steerable: loops that odometry can steer: a point stays in its range bin, the moved row within the angle FFT.
        speed_m_s: largest radial speed of a static point; None: not known.
        tried: radial speeds that motion across the array makes worth trying; 1: it does not matter.
        sideways: such motion matters to this radar or to its partner across it: both measure radial speeds then, which
            pairs their detections.
    """
    at = "no velocity given, taken as standing still" if speed_m_s is None else f"at {speed_m_s:.2f} m/s"
    also = f"; {tried} radial speeds tried, the motion across the array" if tried > 1 else ""
    if most == 1 or wish == "single":
        return Choice("single", 1, ("one loop in use" if most == 1 else "heatmap.doppler asks for one loop") + also)
    if wish == "fft":
        return Choice("fft", most, "heatmap.doppler asks for it")
    if wish == "sum" or coherent >= most:
        return Choice("sum", coherent, f"{at}: {coherent} of {most} loops add up without cancelling{also}")
    if wish == "auto" and sideways and most >= LEAST_FFT_LOOPS:
        return Choice("fft", most, f"{at}: sideways, {most} loops tell radial speeds apart that odometry cannot")
    if wish == "steer" or steerable > coherent:
        reason = f"{at}: {coherent} of {most} loops add up as they are, {steerable} steered{also}"
        return Choice("steer", steerable, reason)
    if most >= LEAST_FFT_LOOPS:
        return Choice("fft", most, f"{at}: too fast to steer more than {steerable} of {most} loops")
    return Choice("sum", coherent, f"{at}: too fast to steer, {coherent} of {most} loops add up{also}")


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
        half_width: from the centre to either edge.
        first, last: rows first <= row < last.
    """

    centre: float
    half_width: float
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
    return tuple(
        Sector(float(c), FOV_COSINE / count, int(a), int(b))
        for c, a, b in zip(centres, rows[:-1], rows[1:], strict=True)
    )
