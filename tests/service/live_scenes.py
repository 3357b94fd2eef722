# SPDX-License-Identifier: Apache-2.0
"""A rig whose imagers are stand-ins that can be slow, fail or hang, its frames and poses, and sinks that keep all."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.frames import RADARS, Detections, Float32, Heatmap, ObjectCloud, Pose, RadarFrame, RadarId, Shape
from edge.pipeline import FrameResult, WindowResult
from edge.rig import Rig, load_rig
from edge.service.live import LivePipeline
from edge.sources.base import Loss

RIG = load_rig("cascade_demo")
LAYOUT = RIG.radars["horizontal"].schedule.layout
ADC = np.ones(LAYOUT.shape, np.int16)
PERIOD_NS, T0_NS, SPEED_M_S = 16_666_700, 5_000_000_000, 3.0
HALF = np.sqrt(0.5)
POWER = np.ones((4, 6), np.float32)
SPOTS = 40
"""Points of the one object that the stand-ins see."""

NOTHING_LOST: dict[str, dict[str, int]] = {radar: {} for radar in RADARS}

Item = RadarFrame | Pose | Loss
Meddle = Callable[[RadarId, int], None]
"""Called by the stand-in imager for every frame: sleeps, raises, or does nothing."""


def nothing(radar: RadarId, number: int) -> None:
    """No trouble."""


def frame(radar: RadarId, number: int, t_ns: int | None = None) -> RadarFrame:
    due_ns = T0_NS + number * PERIOD_NS + (radar == "vertical") * (PERIOD_NS // 2)
    return RadarFrame(radar, number, due_ns if t_ns is None else t_ns, ADC, LAYOUT)


def pose_at(t_ns: int, speed_m_s: float = SPEED_M_S) -> Pose:
    travel_m = speed_m_s * (t_ns - T0_NS) / 1e9
    return Pose(t_ns, np.array([travel_m, 0.0, RIG.geometry.height_m]), np.array([0.0, 0.0, HALF, HALF]))


def drive(frames: int, first: int = 0) -> list[Item]:
    """Frames of both radars and a pose every half period, in order of time."""
    items: list[Item] = [pose_at(T0_NS + (2 * first - 1) * PERIOD_NS // 2)]
    for number in range(first, first + frames):
        items += [pose_at(T0_NS + number * PERIOD_NS), frame("horizontal", number)]
        items += [pose_at(T0_NS + number * PERIOD_NS + PERIOD_NS // 2), frame("vertical", number)]
    return [*items, pose_at(T0_NS + (first + frames) * PERIOD_NS)]


def stand_ins(meddle: Meddle = nothing) -> dict[RadarId, tuple[Imager, Detector]]:
    """Imagers that give an empty heatmap, detectors that see a block of spots three to four metres away."""

    class StandInImager:
        last_report = SimpleNamespace(dead=())

        def __init__(self, radar: RadarId) -> None:
            self.radar = radar

        def process(self, item: RadarFrame, velocity_m_s: Any = None) -> Heatmap:
            meddle(self.radar, item.number)
            axis: Float32 = np.arange(6, dtype=np.float32)
            return Heatmap(self.radar, item.number, item.t_first_chirp_ns, POWER, axis[:4], axis)

    class StandInDetector:
        def process(self, heatmap: Heatmap) -> Detections:
            range_m = 3.0 + 0.3 * np.arange(5, dtype=np.float32)
            level = -10.0 * np.arange(5, dtype=np.float32)
            cosine, zero = np.zeros(5, np.float32), np.zeros(5, np.float32)
            return Detections(
                *(heatmap.radar, heatmap.number, heatmap.t_first_chirp_ns),
                *(range_m, cosine, level, np.full(5, np.nan, np.float32), zero + 20.0),
            )

    made: dict[RadarId, Any] = {radar: (StandInImager(radar), StandInDetector()) for radar in RADARS}
    return made


@dataclass
class StandInModel:
    """Completes everything at once, unless ``meddle`` raises or sleeps."""

    meddle: Callable[[ObjectCloud], None] = lambda cloud: None
    asked: list[ObjectCloud] = field(default_factory=list)

    def complete(self, cloud: ObjectCloud) -> Shape | None:
        self.asked.append(cloud)
        self.meddle(cloud)
        names = {"car": 0.9, "unknown": 0.1}
        return Shape(cloud.identity, "car", names, 0.9, cloud.xyz_m, cloud.xyz_m[:1], cloud, "0123456789abcdef")


class LiveKeep:
    """A sink that keeps everything; thread-safe by the GIL."""

    def __init__(self) -> None:
        self.frames: list[FrameResult] = []
        self.windows: list[WindowResult] = []
        self.shapes: list[Shape] = []

    def frame(self, result: FrameResult) -> None:
        self.frames.append(result)

    def window(self, result: WindowResult) -> None:
        self.windows.append(result)

    def shape(self, shape: Shape) -> None:
        self.shapes.append(shape)


def live(
    meddle: Meddle = nothing, model: Any = None, sinks: Any = (), rig: Rig = RIG, **options: Any
) -> tuple[LivePipeline, LiveKeep]:
    """A live pipeline on stand-ins, with few points enough for an object."""
    keep = LiveKeep()
    settings_ = replace(rig.settings, objects=replace(rig.settings.objects, core_points=1, min_points=2))
    made = {radar: pair for radar, pair in stand_ins(meddle).items() if radar in rig.radars}
    road = LivePipeline(replace(rig, settings=settings_), model, [*sinks, keep], imaging=made, **options)
    return road, keep


def wait_until(true: Callable[[], bool], seconds: float = 60.0) -> bool:
    """Whether it became true within so long."""
    end_s = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.005)
    return True


def feed_patiently(road: LivePipeline, items: list[Item]) -> None:
    """As a source that keeps to the pipeline's pace."""
    for item in items:
        road.book.wait_below(6, 60.0)
        road.feed(item)


def balanced(road: LivePipeline) -> dict[str, dict[str, int]]:
    """Radar -> cause -> count, after the account of every radar was checked."""
    found: dict[str, dict[str, int]] = {}
    for radar, ledger in road.ledgers.items():
        account = ledger.snapshot()
        assert account.frames_in == account.frames_ok + sum(account.lost.values())
        found[radar] = {cause.value: count for cause, count in account.lost.items()}
    return found


def threads_of(road: LivePipeline) -> list[str]:
    """Names of its threads that still run."""
    stages = {id(stage) for stage in road.stages}
    return [thread.name for thread in threading.enumerate() if id(thread) in stages]
