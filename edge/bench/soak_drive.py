# SPDX-License-Identifier: Apache-2.0
"""The drive of the endurance run: past one car at the rig's own frame rate, simulated once and cached."""

from __future__ import annotations

from pathlib import Path

from edge.commands.demo_scene import demo_object, demo_recording
from edge.reference.drive_by import DriveBy
from edge.rig import Rig

PAIRS = 180
SPEED_M_S = 2.0
"""Three seconds, six metres: a window of three metres is full after half of it."""


def soak_recording(rig: Rig) -> Path:
    """Path of the recording; made when it is not in the cache.

    Args:
        rig: two radars.
    Raises:
        CaptureError: the cache cannot be written.
    """
    period_s = max(radar.schedule.frame_period_s_actual for radar in rig.radars.values())
    return demo_recording(rig, demo_object(), DriveBy(frames=PAIRS, frame_period_s=period_s, speed_m_s=SPEED_M_S))
