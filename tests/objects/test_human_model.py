# SPDX-License-Identifier: Apache-2.0
"""People from the human model: true sizes, a pose that does not stretch limbs, clothes only where they belong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from train.objects.human import HumanModel, align, build
from train.objects.mesh import MeshError


@pytest.fixture(scope="module")
def model(object_data: Path) -> HumanModel:
    path = object_data / "human_model" / "mh_model.npz"
    if not path.is_file():
        pytest.skip("no human model here: mh_model.npz belongs into objects/human_model")
    return HumanModel.load(path)


def test_people_have_human_sizes(model: HumanModel) -> None:
    statures = []
    for seed in range(12):
        mesh = model.person(seed)
        assert mesh.vertices[:, 2].min() == 0
        assert 0.2 < mesh.size_m[0] < 1.2
        assert 0.3 < mesh.size_m[1] < 0.8
        statures.append(float(mesh.size_m[2]))
    assert min(statures) > 0.9
    assert 1.55 < np.median(statures) < 1.85
    assert max(statures) < 2.1
    np.testing.assert_array_equal(model.person(3).vertices, model.person(3).vertices)
    assert model.person(3).licence == "CC0-1.0"


def test_without_turns_the_body_stays(model: HumanModel) -> None:
    heads = model.heads(model.neutral)
    bent = model.bend(model.neutral, heads, {})
    weighted = np.abs(model.weights.sum(axis=1) - 1) < 2e-3
    np.testing.assert_allclose(bent[weighted], model.neutral[weighted], atol=0.03)


def test_turning_a_limb_moves_only_what_hangs_on_it(model: HumanModel) -> None:
    heads = model.heads(model.neutral)
    turn = align(np.array([0.0, -1, 0]), np.array([0.0, 0, 1]))
    bent = model.bend(model.neutral, heads, {"calf_l": turn})
    moved = np.linalg.norm(bent - model.neutral, axis=1) > 0.1
    hanging = model.weights[:, [model.bones.index(b) for b in ("calf_l", "foot_l", "ball_l")]].sum(axis=1)
    assert not moved[hanging == 0].any()
    assert moved[hanging > 0.9].mean() > 0.9
    knee = heads[model.bones.index("calf_l")]
    rigid = hanging > 0.999
    np.testing.assert_allclose(  # lengths from the knee are kept
        np.linalg.norm(bent[rigid] - knee, axis=1), np.linalg.norm(model.neutral[rigid] - knee, axis=1), rtol=0.01
    )


def test_weights_of_ages_andbuilds_are_shares() -> None:
    for seed in range(50):
        values = build(np.random.default_rng(seed))
        assert values["male"] + values["female"] == 1
        assert sum(values[a] for a in ("african", "asian", "caucasian")) == pytest.approx(1)
        assert sum(values.get(a, 0) for a in ("baby", "child", "young", "old")) == pytest.approx(1)
        for name in ("muscle", "weight"):
            assert sum(values[k + name] for k in ("min", "average", "max")) == pytest.approx(1)


def testalign_is_a_rotation() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = rng.normal(size=(2, 3))
        turn = align(a, b)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(turn @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-9)


def test_a_foreign_file_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "mh_model.npz", vertices=np.zeros(3))
    with pytest.raises(MeshError, match="human model"):
        HumanModel.load(tmp_path / "mh_model.npz")
