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
from edge.dsp.kernels_doppler import (
    doppler_fft,
    doppler_row,
    keep_larger,
    plan_spreading,
    resolve_folds,
    set_turns,
    spread,
)
from edge.dsp.kernels_heatmap import set_phasors
from edge.reference.point_targets import make_frame

LARGEST_TEMPORARY_BYTES = 32768
"""Far below any plane of the road: a heatmap has 262,144 bytes."""


MOTION = {"sum": [0.0, 0.0, 0.0], "moved sum": [0.05, 0.1, 0.0], "steer": [0.0, 3.0, 0.0], "fft": [0.5, 3.0, 0.0]}
"""What is done with the loops -> velocity of the rig."""


@pytest.fixture(params=[("ca", "moved sum"), ("so", "sum"), ("os", "sum"), ("ca", "steer"), ("ca", "fft")])
def road(request):
    kind, way = request.param
    radar = cascade_radar(loops=2)
    imager = Imager(radar, HeatmapSettings(doppler=way.split()[-1]), AntennaSettings())
    detector = Detector(radar, CfarSettings(kind=kind))
    rng = np.random.default_rng(0)
    points = [place(r, a) for r, a in zip(rng.uniform(2, 12, 8), rng.uniform(-40, 40, 8), strict=True)]
    frames = [make_frame(radar, points, 200.0, n, n, noise_lsb=25.0, rng=rng) for n in range(3)]
    velocity = np.array(MOTION[way])

    def run(count):
        for n in range(count):
            assert len(detector.process(imager.process(frames[n % 3], velocity))) > 0

    run(6)
    return way, imager, detector, run


def motion_kernels(way, imager):
    """Kernels between the range FFT and the power of one frame of two loops, in one sector."""
    steering, doppler = imager._steering, imager._doppler
    steered = [plan_spreading, set_turns, spread, steering._angle_kernels[0]]
    by_bin = [resolve_folds, doppler_row, doppler._angle_kernel, keep_larger]
    return {
        "sum": [set_phasors, imager._row_kernel, imager._angle_kernel],
        "moved sum": [imager._channel_kernel, *steered],
        "steer": [imager._range_kernel, *2 * [imager._channel_kernel], *steered],
        "fft": [imager._range_kernel, *2 * [imager._channel_kernel], doppler_fft, *2 * by_bin],
    }[way]


def array_arguments(kernel):
    """Arrays a call hands over; Numba counts one small descriptor for each."""
    (signature,) = kernel.nopython_signatures
    return sum(isinstance(argument, types.Array) for argument in signature.args)


def test_kernels_allocate_nothing_beyond_the_descriptors_of_their_arguments(road):
    way, imager, detector, run = road
    kernels = [all_zero, dead_channels, imager._range_kernel, strongest, drop_sidelobes, refine]
    kernels += motion_kernels(way, imager)
    ranks = detector.settings.kind == "os"
    kernels += [detector._rank_peaks, detector._rank_noise] if ranks else [detector._ring_noise, mean_peaks]
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
    run = road[-1]
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
