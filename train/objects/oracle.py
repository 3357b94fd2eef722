# SPDX-License-Identifier: Apache-2.0
"""How near the nearest training object is to an unseen one: what a perfect look-up reaches, and what variation adds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.frames import Float32
from train.objects.deform import DeformSettings
from train.objects.library import PROCEDURAL
from train.objects.mesh import ClassName, Mesh, stand
from train.objects.parametric import generate
from train.objects.reference import ObjectRef, library_refs
from train.objects.sampling import sample_surface

PLAIN_LATTICE = DeformSettings(overhang_share=0, wheelbase_share=0, greenhouse_share=0, width_share=0)
"""Only the lattice and the scale."""


def oracle(
    class_name: ClassName, variants: int, points: int, objects_dir: Path | None = None
) -> Iterator[tuple[str, int, float, float]]:
    """Symmetric Chamfer distance of every unseen (val and test) object to its nearest one of several sets.

    Args:
        class_name: which class.
        variants: deformations of each collected training object, and parametric objects per training object.
        points: of each cloud; a cloud against another of the same surface has the floor of this number.
    Yields:
        Name of the set, its size, median and largest distance in metres (mean of both directions).
    """
    refs = [r for r in library_refs(objects_dir) if r.class_name == class_name]
    collected = [r for r in refs if r.entry(objects_dir).provenance != PROCEDURAL]
    train = [r for r in collected if r.entry(objects_dir).split == "train"]
    unseen = [_cloud(r.mesh(objects_dir), points, 1) for r in collected if r.entry(objects_dir).split != "train"]
    plain = [r.mesh(objects_dir) for r in train]
    sets: list[tuple[str, Iterable[Mesh]]] = [
        ("collected", plain),
        ("+ lattice", _varied(train, variants, PLAIN_LATTICE, objects_dir)),
        ("+ lattice and stretch", _varied(train, variants, DeformSettings(), objects_dir)),
        ("+ parametric", (generate(class_name, 3 * k) for k in range(variants * len(train)))),
    ]
    base = np.full(len(unseen), np.inf)
    for name, meshes in sets:
        best, count = base.copy(), 0 if name == "collected" else len(train)
        for mesh in meshes:
            cloud = _cloud(mesh, points, 0)
            best = np.minimum(best, [_chamfer(cloud, other) for other in unseen])
            count += 1
        if name == "collected":
            base = best
        yield name, count, float(np.median(best)), float(best.max())


def _varied(refs: list[ObjectRef], variants: int, settings: DeformSettings, objects_dir: Path | None) -> Iterator[Mesh]:
    for ref in refs:
        for seed in range(variants):
            yield replace(ref, deform_seed=seed).mesh(objects_dir, settings)


def _cloud(mesh: Mesh, points: int, seed: int) -> tuple[Float32, Any]:
    from scipy.spatial import cKDTree

    cloud = sample_surface(stand(mesh.vertices), mesh.faces, points, np.random.default_rng(seed))
    return cloud, cKDTree(cloud)


def _chamfer(a: tuple[Float32, Any], b: tuple[Float32, Any]) -> float:
    return float((b[1].query(a[0])[0].mean() + a[1].query(b[0])[0].mean()) / 2)
