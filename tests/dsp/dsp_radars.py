# SPDX-License-Identifier: Apache-2.0
"""Radars the DSP tests look through."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np

from edge.config import Mounting
from edge.frames import Layout

C = 299_792_458.0


def _array(tx: list[int], elevation: list[int], rx: list[int], design_hz: float) -> Any:
    tx_azimuth, tx_elevation, rx_azimuth = (np.array(x, dtype=float) for x in (tx, elevation, rx))
    position = np.where(tx_elevation[:, None] == 0, (tx_azimuth[:, None] + rx_azimuth).astype(int), -1)
    middle = 0.25 * (position[position >= 0].min() + position.max())
    half = C / (2 * design_hz)
    return SimpleNamespace(
        tx_azimuth=tx_azimuth,
        tx_elevation=tx_elevation,
        rx_azimuth=rx_azimuth,
        rx_elevation=np.zeros(len(rx)),
        design_frequency_hz=design_hz,
        position=position,
        pitch_wavelengths=lambda frequency_hz: frequency_hz / (2 * design_hz),
        element_offsets_m=lambda: ((tx_azimuth - middle) * half, (rx_azimuth - middle) * half),
    )


def _radar(radar: str, layout: Layout, array: Any, mounting: Mounting, slope: float, rate: float, start: float) -> Any:
    center = start + slope * (6e-6 + layout.samples / 2 / rate)
    profile = SimpleNamespace(
        slope_hz_per_s_actual=slope,
        sample_rate_hz=rate,
        center_frequency_hz=center,
        wavelength_m=C / center,
        chirp_time_s=45e-6,
        range_bin_m=C * rate / (2 * slope * layout.samples),
    )
    schedule = SimpleNamespace(profile=profile, layout=layout, transmit_time_s=np.arange(layout.slots) * 45e-6)
    shape = (layout.slots, layout.devices * layout.rx)
    calibration = SimpleNamespace(
        gain=np.ones(shape, np.complex64), range_shift_bins=np.zeros(shape), reference_range_m=np.inf
    )
    return SimpleNamespace(radar=radar, schedule=schedule, array=array, mounting=mounting, calibration=calibration)


def cascade_radar(radar: str = "horizontal", loops: int = 1, samples: int = 256, **mounting: Any) -> Any:
    array = _array(
        [0, 4, 8, 12, 16, 20, 24, 28, 32, 9, 10, 11],
        [0] * 9 + [1, 4, 6],
        [11, 12, 13, 14, 50, 51, 52, 53, 46, 47, 48, 49, 0, 1, 2, 3],
        76.8e9,
    )
    layout = Layout("cascade", 4, loops, 12, samples, 4)
    return _radar(radar, layout, array, Mounting(**mounting), 78.986e12, 8e6, 77e9)


def single_chip_radar(samples: int = 256, loops: int = 1, iq_order: str = "QI", **mounting: Any) -> Any:
    array = _array([0, 4, 2], [0, 0, 1], [0, 1, 2, 3], 77e9)
    layout = Layout("dca1000", 1, loops, 3, samples, 4, iq_order)  # type: ignore[arg-type]
    return _radar("horizontal", layout, array, Mounting(**mounting), 60e12, 6e6, 77e9)


def calibrated(radar: Any, **changes: Any) -> Any:
    """The radar with another gain, range_shift_bins or reference_range_m."""
    turned = copy.copy(radar)
    turned.calibration = copy.copy(radar.calibration)
    vars(turned.calibration).update(changes)
    return turned


def relaid(radar: Any, layout: Layout) -> Any:
    """The radar with another layout."""
    turned = copy.copy(radar)
    turned.schedule = copy.copy(radar.schedule)
    turned.schedule.layout = layout
    return turned


def place(range_m: float, angle_deg: float, radar: str = "horizontal") -> list[float]:
    """Point in the plane of a radar's array, rig frame, array at the origin."""
    forward, along = range_m * np.cos(np.radians(angle_deg)), range_m * np.sin(np.radians(angle_deg))
    return [forward, along, 0.0] if radar == "horizontal" else [forward, 0.0, along]
