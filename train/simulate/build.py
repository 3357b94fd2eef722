# SPDX-License-Identifier: Apache-2.0
"""Build a data set: work list to shards, index and credits; a kill at any moment costs the unfinished shards only."""

from __future__ import annotations

import fcntl
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from edge.errors import ConfigError, RecordingError
from train.objects.reference import ObjectRef
from train.perturb import perturb
from train.simulate.cloud_statistics import measure
from train.simulate.pool import Failure, Pool
from train.simulate.progress import Progress
from train.simulate.recipe import Recipe, differences, digest
from train.simulate.shards import (
    SUFFIX,
    Cloud,
    ObjectInfo,
    Shard,
    ShardError,
    check_cloud,
    encode,
    read_clouds,
    read_shard,
    write_whole,
)
from train.simulate.work import Item, Plan, group_key

SCHEMA = 1
INDEX, CREDITS = "index.json", "CREDITS.txt"
_ATTEMPTS = 16
_FIGURES = ("within_10cm", "within_20cm", "median_m", "coverage", "spacing_m")
"""Statistics that mean something where there are no radar frames."""
Maker = Callable[[Item], Cloud]


@dataclass(frozen=True, slots=True)
class Built:
    """What a call of ``build`` found and did: clouds of the set, of these failed, shards kept and remade."""

    clouds: int
    failed: int
    kept: int
    made: int
    damaged: int


def shard_name(number: int) -> str:
    """File name of a shard."""
    return f"shard-{number:05d}{SUFFIX}"


def make_cloud(recipe: Recipe, item: Item) -> Cloud:
    """The cloud of an item; the same item gives the same cloud.

    Raises:
        RfconstructError: the object or the cloud cannot be made.
    """
    ref = ObjectRef.from_text(item.object)
    cloud = _simulated(recipe, ref, item) if item.kind == "simulated" else _perturbed(recipe, ref, item)
    check_cloud(cloud)
    return cloud


def _simulated(recipe: Recipe, ref: ObjectRef, item: Item) -> Cloud:
    from train.simulate.cloud import DriveSpec, simulate_cloud

    drive = recipe.drive
    made = simulate_cloud(DriveSpec(ref, item.seed, drive.ranges, drive.rig, drive.every))
    statistics = {name: value for name, value in asdict(made.statistics).items() if math.isfinite(value)}
    return Cloud(
        *(item.object, item.kind, item.variation, item.seed, made.xyz_m, made.power_db, made.frame_number),
        np.zeros(3) if made.status == "missing" else made.sensor_m,
        *(made.truth_rotation, made.truth_translation_m, made.frames, made.travel_m, statistics, made.status),
    )


def _perturbed(recipe: Recipe, ref: ObjectRef, item: Item) -> Cloud:
    """One scan of perturbed geometry in the frame of the mesh; variation k looks from eighth k of the circle."""
    rng, mesh = np.random.default_rng(item.seed), ref.mesh()
    for _ in range(_ATTEMPTS):
        xyz_m, sensor_m = perturb(mesh, recipe.perturb, rng, item.variation)
        if len(xyz_m) >= recipe.set.min_points:
            break
    n = len(xyz_m)
    frame_number = np.zeros(n, np.int64)
    figures = asdict(measure(mesh, xyz_m, frame_number, 1, [sensor_m], rng))
    statistics = {name: figures[name] for name in _FIGURES if math.isfinite(figures[name])}
    return Cloud(
        *(item.object, item.kind, item.variation, item.seed, xyz_m, np.zeros(n, np.float32), frame_number),
        *(sensor_m, np.eye(3), np.zeros(3), 0, 0.0, statistics),
    )


def build(plan: Plan, folder: Path, pool: Pool, make: Maker | None = None, progress: Progress | None = None) -> Built:
    """Make what is missing of a data set.

    Args:
        plan: what the set holds.
        folder: of the set; it may hold a part of the same set.
        pool: where the work is done.
        make: gives the cloud of an item; ``make_cloud`` by default.
        progress: told of every cloud.
    Raises:
        ConfigError: the folder holds another set or other things.
        RecordingError: another process builds in it, or it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _alone(folder):
            _claim(plan, folder)
            return _build(plan, folder, pool, make or partial(make_cloud, plan.recipe), progress or Progress())
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be written", value=error.strerror) from error


def _build(plan: Plan, folder: Path, pool: Pool, make: Maker, progress: Progress) -> Built:
    missing, damaged = _missing(plan, folder)
    of_object = {name: number for number in missing for name in plan.shard_objects(number)}
    items = (item for number in missing for item in plan.items(number))
    done = plan.per_object * (len(plan.objects) - len(of_object))
    waiting: dict[int, dict[Item, Cloud]] = {}
    results = pool.run(make, items)
    try:
        progress.begin(plan.per_object * len(plan.objects), done)
        for item, result in results:
            number = of_object[item.object]
            clouds = waiting.setdefault(number, {})
            clouds[item] = _recorded(item, result)
            progress.step(clouds[item])
            wanted = list(plan.items(number))
            if len(clouds) == len(wanted):
                shard = Shard(plan.identity, number, _infos(plan, number), tuple(clouds[one] for one in wanted))
                write_whole(folder / shard_name(number), encode(shard))
                del waiting[number]
    finally:
        results.close()  # type: ignore[attr-defined]  # ends the workers at once when this is left early
        progress.end()
        shards = write_index(plan, folder)
    failed = sum(bool(cloud.error) for shard in shards for cloud in shard.clouds)
    clouds_made = sum(len(shard.clouds) for shard in shards)
    return Built(clouds_made, failed, plan.shards - len(missing), len(missing), damaged)


def _recorded(item: Item, result: Cloud | Failure) -> Cloud:
    if isinstance(result, Failure):
        return Cloud.failed(item.object, item.kind, item.variation, item.seed, result.error)
    return result


def _infos(plan: Plan, number: int) -> dict[str, ObjectInfo]:
    infos = {}
    for name in plan.shard_objects(number):
        ref = ObjectRef.from_text(name)
        x_m, y_m, z_m = (round(float(v), 3) for v in ref.mesh().size_m)
        infos[name] = ObjectInfo(ref.split, group_key(ref), ref.licence, ref.attribution, (x_m, y_m, z_m))
    return infos


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep every other builder out of the folder; the lock ends with the process."""
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RecordingError(f"{folder}: another process builds here", action="wait for it or stop it") from error
        yield


def _claim(plan: Plan, folder: Path) -> None:
    """Make the folder this plan's, or find that it is already."""
    if (folder / INDEX).exists():
        there = read_plan(folder)
        differ = differences(plan.settings, there.settings)
        if plan.seed != there.seed:
            differ.append(f"seed = {plan.seed} ({there.seed})")
        if not differ and plan.objects != there.objects:
            differ = [f"{name} (another library?)" for name in sorted({*plan.objects} ^ {*there.objects})]
        if differ:
            raise ConfigError(
                f"{folder}: holds another data set",
                value=", ".join(differ[:4]),
                allowed=f"what {INDEX} says (in brackets)",
                action="name another folder, or give the recipe and the seed that it was begun with",
            )
        return
    if others := [path.name for path in folder.iterdir() if not path.name.startswith(".")]:
        raise ConfigError(f"{folder}: holds other things", value=sorted(others)[:5], action="name an empty folder")
    write_whole(folder / INDEX, _index(plan, [], []))


def _missing(plan: Plan, folder: Path) -> tuple[list[int], int]:
    """Numbers of the shards that are not there or not intact, and how many of these are there but damaged."""
    missing, damaged = [], 0
    for left_over in folder.glob(".*.tmp"):
        left_over.unlink()
    for number in range(plan.shards):
        path = folder / shard_name(number)
        if not path.exists():
            missing.append(number)
            continue
        try:
            shard = read_shard(path)
            if (shard.identity, shard.number) != (plan.identity, number):
                raise ShardError(f"{path.name}: of another set")
        except ShardError:
            missing.append(number)
            damaged += 1
    return missing, damaged


def read_plan(folder: Path) -> Plan:
    """The plan that a folder was begun with.

    Raises:
        RecordingError: no index, or one that contradicts itself.
    """
    index = read_index(folder)
    try:
        recipe = index["recipe"]
        plan = Plan(recipe["settings"], recipe["text"], int(index["seed"]), tuple(index["objects"]))
        right = plan.per_object > 0 and plan.identity == index["identity"]
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{folder / INDEX}: contradicts itself ({error!r})") from error
    if not right:
        raise RecordingError(f"{folder / INDEX}: recipe, seed and objects do not fit its identity")
    return plan


def read_index(folder: Path) -> dict[str, Any]:
    """index.json.

    Raises:
        RecordingError: absent, unreadable or of another schema.
    """
    try:
        index = json.loads((folder / INDEX).read_bytes())
        schema = index["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{folder / INDEX}: no index of a data set ({error})") from error
    if schema != SCHEMA:
        raise RecordingError(f"{folder / INDEX}: another schema", value=schema, allowed=str(SCHEMA))
    assert isinstance(index, dict)
    return index


def write_index(plan: Plan, folder: Path) -> list[Shard]:
    """Write index.json and CREDITS.txt from the shards that are there and intact; returns these."""
    shards, files = [], []
    for number in range(plan.shards):
        path = folder / shard_name(number)
        if path.exists():
            shard = read_shard(path)
            data = path.read_bytes()
            shards.append(shard)
            files.append({"file": path.name, "sha256": sha256(data).hexdigest(), "bytes": len(data)})
    write_whole(folder / CREDITS, credits_text(shard.objects for shard in shards).encode())
    write_whole(folder / INDEX, _index(plan, shards, files))
    return shards


def _index(plan: Plan, shards: list[Shard], files: list[dict[str, Any]]) -> bytes:
    """index.json, one line a sample."""
    head = {
        "schema": SCHEMA,
        "complete": len(shards) == plan.shards,
        "identity": plan.identity,
        "seed": plan.seed,
        "recipe": {"sha256": digest(plan.settings), "text": plan.text, "settings": plan.settings},
        "objects": plan.objects,
        "shards": files,
    }
    samples = [
        json.dumps({"shard": shard.number} | cloud.record() | {"split": shard.objects[cloud.object].split})
        for shard in shards
        for cloud in shard.clouds
    ]
    return (json.dumps(head)[:-1] + ', "samples": [\n' + ",\n".join(samples) + "\n]}\n").encode()


def credits_text(objects: Iterable[dict[str, ObjectInfo]]) -> str:
    """Whose objects the clouds were made from, and under which licences."""
    owed: dict[tuple[str, str], set[str]] = {}
    for infos in objects:
        for name, info in infos.items():
            owed.setdefault((info.licence, info.attribution), set()).add(re.split("[+@]", name)[0])
    lines = ["These radar clouds were simulated from the following 3-D objects; no geometry of theirs is included.", ""]
    for (licence, attribution), names in sorted(owed.items()):
        shown = sorted(names) if attribution else [f"{len(names)} objects of this project's own generators"]
        lines.append(f"- {attribution or 'RFconstruct'} - {licence} - {', '.join(shown)}")
    return "\n".join(lines) + "\n"


def export_clouds(folder: Path, file: Path) -> int:
    """Pack the radar clouds of a set into one file, without perturbed geometry and failed clouds.

    Args:
        folder: of a set, finished or not.
        file: to be written; the credits go beside it.
    Returns:
        Number of clouds.
    Raises:
        RecordingError: a damaged shard, or no radar cloud.
    """
    shards = read_clouds(folder)
    clouds = [cloud for shard in shards for cloud in shard.clouds if cloud.kind == "simulated" and len(cloud)]
    if not clouds:
        raise RecordingError(f"{folder}: no radar clouds to pack", action="build the set first")
    names = {cloud.object for cloud in clouds}
    objects = {name: info for shard in shards for name, info in shard.objects.items() if name in names}
    write_whole(file, encode(Shard(shards[0].identity, 0, objects, tuple(clouds))))
    write_whole(file.with_name(f"{file.stem}.{CREDITS}"), credits_text([objects]).encode())
    return len(clouds)
