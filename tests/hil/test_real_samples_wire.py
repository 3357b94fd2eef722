# SPDX-License-Identifier: Apache-2.0
"""A point before two AWR2944: synthesised, sent as real samples over the emulated wire, and found where it stands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from card_rig import CardRig

from edge.dsp.detector import Detector
from edge.dsp.imager import Imager
from edge.frames import RADARS, RadarFrame
from edge.fusion.association import Associator
from edge.rig import Rig, load_rig
from edge.sources.live_cards import CardSource
from train.simulate.front_end import FrontEnd, FrontEndSettings
from train.simulate.scatterers import Scatterers
from train.simulate.supplies import CyclicSupply
from train.simulate.synthesis import Synthesizer

POINT_M = np.array([5.2, 1.1, 0.35])
AMPLITUDE_LSB, NOISE_LSB = 400.0, 25.0
FRAMES = 4


def slow_rig() -> Rig:
    """Frames rare enough for a busy machine."""
    rig = load_rig("awr2944_pair")
    boards = {r: replace(b, schedule=replace(b.schedule, frame_period_s=0.1)) for r, b in rig.radars.items()}
    return replace(rig, radars=boards)


def test_a_point_comes_out_where_it_stands(tmp_path: Path) -> None:
    rig, made = slow_rig(), {}
    for radar in RADARS:
        front_end = FrontEnd(rig.radars[radar], FrontEndSettings.ideal(NOISE_LSB), 1)
        synthesizer, point = Synthesizer(rig.radars[radar]), Scatterers.direct(POINT_M[None, :], AMPLITUDE_LSB)
        made[radar] = [synthesizer.frame(point, front_end, number, number + 1) for number in range(2)]
    with CardRig(rig, tmp_path, supply=CyclicSupply(rig, made)) as cards:
        source = CardSource(
            *(rig, cards.ready().drivers),
            starter=lambda first, second, rearm: (first.start(), second.start()),
            frames=FRAMES,
            watch_offset=False,
        )
        items = list(source)
        assert cards.violations() == []
    found = {}
    for radar in RADARS:
        board = rig.radars[radar]
        frames = [item for item in items if isinstance(item, RadarFrame) and item.radar == radar]
        sent = {frame.adc.tobytes() for frame in made[radar]}
        assert len(frames) == FRAMES
        assert all(frame.adc.tobytes() in sent for frame in frames)
        imager, detector = Imager(board, rig.settings.heatmap, rig.settings.antenna), Detector(board, rig.settings.cfar)
        found[radar] = detector.process(imager.process(frames[0]))
        away_m = POINT_M - np.array(board.mounting.position_m)
        range_m, along = float(np.linalg.norm(away_m)), 1 if radar == "horizontal" else 2
        assert found[radar].range_m[0] == pytest.approx(range_m, abs=5e-3)
        assert found[radar].direction_cosine[0] == pytest.approx(away_m[along] / range_m, abs=5e-3)
    points = Associator(rig).process(found["horizontal"], found["vertical"], np.zeros(3))
    assert np.linalg.norm(points.xyz_m[np.argmax(points.power_db)] - POINT_M) < 0.03
