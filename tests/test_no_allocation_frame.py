# SPDX-License-Identifier: Apache-2.0
"""A steady two-radar frame, raw int16 to fused points, allocates nothing in kernels and keeps nothing in Python."""

from __future__ import annotations

import numpy as np
import pytest
from allocations import Run, check_kernels, check_python

from edge.bench.cases import Road, Scene
from edge.config import CfarKind, DopplerChoice, FusionSettings
from edge.frames import PointCloud, Pose
from edge.fusion.temporal import TemporalFusion
from edge.rig import load_rig

LARGEST_TEMPORARY_BYTES = 65536
"""A quarter of one heatmap; what is handed to the caller is far smaller."""
VELOCITY_M_S = np.array([0.05, 0.5, 0.0])
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def drive(loops: int, kind: CfarKind, doppler: DopplerChoice) -> tuple[Road, Run]:
    """A road and a call that sends frames along it; no window of travel ends meanwhile."""
    scene = Scene(load_rig("cascade_demo"), loops, VELOCITY_M_S)
    road, fusion = Road(scene, kind, doppler), TemporalFusion(FusionSettings(travel_m=1000.0, max_time_s=1000.0))
    clock = iter(range(1, 10**6))

    def run(count: int) -> None:
        for _ in range(count):
            step = next(clock)
            cloud = road()
            assert len(cloud) > 0
            t_ns = step * 16_666_667
            moved = PointCloud(
                step, t_ns, cloud.xyz_m, cloud.power_db, cloud.range_horizontal_m, cloud.range_vertical_m
            )
            assert fusion.add(moved, Pose(t_ns, VELOCITY_M_S * (t_ns / 1e9), UPRIGHT)) is None

    run(4)
    return road, run


@pytest.mark.parametrize(
    ("loops", "kind", "doppler"), [(1, "ca", "sum"), (1, "os", "sum"), (2, "so", "steer"), (2, "ca", "fft")]
)
def test_kernels_allocate_nothing_beyond_the_descriptors_of_their_arguments(
    loops: int, kind: CfarKind, doppler: DopplerChoice, monkeypatch: pytest.MonkeyPatch
) -> None:
    road, run = drive(loops, kind, doppler)
    stages = (*road.imagers.values(), *road.detectors.values(), road.associator)
    seen = check_kernels(run, 5, stages, monkeypatch)
    assert len(seen) >= 10, seen
    assert {"solve", "store", "strongest"} <= set(seen)


@pytest.mark.parametrize("kind", ["ca", "os"])
def test_python_keeps_nothing_and_makes_no_large_temporary(kind: CfarKind) -> None:
    _, run = drive(1, kind, "sum")
    check_python(run, 20, 4096, LARGEST_TEMPORARY_BYTES)
