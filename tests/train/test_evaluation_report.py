# SPDX-License-Identifier: Apache-2.0
"""Report: sections are replaced and nothing else, figures arrive in the tables; degradations do what they say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from edge.errors import ConfigError
from edge.frames import Float32
from train.dataset import Sample
from train.degrade import DEGRADATIONS, worsened
from train.evaluate import FLOOR, Scores, measure
from train.evaluate_command import _named, _shown
from train.gallery import calibration_picture, case_row, drawn, gallery
from train.held_out import Case
from train.objects.mesh import Mesh
from train.predictors import Answer
from train.report import Part, calibrations, markdown, plain, update_section
from train.robustness import clutter_named, robustness, robustness_table

CHANGE = {one.name: one.change for one in DEGRADATIONS}
BOX = np.array([[0, 0, 0], [4, 0, 0], [0, 2, 0], [4, 2, 1.5]], np.float32)


def case(number: int = 0, label: int = 0, frames: bool = False) -> Case:
    rng = np.random.default_rng(number)
    truth = (rng.uniform(-1, 1, (3000, 3)) * (2, 1, 0.7) + (0, 0, 0.8)).astype(np.float32)
    sample = Sample(truth[:400].copy(), truth, label, f"object/{number}", (4.0, 2.0, 1.5))
    mesh = Mesh(BOX, np.array([[0, 1, 2], [1, 2, 3]], np.int32), label, f"object/{number}")
    times = np.sort(rng.integers(0, 100, 400)) if frames else None
    return Case(sample, number, "scans", mesh, np.eye(3), np.zeros(3), 100 if frames else 60, times)


def changed(name: str, level: float, one: Case) -> Float32:
    result = CHANGE[name](one, level, np.random.default_rng(0), [case(5), case(6)])
    assert result is not None
    return result.sample.partial


def test_degradations_do_what_they_say() -> None:
    one, timed = case(), case(1, frames=True)
    cloud = one.sample.partial
    assert len(changed("points", 64, one)) == 64
    assert CHANGE["points"](one, 512, np.random.default_rng(0), []) is None
    ghosts = changed("ghosts below ground", 0.25, one)
    assert len(ghosts) == 500
    assert 60 < (ghosts[:, 2] < 0).sum() <= 100
    assert len(changed("outliers", 0.5, one)) == 600
    assert np.abs(changed("outliers", 0.5, one)).max() <= np.abs(cloud).max() + 0.5
    smeared = changed("pose smear", 0.8, timed)
    moved = smeared[:, 1] - timed.sample.partial[:, 1]
    assert timed.frame_number is not None
    np.testing.assert_allclose(moved, 0.8 * (timed.frame_number / 99 - 0.5), atol=1e-5)
    few = CHANGE["merged frames"](timed, 50, np.random.default_rng(0), [])
    assert few is not None
    assert few.frames == 50
    assert len(few.sample.partial) == ((timed.frame_number >= 25) & (timed.frame_number < 75)).sum()
    assert CHANGE["merged frames"](one, 50, np.random.default_rng(0), []) is None
    assert CHANGE["merged frames"](timed, 200, np.random.default_rng(0), []) is None


def test_neighbours_stand_beside_the_cloud() -> None:
    one = case()
    cloud, result = one.sample.partial, changed("neighbours' points", 0.5, one)
    outside = (result[:, 1] > cloud[:, 1].max()) | (result[:, 1] < cloud[:, 1].min())
    assert outside.sum() == 200
    gap_m = np.abs(result[outside, 1]).min() - np.abs(cloud[:, 1]).max()
    assert 0.4 < gap_m < 1.6


def test_worsened_clouds_stay_clouds() -> None:
    rng, others = np.random.default_rng(0), [case(5), case(6)]
    for number in range(20):
        cloud = worsened(case(number, frames=True), rng, others).sample.partial
        assert 64 <= len(cloud) <= 2048
        assert np.isfinite(cloud).all()


def trusting(one: Case) -> Answer:
    """The truth, 10 cm too high; certain of a car."""
    return Answer(one.sample.truth + np.float32([0, 0, 0.1]), None, np.float32([0.9, 0.1, 0, 0]), 0.75, "car")


def perfect(one: Case) -> Answer:
    return Answer(one.sample.truth)


@pytest.fixture(scope="module")
def part() -> Part:
    cases = [case(number, number % 4) for number in range(8)]
    scores = measure({"net": trusting, "other": perfect, FLOOR: perfect}, cases, 1)
    return Part("nobbox", "scans", "test", "net", ["net", "other"], scores, [0.01, 0.02])


def test_the_report_says_what_was_measured(part: Part) -> None:
    part.levels = robustness(trusting, [case(0), case(1)])
    part.clutter = clutter_named(trusting, [case(0)], 10)
    text = markdown(part, "the command")
    mean = part.scores["net"].summary("cd_cm").mean
    assert f"**{mean:.2f} cm**" in text
    assert "the command" in text
    assert "| bike |" in text
    assert "mean of 2 samples, worst 2.00 %" in text
    assert "100.0%" not in text  # only a quarter of the objects are cars
    assert "25.0% of these are right" not in text or "A class is named for 100%" in text
    assert "| all | 10 | 0% | |" in text
    content = json.loads(json.dumps(plain(part, "the command")))
    assert content["summaries"]["net"]["cd_cm"]["macro"]["mean"] == pytest.approx(mean)
    assert content["summaries"]["net"]["class_right"]["car"]["mean"] == 1
    assert len(content["samples"]["other"]["objects"]) == 8
    by_class = text.partition("All predictors by class:")[2]
    car = part.scores["net"].summary("cd_cm", "car").mean
    assert f"| net | {car:.2f} |" in by_class
    assert "| other | 0.00 |" in by_class
    table = robustness_table(part.levels)
    assert "| points | 1024 points | 0 | – | – | – |" in table  # the clouds have 400
    assert "| points | 256 points | 2 | " in table
    assert "nan" not in table.lower()


def test_calibration_of_a_constant_promise(part: Part) -> None:
    diagrams, curves = calibrations(part.scores["net"])
    assert diagrams["CD below 15 cm"].error == pytest.approx(0.25)  # 0.75 promised, all kept
    assert diagrams["class right"].error == pytest.approx(0.9 - 0.25)
    assert curves["by confidence"].at(1) == pytest.approx(np.mean(part.scores["net"].values["cd_cm"]))
    assert calibrations(part.scores["other"]) == ({}, {})


def test_sections_are_replaced_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "results.md"
    update_section(path, "one", "first")
    update_section(path, "two", "second")
    path.write_text(path.read_text().replace("<!-- begin two", "Words of a person.\n\n<!-- begin two"))
    update_section(path, "one", "changed \\1 \n")
    text = path.read_text()
    assert text.startswith("<!-- SPDX")
    assert "first" not in text
    assert text.index("changed \\1") < text.index("Words of a person.") < text.index("second")
    update_section(path, "one", "changed \\1 \n")
    assert path.read_text() == text
    path.write_text(text.replace("<!-- end one -->", ""))
    with pytest.raises(ConfigError, match="damaged"):
        update_section(path, "one", "x")
    with pytest.raises(ConfigError, match="section"):
        update_section(path, "a b", "x")


def test_pictures_are_drawn_and_nobody_chooses(tmp_path: Path, part: Part) -> None:
    labels = [0] * 20 + [3] * 2
    assert drawn(labels, 6, 0) == drawn(labels, 6, 0) != drawn(labels, 6, 1)
    assert [labels[row] for row in drawn(labels, 5, 0)] == [0, 3, 0, 3, 0]
    assert sorted(drawn(labels, 99, 0)) == list(range(22))
    row = case_row(case(), [("net", case().sample.truth)])
    gallery([row], tmp_path / "pictures" / "gallery.png")
    diagrams, curves = calibrations(part.scores["net"])
    calibration_picture(list(diagrams.items()), list(curves.items()), tmp_path / "trust.png")
    for path in (tmp_path / "pictures" / "gallery.png", tmp_path / "trust.png"):
        assert path.read_bytes()[:4] == b"\x89PNG"


def test_worst_are_the_worst() -> None:
    scores = Scores({"cd_cm": [1.0, 9.0, float("nan"), 4.0]}, ["a", "b", "c", "d"], [0, 0, 0, 0])
    assert scores.worst(2) == [1, 3]


def test_models_have_names() -> None:
    assert _named("PCN=runs/a/checkpoint.pt") == ("PCN", Path("runs/a/checkpoint.pt"))
    assert _named("runs/a/checkpoint.pt")[0] == "a"
    assert _named("models/default")[0] == "default"


def test_commands_show_no_place_of_a_machine() -> None:
    assert _shown(Path("out/equal400")) == "out/equal400"
    assert _shown(Path("/somewhere/private/equal400")) == ".../equal400"
