# SPDX-License-Identifier: Apache-2.0
"""Steady frames allocate nothing in kernels and keep nothing in Python."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from dsp_radars import cascade_radar, place
from numba import types
from numba.core.runtime import _nrt_python, rtsys

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.dsp.kernels_cfar import mean_peaks
from edge.dsp.kernels_checks import all_zero, dead_channels
from edge.dsp.kernels_detect import drop_sidelobes, refine, strongest
from edge.dsp.kernels_heatmap import set_phasors
from edge.reference.point_targets import make_frame

LARGEST_TEMPORARY_BYTES = 32768
"""Far below any plane of the road: a heatmap has 262,144 bytes."""


@pytest.fixture(params=["ca", "so", "os"])
def road(request):
    radar = cascade_radar(loops=2)
    imager = Imager(radar, HeatmapSettings(), AntennaSettings())
    detector = Detector(radar, CfarSettings(kind=request.param))
    rng = np.random.default_rng(0)
    points = [place(r, a) for r, a in zip(rng.uniform(2, 12, 8), rng.uniform(-40, 40, 8), strict=True)]
    frames = [make_frame(radar, points, 200.0, n, n, noise_lsb=25.0, rng=rng) for n in range(3)]
    velocity = np.array([0.05, 0.1, 0.0])

    def run(count):
        for n in range(count):
            assert len(detector.process(imager.process(frames[n % 3], velocity))) > 0

    run(6)
    return imager, detector, run


def array_arguments(kernel):
    """Arrays a call hands over; Numba counts one small descriptor for each."""
    (signature,) = kernel.nopython_signatures
    return sum(isinstance(argument, types.Array) for argument in signature.args)


def test_kernels_allocate_nothing_beyond_the_descriptors_of_their_arguments(road):
    imager, detector, run = road
    kernels = [
        all_zero,
        dead_channels,
        set_phasors,
        imager._range_kernel,
        imager._row_kernel,
        imager._angle_kernel,
        strongest,
        drop_sidelobes,
        refine,
    ]
    kernels += [detector._rank_peaks] if detector.settings.kind == "os" else [detector._ring_noise, mean_peaks]
    _nrt_python.memsys_enable_stats()
    try:
        before = rtsys.get_allocation_stats()
        run(20)
        after = rtsys.get_allocation_stats()
    finally:
        _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == 20 * sum(array_arguments(kernel) for kernel in kernels)
    assert after.free - before.free == after.alloc - before.alloc


def test_python_keeps_nothing_and_makes_no_large_temporary(road):
    run = road[2]
    tracemalloc.start()
    try:
        run(5)
        start = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        run(30)
        end, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert end - start < 2048
    assert peak - start < LARGEST_TEMPORARY_BYTES
