# SPDX-License-Identifier: Apache-2.0
"""The data set on Ray: two local workers give the bytes of one process, also when a worker is killed."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_clouds import fake_cloud, small_plan

from edge.errors import DependencyError, RfconstructError
from train.simulate.build import INDEX, build
from train.simulate.check import check
from train.simulate.on_ray import RayPool
from train.simulate.pool import Failure, LocalPool
from train.simulate.shards import Cloud, read_clouds
from train.simulate.work import Item


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(DependencyError, match="cluster"):
        RayPool("auto")


@pytest.fixture(scope="module")
def two_workers() -> Iterator[RayPool]:
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'rfconstruct[cluster]'")
    import fake_clouds

    ray.cloudpickle.register_pickle_by_value(fake_clouds)
    pool = RayPool("local", cores=2)
    yield pool
    pool.close()


def test_the_bytes_are_those_of_local_processes(two_workers: RayPool, tmp_path: Path) -> None:
    build(small_plan(), tmp_path / "ray", two_workers, fake_cloud)
    build(small_plan(), tmp_path / "here", LocalPool(1), fake_cloud)
    for path in (tmp_path / "here").glob("*.*"):
        assert path.read_bytes() == (tmp_path / "ray" / path.name).read_bytes(), path.name
    assert check(tmp_path / "ray").good


def test_a_killed_worker_costs_nothing_and_a_hopeless_item_is_recorded(two_workers: RayPool, tmp_path: Path) -> None:
    plan = small_plan()
    items = [item for number in range(plan.shards) for item in plan.items(number)]
    once, always, wrong = items[1], items[9], items[13]

    def make(item: Item) -> Cloud:
        mark = tmp_path / f"tried {item.seed}"
        first = not mark.exists()
        mark.touch()
        if item == always or (item == once and first):
            os.kill(os.getpid(), signal.SIGKILL)
        if item == wrong:
            raise ValueError("no such thing")
        return fake_cloud(item)

    built = build(plan, tmp_path / "ray", two_workers, make)
    assert (built.clouds, built.failed) == (18, 2)
    clouds = {cloud.seed: cloud for shard in read_clouds(tmp_path / "ray") for cloud in shard.clouds}
    assert (tmp_path / f"tried {once.seed}").exists()
    assert len(clouds[once.seed]) == 300
    assert clouds[always.seed].error.startswith("its process died")
    assert clouds[wrong.seed].error == "ValueError: no such thing"
    assert not check(tmp_path / "ray").faults
    assert (tmp_path / "ray" / INDEX).exists()


def test_an_item_that_hangs_is_stopped(two_workers: RayPool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(two_workers, "_limit_s", 1.0)

    def nap(seconds: int) -> int:
        import time

        time.sleep(seconds)
        return seconds

    answers = dict(two_workers.run(nap, [0, 3600]))
    assert answers[0] == 0
    assert answers[3600] == Failure("its process died (WorkerCrashedError)")


def test_no_cluster_is_an_error_that_says_so(two_workers: RayPool) -> None:
    for address in ("127.0.0.1:1", "ray://127.0.0.1:1", "127.0.0.1:port", "nowhere.invalid:1"):
        with pytest.raises(RfconstructError, match="no Ray cluster"):
            RayPool(address)
