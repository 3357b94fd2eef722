# SPDX-License-Identifier: Apache-2.0
"""What a whole drive-by costs, stage by stage, the edge pipeline included: CPU time and memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from edge.frames import RADARS
from edge.pipeline import Pipeline
from edge.rig import load_rig
from edge.timing import StageTimes
from train.objects.reference import ObjectRef
from train.simulate.bench import Case, framing, resident_mb
from train.simulate.cloud import Windows
from train.simulate.drive_by import DriveBy
from train.simulate.scene import make_scene
from train.simulate.settings import SceneSettings, SimulationSettings, TrackSettings
from train.simulate.stages import SharedStages
from train.simulate.street import make_street

if TYPE_CHECKING:
    from edge.rig import Rig
    from train.objects.mesh import Mesh
    from train.simulate.surface import Placed

DEMO = "cascade_demo"
"""Rig with one loop, of which data sets are made."""
FRAMES, TRAVEL_M = 300, 3.0
DRIVE_GOAL_MS, LIVE_GOAL_MS = 4000.0, 6.0
TARGET = ObjectRef("car", "parametric_00012")
LIVE_SCATTERERS, LIVE_SPEED_M_S = 600, 1.5
MEMORY_DRIVES, WARM_DRIVES = 6, 3


class CpuTimes(StageTimes):
    """CPU time of the calling thread instead of the wall clock's.

    Attributes:
        total_ms: stage -> all its measurements.
        calls: stage -> how many.
    """

    def __init__(self) -> None:
        super().__init__()
        self.total_ms: dict[str, float] = {}
        self.calls: dict[str, int] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Time the body as one measurement of ``stage``."""
        start_ns = time.thread_time_ns()
        yield
        self.total_ms[stage] = self.total_ms.get(stage, 0.0) + (time.thread_time_ns() - start_ns) / 1e6
        self.calls[stage] = self.calls.get(stage, 0) + 1


@dataclass(slots=True)
class Bench:
    """Drive-bys of one rig past one object, a new one with every call.

    Args:
        rig: how it is driven past.
        every: only each n-th frame.
        neighbours: objects beside the target.
    """

    rig: Rig
    every: int = 1
    neighbours: int = 1
    mesh: Mesh | None = None
    stages: SharedStages | None = None
    seed: int = 0

    def drive(self) -> DriveBy:
        """The next drive-by: scene, surfaces, front ends."""
        self.seed += 1
        self.mesh, self.stages = self.mesh or TARGET.mesh(), self.stages or SharedStages()
        schedule = self.rig.radars["horizontal"].schedule
        duration_s = FRAMES * schedule.frame_period_s
        scene = SceneSettings(side_m=4.0, yaw_deg=20.0, neighbours=self.neighbours)
        track = TrackSettings(frames=FRAMES, every=self.every, speed_m_s=TRAVEL_M / duration_s)
        settings = SimulationSettings(track=track, scene=scene)
        placed = self._place(settings, duration_s)
        return DriveBy(self.rig, placed, settings, self.seed, self.stages.synthesizers(self.rig))

    def _place(self, settings: SimulationSettings, duration_s: float) -> list[Placed]:
        assert self.mesh is not None
        wavelength_m = float(self.rig.radars["horizontal"].schedule.profile.wavelength_m)
        return make_scene(
            self.mesh, settings.scene, settings.surface, TRAVEL_M, duration_s, wavelength_m, self.seed % 2
        )

    def run(self, times: CpuTimes | None = None) -> int:
        """One drive-by through the whole pipeline; returns its windows."""
        with times.measure("scene") if times else _nothing():
            drive = self.drive()
        assert self.stages is not None
        windows = Windows()
        pipeline = Pipeline(drive.rig, None, [windows], self.stages.imaging(drive.rig))
        if times is not None:
            drive.times = pipeline.times = times
        for item in drive:
            pipeline.feed(item)
        pipeline.finish()
        return len(windows.results)


@contextmanager
def _nothing() -> Iterator[None]:
    yield


def drive_cases(rig: Rig) -> list[Case]:
    """Whole drive-bys with one loop, then with the rig's own loops; what the live source makes sixty times a second."""
    demo = load_rig(DEMO)
    loops = rig.radars["horizontal"].schedule.loops
    return [
        Case(f"drive-by of {FRAMES} frames through the pipeline, one loop", Bench(demo).run, DRIVE_GOAL_MS),
        Case("the same, every third frame", Bench(demo, every=3).run),
        Case(f"the same, every third frame, {loops} loops", Bench(rig, every=3).run),
        Case(
            f"{LIVE_SCATTERERS} scatterers at {LIVE_SPEED_M_S:g} m/s, both radars, {loops} loops",
            framing(list(rig.radars.values()), LIVE_SCATTERERS, LIVE_SPEED_M_S),
            LIVE_GOAL_MS,
        ),
        Case("a pair of frames of the street, one loop", supplying(demo)),
        Case(f"a pair of frames of the street, {loops} loops", supplying(rig)),
    ]


def supplying(rig: Rig) -> Callable[[], object]:
    """Call that makes the next frame of both radars: optics, synthesis, front end; neighbouring frames as they come."""
    drive = make_street(rig).drive
    number = 0

    def call() -> None:
        nonlocal number
        for radar in RADARS:
            drive.frame(radar, number)
        number = (number + 1) % drive.frames

    return call


def drive_stages(every: int) -> list[dict[str, Any]]:
    """CPU time of every stage of a drive-by with one loop: calls, milliseconds of one call, of all."""
    bench = Bench(load_rig(DEMO), every=every)
    bench.run()
    times = CpuTimes()
    begin_ns = time.thread_time_ns()
    bench.run(times)
    whole_ms = (time.thread_time_ns() - begin_ns) / 1e6
    rows = [
        {"stage": stage, "calls": times.calls[stage], "call_ms": total / times.calls[stage], "total_ms": total}
        for stage, total in times.total_ms.items()
    ]
    rest_ms = whole_ms - sum(times.total_ms.values())
    rows.append({"stage": "all else", "calls": 1, "call_ms": rest_ms, "total_ms": rest_ms})
    return [*rows, {"stage": "together", "calls": 1, "call_ms": whole_ms, "total_ms": whole_ms}]


def drive_memory() -> dict[str, Any]:
    """Resident memory before and after several drive-bys, every one with new frames, calibrations and scenes."""
    bench = Bench(load_rig(DEMO), every=3)
    for _ in range(WARM_DRIVES):
        bench.run()
    before_mb = resident_mb()
    for _ in range(MEMORY_DRIVES):
        bench.run()
    return {"drives": MEMORY_DRIVES, "before_mb": before_mb, "after_mb": resident_mb()}


def drive_report(rig: Rig) -> dict[str, Any]:
    """Stages of a drive-by of all frames and of every third, memory over several, size of the live source's bursts."""
    stages = {"stages": drive_stages(1), "third": drive_stages(3)}
    return {"frames": FRAMES, "scatterers": scatterers_of(rig), "memory": drive_memory(), **stages}


def scatterers_of(rig: Rig) -> float:
    """Mean number of scatterers of a radar's burst in ``supplying``."""
    drive = make_street(rig).drive
    counts = [len(drive.scatterers(radar, number)[0]) for number in range(0, drive.frames, 30) for radar in RADARS]
    return float(np.mean(counts))
