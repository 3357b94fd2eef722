# SPDX-License-Identifier: Apache-2.0
"""Clouds for tests of the data set's machinery: points on the object itself at a known pose, made in a millisecond."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from train.objects.reference import ObjectRef
from train.objects.sampling import sample_surface
from train.simulate.pool import guarded
from train.simulate.recipe import Recipe
from train.simulate.shards import Cloud
from train.simulate.work import Item, Plan

SIZE = {"objects": 6, "drive_bys": 2, "perturbed": 1, "val_share": 0.2, "test_share": 0.2}


def small_plan(seed: int = 0, **sizes: int) -> Plan:
    """Six parametric objects with three clouds each: three shards of six. The library is not used."""
    recipe = Recipe().resized(**SIZE | sizes)  # type: ignore[arg-type]
    count = recipe.set.objects
    names = ("car", "bicycle", "motorcycle", "pedestrian")
    return Plan(recipe.settings, "", seed, tuple(f"{names[k % 4]}/parametric_{k:05d}" for k in range(count)))


class Here:
    """A pool that works in this process; after ``stop_after`` items it raises what a user's Ctrl-C raises."""

    def __init__(self, stop_after: int = 10**9) -> None:
        self.left = stop_after

    def run(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        for item in items:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            yield item, guarded(function, item)


def fake_cloud(item: Item) -> Cloud:
    """300 points on the surface, turned by a yaw and moved; seen from 6 m away."""
    rng = np.random.default_rng(item.seed)
    mesh = ObjectRef.from_text(item.object).mesh()
    yaw = rng.uniform(0, 2 * math.pi)
    rotation = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    translation = np.array([*rng.normal(0, 0.2, 2), 0.0])
    points = sample_surface(mesh.vertices, mesh.faces, 300, rng) @ rotation.T + translation
    return Cloud(
        *(item.object, item.kind, item.variation, item.seed, points.astype(np.float32)),
        *(rng.normal(90, 5, 300).astype(np.float32), np.sort(rng.integers(0, 120, 300))),
        *(np.array([0.5, -6.0, 0.8]), rotation, translation, 120, 2.9),
        {"points_per_frame": 2.5, "within_10cm": 0.95, "coverage": 0.4, "spacing_m": 0.03},
    )


def slow_cloud(item: Item) -> Cloud:
    """As fake_cloud, slow enough to be killed half way."""
    import time

    time.sleep(0.15)
    return fake_cloud(item)


def dying_cloud(item: Item) -> Cloud:
    """One of the clouds kills its process, one raises."""
    if item.kind == "simulated" and item.variation == 0:
        if item.object == "car/parametric_00004":
            os.kill(os.getpid(), signal.SIGKILL)
        if item.object == "car/parametric_00000":
            raise ValueError("no such thing")
    return fake_cloud(item)


def counted_cloud(folder: Path, item: Item) -> Cloud:
    """As fake_cloud; leaves a mark for every cloud that is made."""
    with (folder / "made").open("a") as file:
        file.write(f"{item.object} {item.kind} {item.variation}\n")
    return fake_cloud(item)
