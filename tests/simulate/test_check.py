# SPDX-License-Identifier: Apache-2.0
"""The check of a data set: a good one passes, every kind of damage is found and named."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_clouds import Here, fake_cloud, small_plan

from edge.errors import ConfigError, RecordingError
from train.simulate.build import INDEX, build, shard_name, write_index
from train.simulate.check import check, implausible, show
from train.simulate.shards import Cloud, Shard, encode, read_shard
from train.simulate.work import Plan


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    build(small_plan(), tmp_path / "set", Here(), fake_cloud)
    return tmp_path / "set"


def rewrite(folder: Path, change: Callable[[Shard], Shard], index: bool = True) -> None:
    """Change shard 1 and write it, and the index, as if it had been made so."""
    path = folder / shard_name(1)
    path.write_bytes(encode(change(read_shard(path))))
    if index:
        write_index(small_plan(), folder)


def test_a_good_set_passes(folder: Path) -> None:
    report = check(folder)
    assert report.good, report.faults
    shown = io.StringIO()
    show(report, shown)
    assert "18 clouds of 6 objects: good" in shown.getvalue()
    assert "95 95 95" in shown.getvalue()


def test_any_changed_byte_is_found(folder: Path) -> None:
    path = folder / shard_name(2)
    data = path.read_bytes()
    for position in np.linspace(0, len(data) - 1, 40).astype(int):
        changed = bytearray(data)
        changed[position] ^= 0x40
        path.write_bytes(bytes(changed))
        assert any(path.name in fault for fault in check(folder).faults)


def test_a_missing_and_a_foreign_shard_are_found(folder: Path) -> None:
    (folder / shard_name(0)).rename(folder / shard_name(7))
    faults = " ".join(check(folder).faults)
    assert f"{shard_name(0)}: cannot be read" in faults
    assert f"{shard_name(7)}: no shard of this set" in faults


def test_a_missing_cloud_is_found(folder: Path) -> None:
    rewrite(folder, lambda shard: replace(shard, clouds=shard.clouds[1:]))
    assert "1 of 6 clouds are missing" in " ".join(check(folder).faults)


def test_doubled_points_are_found(folder: Path) -> None:
    def double(shard: Shard) -> Shard:
        first, second, *rest = shard.clouds
        return replace(shard, clouds=(first, replace(second, xyz_m=first.xyz_m), *rest))

    rewrite(folder, double)
    assert "the same points" in " ".join(check(folder).faults)


def test_a_group_in_two_splits_is_found(folder: Path) -> None:
    def share(shard: Shard) -> Shard:
        splits = ("train", "test")
        infos = {
            name: replace(info, group="someone", split=split)
            for (name, info), split in zip(shard.objects.items(), splits, strict=True)
        }
        return replace(shard, objects=infos)

    rewrite(folder, share)
    assert "source group someone: in test and train" in check(folder).faults


def test_a_shard_changed_behind_the_index_is_found(folder: Path) -> None:
    def move(shard: Shard) -> Shard:
        first, *rest = shard.clouds
        return replace(shard, clouds=(replace(first, travel_m=1.0), *rest))

    rewrite(folder, move, index=False)
    faults = " ".join(check(folder).faults)
    assert f"not the file that {INDEX} names" in faults
    assert "not what the shard says" in faults


def test_an_edited_index_is_found(folder: Path) -> None:
    index = json.loads((folder / INDEX).read_text())
    index["seed"] = 4
    (folder / INDEX).write_text(json.dumps(index))
    with pytest.raises(RecordingError, match="identity"):
        check(folder)


def test_without_an_index_there_is_nothing_to_check(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no index"):
        check(tmp_path)


def test_an_unfinished_set_is_not_good(folder: Path) -> None:
    (folder / shard_name(1)).unlink()
    write_index(small_plan(), folder)
    assert not check(folder).good


def test_failed_clouds_are_shown_and_not_good(folder: Path) -> None:
    def fail(shard: Shard) -> Shard:
        first, *rest = shard.clouds
        return replace(shard, clouds=(Cloud.failed(first.object, first.kind, 0, first.seed, "no power"), *rest))

    rewrite(folder, fail)
    report, shown = check(folder), io.StringIO()
    show(report, shown)
    assert report.faults == []
    assert not report.good
    assert "no power" in shown.getvalue()
    assert "1 failed clouds" in shown.getvalue()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "no rotation"),
        ({"rotation": 1.01 * np.eye(3)}, "no rotation"),
        ({"frames": -1}, "frames"),
        ({"travel_m": 1e4}, "travel"),
        ({"sensor_m": np.array([0.0, 0.0, 1.0])}, "sensor"),
        ({"sensor_m": np.array([100.0, 0.0, 1.0])}, "sensor"),
        ({"sensor_m": np.array([np.nan, 0.0, 1.0])}, "finite"),
        ({"statistics": {"coverage": np.inf}}, "finite"),
        ({"xyz_m": np.full((300, 3), 25.0, np.float32)}, "too far"),
        ({"xyz_m": np.full((300, 3), 7.0, np.float32)}, "too high"),
        ({"frame_number": np.full(300, 10**6)}, "frame numbers"),
        ({"status": "missing"}, "missing"),
    ],
)
def test_numbers_that_cannot_be_are_named(changes: dict[str, Any], named: str) -> None:
    cloud = fake_cloud(next(small_plan().items(0)))
    assert implausible(cloud) == ""
    assert named in implausible(replace(cloud, **changes))


def test_a_set_of_other_settings_than_todays_can_still_be_checked(folder: Path) -> None:
    """A later version has another setting: the old set stays what it is; only going on with it is refused."""
    plan = small_plan()
    older = Plan(plan.settings | {"gone": 1}, plan.text, plan.seed, plan.objects)
    for number in range(plan.shards):
        path = folder / shard_name(number)
        path.write_bytes(encode(replace(read_shard(path), identity=older.identity)))
    write_index(older, folder)
    assert check(folder).good
    with pytest.raises(ConfigError, match=r"gone = None \(1\)"):
        build(plan, folder, Here(), fake_cloud)
