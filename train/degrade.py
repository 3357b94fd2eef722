# SPDX-License-Identifier: Apache-2.0
"""Held-out clouds made worse on purpose: fewer frames or points, ghosts, neighbours, outliers, smear; and clutter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from edge.completion.sight import turned
from edge.frames import Float32
from train.held_out import Case

_LEAST_POINTS, _MOST_POINTS = 64, 2048
_GHOST_SIGMA_M = 0.1
_OUTLIER_MARGIN_M = 0.5
_GAP_M = (0.5, 1.5)

Generator = np.random.Generator
Change = Callable[[Case, float, Generator, Sequence[Case]], Case | None]


def frames(case: Case, level: float, rng: Generator, others: Sequence[Case]) -> Case | None:
    """Only so many frames in a row about the middle of the window; None for scans, short windows and empty results."""
    if case.frame_number is None or level > case.frames:
        return None
    first = (case.frames - level) / 2
    seen = (case.frame_number >= first) & (case.frame_number < first + level)
    return case.seen_as(case.sample.partial[seen], int(level)) if seen.sum() >= _LEAST_POINTS else None


def points(case: Case, level: float, rng: Generator, others: Sequence[Case]) -> Case | None:
    """Only so many points, at random; None where there are fewer."""
    cloud = case.sample.partial
    if len(cloud) < level:
        return None
    return case.seen_as(cloud[rng.permutation(len(cloud))[: int(level)]])


def ghosts(case: Case, level: float, rng: Generator, others: Sequence[Case]) -> Case | None:
    """This share of the points again, mirrored in a ground of uncertain height."""
    cloud = _chosen(case.sample.partial, level, rng)
    cloud[:, 2] = rng.normal(0, _GHOST_SIGMA_M, len(cloud)) - cloud[:, 2]
    return _with(case, cloud, rng)


def outliers(case: Case, level: float, rng: Generator, others: Sequence[Case]) -> Case | None:
    """This share of points more, anywhere in the cloud's box and half a metre around it, not below the ground."""
    cloud = case.sample.partial
    low, high = cloud.min(axis=0) - _OUTLIER_MARGIN_M, cloud.max(axis=0) + _OUTLIER_MARGIN_M
    low[2] = max(low[2], 0)
    return _with(case, rng.uniform(low, high, (round(level * len(cloud)), 3)), rng)


def neighbours(case: Case, level: float, rng: Generator, others: Sequence[Case]) -> Case | None:
    """This share of points more, from another object that stands half a metre to one and a half beside the cloud."""
    cloud, other = case.sample.partial, others[int(rng.integers(len(others)))].sample.partial
    side = 1.0 if rng.random() < 0.5 else -1.0
    gap_m = side * rng.uniform(*_GAP_M)
    moved = other - (other.max(axis=0) + other.min(axis=0)) / 2 * (1, 1, 0)
    edges = (cloud[:, 1].max(), moved[:, 1].min()) if side > 0 else (cloud[:, 1].min(), moved[:, 1].max())
    moved[:, 1] += edges[0] + gap_m - edges[1]
    closest = moved[np.argsort(side * moved[:, 1])]
    return _with(case, closest[: round(level * len(cloud))], rng)


def smear(case: Case, level: float, rng: Generator, others: Sequence[Case]) -> Case | None:
    """Odometry that drifts: the cloud is sheared along the path (y) by so many metres from first frame to last.

    Points of a scan get a random time; those of a drive-by have their own.
    """
    cloud = case.sample.partial.copy()
    when = rng.random(len(cloud)) if case.frame_number is None else case.frame_number / max(case.frames - 1, 1)
    cloud[:, 1] += level * (when - 0.5)
    return case.seen_as(cloud)


@dataclass(frozen=True, slots=True)
class Degradation:
    """One way to make a cloud worse.

    Args:
        name: for tables. unit: of the levels. levels: from good to bad. change: (case, level, generator, other cases).
    """

    name: str
    unit: str
    levels: tuple[float, ...]
    change: Change


DEGRADATIONS = (
    Degradation("merged frames", "frames", (400, 200, 100, 50, 25, 12), frames),
    Degradation("points", "points", (2048, 1024, 512, 256, 128, 64), points),
    Degradation("ghosts below ground", "share", (0.0, 0.05, 0.1, 0.2, 0.4), ghosts),
    Degradation("neighbours' points", "share", (0.0, 0.1, 0.2, 0.4, 0.8), neighbours),
    Degradation("outliers", "share", (0.0, 0.02, 0.05, 0.1, 0.2, 0.5), outliers),
    Degradation("pose smear", "m", (0.0, 0.05, 0.1, 0.2, 0.4, 0.8), smear),
)


def worsened(case: Case, rng: Generator, others: Sequence[Case]) -> Case:
    """A case with one degradation of a random level, or as it is where that one does not apply."""
    chosen = DEGRADATIONS[int(rng.integers(len(DEGRADATIONS)))]
    low, high = min(chosen.levels), max(chosen.levels)
    level = rng.uniform(low, high) if low == 0 else np.exp(rng.uniform(np.log(low), np.log(high)))
    found = chosen.change(case, float(level if low == 0 else round(level)), rng, others)
    return case if found is None else found


def _chosen(cloud: Float32, share: float, rng: Generator) -> Float32:
    return cloud[rng.choice(len(cloud), min(len(cloud), round(share * len(cloud))), replace=False)].copy()


def _with(case: Case, more: np.ndarray, rng: Generator) -> Case:
    """The case with points added, in random order, at most as many as a network takes."""
    cloud = np.concatenate([case.sample.partial, np.asarray(more, np.float32)])
    return case.seen_as(cloud[rng.permutation(len(cloud))[:_MOST_POINTS]])


CLUTTER = ("wall", "corner", "hedge", "bush", "pole", "tree", "sign", "kerb", "box", "scatter", "reflectors")


def clutter(kind: str, rng: Generator) -> Float32:
    """A cloud of something that is no road user, as the cascade pair might see it: clusters, gaps, noise.

    Args:
        kind: of ``CLUTTER``. rng: of size, heading, density, gaps and noise.
    Returns:
        float32 [64..1024, 3] in the line-of-sight frame, x and y about the middle of its box.
    """
    count = round(np.exp(rng.uniform(np.log(_LEAST_POINTS), np.log(1024))))
    cloud = _SHAPES[kind](3 * count, rng)
    spots = cloud[rng.integers(len(cloud), size=int(rng.integers(4, 20)))]
    nearest = np.sqrt(((cloud[:, None] - spots) ** 2).sum(axis=2).min(axis=1))
    weight = np.exp(-0.5 * (nearest / rng.uniform(0.15, 1.0)) ** 2) + rng.uniform(0.01, 0.3)
    seen = cloud[rng.choice(len(cloud), count, replace=False, p=weight / weight.sum())]
    seen = seen + rng.normal(size=seen.shape) * rng.uniform(0.02, 0.12)
    seen[:, 2] = np.abs(seen[:, 2])
    seen = turned(seen.astype(np.float32), rng.uniform(-np.pi, np.pi))
    seen[:, :2] -= (seen[:, :2].max(axis=0) + seen[:, :2].min(axis=0)) / 2
    return np.ascontiguousarray(seen, np.float32)


def clutter_cases(models: Sequence[Case], count: int, seed: int = 0) -> list[Case]:
    """Cases of clutter, kinds in turn; windows are those of ``models`` in turn, whose truth then means nothing."""
    generators = [np.random.default_rng([seed, number]) for number in range(count)]
    clouds = [clutter(CLUTTER[number % len(CLUTTER)], rng) for number, rng in enumerate(generators)]
    return [models[number % len(models)].seen_as(cloud) for number, cloud in enumerate(clouds)]


def _wall(count: int, rng: Generator) -> np.ndarray:
    return rng.uniform(0, 1, (count, 3)) * (rng.uniform(1.5, 7), 0.02, rng.uniform(0.8, 3))


def _corner(count: int, rng: Generator) -> np.ndarray:
    first, second = _wall(count // 2, rng), _wall(count - count // 2, rng)
    return np.concatenate([first, second[:, [1, 0, 2]]])


def _hedge(count: int, rng: Generator) -> np.ndarray:
    return rng.uniform(0, 1, (count, 3)) * (rng.uniform(1.5, 6), rng.uniform(0.3, 1), rng.uniform(0.6, 2))


def _ball(count: int, rng: Generator) -> np.ndarray:
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ball: np.ndarray = direction * rng.uniform(0, 1, (count, 1)) ** (1 / 3)
    return ball


def _bush(count: int, rng: Generator) -> np.ndarray:
    size = rng.uniform((0.3, 0.3, 0.25), (1.2, 1.2, 1.0))
    return _ball(count, rng) * size + (0, 0, size[2])


def _pole(count: int, rng: Generator) -> np.ndarray:
    angle, radius = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.02, 0.2)
    height = rng.uniform(0, rng.uniform(1.0, 3.0), count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _tree(count: int, rng: Generator) -> np.ndarray:
    crown = _ball(2 * count // 3, rng) * rng.uniform(0.5, 1.5) + np.array([0, 0, 2.4])
    whole = np.concatenate([_pole(count - len(crown), rng), crown])
    whole[:, 2] = np.clip(whole[:, 2], 0, 3)
    return whole


def _sign(count: int, rng: Generator) -> np.ndarray:
    plate = rng.uniform(-0.5, 0.5, (count // 2, 3)) * (rng.uniform(0.4, 0.9), 0.01, rng.uniform(0.4, 0.9))
    return np.concatenate([_pole(count - len(plate), rng), plate + np.array([0, 0, rng.uniform(1.8, 2.6)])])


def _kerb(count: int, rng: Generator) -> np.ndarray:
    return rng.uniform(0, 1, (count, 3)) * (rng.uniform(1.5, 6), rng.uniform(0.1, 0.5), rng.uniform(0.1, 0.25))


def _box(count: int, rng: Generator) -> np.ndarray:
    cube = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(3, size=count)
    cube[np.arange(count), axis] = np.sign(cube[np.arange(count), axis]) * 0.5
    size = rng.uniform((0.4, 0.4, 0.5), (2.0, 1.2, 1.6))
    return cube * size + (0, 0, size[2] / 2)


def _scatter(count: int, rng: Generator) -> np.ndarray:
    return rng.uniform(0, 1, (count, 3)) * rng.uniform((0.8, 0.8, 0.8), (5, 4, 3))


def _reflectors(count: int, rng: Generator) -> np.ndarray:
    """A few corner reflectors, lamps, bolts: points in the room, nothing between them."""
    extent = rng.uniform((0.3, 0.3, 0.3), (5.0, 2.5, 2.0))
    places = rng.uniform(0, 1, (int(rng.integers(1, 7)), 3)) * extent + (0, 0, 0.1)
    chosen: np.ndarray = places[rng.integers(len(places), size=count)]
    return chosen


_SHAPES: dict[str, Callable[[int, Generator], np.ndarray]] = {
    "wall": _wall,
    "corner": _corner,
    "hedge": _hedge,
    "bush": _bush,
    "pole": _pole,
    "tree": _tree,
    "sign": _sign,
    "kerb": _kerb,
    "box": _box,
    "scatter": _scatter,
    "reflectors": _reflectors,
}
