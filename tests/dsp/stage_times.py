# SPDX-License-Identifier: Apache-2.0
"""Print the time of every stage on one cascade loop frame: ``python tests/dsp/stage_times.py [frames]``, one thread."""

from __future__ import annotations

import dataclasses
import sys
import time

import numpy as np
from dsp_radars import cascade_radar

from edge.config import AntennaSettings, CfarSettings, HeatmapSettings
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.dsp.kernels_cfar import mean_peaks
from edge.reference.point_targets import make_frame


def main(count: int) -> None:
    rng = np.random.default_rng(0)
    radar = cascade_radar()
    points = np.c_[rng.uniform(2, 12, 15), rng.uniform(-4, 4, 15), rng.uniform(-1, 1, 15)]
    frame = make_frame(radar, points, rng.uniform(20, 200, 15), 0, 0, noise_lsb=25.0, rng=rng)
    imager = Imager(radar, HeatmapSettings(), AntennaSettings())
    ca, os_, go = (Detector(radar, CfarSettings(kind=kind)) for kind in ("ca", "os", "go"))
    heatmap = imager.process(frame)
    heatmap = dataclasses.replace(heatmap, power=heatmap.power.copy())
    print(f"{len(ca.process(heatmap))} CA detections, {len(os_.process(heatmap))} OS detections")
    adc, power, tables, rank = imager._packed(frame), heatmap.power, ca._tables, os_._tables
    stages = {
        "range": lambda: imager._run_range(adc, 1),
        "imager": lambda: imager.process(frame),
        "imager 1.5 m/s": lambda: imager.process(frame, np.array([0.0, 1.5, 0.0])),
        "imager 3 m/s": lambda: imager.process(frame, np.array([0.0, 3.0, 0.0])),
        "ring mean": lambda: ca._estimate(power),
        "peaks": lambda: mean_peaks(
            *(power, ca._pattern, ca._noise, tables.factor, tables.first, ca._marks, ca._words),
            *(ca._cells, ca._estimates),
        ),
        "detector CA": lambda: ca.process(heatmap),
        "detector GO": lambda: go.process(heatmap),
        "peaks OS": lambda: os_._rank_peaks(
            *(power, os_._pattern, rank.first, rank.factor, rank.allowed, os_._padded, os_._mark),
            *(os_._row, os_._cells),
        ),
        "detector OS": lambda: os_.process(heatmap),
        "imager + CA": lambda: ca.process(imager.process(frame)),
    }
    times = {name: np.empty(count) for name in stages}
    for n in range(count):
        for name, stage in stages.items():
            start = time.thread_time()
            stage()
            times[name][n] = time.thread_time() - start
    for name, spent in times.items():
        print(f"{name:14s} median {1e3 * np.median(spent):.3f} ms, fastest {1e3 * spent.min():.3f} ms")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
