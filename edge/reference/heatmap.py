# SPDX-License-Identifier: Apache-2.0
"""Range-angle power from its definition in float64: sums over samples and channels, no FFT, no row of elements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edge.config import AntennaSettings, HeatmapSettings
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
    forward_m_s: float = 0.0,
) -> Float64:
    """Power over direction cosine and range, as the imager's recipe defines it.

    P[b, k] = G(u_b) | sum_c w(p_c) / m(p_c) exp(j 2 pi p_c u_b / lambda) F_c(r_k) X_c[k] |^2 / (sum w)^2 over
    channels c at p_c = a + b of the row, m channels at the same p, with X_c the windowed Fourier sum of calibrated
    samples, F_c(r) = exp(-j 2 pi (kappa_c(r) - kappa_c(R_cal)) / lambda), kappa_c(r) the path beyond 2 r of a point at
    boresight, and the phase of the rig's forward motion since the first chirp undone.

    Args:
        radar: board, schedule, mounting and calibration.
        frame: raw samples.
        settings, antenna: as the imager takes them.
        loops: loops that are averaged.
        forward_m_s: speed of the rig along boresight.
    Returns:
        float64 [angle, range].
    """
    profile, samples = radar.schedule.profile, radar.schedule.layout.samples
    wavelength_m = SPEED_OF_LIGHT_M_S / profile.center_frequency_hz
    points = max(64, 1 << int(np.ceil(np.log2(samples))))
    spectrum = _range_spectrum(radar, frame, settings, loops, points)
    spacing_m = SPEED_OF_LIGHT_M_S * profile.sample_rate_hz / (2.0 * profile.slope_hz_per_s_actual * points)
    range_m = np.maximum(np.arange(points) * spacing_m + radar.mounting.range_offset_m, SHORTEST_RANGE_M)
    a, b = (radar.mounting.array_sign * np.asarray(offset)[..., None] for offset in radar.array.element_offsets_m())
    a, b = a[:, None], b[None, :]
    if settings.focus:
        reference = radar.calibration.reference_range_m
        baked = 0.0 if np.isinf(reference) else np.hypot(reference, a) + np.hypot(reference, b) - 2.0 * reference
        beyond = np.hypot(range_m, a) + np.hypot(range_m, b) - 2.0 * range_m - baked
        spectrum = spectrum * np.exp(-2j * np.pi * beyond / wavelength_m)
    time_s = np.asarray(radar.schedule.transmit_time_s)[:, None, None]
    spectrum = spectrum * np.exp(4j * np.pi * forward_m_s * time_s / wavelength_m)
    inside = np.asarray(radar.array.position) >= 0
    position_m = np.broadcast_to((a + b)[..., 0], inside.shape)[inside]
    weight = _row_weights(position_m, settings)
    pitch = radar.array.pitch_wavelengths(profile.center_frequency_hz)
    u = (np.arange(settings.angle_bins) / settings.angle_bins - 0.5) / pitch
    steering = weight * np.exp(2j * np.pi / wavelength_m * np.outer(u, position_m))
    loss_db = antenna.along_loss_db * np.square(np.degrees(np.arcsin(np.clip(u, -1, 1))) / antenna.along_edge_deg)
    gain = 10.0 ** (2.0 * np.minimum(loss_db, antenna.max_loss_db) / 10.0)
    return np.asarray(gain[:, None] * np.square(np.abs(steering @ spectrum[inside])))


def _range_spectrum(radar: Radar, frame: RadarFrame, settings: HeatmapSettings, loops: int, points: int) -> Complex128:
    """Windowed Fourier sums [slots, receivers, points] of the calibrated mean over loops."""
    samples = radar.schedule.layout.samples
    n = np.arange(samples)
    window = np.ones(samples) if settings.range_window == "rectangular" else np.sin(np.pi * n / samples) ** 2
    shift = np.asarray(radar.calibration.range_shift_bins)[..., None]
    mean = unpack(frame.adc, frame.layout)[:loops].mean(axis=0)
    calibrated = mean * np.asarray(radar.calibration.gain)[..., None] * np.exp(-2j * np.pi * n * shift / samples)
    kernel = np.exp(-2j * np.pi * np.outer(n, np.arange(points)) / points)
    return np.asarray((calibrated * window / window.sum()) @ kernel)


def _row_weights(position_m: Float64, settings: HeatmapSettings) -> Float64:
    """Taper of every channel over the row's length, shared by the channels at one position; sums to 1."""
    places = np.unique(np.round(position_m, 7))
    spacing_m = (places[-1] - places[0]) / (len(places) - 1)
    index = np.rint((position_m - places[0]) / spacing_m).astype(int)
    taper = np.ones(len(places))
    if settings.angle_window == "hann":
        taper = np.sin(np.pi * (np.arange(len(places)) + 0.5) / len(places)) ** 2
    return np.asarray(taper[index] / np.bincount(index)[index] / taper.sum())
