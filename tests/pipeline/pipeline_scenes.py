# SPDX-License-Identifier: Apache-2.0
"""A few point scatterers beside a moving rig as raw frames and poses in time order; a sink that keeps everything."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from edge.frames import RADARS, Detections, Float64, Pose, RadarFrame, RadarId
from edge.odometry.transforms import rotation_matrix
from edge.pipeline import FrameResult, Pipeline, WindowResult
from edge.reference.point_targets import make_frame
from edge.rig import load_rig
from edge.sources.base import Loss

RIG = load_rig("cascade_demo")
PERIOD_NS = round(1e9 * RIG.radars["horizontal"].schedule.frame_period_s)
T0_NS = 5_000_000_000
SPEED_M_S = 3.0
HALF = np.sqrt(0.5)
LOOKING_LEFT = np.array([0.0, 0.0, HALF, HALF])
TRUTH_ODOM_M = np.array([[0.2, 3.0, 0.5], [-0.7, 4.1, 1.1], [1.0, 5.2, 0.3], [0.4, 6.5, 1.6], [0.0, 8.0, 0.9]])
AMPLITUDE_LSB = 3.0
"""Weak: the window's sidelobes stay below the noise, so that nearly all detections are targets."""
NOISE_LSB = 20.0

Item = RadarFrame | Pose | Loss


def pose_at(t_ns: int) -> Pose:
    """The rig drives along x and looks along y, 0.8 m above the ground."""
    return Pose(t_ns, np.array([SPEED_M_S * (t_ns - T0_NS) / 1e9, 0.0, RIG.geometry.height_m]), LOOKING_LEFT.copy())


def scene_poses(frames: int, step_ns: int = PERIOD_NS // 2) -> list[Pose]:
    return [pose_at(t) for t in range(T0_NS - 2 * step_ns, T0_NS + frames * PERIOD_NS + 3 * step_ns, step_ns)]


def scene_frame(radar: RadarId, number: int, truth_odom_m: Float64 = TRUTH_ODOM_M) -> RadarFrame:
    t_ns = T0_NS + number * PERIOD_NS + (radar == "vertical") * (PERIOD_NS // 2)
    pose = pose_at(t_ns)
    rotation = rotation_matrix(pose.quaternion_xyzw)
    seen_m = (truth_odom_m - pose.position_m) @ rotation
    velocity = rotation.T @ np.array([SPEED_M_S, 0.0, 0.0])
    rng = np.random.default_rng((number, radar == "vertical"))
    board = RIG.radars[radar]
    return make_frame(board, seen_m, AMPLITUDE_LSB, number, t_ns, velocity, noise_lsb=NOISE_LSB, rng=rng)


def in_time_order(*parts: Iterable[Item]) -> list[Item]:
    return list(heapq.merge(*parts, key=instant))


def instant(item: Item) -> int:
    return item.t_first_chirp_ns if isinstance(item, RadarFrame) else item.t_ns


class Keep:
    """A sink that keeps copies of all results."""

    def __init__(self) -> None:
        self.frames: list[FrameResult] = []
        self.windows: list[WindowResult] = []

    def frame(self, result: FrameResult) -> None:
        copies = {r: replace(h, power=h.power.copy()) for r, h in result.heatmaps.items()}
        self.frames.append(replace(result, heatmaps=copies))

    def window(self, result: WindowResult) -> None:
        self.windows.append(result)


def run(items: Iterable[Item], pipeline: Pipeline | None = None) -> tuple[Pipeline, Keep]:
    """Feed everything, finish, check that every frame is accounted for."""
    keep = Keep()
    pipeline = pipeline if pipeline is not None else Pipeline(RIG, None)
    pipeline.sinks.append(keep)
    for item in items:
        pipeline.feed(item)
    finish(pipeline, keep)
    return pipeline, keep


def finish(pipeline: Pipeline, keep: Keep) -> None:
    """The end of the source; afterwards every frame is accounted for, and results are as many as the account says."""
    pipeline.finish()
    for radar, ledger in pipeline.ledgers.items():
        account = ledger.snapshot()
        assert account.frames_in == account.frames_ok + sum(account.lost.values())
        assert account.frames_ok == sum(radar in result.detections for result in keep.frames)


def lost(pipeline: Pipeline) -> dict[str, dict[str, int]]:
    """Radar -> cause -> count, without radars that lost nothing."""
    accounts = {r: {c.value: n for c, n in x.snapshot().lost.items()} for r, x in pipeline.ledgers.items()}
    return {radar: causes for radar, causes in accounts.items() if causes}


def columns(detections: Sequence[Detections]) -> bytes:
    """All numbers of detections, bit for bit."""
    parts = [(d.range_m, d.direction_cosine, d.power_db, d.snr_db) for d in detections]
    return b"".join(column.tobytes() for part in parts for column in part)


def frames_of(count: int) -> dict[RadarId, list[RadarFrame]]:
    return {radar: [scene_frame(radar, number) for number in range(count)] for radar in RADARS}
