# SPDX-License-Identifier: Apache-2.0
"""Range-angle power from its definition in float64: sums over samples and channels, no FFT, no row of elements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edge.config import AntennaSettings, HeatmapSettings, WindowName
from edge.frames import Float64, RadarFrame
from edge.reference.point_targets import Complex128, unpack

if TYPE_CHECKING:
    from edge.rig import Radar

SPEED_OF_LIGHT_M_S = 299_792_458.0
SHORTEST_RANGE_M = 0.05


def range_angle_power(
    radar: Radar,
    frame: RadarFrame,
    settings: HeatmapSettings,
    antenna: AntennaSettings,
    loops: int = 1,
    closing_m_s: float = 0.0,
) -> Float64:
    """Power over direction cosine and range, as the imager's recipe defines it.

    P[b, k] = G(u_b) | sum_c w(p_c) / m(p_c) exp(j 2 pi p_c u_b / lambda) F_c(r_k) X_c[k] |^2 / (sum w)^2 over
    channels c at p_c = a + b of the row, m channels at the same p, with X_c the windowed Fourier sum of calibrated
    samples, F_c(r) = exp(-j 2 pi (kappa_c(r) - kappa_c(R_cal)) / lambda), kappa_c(r) the path beyond 2 r of a point at
    boresight, and the phase of one closing speed since the first chirp undone.

    Args:
        radar: board, schedule, mounting and calibration.
        frame: raw samples.
        settings, antenna: as the imager takes them.
        loops: loops that are averaged.
        closing_m_s: speed at which everything comes nearer.
    Returns:
        float64 [angle, range].
    """
    wavelength_m = SPEED_OF_LIGHT_M_S / radar.schedule.profile.center_frequency_hz
    by_loop, position_m = focused_spectrum(radar, frame, settings, loops)
    time_s = np.asarray(radar.schedule.transmit_time_s)[:, None, None]
    spectrum = by_loop.mean(axis=0) * np.exp(4j * np.pi * closing_m_s * time_s / wavelength_m)
    inside = np.asarray(radar.array.position) >= 0
    u = direction_cosines(radar, settings)
    weight = _row_weights(position_m[inside], settings)
    steering = weight * np.exp(2j * np.pi / wavelength_m * np.outer(u, position_m[inside]))
    return np.asarray(antenna_gain(antenna, u)[:, None] * np.square(np.abs(steering @ spectrum[inside])))


def direction_cosines(radar: Radar, settings: HeatmapSettings) -> Float64:
    """Rows of a heatmap, float64 [angle]: one period of the row's pitch."""
    pitch = radar.array.pitch_wavelengths(radar.schedule.profile.center_frequency_hz)
    return np.asarray((np.arange(settings.angle_bins) / settings.angle_bins - 0.5) / pitch)


def antenna_gain(antenna: AntennaSettings, direction_cosine: Float64) -> Float64:
    """Factor that gives back what the antennas lose along the array, twice; same shape as the direction cosines."""
    angle_deg = np.degrees(np.arcsin(np.clip(direction_cosine, -1, 1)))
    loss_db = antenna.along_loss_db * np.square(angle_deg / antenna.along_edge_deg)
    return np.asarray(10.0 ** (2.0 * np.minimum(loss_db, antenna.max_loss_db) / 10.0))


def focused_spectrum(
    radar: Radar, frame: RadarFrame, settings: HeatmapSettings, loops: int
) -> tuple[Complex128, Float64]:
    """Windowed Fourier sums of calibrated samples, focused, and where the channels stand.

    Args:
        radar, frame, settings: as for ``range_angle_power``.
        loops: the first so many.
    Returns:
        complex128 [loop, slots, receivers, points], of real samples the first half, doubled, and float64 [slots,
        receivers], metres along the rig axis.
    """
    profile, samples = radar.schedule.profile, radar.schedule.layout.samples
    points = max(64, 1 << int(np.ceil(np.log2(samples))))
    if radar.schedule.layout.kind == "dca1000_real":
        points = max(128, points)
    spectrum = _range_spectrum(radar, frame, settings, loops, points)
    spacing_m = SPEED_OF_LIGHT_M_S * profile.sample_rate_hz / (2.0 * profile.slope_hz_per_s_actual * points)
    if radar.schedule.layout.kind == "dca1000_real":
        points //= 2
        spectrum = 2.0 * spectrum[..., :points]
    a, b = (radar.mounting.array_sign * np.asarray(offset)[..., None] for offset in radar.array.element_offsets_m())
    a, b = a[:, None], b[None, :]
    if settings.focus:
        range_m = np.maximum(np.arange(points) * spacing_m + radar.mounting.range_offset_m, SHORTEST_RANGE_M)
        reference = radar.calibration.reference_range_m
        baked = 0.0 if np.isinf(reference) else np.hypot(reference, a) + np.hypot(reference, b) - 2.0 * reference
        beyond = np.hypot(range_m, a) + np.hypot(range_m, b) - 2.0 * range_m - baked
        spectrum = spectrum * np.exp(-2j * np.pi * profile.center_frequency_hz / SPEED_OF_LIGHT_M_S * beyond)
    return spectrum, np.asarray((a + b)[..., 0])


def _range_spectrum(radar: Radar, frame: RadarFrame, settings: HeatmapSettings, loops: int, points: int) -> Complex128:
    """Windowed Fourier sums [loop, slots, receivers, points] of the calibrated samples."""
    samples = radar.schedule.layout.samples
    n = np.arange(samples)
    window = shape(settings.range_window, n / samples - 0.5, settings)
    shift = np.asarray(radar.calibration.range_shift_bins)[..., None]
    codes = unpack(frame.adc, frame.layout)[:loops]
    calibrated = codes * np.asarray(radar.calibration.gain)[..., None] * np.exp(-2j * np.pi * n * shift / samples)
    kernel = np.exp(-2j * np.pi * np.outer(n, np.arange(points)) / points)
    return np.asarray((calibrated * window / window.sum()) @ kernel)


def taper(settings: HeatmapSettings, x: Float64) -> Float64:
    """Angle window at x, -1/2 .. +1/2 from edge to edge of the row."""
    return shape(settings.angle_window, x, settings)


def shape(name: WindowName, x: Float64, settings: HeatmapSettings) -> Float64:
    """A window at x, -1/2 .. +1/2; Taylor's as 1 + 2 sum_m F_m cos(2 pi m x) over its value at 0 (Taylor 1955)."""
    if name == "rectangular":
        return np.ones_like(x)
    if name == "hann":
        return np.asarray(np.cos(np.pi * x) ** 2)
    nbar, a = settings.taylor_nbar, np.arccosh(10.0 ** (settings.taylor_sidelobe_db / 20.0)) / np.pi
    zero = [nbar**2 * (a**2 + (i - 0.5) ** 2) / (a**2 + (nbar - 0.5) ** 2) for i in range(1, nbar)]
    values, centre = np.ones_like(x), 1.0
    for m in range(1, nbar):
        moved = np.prod([1.0 - m**2 / z for z in zero])
        kept = np.prod([1.0 - m**2 / i**2 for i in range(1, nbar) if i != m])
        f = (-1.0) ** (m + 1) * moved / (2.0 * kept)
        values, centre = values + 2.0 * f * np.cos(2.0 * np.pi * m * x), centre + 2.0 * f
    return np.asarray(values / centre)


def _row_weights(position_m: Float64, settings: HeatmapSettings) -> Float64:
    """Taper of every channel over the row's length, shared by the channels at one position; sums to 1."""
    places = np.unique(np.round(position_m, 7))
    spacing_m = (places[-1] - places[0]) / (len(places) - 1)
    index = np.rint((position_m - places[0]) / spacing_m).astype(int)
    weight = taper(settings, (np.arange(len(places)) + 0.5) / len(places) - 0.5)
    return np.asarray(weight[index] / np.bincount(index)[index] / weight.sum())
