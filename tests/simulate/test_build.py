# SPDX-License-Identifier: Apache-2.0
"""Building a data set: the same bytes however it was built, killed and resumed included; other sets are refused."""

from __future__ import annotations

import fcntl
import io
import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fake_clouds import Here, counted_cloud, dying_cloud, fake_cloud, small_plan

from edge.errors import ConfigError, RecordingError
from train.objects.reference import ObjectRef
from train.perturb import perturb
from train.simulate.build import CREDITS, INDEX, build, export_clouds, make_cloud, shard_name
from train.simulate.pool import LocalPool
from train.simulate.progress import Progress
from train.simulate.shards import read_clouds, read_shard
from train.simulate.work import Plan


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if not path.name.startswith(".")}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished set; not to be changed."""
    folder = tmp_path_factory.mktemp("whole") / "set"
    build(small_plan(), folder, Here(), fake_cloud)
    return folder


def test_the_index_says_what_is_there(whole: Path) -> None:
    plan, index = small_plan(), json.loads((whole / INDEX).read_text())
    assert (index["schema"], index["seed"], index["complete"]) == (1, 0, True)
    assert index["recipe"]["sha256"] == plan.recipe.sha256
    assert len(index["samples"]) == 18
    first = index["samples"][0]
    assert (first["object"], first["class"], first["kind"]) == ("car/parametric_00000", "car", "simulated")
    assert first["split"] == ObjectRef.from_text(first["object"]).split
    assert np.linalg.det(np.reshape(first["rotation"], (3, 3))) == pytest.approx(1)
    assert {"sensor_m", "translation_m", "frames", "travel_m", "seed", "statistics"} <= set(first)


def test_processes_give_the_same_bytes_as_one(whole: Path, tmp_path: Path) -> None:
    build(small_plan(), tmp_path, LocalPool(2), fake_cloud)
    assert files(tmp_path) == files(whole)


def test_a_finished_set_is_not_made_again(whole: Path, tmp_path: Path) -> None:
    target = tmp_path / "set"
    build(small_plan(), target, Here(), partial(counted_cloud, tmp_path))
    assert len((tmp_path / "made").read_text().splitlines()) == 18
    built = build(small_plan(), target, Here(), partial(counted_cloud, tmp_path))
    assert (built.kept, built.made) == (3, 0)
    assert len((tmp_path / "made").read_text().splitlines()) == 18


@pytest.mark.parametrize("after", [0, 1, 5, 6, 7, 17])
def test_a_stopped_run_goes_on_where_it_was(whole: Path, tmp_path: Path, after: int) -> None:
    target = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        build(small_plan(), target, Here(after), fake_cloud)
    assert json.loads((target / INDEX).read_text())["complete"] is False
    built = build(small_plan(), target, Here(), fake_cloud)
    assert built.kept == after // 6
    assert files(target) == files(whole)


def test_a_run_killed_at_any_moment_goes_on(whole: Path, tmp_path: Path) -> None:
    target = tmp_path / "set"
    script = (
        f"import sys; from pathlib import Path; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from fake_clouds import Here, slow_cloud, small_plan\n"
        "from train.simulate.build import build\nfrom train.simulate.pool import LocalPool\n"
        "if __name__ == '__main__':\n"
        "    build(small_plan(), Path(sys.argv[1]), LocalPool(1), slow_cloud)\n"
    )
    path = tmp_path / "run.py"
    path.write_text(script)
    with subprocess.Popen([sys.executable, str(path), str(target)]) as run:
        while not (target / shard_name(0)).exists():
            assert run.poll() is None
            time.sleep(0.01)
        run.kill()
    (target / f".{shard_name(1)}.tmp").write_bytes(b"half")
    build(small_plan(), target, Here(), fake_cloud)
    assert files(target) == files(whole)
    assert not list(target.glob(".*.tmp"))


@pytest.mark.parametrize("damage", ["cut", "byte", "foreign"])
def test_a_damaged_shard_is_remade_and_no_other(whole: Path, tmp_path: Path, damage: str) -> None:
    target = tmp_path / "set"
    build(small_plan(), target, Here(), fake_cloud)
    path = target / shard_name(1)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    other = (target / shard_name(0)).read_bytes()
    path.write_bytes({"cut": bytes(data[: len(data) // 2]), "byte": bytes(data), "foreign": other}[damage])
    built = build(small_plan(), target, Here(), partial(counted_cloud, tmp_path))
    assert (built.kept, built.made, built.damaged) == (2, 1, 1)
    assert len((tmp_path / "made").read_text().splitlines()) == 6
    assert files(target) == files(whole)


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (small_plan(seed=1), r"seed = 1 \(0\)"),
        (small_plan(drive_bys=3), r"set.drive_bys = 3 \(2\)"),
        (Plan(small_plan().settings, "", 0, (*small_plan().objects[:-1], "car/parametric_00099")), "parametric_00099"),
    ],
)
def test_another_set_in_the_same_folder_is_refused(whole: Path, other: Plan, named: str) -> None:
    before = files(whole)
    with pytest.raises(ConfigError, match=named):
        build(other, whole, Here(), fake_cloud)
    assert files(whole) == before


def test_a_folder_of_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(ConfigError, match="other things"):
        build(small_plan(), tmp_path, Here(), fake_cloud)


def test_two_builders_do_not_share_a_folder(tmp_path: Path) -> None:
    with (tmp_path / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(RecordingError, match="another process"):
            build(small_plan(), tmp_path, Here(), fake_cloud)


def test_what_cannot_be_made_is_recorded_with_its_reason(tmp_path: Path) -> None:
    target, said = tmp_path / "set", io.StringIO()
    built = build(small_plan(), target, LocalPool(1), dying_cloud, Progress(said))
    assert (built.clouds, built.failed) == (18, 2)
    failed = {c.object: c.error for shard in read_clouds(target) for c in shard.clouds if c.error}
    assert failed == {
        "car/parametric_00004": "its process died (signal SIGKILL)",
        "car/parametric_00000": "ValueError: no such thing",
    }
    assert "18/18 clouds" in said.getvalue()
    assert "car/parametric_00004" in said.getvalue()


def test_progress_on_a_terminal_is_a_bar(tmp_path: Path) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    build(small_plan(), tmp_path, Here(), fake_cloud, Progress(terminal))
    assert "18/18" in terminal.getvalue()


def test_a_perturbed_scan_is_that_of_its_seed() -> None:
    plan = small_plan()
    item = next(item for item in plan.items(0) if item.kind == "perturbed")
    cloud = make_cloud(plan.recipe, item)
    mesh = ObjectRef.from_text(item.object).mesh()
    xyz_m, sensor_m = perturb(mesh, plan.recipe.perturb, np.random.default_rng(item.seed), item.variation)
    if len(xyz_m) >= plan.recipe.set.min_points:
        np.testing.assert_array_equal(cloud.xyz_m, xyz_m)
        np.testing.assert_array_equal(cloud.sensor_m, sensor_m)
    assert len(cloud) >= plan.recipe.set.min_points
    np.testing.assert_array_equal(cloud.rotation, np.eye(3))


def test_credits_name_every_source(whole: Path, tmp_path: Path) -> None:
    assert "7 objects" not in (whole / CREDITS).read_text()
    assert "6 objects of this project's own generators" in (whole / CREDITS).read_text()


def test_only_the_radar_clouds_are_exported(whole: Path, tmp_path: Path) -> None:
    file = tmp_path / "reference.clouds"
    assert export_clouds(whole, file) == 12
    shard = read_shard(file)
    assert {cloud.kind for cloud in shard.clouds} == {"simulated"}
    assert len(shard.clouds) == 12
    assert "own generators" in (tmp_path / f"reference.{CREDITS}").read_text()


def test_a_set_without_radar_clouds_cannot_be_exported(tmp_path: Path) -> None:
    build(small_plan(drive_bys=0), tmp_path / "set", Here(), fake_cloud)
    with pytest.raises(RecordingError, match="no radar clouds"):
        export_clouds(tmp_path / "set", tmp_path / "x.clouds")
