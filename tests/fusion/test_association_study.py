# SPDX-License-Identifier: Apache-2.0
"""The association study: its measures on hand-made cases, its scenes' truth, and that the default earns its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.bench.studies.association import PRODUCTION, Score, alternatives, greedy, production, renewed, scored, sure
from edge.bench.studies.association_scenes import LEVELS, RAWS, Level, detection_scene, person, raw_scenes
from edge.config import HeatmapSettings
from edge.rig import load_rig

RIG = load_rig("cascade_demo")


def test_score_counts_right_points_and_found_reflectors() -> None:
    truth = np.array([[0.0, 0, 0], [5.0, 0, 0], [9.0, 0, 0]])
    score = Score()
    score.add(np.array([[0.05, 0, 0], [5.15, 0, 0], [7.0, 0, 0]]), truth, np.array([True, True, True]))
    score.add(np.zeros((0, 3)), truth, np.array([True, False, False]))
    assert (score.frames, score.points, score.near, score.far, score.found, score.sought) == (2, 3, 1, 2, 2, 4)
    assert score.precision == (1 / 3, 2 / 3)
    assert (score.recall, score.per_frame) == (0.5, 1.5)


def test_tables_of_a_document_are_renewed_by_their_first_heading() -> None:
    text = "a\n\n| x | y |\n|---|---:|\n| 1 | 2 |\n| 3 | 4 |\n\nb\n| other | y |\n|---|---:|\n"
    expected = "a\n\n| x | z |\n|---|---:|\n| 9 | 8 |\n\nb\n| other | y |\n|---|---:|\n"
    assert renewed(text, ["", "| x | z |", "|---|---:|", "| 9 | 8 |", "", "| new | w |", "", "picture: p"]) == expected


def test_greedy_is_not_optimal_and_sure_pairs_have_no_rival() -> None:
    value = np.array([[3.0, 2.9], [2.8, 0.0], [0.0, 0.0]])
    assert greedy(value) == [(0, 0)]
    assert sure(value, 0.0) == [(0, 0)]
    assert sure(value, 0.2) == []


@pytest.mark.parametrize("name", ["20 reflectors", "boards 6 dB apart"])
def test_every_rule_gives_the_points_of_a_scene_without_rivals(name: str) -> None:
    """Far apart in range, no ghosts: all rules agree, and all points are right."""
    level = Level(name, targets=4, depth_m=10.0, fading_db=1.0, ghosts=0.0)
    rng = np.random.default_rng(6)
    scenes = [detection_scene(rng, level, RIG) for _ in range(20)]
    apart = [s for s in scenes if np.diff(np.sort(np.linalg.norm(s.truth_m, axis=1))).min() > 0.5]
    assert len(apart) >= 3
    for rule, score in scored(production(RIG) | alternatives(RIG), apart).items():
        if "mutual" not in rule:
            assert (score.precision[1], score.recall) == (1.0, 1.0), rule


def test_the_default_beats_the_paper_s_rule_in_precision_and_recall() -> None:
    """Crowded scenes with mounting offset, power imbalance, fading and ghosts."""
    crowded = [level for level in LEVELS if level.name in ("20 within 2 m", "60 reflectors", "boards 6 dB apart")]
    assert len(crowded) == 3
    for level in crowded:
        rng = np.random.default_rng(11)
        scores = scored(production(RIG), [detection_scene(rng, level, RIG) for _ in range(400 // level.targets)])
        assert scores["optimal"].precision[1] > scores["paper"].precision[1], level.name
        assert scores["optimal"].recall > scores["paper"].recall, level.name


def test_sidelobes_of_strong_reflectors_make_no_points() -> None:
    kept = replace(RIG.settings, cfar=replace(RIG.settings.cfar, sidelobe_guard=False), heatmap=HeatmapSettings())
    bare = replace(RIG, settings=kept)
    scores = scored(production(bare), raw_scenes(np.random.default_rng(2), RAWS[1], bare, 4))
    assert set(scores) == set(PRODUCTION)
    assert scores["optimal"].precision[1] > 0.95
    assert scores["optimal"].precision[1] >= scores["optimal, sidelobes kept"].precision[1]
    assert scores["optimal"].recall > 0.8


def test_the_person_stands_on_the_ground_and_is_closed() -> None:
    vertices, faces = person()
    assert -0.02 < vertices[:, 2].min() < 0.02
    assert 1.6 < vertices[:, 2].max() < 1.8
    corners = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert area.min() > 0.0
    assert 1.0 < area.sum() < 2.5
