# SPDX-License-Identifier: Apache-2.0
"""HawkEye's method restated: the delay of every point to every antenna, a complex exponential for every sample.

After Guan, Madani, Jog, Hassanieh, Through Fog High-Resolution Imaging Using Millimeter Wave Radar (HawkEye), CVPR
2020, and the signal of its published data synthesis: spherical time of flight from transmitter to point to receiver,
exp(j 2 pi (f_c tau + S tau t)), point by point, vectorised over antennas and samples. What differs from theirs is the
scene's amplitudes (theirs are all 1), the board, and that noise is added and the samples rounded as an ADC does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.reference.point_targets import element_positions_m, pack
from edge.waveform import SPEED_OF_LIGHT_M_S

if TYPE_CHECKING:
    from edge.frames import Int16
    from edge.rig import Radar
    from train.simulate.scatterers import Scatterers


def direct_delays(radar: Radar, scatterers: Scatterers) -> NDArray[np.complex128]:
    """Beat signal [slots, receivers, samples] of points that stand still."""
    profile = radar.schedule.profile
    transmitters_m, receivers_m = element_positions_m(radar)
    time_s = (np.arange(profile.samples) - 0.5 * profile.samples) / profile.sample_rate_hz
    total = np.zeros((len(transmitters_m), len(receivers_m), profile.samples), dtype=np.complex128)
    for place, amplitude in zip(scatterers.position_m, scatterers.amplitude, strict=True):
        path_m = (
            np.linalg.norm(place - transmitters_m, axis=1)[:, None] + np.linalg.norm(place - receivers_m, axis=1)
        ) - 2.0 * radar.mounting.range_offset_m
        delay_s = (path_m / SPEED_OF_LIGHT_M_S)[:, :, None]
        cycles = (profile.center_frequency_hz + profile.slope_hz_per_s_actual * time_s) * delay_s
        total += complex(amplitude) * np.exp(2j * np.pi * cycles)
    return total


def direct_frame(radar: Radar, scatterers: Scatterers, noise_lsb: float, rng: np.random.Generator) -> Int16:
    """One loop in the order of the capture, with noise."""
    samples = direct_delays(radar, scatterers)
    parts = rng.standard_normal((*samples.shape, 2)) * (noise_lsb / np.sqrt(2.0))
    return pack((samples + parts.view(np.complex128)[..., 0])[None], radar.schedule.layout)
