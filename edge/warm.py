# SPDX-License-Identifier: Apache-2.0
"""Compiles, or loads from Numba's cache, every kernel that a rig's pipeline will call, before the first real frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.frames import Pose, RadarFrame, RadarId
from edge.pipeline import Pipeline, Road
from edge.rig import Rig
from edge.warm_frames import noise_frames

FRAMES = 3
P_FA = 0.05
"""Enough false alarms to have detections, pairs and points."""


def warm_up(rig: Rig, pipeline: Road | None = None) -> dict[str, float]:
    """Run a few frames of noise through a pipeline of their own, then rehearse the one that will be used.

    Args:
        rig: its settings decide which kernels are compiled.
        pipeline: of the rig; its tables are made. None: only the kernels are compiled.
    Returns:
        Stage -> longest time in milliseconds; seconds when a kernel was compiled, a few milliseconds from the cache.
    """
    settings = replace(
        rig.settings,
        cfar=replace(rig.settings.cfar, p_fa=P_FA),
        objects=replace(rig.settings.objects, core_points=1, min_points=1),
    )
    own = Pipeline(replace(rig, settings=settings), None)
    frames: dict[RadarId, RadarFrame] = {}
    for number in range(FRAMES):
        t_ns = (number + 1) * round(1e9 * max(r.schedule.frame_period_s for r in rig.radars.values()))
        own.feed(Pose(t_ns, np.array([0.01 * number, 0.0, rig.geometry.height_m]), np.array([0.0, 0.0, 0.0, 1.0])))
        frames = noise_frames(rig, number, t_ns)
        for frame in frames.values():
            own.feed(frame)
    own.finish()
    if pipeline is not None:
        pipeline.rehearse(frames)
    return {stage: time.max_us / 1e3 for stage, time in own.times.summary().items()}
