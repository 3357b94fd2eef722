# SPDX-License-Identifier: Apache-2.0
"""The benchmark compares like with like: its peer computes what the kernels compute."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.bench.measure import measure
from edge.bench.numpy_peer import NumpyImager, ca_decisions
from edge.commands.bench_command import ca_peaks
from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.frames import RADARS, RadarId
from edge.reference.point_targets import make_frame
from edge.rig import load_rig

RIG = load_rig("cascade_demo")
SCENE = [[4.0, 1.0, 0.2], [6.0, -2.0, 0.4], [9.0, 0.5, 0.0]]


@pytest.mark.parametrize("radar", RADARS)
def test_the_peer_makes_the_same_heatmap_and_detections(radar: RadarId) -> None:
    board, settings = RIG.radars[radar], RIG.settings
    frame = make_frame(board, SCENE, 150.0, 0, 0, noise_lsb=25.0)
    heatmap = Imager(board, settings.heatmap, settings.antenna).process(frame)
    power = NumpyImager(board, settings.heatmap, settings.antenna).process(frame)
    np.testing.assert_allclose(power, heatmap.power, rtol=2e-3, atol=1e-5 * float(power.max()))
    cfar = replace(settings.cfar, kind="ca", p_fa=1e-4)
    detector = Detector(board, cfar)
    first = int(np.searchsorted(heatmap.range_m, cfar.min_range_m))
    ours = detector.decisions(heatmap)
    assert np.mean(ours != ca_decisions(heatmap.power, first, cfar)) < 1e-4
    found, peaks = detector.process(heatmap), ca_peaks(heatmap.power, first, cfar)
    assert abs(len(found) - len(peaks[0])) <= 1
    assert len(found) >= len(SCENE)


def test_every_call_is_timed_equally_often() -> None:
    counts = {"a": 0, "b": 0}

    def call(name: str) -> None:
        counts[name] += 1

    timings = measure({"a": lambda: call("a"), "b": lambda: call("b")}, budget_s=0.0)
    assert counts == {"a": 6, "b": 6}
    assert all(t.repetitions == 5 and t.p99_ms >= t.median_ms for t in timings.values())
