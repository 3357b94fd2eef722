# SPDX-License-Identifier: Apache-2.0
"""Any folder of OBJ, PLY, GLB, OFF or STL meshes into the library format: ``python -m train.objects.folder IN OUT``.

The folder holds one subfolder a class (car, bicycle, motorcycle, pedestrian); deeper subfolders name the source group.
ShapeNet: ``--up=+y --forward=-z --length car=4.5 --length bicycle=1.75 --length motorcycle=2.1``.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge.errors import DependencyError
from edge.frames import Float64
from train.objects.mesh import CLASSES, Mesh, MeshError, stand

SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".off", ".stl")
COLUMNS = ("class", "name", "file", "licence", "attribution", "provenance_grade", "source_group")
_AXES = {sign + name: value * np.eye(3)[k] for sign, value in (("+", 1.0), ("-", -1.0)) for k, name in enumerate("xyz")}


def axes_rotation(forward: str, up: str) -> Float64:
    """Rotation [3, 3] from a file's axes to x forward, y left, z up.

    Args:
        forward, up: one of +x -x +y -y +z -z, at right angles.
    Raises:
        MeshError: anything else.
    """
    if forward not in _AXES or up not in _AXES or _AXES[forward] @ _AXES[up] != 0:
        raise MeshError("axes are not at right angles", value=f"{forward}, {up}", allowed="two of +-x, +-y, +-z")
    return np.stack([_AXES[forward], np.cross(_AXES[up], _AXES[forward]), _AXES[up]])


def read_mesh(path: Path, label: int, rotation: Float64, length_m: float | None, licence: str, group: str) -> Mesh:
    """Read one file of any format that trimesh knows.

    Args:
        path: the file.
        label: index into CLASSES.
        rotation: see axes_rotation.
        length_m: scale the mesh so that it is this long in x (tall in z for a pedestrian); None = it is in metres.
        licence, group: carried along.
    Raises:
        MeshError: unreadable or without a surface. DependencyError: trimesh is not installed.
    """
    try:
        import trimesh
    except ImportError as error:
        raise DependencyError("reading this format needs trimesh", action="pip install 'rfconstruct[train]'") from error
    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces, dtype=np.int32)
    except Exception as error:  # trimesh raises whatever the format's reader raises
        raise MeshError(f"{path.name}: unreadable mesh ({error})", allowed=", ".join(SUFFIXES)) from error
    if vertices.ndim != 2 or len(faces) == 0:
        raise MeshError(f"{path.name}: no triangles", action="point clouds cannot be scanned; give a mesh")
    vertices = vertices @ rotation.T
    if length_m is not None:
        axis = 2 if CLASSES[label] == "pedestrian" else 0
        vertices = vertices * (length_m / max(float(np.ptp(vertices[:, axis])), 1e-9))
    name = f"{CLASSES[label]}/{path.stem}"
    return Mesh(stand(vertices.astype(np.float32)), faces, label, name, group, "B", licence, path.name)


def convert(
    source: Path,
    target: Path,
    rotation: Float64,
    lengths_m: dict[str, float],
    licence: str,
) -> int:
    """Write ``<target>/<class>/<name>.npz`` and ``manifest.csv``; returns how many objects were written.

    Raises:
        MeshError: a file cannot be read, two have one name, or there is none.
    """
    rows: list[tuple[str, ...]] = []
    for label, class_name in enumerate(CLASSES):
        for path in sorted(p for p in (source / class_name).rglob("*") if p.suffix.lower() in SUFFIXES):
            parent = path.parent.relative_to(source / class_name).as_posix()
            group = path.stem if parent == "." else parent
            name = path.stem if parent == "." else f"{parent}/{path.stem}".replace("/", "_")
            mesh = read_mesh(path, label, rotation, lengths_m.get(class_name), licence, group)
            file = Path(class_name) / f"{name}.npz"
            if (target / file).exists():
                raise MeshError("an object of this name is already there", value=str(file), action="empty the target")
            (target / class_name).mkdir(parents=True, exist_ok=True)
            np.savez_compressed(target / file, vertices=mesh.vertices, faces=mesh.faces)
            rows.append((class_name, name, file.as_posix(), licence, path.name, "B", group))
    if not rows:
        raise MeshError("no meshes found", value=str(source), allowed=f"subfolders {CLASSES}, files {SUFFIXES}")
    with (target / "manifest.csv").open("w", newline="", encoding="utf-8") as lines:
        csv.writer(lines).writerows([COLUMNS, *rows])
    return len(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Convert a folder; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m train.objects.folder", description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--forward", default="+x", help="the files' forward axis (default +x)")
    parser.add_argument("--up", default="+z", help="the files' up axis (default +z)")
    parser.add_argument("--length", action="append", default=[], metavar="CLASS=METRES", help="scale to this size")
    parser.add_argument("--licence", default="unknown", help="licence of the files, written to the manifest")
    options = parser.parse_args(arguments)
    lengths = {key: float(value) for key, value in (item.split("=", 1) for item in options.length)}
    rotation = axes_rotation(options.forward, options.up)
    print(convert(options.source, options.target, rotation, lengths, options.licence), "objects")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
