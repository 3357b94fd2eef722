# SPDX-License-Identifier: Apache-2.0
"""A steady two-radar frame, raw int16 to fused points, allocates nothing in kernels and keeps nothing in Python."""

from __future__ import annotations

import importlib
import pkgutil
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import _nrt_python, rtsys

import edge.dsp
import edge.fusion
from edge.bench.cases import Road, Scene
from edge.config import CfarKind, DopplerChoice, FusionSettings
from edge.frames import PointCloud, Pose
from edge.fusion.temporal import TemporalFusion
from edge.rig import load_rig

LARGEST_TEMPORARY_BYTES = 65536
"""A quarter of one heatmap; what is handed to the caller is far smaller."""
VELOCITY_M_S = np.array([0.05, 0.5, 0.0])
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
Run = Callable[[int], None]


def arrays_in(arguments: tuple[Any, ...]) -> int:
    """Arrays a call hands over; Numba allocates and frees one small descriptor for each."""
    return sum(arrays_in(a) if isinstance(a, tuple) else isinstance(a, np.ndarray) for a in arguments)


def count_calls(owner: Any, patch: pytest.MonkeyPatch, seen: Counter[str]) -> None:
    """Replace the compiled kernels that a module or stage holds by ones that count the arrays they are given."""

    def counting(kernel: Dispatcher) -> Callable[..., Any]:
        def counted(*arguments: Any) -> Any:
            seen[kernel.__name__] += arrays_in(arguments)
            return kernel(*arguments)

        return counted

    for name, value in list(vars(owner).items()):
        if isinstance(value, Dispatcher):
            patch.setattr(owner, name, counting(value))
        elif isinstance(value, list) and any(isinstance(entry, Dispatcher) for entry in value):
            patch.setattr(owner, name, [counting(entry) for entry in value])


def modules() -> Iterator[Any]:
    for package in (edge.dsp, edge.fusion):
        for entry in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
            yield importlib.import_module(entry.name)


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
    seen: Counter[str] = Counter()
    for module in modules():
        count_calls(module, monkeypatch, seen)
    for stage in (*road.imagers.values(), *road.detectors.values(), road.associator):
        for part in (stage, *vars(stage).values()):
            if type(part).__module__.startswith(("edge.dsp", "edge.fusion")) and hasattr(part, "__dict__"):
                count_calls(part, monkeypatch, seen)
    _nrt_python.memsys_enable_stats()
    try:
        before = rtsys.get_allocation_stats()
        run(5)
        after = rtsys.get_allocation_stats()
    finally:
        _nrt_python.memsys_disable_stats()
    assert len(seen) >= 10, seen
    assert {"solve", "store", "strongest"} <= set(seen)
    assert after.alloc - before.alloc == seen.total()
    assert after.free - before.free == after.alloc - before.alloc


@pytest.mark.parametrize("kind", ["ca", "os"])
def test_python_keeps_nothing_and_makes_no_large_temporary(kind: CfarKind) -> None:
    _, run = drive(1, kind, "sum")
    tracemalloc.start()
    try:
        run(3)
        start = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        run(20)
        end, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert end - start < 4096
    assert peak - start < LARGEST_TEMPORARY_BYTES
