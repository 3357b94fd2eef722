# SPDX-License-Identifier: Apache-2.0
"""Raw frames of point scatterers in float64, from the definition of the beat signal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.frames import RadarFrame

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edge.frames import Int16, Layout
    from edge.rig import Radar

Complex128 = NDArray[np.complex128]
Float = NDArray[np.float64]

SPEED_OF_LIGHT_M_S = 299_792_458.0
FINE_SAMPLES = 16


def element_positions_m(radar: Radar) -> tuple[Float, Float]:
    """Antenna positions of one radar in the rig frame.

    The board's array axis is rig +y (horizontal) or +z (vertical: the same board turned by +90 degrees about x, so
    that its elevation axis points to -y); ``array_sign`` -1 turns the board by another 180 degrees about x.

    Args:
        radar: board, mounting and schedule.
    Returns:
        Transmitters [slots, 3] in firing order and receivers [receivers, 3] in capture order, metres.
    """
    half_wavelength_m = SPEED_OF_LIGHT_M_S / (2.0 * radar.array.design_frequency_hz)
    along, across = (1, 2) if radar.radar == "horizontal" else (2, 1)
    across_sign = 1.0 if radar.radar == "horizontal" else -1.0
    positions = []
    offsets_m = radar.array.element_offsets_m()
    elevations = (radar.array.tx_elevation, radar.array.rx_elevation)
    for offset_m, elevation in zip(offsets_m, elevations, strict=True):
        position = np.tile(np.asarray(radar.mounting.position_m, dtype=np.float64), (len(offset_m), 1))
        position[:, along] += radar.mounting.array_sign * np.asarray(offset_m)
        position[:, across] += radar.mounting.array_sign * across_sign * half_wavelength_m * np.asarray(elevation)
        positions.append(position)
    return positions[0], positions[1]


def _beat_signal(radar: Radar, points_m: Float, amplitude: Complex128, displacement_m: Float) -> Complex128:
    """Beat signal [slots, receivers, samples] of points that move by ``displacement_m`` [slots, 3] at each slot.

    x[m, n, i] = sum_k a_k exp(j 2 pi (f_c tau + S tau t_i)): with i = 16 c + f the sum over k is, for every channel,
    the matrix product of coarse phasors [c, k] and fine phasors [k, f].
    """
    profile = radar.schedule.profile
    samples = radar.schedule.layout.samples
    transmitters_m, receivers_m = element_positions_m(radar)
    moved_m = points_m[None, :, :] + displacement_m[:, None, :]
    to_transmitter_m = np.linalg.norm(moved_m - transmitters_m[:, None, :], axis=-1)
    to_receiver_m = np.linalg.norm(moved_m[:, None] - receivers_m[None, :, None, :], axis=-1)
    path_m = to_transmitter_m[:, None, :] + to_receiver_m - 2.0 * radar.mounting.range_offset_m
    delay_s = path_m / SPEED_OF_LIGHT_M_S
    beat_hz = profile.slope_hz_per_s_actual * delay_s
    start_s = -(samples / 2) / profile.sample_rate_hz
    first = amplitude * np.exp(2j * np.pi * (profile.center_frequency_hz * delay_s + beat_hz * start_s))
    step = np.exp(2j * np.pi * beat_hz / profile.sample_rate_hz)
    fine, next_power = _powers(step, FINE_SAMPLES)
    coarse, _ = _powers(next_power, -(-samples // FINE_SAMPLES))
    coarse *= first[..., None, :]
    signal = np.matmul(coarse, np.swapaxes(fine, -1, -2))
    return np.asarray(signal.reshape(*signal.shape[:2], -1)[..., :samples])


def _powers(base: Complex128, count: int) -> tuple[Complex128, Complex128]:
    """Powers 0..count-1 of ``base`` [..., k] as [..., count, k], and the power ``count`` (a power of two)."""
    powers = np.ones((*base.shape[:-1], 1, base.shape[-1]), dtype=np.complex128)
    square = base
    while powers.shape[-2] < count:
        powers = np.concatenate((powers, powers * square[..., None, :]), axis=-2)
        square = square * square
    return powers[..., :count, :], square


def pack(samples: Complex128, layout: Layout) -> Int16:
    """Round, clip and order complex samples as the capture does.

    Args:
        samples: complex128 [loops, slots, devices * rx, samples], LSB.
        layout: axis order of the capture.
    Returns:
        int16 array of shape ``layout.shape``; of real samples the real parts.
    """
    shape = (layout.loops, layout.slots, layout.devices, layout.rx, layout.samples)
    parts = np.stack((samples.real, samples.imag), axis=-1).reshape(*shape, 2)
    codes = np.clip(np.rint(parts), -32768, 32767).astype(np.int16)
    if layout.kind == "dca1000_real":
        return np.ascontiguousarray(codes[:, :, 0, ..., 0])
    if layout.iq_order == "QI":
        codes = codes[..., ::-1]
    if layout.kind == "cascade":
        return np.ascontiguousarray(codes.transpose(2, 0, 1, 4, 3, 5))
    pairs = codes[:, :, 0].reshape(layout.loops, layout.slots, layout.rx, layout.samples // 2, 2, 2)
    return np.ascontiguousarray(pairs.swapaxes(-1, -2)).reshape(layout.shape)


def unpack(adc: Int16, layout: Layout) -> Complex128:
    """Complex samples [loops, slots, devices * rx, samples] of a capture: the inverse of ``pack``; real ones as are."""
    values = adc.astype(np.float64)
    if layout.kind == "dca1000_real":
        return values.astype(np.complex128)
    if layout.kind == "cascade":
        parts = values.transpose(1, 2, 0, 4, 3, 5)
    else:
        pairs = values.reshape(layout.loops, layout.slots, layout.rx, layout.samples // 2, 2, 2)
        parts = pairs.swapaxes(-1, -2)
    first, second = parts[..., 0], parts[..., 1]
    codes = first + 1j * second if layout.iq_order == "IQ" else second + 1j * first
    return codes.reshape(layout.loops, layout.slots, layout.devices * layout.rx, layout.samples)


def make_frame(
    radar: Radar,
    scatterers_m: Float | Sequence[Sequence[float]],
    amplitude: Complex128 | Float | Sequence[float] | float,
    number: int,
    t_first_chirp_ns: int,
    velocity_rig_m_s: Float | Sequence[float] | None = None,
    noise_lsb: float = 0.0,
    rng: np.random.Generator | None = None,
    channel_gain: Complex128 | None = None,
    shift_bins: Float | None = None,
) -> RadarFrame:
    """One burst of isotropic point scatterers, exact spherical two-way paths, rounded and clipped as an ADC does.

    No antenna pattern is applied: give amplitudes that contain it.

    Args:
        radar: board, schedule and mounting; its calibration is not used.
        scatterers_m: [K, 3] in the rig frame at the first chirp.
        amplitude: [K] (or one for all) in LSB per complex sample, real or complex.
        number, t_first_chirp_ns: of the frame.
        velocity_rig_m_s: [3] velocity of the rig over ground in rig axes; static scatterers come nearer by it.
        noise_lsb: standard deviation of each complex sample's circular Gaussian noise, independent per loop.
        rng: generator of the noise; seed 0 when it is not given.
        channel_gain: [slots, receivers] factor of each channel (mismatch); none: 1.
        shift_bins: [slots, receivers] beat frequency offset of each channel in bins of a ``samples``-point FFT.
    Returns:
        The frame in the capture layout of ``radar.schedule``.
    Source: the beat signal of docs/architecture.md, sign and phase conventions.
    """
    layout = radar.schedule.layout
    points_m = np.asarray(scatterers_m, dtype=np.float64).reshape(-1, 3)
    amplitudes = np.broadcast_to(np.asarray(amplitude, dtype=np.complex128), (len(points_m),))
    velocity = np.zeros(3) if velocity_rig_m_s is None else np.asarray(velocity_rig_m_s, dtype=np.float64)
    slot_time_s = np.arange(layout.slots) * radar.schedule.profile.chirp_time_s
    loop_time_s = layout.slots * radar.schedule.profile.chirp_time_s
    moving = bool(np.any(velocity != 0.0))
    bursts = [
        _beat_signal(radar, points_m, amplitudes, -velocity * (slot_time_s + loop * loop_time_s)[:, None])
        for loop in range(layout.loops if moving else 1)
    ]
    samples = np.broadcast_to(np.stack(bursts), (layout.loops, *bursts[0].shape))
    if shift_bins is not None:
        ramp = np.arange(layout.samples) / layout.samples
        samples = samples * np.exp(2j * np.pi * shift_bins[..., None] * ramp)
    if channel_gain is not None:
        samples = samples * channel_gain[..., None]
    if noise_lsb > 0.0:
        generator = rng if rng is not None else np.random.default_rng(0)
        parts = generator.standard_normal((*samples.shape, 2)) * (noise_lsb / np.sqrt(2.0))
        samples = samples + parts.view(np.complex128)[..., 0]
    return RadarFrame(radar.radar, number, t_first_chirp_ns, pack(samples, layout), layout)
