# SPDX-License-Identifier: Apache-2.0
"""Steady frames of one radar allocate nothing in kernels and keep nothing in Python, whatever becomes of the loops."""

from __future__ import annotations

import numpy as np
import pytest
from allocations import check_kernels, check_python
from dsp_radars import cascade_radar, place

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.reference.point_targets import make_frame

LARGEST_TEMPORARY_BYTES = 32768
"""Far below any plane of the road: a heatmap has 262,144 bytes."""
MOTION = {
    "sum": [0.0, 0.0, 0.0],
    "moved sum": [0.05, 0.1, 0.0],
    "several maps single": [0.0, 0.0, 2.0],
    "steer": [0.0, 3.0, 0.0],
    "fft": [0.5, 3.0, 0.0],
}
"""What is done with the loops -> velocity of the rig."""
KERNELS = {
    "sum": {"set_phasors"},
    "several maps single": {"set_phasors", "keep_strongest", "give_to_owners"},
    "moved sum": {"plan_spreading", "set_turns", "spread"},
    "steer": {"plan_spreading", "set_turns", "spread"},
    "fft": {"doppler_fft", "resolve_folds", "doppler_row", "keep_larger"},
}
"""What is done with the loops -> kernels that only this needs."""
ALWAYS = {"all_zero", "dead_channels", "strongest", "drop_sidelobes", "refine"}


ROADS = [("ca", way) for way in MOTION if way != "sum"] + [("so", "sum"), ("os", "sum")]


@pytest.fixture(params=ROADS, ids=str)
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


def test_kernels_allocate_nothing_beyond_the_descriptors_of_their_arguments(road, monkeypatch):
    way, imager, detector, run = road
    seen = set(check_kernels(run, 20, (imager, detector), monkeypatch))
    assert seen >= ALWAYS | KERNELS[way] | ({"mean_peaks"} if detector.settings.kind != "os" else set())
    assert not seen & (set().union(*KERNELS.values()) - KERNELS[way])


def test_python_keeps_nothing_and_makes_no_large_temporary(road):
    check_python(road[-1], 30, 2048, LARGEST_TEMPORARY_BYTES)
