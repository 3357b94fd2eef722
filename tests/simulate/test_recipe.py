# SPDX-License-Identifier: Apache-2.0
"""Recipes and work lists: the class mix, the splits, and that the same seed always means the same work."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from edge.errors import ConfigError
from train.objects.mesh import CLASSES
from train.objects.reference import ObjectRef
from train.simulate.recipe import ClassMix, Recipe, known_recipes, load_recipe
from train.simulate.work import Plan, class_counts, group_key, item_seed


def test_counts_of_the_paper() -> None:
    assert ClassMix().counts(2573) == {"car": 1697, "bicycle": 198, "motorcycle": 198, "pedestrian": 480}
    for objects in (1, 2, 7, 50, 400):
        assert sum(ClassMix().counts(objects).values()) == objects


def test_recipes_that_come_with_the_software() -> None:
    assert {"approach", "equal", "paper", "reference"} <= set(known_recipes())
    for name in known_recipes():
        load_recipe(name)
    assert load_recipe("reference").set.objects * load_recipe("reference").set.drive_bys == 3200
    assert set(load_recipe("equal").classes.counts(8).values()) == {2}


def test_equal_values_have_equal_hashes_and_others_do_not() -> None:
    assert load_recipe("paper") == Recipe()
    assert load_recipe("paper").sha256 == Recipe().sha256
    assert Recipe().resized(objects=3).sha256 != Recipe().sha256
    assert Recipe().resized(objects=None) == Recipe()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[set]\nobjetcs = 3\n", "objects"),
        ("[set]\nobjects = 0\n", "set.objects"),
        ("[set]\ndrive_bys = 0\nperturbed = 0\n", "set.drive_bys"),
        ("[set]\nval_share = 0.7\ntest_share = 0.7\n", "val_share"),
        ("[classes.car]\nweight = -1\n", "weight"),
        ("[classes.lorry]\nweight = 1\n", "lorry"),
        ("[pertrub]\n", "perturb"),
        ("[set\n", "TOML"),
    ],
)
def test_a_recipe_that_cannot_work_is_refused_by_name(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=named):
        load_recipe(str(path))


def test_an_unknown_recipe_names_those_that_there_are() -> None:
    with pytest.raises(ConfigError, match=r"equal.*paper.*reference"):
        load_recipe("refrence")


@pytest.fixture(params=["library", "none"])
def plan(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Plan:
    """A plan of 300 objects with the library of this machine, if any, and one without."""
    if request.param == "none":
        monkeypatch.setattr("train.simulate.work.library_refs", list)
        monkeypatch.setattr("train.simulate.work.default_objects_dir", lambda: None)
    return Plan.make(Recipe().resized(objects=300), 5)


def test_objects_are_distinct_and_in_the_mix(plan: Plan) -> None:
    assert len(set(plan.objects)) == 300
    assert class_counts(plan) == ClassMix().counts(300)


def test_splits_have_their_share_and_no_source_group_in_common(plan: Plan) -> None:
    refs = [ObjectRef.from_text(text) for text in plan.objects]
    for name in CLASSES:
        splits = Counter(ref.split for ref in refs if ref.class_name == name)
        assert splits["val"] == splits["test"] == round(0.1 * class_counts(plan)[name])
    groups: dict[str, set[str]] = {}
    for ref in refs:
        groups.setdefault(group_key(ref), set()).add(ref.split)
    assert all(len(splits) == 1 for splits in groups.values())


def test_the_same_seed_gives_the_same_list_and_another_one_does_not(plan: Plan) -> None:
    assert Plan.make(plan.recipe, 5) == plan
    other = Plan.make(plan.recipe, 6)
    assert other.objects != plan.objects
    assert other.identity != plan.identity


def test_the_shards_hold_every_item_once() -> None:
    plan = Plan.make(Recipe().resized(objects=9, drive_bys=2, perturbed=1), 0)
    items = [item for number in range(plan.shards) for item in plan.items(number)]
    assert plan.shards == 5
    assert len(items) == len(set(items)) == 27
    assert Counter((item.object, item.kind) for item in items) == Counter(
        {(name, kind): count for name in plan.objects for kind, count in (("simulated", 2), ("perturbed", 1))}
    )
    assert len({item.seed for item in items}) == 27


def test_a_cloud_keeps_its_seed_when_the_set_grows() -> None:
    small, large = (Plan.make(Recipe().resized(drive_bys=n, objects=2), 3) for n in (1, 4))
    shared = set(small.items(0)) & set(large.items(0))
    assert len(shared) == len(list(small.items(0)))
    assert item_seed(3, small.objects[0], "simulated", 0) in {item.seed for item in shared}


def test_a_plan_gives_its_recipe_back() -> None:
    recipe = load_recipe("equal").resized(objects=2)
    plan = Plan.make(recipe, 0)
    assert plan.recipe == recipe
    assert plan.recipe.sha256 == recipe.sha256


def test_riders_are_people_of_the_same_split_on_two_wheelers(plan: Plan) -> None:
    for ref in (ObjectRef.from_text(text) for text in plan.objects if "@" in text):
        assert ref.class_name in ("bicycle", "motorcycle")
        assert ref.rider is not None
        assert ("train", "val", "test")[int(ref.rider.lstrip("adehimnru")) % 3] == ref.split
