# SPDX-License-Identifier: Apache-2.0
"""Draws: inside their ranges over many seeds, reproducible, and independent of each other's ranges."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.rig_toml import Place, fill
from train.simulate.randomise import FRAME_PERIOD_S, Ranges, draw

SEEDS = range(300)


def test_same_seed_same_settings_and_other_seeds_differ() -> None:
    assert draw(Ranges(), 7) == draw(Ranges(), 7)
    assert draw(Ranges(), 7) != draw(Ranges(), 8)
    assert draw(Ranges(), 2**63 - 1).track.frames >= 300


def test_a_changed_range_moves_no_other_value() -> None:
    plain, changed = draw(Ranges(), 5), draw(Ranges(side_m=(20.0, 21.0), neighbours=(3, 3)), 5)
    assert changed.scene.side_m >= 20.0
    assert replace(changed.scene, side_m=plain.scene.side_m, neighbours=plain.scene.neighbours) == plain.scene
    assert replace(changed, scene=plain.scene) == plain


def test_draws_fill_their_ranges_and_stay_inside() -> None:
    ranges = Ranges()
    drawn = [draw(ranges, seed) for seed in SEEDS]
    for name, values in {
        "side_m": [d.scene.side_m for d in drawn],
        "height_m": [d.track.height_m for d in drawn],
        "noise_lsb": [d.front_end.noise_lsb for d in drawn],
        "clutter_db": [d.optics.ground.clutter_db for d in drawn],
        "walk_m": [d.odometry.walk_m for d in drawn],
        "frames": [d.track.frames for d in drawn],
        "mounting_deg": np.ravel([d.odometry.mounting_deg for d in drawn]),
    }.items():
        low, high = getattr(ranges, name)
        assert low <= min(values) < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < max(values) <= high
    travel_m = [d.track.speed_m_s * d.track.frames * FRAME_PERIOD_S for d in drawn]
    assert min(travel_m) >= 2.0 - 1e-9
    assert max(travel_m) <= 4.0 + 1e-9
    walls = np.mean([d.scene.wall_m > 0 for d in drawn])
    assert walls == pytest.approx(ranges.wall_share, abs=3.5 * np.sqrt(0.3 * 0.7 / len(SEEDS)))
    assert {d.scene.neighbours for d in drawn} == {0, 1, 2}
    assert {d.processing.window for d in drawn} == {"taylor", "hann"}


def test_faults_that_nobody_measured_are_drawn_when_asked_for() -> None:
    names = ("start_jitter", "second_harmonic", "phase_noise", "iq_image")
    plain = [draw(Ranges(), seed).front_end for seed in range(50)]
    assert not any(f.start_jitter_s or f.second_harmonic_dbc or f.phase_noise_dbc_hz or f.iq_image_db for f in plain)
    always = [draw(Ranges(**{f"{name}_share": 1.0 for name in names}), seed).front_end for seed in range(50)]  # type: ignore[arg-type]
    for key in ("start_jitter_s", "second_harmonic_dbc", "phase_noise_dbc_hz", "iq_image_db"):
        low, high = getattr(Ranges(), key)
        values = [getattr(front_end, key) for front_end in always]
        assert low <= min(values) < max(values) <= high
    half = [draw(Ranges(iq_image_share=0.5), seed).front_end for seed in SEEDS]
    assert np.mean([f.iq_image_db is not None for f in half]) == pytest.approx(0.5, abs=3.5 * 0.5 / np.sqrt(len(SEEDS)))


def test_speed_is_kept_inside_its_range() -> None:
    drawn = [draw(Ranges(frames=(10, 600)), seed).track for seed in SEEDS]
    assert min(t.speed_m_s for t in drawn) >= 0.3
    assert max(t.speed_m_s for t in drawn) == 1.5


def test_ranges_are_read_from_a_table_and_can_be_hashed_as_json() -> None:
    ranges = fill(Ranges, {"side_m": [3.0, 5.0], "windows": ["hann"], "frames": [60, 360]}, Place(Path("r.toml")))
    assert (ranges.side_m, ranges.windows, ranges.frames) == ((3.0, 5.0), ("hann",), (60, 360))
    assert json.loads(json.dumps(asdict(ranges)))["frames"] == [60, 360]
    with pytest.raises(ConfigError, match="side_m"):
        Ranges(side_m=(5.0, 3.0))
    with pytest.raises(ConfigError, match="wall_share"):
        Ranges(wall_share=1.5)
