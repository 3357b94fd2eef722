# SPDX-License-Identifier: Apache-2.0
"""Check a data set against its own plan: intact, complete, plausible, without duplicates, splits apart; figures."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import numpy as np

from edge.frames import Float64
from train.objects.mesh import CLASSES
from train.simulate.build import INDEX, read_index, read_plan, shard_name
from train.simulate.shards import SUFFIX, Cloud, Shard, ShardError, read_shard
from train.simulate.work import Plan

FURTHEST_POINT_M = 20.0
"""From the middle of an object's cloud: the longest object of the library is 9 m."""
SENSOR_M = (0.3, 40.0)
HEIGHT_M = (-1.0, 6.0)
TURN_TOLERANCE = 1e-6
FRAMES = 10_000
SHOWN = 20


@dataclass(slots=True)
class Report:
    """What a check found.

    Args:
        plan: of the set.
        faults: sentences; a set without any is good.
        clouds: of all intact shards.
    """

    plan: Plan
    faults: list[str] = field(default_factory=list)
    clouds: list[Cloud] = field(default_factory=list)

    @property
    def failed(self) -> list[Cloud]:
        """Clouds that could not be made."""
        return [cloud for cloud in self.clouds if cloud.error]

    @property
    def good(self) -> bool:
        """No fault and no failed cloud."""
        return not self.faults and not self.failed


def check(folder: Path) -> Report:
    """Read everything and compare.

    Raises:
        RecordingError: no readable index: there is nothing to check against.
    """
    plan, index = read_plan(folder), read_index(folder)
    report = Report(plan)
    recorded = {one.get("file"): one.get("sha256") for one in index.get("shards", [])}
    shards = []
    for number in range(plan.shards):
        path = folder / shard_name(number)
        try:
            shard = read_shard(path)
        except ShardError as error:
            report.faults.append(error.what)
            continue
        if recorded.get(path.name) != hashlib.sha256(path.read_bytes()).hexdigest():
            report.faults.append(f"{path.name}: not the file that {INDEX} names")
        report.faults += _shard_faults(plan, shard, number, path.name)
        shards.append(shard)
    report.clouds = [cloud for shard in shards for cloud in shard.clouds]
    expected = {shard_name(number) for number in range(plan.shards)}
    foreign = sorted(path.name for path in folder.glob(f"*{SUFFIX}") if path.name not in expected)
    report.faults += [f"{name}: no shard of this set" for name in foreign]
    report.faults += _index_faults(index, shards, report.clouds)
    report.faults += _doubles(report.clouds)
    report.faults += _common_groups(shards)
    return report


def _shard_faults(plan: Plan, shard: Shard, number: int, name: str) -> Iterator[str]:
    """Another set's shard, missing or foreign clouds, numbers that cannot be."""
    if (shard.identity, shard.number) != (plan.identity, number):
        yield f"{name}: of another set"
        return
    items = [(i.object, i.kind, i.variation, i.seed) for i in plan.items(number)]
    found = [(c.object, c.kind, c.variation, c.seed) for c in shard.clouds]
    if found != items:
        missing = len(set(items) - set(found))
        yield f"{name}: {missing} of {len(items)} clouds are missing, {len(set(found) - set(items))} are foreign"
    if set(shard.objects) != set(plan.shard_objects(number)):
        yield f"{name}: not the objects of the plan"
    for cloud in shard.clouds:
        if fault := implausible(cloud):
            yield f"{name}: {cloud.object} {cloud.kind} {cloud.variation}: {fault}"


def implausible(cloud: Cloud) -> str:
    """What is wrong with a cloud's numbers; empty when nothing is."""
    if cloud.error:
        return "" if len(cloud) == 0 else "failed, yet it has points"
    turn = cloud.rotation @ cloud.rotation.T - np.eye(3)
    numbers = [*cloud.sensor_m, *cloud.rotation.ravel(), *cloud.translation_m, cloud.travel_m]
    away_m = float(np.linalg.norm(cloud.sensor_m[:2]))
    checks = {
        "truth or statistics are not finite": not np.isfinite([*numbers, *cloud.statistics.values()]).all(),
        "the pose of the truth is no rotation": np.abs(turn).max() > TURN_TOLERANCE
        or np.linalg.det(cloud.rotation) < 0,
        "frames or travel": not (0 <= cloud.frames <= FRAMES and 0 <= cloud.travel_m <= 100),
        "frame numbers outside the drive-by": len(cloud) > 0 and cloud.frame_number[-1] > FRAMES,
        "missing, yet it has points": (cloud.status == "missing") != (len(cloud) == 0) and cloud.kind == "simulated",
        "points too far away": len(cloud) > 0 and np.abs(cloud.xyz_m[:, :2]).max() > FURTHEST_POINT_M,
        "points too high or too low": len(cloud) > 0
        and not (HEIGHT_M[0] <= cloud.xyz_m[:, 2].min() and cloud.xyz_m[:, 2].max() <= HEIGHT_M[1]),
        f"sensor {away_m:.1f} m away": len(cloud) > 0 and not SENSOR_M[0] <= away_m <= SENSOR_M[1],
    }
    return ", ".join(text for text, wrong in checks.items() if wrong)


def _index_faults(index: dict[str, object], shards: list[Shard], clouds: list[Cloud]) -> Iterator[str]:
    """index.json against the shards."""
    samples = index.get("samples")
    if not isinstance(samples, list) or not all(isinstance(one, dict) for one in samples):
        yield f"{INDEX}: no list of samples"
    elif not index.get("complete"):
        yield f"{INDEX}: the set is not complete; the same command goes on"
    elif len(samples) != len(clouds):
        yield f"{INDEX}: names {len(samples)} clouds, the shards hold {len(clouds)}"
    else:
        numbers = [shard.number for shard in shards for _ in shard.clouds]
        for sample, cloud, number in zip(samples, clouds, numbers, strict=True):
            record = cloud.record() | {"shard": number, "split": sample.get("split")}
            if record != sample:
                yield f"{INDEX}: {cloud.object} {cloud.kind} {cloud.variation}: not what the shard says"


def _doubles(clouds: list[Cloud]) -> Iterator[str]:
    """Clouds with one name, or with exactly the same points."""
    names = Counter((cloud.object, cloud.kind, cloud.variation) for cloud in clouds)
    for name, count in names.items():
        if count > 1:
            yield f"{' '.join(map(str, name))}: {count} times"
    points: dict[bytes, Cloud] = {}
    for cloud in clouds:
        if len(cloud):
            key = hashlib.sha256(cloud.xyz_m.tobytes()).digest()
            other = points.setdefault(key, cloud)
            if other is not cloud:
                yield f"{cloud.object} and {other.object}: {cloud.kind} clouds with the same points"


def _common_groups(shards: list[Shard]) -> Iterator[str]:
    """Source groups that occur in more than one split."""
    splits: dict[str, set[str]] = {}
    for shard in shards:
        for info in shard.objects.values():
            splits.setdefault(info.group, set()).add(info.split)
    for group, found in sorted(splits.items()):
        if len(found) > 1:
            yield f"source group {group}: in {' and '.join(sorted(found))}"


def show(report: Report, stream: TextIO) -> None:
    """Print the figures by class, the faults and the verdict."""
    for kind in ("simulated", "perturbed"):
        rows = [(name, [c for c in report.clouds if c.kind == kind and _class(c) == name]) for name in CLASSES]
        if any(clouds for _, clouds in rows):
            print(f"{kind} clouds; three numbers are quartile, median, quartile", file=stream)
            print(_row("class", *_HEAD), file=stream)
            for name, clouds in rows:
                print(_row(name, *_cells(clouds)), file=stream)
    for cloud in report.failed[:SHOWN]:
        print(f"failed: {cloud.object} {cloud.kind} {cloud.variation}: {cloud.error}", file=stream)
    for fault in report.faults[:SHOWN]:
        print(f"fault: {fault}", file=stream)
    hidden = max(0, len(report.failed) - SHOWN) + max(0, len(report.faults) - SHOWN)
    if hidden:
        print(f"... and {hidden} more", file=stream)
    verdict = "good" if report.good else f"BAD: {len(report.faults)} faults, {len(report.failed)} failed clouds"
    print(f"{len(report.clouds)} clouds of {len(report.plan.objects)} objects: {verdict}", file=stream)


def _class(cloud: Cloud) -> str:
    return cloud.object.split("/")[0]


_HEAD = ("clouds", "points", "a frame", "in 10 cm %", "coverage %", "spacing cm", "status W/S/M/-", "failed")


def _row(*cells: str) -> str:
    widths = (11, 7, 15, 17, 12, 12, 15, 15, 6)
    return "  ".join(
        cell.rjust(width) if k else cell.ljust(width) for k, (cell, width) in enumerate(zip(cells, widths, strict=True))
    )


def _cells(clouds: list[Cloud]) -> list[str]:
    """One class's line."""
    made = [cloud for cloud in clouds if not cloud.error]
    seen = [cloud for cloud in made if len(cloud)]
    of = {
        name: [c.statistics[name] for c in seen if name in c.statistics]
        for name in ("points_per_frame", "within_10cm", "coverage")
    }
    states = Counter(cloud.status for cloud in made)
    return [
        str(len(clouds)),
        _quartiles([float(len(cloud)) for cloud in made], "{:.0f}"),
        _quartiles(of["points_per_frame"], "{:.2f}"),
        _quartiles([100 * v for v in of["within_10cm"]], "{:.0f}"),
        _quartiles([100 * v for v in of["coverage"]], "{:.0f}"),
        _quartiles([c.statistics["spacing_m"] * 100 for c in seen if "spacing_m" in c.statistics], "{:.1f}"),
        "/".join(str(states[s]) for s in ("whole", "split", "merged", "missing")),
        str(len(clouds) - len(made)),
    ]


def _quartiles(values: list[float], form: str) -> str:
    """Lower quartile, median, upper quartile."""
    if not values:
        return "-"
    three: Float64 = np.percentile(values, [25, 50, 75])
    return " ".join(form.format(v) for v in three)
