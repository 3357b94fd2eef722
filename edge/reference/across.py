# SPDX-License-Identifier: Apache-2.0
"""Cells of a heatmap from maps of several radial speeds by definition in float64, one range bin at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edge.config import HeatmapSettings
from edge.frames import Float64
from edge.reference.heatmap import taper

if TYPE_CHECKING:
    from edge.rig import Radar

SPEED_OF_LIGHT_M_S = 299_792_458.0


def lobe_amplitudes(radar: Radar, settings: HeatmapSettings, step_m_s: float, most: int) -> Float64:
    """Bound of a far point's amplitude in a map of another speed, by speed and angle difference; 1 at the point.

    A(m, b) = | sum_c w_c exp(j 2 pi (p_c b du + 2 m v t_c) / lambda) |, w shared by the channels at one place, summing
    to 1, v the step; of it the largest within half a step and one bin.

    Args:
        radar: board and schedule.
        settings: angle window and bins.
        step_m_s: between maps.
        most: largest difference of maps.
    Returns:
        float64 [2 * most + 1, angle difference, periodic].
    """
    wavelength_m = SPEED_OF_LIGHT_M_S / radar.schedule.profile.center_frequency_hz
    inside = np.asarray(radar.array.position) >= 0
    a, b = (radar.mounting.array_sign * np.asarray(offset) for offset in radar.array.element_offsets_m())
    element = np.asarray(radar.array.position)[inside]
    element = (element - element.min()) * radar.mounting.array_sign % (np.ptp(element) + 1)
    count = element.max() + 1
    weight = taper(settings, (np.arange(count) + 0.5) / count - 0.5)[element] / np.bincount(element)[element]
    time_s = np.asarray(radar.schedule.transmit_time_s)[np.nonzero(inside)[0]]
    turns = np.outer(np.arange(-2 * most - 1, 2 * most + 2), step_m_s * time_s) / wavelength_m
    pitch = radar.array.pitch_wavelengths(radar.schedule.profile.center_frequency_hz)
    bins = np.arange(settings.angle_bins) / (settings.angle_bins * pitch)
    path = np.outer((a[:, None] + b[None, :])[inside] / wavelength_m, bins)
    value = np.abs((weight / weight.sum() * np.exp(2j * np.pi * turns)) @ np.exp(2j * np.pi * path))
    value = np.max([np.roll(value, shift, axis=1) for shift in (-1, 0, 1)], axis=0)
    return np.asarray(np.max([value[i : i + 4 * most + 1 : 2] for i in (0, 1, 2)], axis=0))


def speed_parabola(powers: Float64, k: int) -> tuple[int, Float64]:
    """Middle of three maps and their shares at the speed where a point's power [map] peaks, next to map ``k``."""
    middle = min(max(k, 1), len(powers) - 2)
    before, at, after = powers[middle - 1 : middle + 2]
    bend = before - 2.0 * at + after
    offset = 0.5 * (before - after) / bend if bend < 0 else float(k - middle)
    x = np.clip(offset, max(k - middle - 0.5, -1.0), min(k - middle + 0.5, 1.0))
    return middle, np.array([x * (x - 1.0) / 2.0, 1.0 - x * x, x * (x + 1.0) / 2.0])


def cells_of_range_bin(
    maps: Float64, pattern: Float64, lobes: Float64, floor: float, prominent: float, weakest: float, targets: int
) -> Float64:
    """One range bin's power from its maps.

    Args:
        maps: [K, angle].
        pattern: [angle], received over compensated power.
        lobes: as ``lobe_amplitudes`` gives them, floored at ``floor``.
        floor: amplitude of a target's far lobes.
        prominent, weakest, targets: largest power over the mean that is searched; weakest target over the strongest;
            most targets.
    Returns:
        float64 [angle]: the strongest map where no target's lobes explain it; beside a target its own lobes, at its
        speed; elsewhere the least of all targets' maps.
    """
    which = maps.argmax(axis=0)
    received = maps.max(axis=0) * pattern
    power = maps.max(axis=0)
    if received.max() <= prominent * received.mean():
        return np.asarray(power)
    bound = np.zeros(len(power))
    own: list[Float64] = []
    shown: list[Float64] = []
    while len(own) < targets:
        left = np.where(received > bound**2, received, 0.0)
        peak = int(left.argmax())
        if left[peak] <= weakest * received.max():
            break
        apart, same = (np.arange(len(power)) - peak) % len(power), len(lobes) // 2
        amplitude = np.sqrt(received[peak])
        bound = bound + amplitude * lobes[same + which - which[peak], apart]
        own.append(amplitude * lobes[same, apart])
        middle, share = speed_parabola(maps[:, peak], int(which[peak]))
        shown.append(np.maximum(share @ maps[middle - 1 : middle + 2], 0.0))
    lobe, at_speed = np.array(own), np.array(shown)
    owned = np.take_along_axis(at_speed, lobe.argmax(axis=0)[None], axis=0)[0]
    beside = lobe.max(axis=0) > 1.01 * floor * np.sqrt(received.max())
    explained = received <= bound**2
    return np.asarray(np.where(explained, np.where(beside, owned, at_speed.min(axis=0)), power))
