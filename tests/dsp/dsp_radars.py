# SPDX-License-Identifier: Apache-2.0
"""Radars the DSP tests look through."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from edge.array import array_for
from edge.calibration import Calibration
from edge.config import Mounting
from edge.devices import DeviceName
from edge.dsp.imager import Imager
from edge.dsp.steering import MOST_SECTORS
from edge.frames import Heatmap, Layout, RadarFrame, RadarId
from edge.rig import Radar
from edge.waveform import SPEED_OF_LIGHT_M_S, ChirpProfile, Schedule

C = SPEED_OF_LIGHT_M_S


def _radar(
    radar: RadarId,
    device: DeviceName,
    slope_hz_per_s: float,
    sample_rate_hz: float,
    samples: int,
    loops: int,
    mounting: Mounting,
    iq_order: Any = None,
) -> Radar:
    profile = ChirpProfile(device, 77e9, slope_hz_per_s, 5e-6, 6e-6, 40e-6, samples, sample_rate_hz)
    schedule = Schedule(profile, loops, 0.1, iq_order=iq_order)
    calibration = Calibration.identity(schedule.layout)
    return Radar(radar, schedule, array_for(device), mounting, calibration)


def cascade_radar(radar: RadarId = "horizontal", loops: int = 1, samples: int = 256, **mounting: Any) -> Radar:
    return _radar(radar, "AWR2243", 78.986e12, 8e6, samples, loops, Mounting(**mounting))


def single_chip_radar(samples: int = 256, loops: int = 1, iq_order: str = "QI", **mounting: Any) -> Radar:
    return _radar("horizontal", "AWR1843", 60e12, 6e6, samples, loops, Mounting(**mounting), iq_order)


def calibrated(radar: Radar, **changes: Any) -> Radar:
    """The radar with another gain, range_shift_bins or reference_range_m."""
    return dataclasses.replace(radar, calibration=dataclasses.replace(radar.calibration, **changes))


def relaid(radar: Radar, layout: Layout) -> Radar:
    """The radar with another I/Q order or number of loops."""
    schedule = dataclasses.replace(radar.schedule, iq_order=layout.iq_order, loops=layout.loops)
    assert schedule.layout == layout
    return dataclasses.replace(radar, schedule=schedule)


def place(range_m: float, angle_deg: float, radar: str = "horizontal") -> list[float]:
    """Point in the plane of a radar's array, rig frame, array at the origin."""
    forward, along = range_m * np.cos(np.radians(angle_deg)), range_m * np.sin(np.radians(angle_deg))
    return [forward, along, 0.0] if radar == "horizontal" else [forward, 0.0, along]


def settled(imager: Imager, frame: RadarFrame, velocity_rig_m_s: Any) -> Heatmap:
    """Heatmap of the first frame at this velocity for which nothing was left to be solved for."""
    for _ in range(MOST_SECTORS + 1):
        before = imager._steering.beam_weights.solved
        heatmap = imager.process(frame, np.array(velocity_rig_m_s))
        if imager._steering.beam_weights.solved == before:
            return heatmap
    raise AssertionError("more frames than sectors")
