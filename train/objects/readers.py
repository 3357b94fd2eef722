# SPDX-License-Identifier: Apache-2.0
"""Triangles from a file of any common mesh format: OBJ, PLY, GLB, GLTF, OFF, STL through trimesh, NPZ directly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.errors import DependencyError
from edge.frames import Float64
from train.objects.mesh import MeshError

SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".off", ".stl", ".npz")
Faces = NDArray[np.int64]
Soup = tuple[Float64, Faces]
"""Vertices float64 [n, 3] and faces int64 [m, 3]."""
_AXES = {sign + name: value * np.eye(3)[k] for sign, value in (("+", 1.0), ("-", -1.0)) for k, name in enumerate("xyz")}


def read_soup(path: Path) -> Soup:
    """All triangles of a file in the file's own axes and unit; the parts of a scene at their places.

    Raises:
        MeshError: unreadable, without triangles, a vertex that is not finite, a face that names no vertex.
        DependencyError: trimesh is not installed.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(f"{path.name}: not a mesh file", allowed=", ".join(SUFFIXES))
    vertices, faces = _npz(path) if path.suffix.lower() == ".npz" else _trimesh(path)
    if vertices.ndim != 2 or faces.ndim != 2 or vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or not len(faces):
        raise MeshError(f"{path.name}: no triangles", action="point clouds cannot be scanned; give a mesh")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(f"{path.name}: a face names a vertex that is not there", value=int(faces.max()))
    if not np.isfinite(vertices).all():
        raise MeshError(f"{path.name}: a vertex is not finite")
    return vertices, faces


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


def load_trimesh() -> Any:
    """The trimesh module.

    Raises:
        DependencyError: it is not installed.
    """
    try:
        import trimesh
    except ImportError as error:
        raise DependencyError("importing meshes needs trimesh", action="pip install 'rfconstruct[train]'") from error
    return trimesh


def _npz(path: Path) -> Soup:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return archive["vertices"].astype(np.float64), archive["faces"].astype(np.int64)
    except (OSError, KeyError, ValueError) as error:
        raise MeshError(
            f"{path.name}: unreadable mesh ({error})", allowed="npz with vertices [n, 3] and faces [m, 3]"
        ) from error


def _trimesh(path: Path) -> Soup:
    trimesh = load_trimesh()
    options = {"skip_materials": True} if path.suffix.lower() == ".obj" else {}
    try:
        loaded = trimesh.load(path, force="mesh", process=False, **options)
        return np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces, dtype=np.int64)
    except Exception as error:  # trimesh raises whatever the format's reader raises
        raise MeshError(f"{path.name}: unreadable mesh ({error})", allowed=", ".join(SUFFIXES)) from error
