# SPDX-License-Identifier: Apache-2.0
"""Frames of noise to warm up with."""

from __future__ import annotations

import numpy as np

from edge.frames import RadarFrame, RadarId
from edge.rig import Rig

CODES = 64
"""Size of the noise, in ADC codes."""


def noise_frames(rig: Rig, number: int, t_ns: int) -> dict[RadarId, RadarFrame]:
    """One frame of uniform noise for every radar of the rig, the same for the same number."""
    rng = np.random.default_rng(number)
    layouts = {radar: board.schedule.layout for radar, board in rig.radars.items()}
    return {
        radar: RadarFrame(radar, number, t_ns, rng.integers(-CODES, CODES, layout.shape, dtype=np.int16), layout)
        for radar, layout in layouts.items()
    }
