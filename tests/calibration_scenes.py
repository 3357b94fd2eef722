# SPDX-License-Identifier: Apache-2.0
"""Simulated corner-reflector captures with known mismatch, for the calibration tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from edge.calibration_capture import CaptureAverager, CaptureMean
from edge.frames import RadarFrame, RadarId
from edge.reference.point_targets import make_frame, pack, unpack
from edge.rig import Radar, Rig, load_rig

RIG = load_rig("cascade_demo")
NOISE_LSB = 20.0
AMPLITUDE = 800.0


def radar(loops: int = 2, which: RadarId = "horizontal") -> Radar:
    one = RIG.radars[which]
    return replace(one, schedule=replace(one.schedule, loops=loops, frame_period_s=0.1))


def rig(loops: int = 2) -> Rig:
    return replace(RIG, radars={which: radar(loops, which) for which in RIG.radars})


def mismatch(seed: int, shape: tuple[int, int] = (12, 16), coupling_deg: float = 0.0) -> tuple[Any, Any]:
    """Gain and shift of transmitters times receivers; phases separable in the middle of the chirp, plus coupling."""
    rng = np.random.default_rng(seed)
    level_db, angle, shift = (rng.uniform(-a, a, shape[0])[:, None] + rng.uniform(-a, a, shape[1]) for a in (1, 3, 0.3))
    angle = angle + np.radians(coupling_deg) * rng.standard_normal(shape)
    return 10 ** (level_db / 20) * np.exp(1j * (angle - np.pi * shift)), shift


def at(board: Radar, range_m: float, angle_deg: float = 0.0) -> Any:
    turn = np.radians(angle_deg)
    along = [0.0, np.sin(turn), 0.0] if board.radar == "horizontal" else [0.0, 0.0, np.sin(turn)]
    return np.asarray(board.mounting.position_m) + range_m * (np.array([np.cos(turn), 0.0, 0.0]) + along)


def capture(board: Radar, points: Any, amplitude: Any, seed: int = 0, **options: Any) -> RadarFrame:
    options = {"noise_lsb": NOISE_LSB, "rng": np.random.default_rng(seed), **options}
    return make_frame(board, points, amplitude, options.pop("number", 0), 0, **options)


def altered(frame: RadarFrame, change: Any) -> RadarFrame:
    """The frame with its complex samples [loops, slots, receivers, sample] changed."""
    samples = unpack(frame.adc, frame.layout)
    return replace(frame, adc=pack(change(samples), frame.layout))


def averaged(board: Radar, frames: list[RadarFrame], range_m: float, search_m: float = 0.3) -> CaptureMean:
    bin_m = board.schedule.profile.range_bin_m
    averager = CaptureAverager(board.schedule, range_m / bin_m, search_m / bin_m)
    for frame in frames:
        averager.add(frame)
    return averager.mean()
