# SPDX-License-Identifier: Apache-2.0
"""Contact sheets for the eye: objects as shaded surfaces, and samples of the data set as clouds."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge.errors import DependencyError
from edge.frames import Float32
from train.depth_scan import project, rasterize
from train.objects.mesh import Mesh

if TYPE_CHECKING:
    from train.dataset import CompletionDataset


def shade(mesh: Mesh, position: tuple[float, float, float], columns: int = 320, rows: int = 200) -> NDArray[np.float32]:
    """A grey picture of a mesh by the z-buffer: brightness is the cosine of the incidence, white is nothing.

    Args:
        mesh: the object.
        position: the eye in units of the object's largest extent, from its centre.
    Returns:
        float32 [rows, columns], 0..1.
    """
    center = np.array([0, 0, float(mesh.size_m[2]) / 2])
    eye = center + np.asarray(position) * float(mesh.size_m.max())
    camera, _, pinhole = project(mesh.vertices, eye, center, columns, rows)
    depth = np.empty((rows, columns), np.float32)
    hit = np.empty((rows, columns), np.int32)
    rasterize(camera, mesh.faces, *pinhole, depth, hit)
    a, b, c = (camera[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = np.abs(normal @ np.array([0.35, 0.75, 0.55]))
    picture = np.where(hit >= 0, 0.15 + 0.75 * light[hit], 1.0)
    return picture.astype(np.float32)


def _pyplot() -> Any:
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise DependencyError("contact sheets need matplotlib", action="pip install 'rfconstruct[plot]'") from error
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    return plt


def object_sheet(meshes: Sequence[Mesh], path: Path, columns: int = 4) -> None:
    """Side and oblique view of every mesh, with its size, as one PNG of 24 greys."""
    plt = _pyplot()
    from PIL import Image  # comes with matplotlib

    rows = -(-len(meshes) // columns)
    figure, axes = plt.subplots(rows, 2 * columns, figsize=(4 * columns, 1.5 * rows), squeeze=False)
    for axis in axes.ravel():
        axis.set_axis_off()
    for number, mesh in enumerate(meshes):
        row, column = divmod(number, columns)
        for part, eye in enumerate(((0.0, -4.0, 0.0), (2.2, -2.6, 1.2))):
            axes[row, 2 * column + part].imshow(shade(mesh, eye), cmap="gray", vmin=0, vmax=1)
        size = " x ".join(f"{s:.2f}" for s in mesh.size_m)
        axes[row, 2 * column].set_title(f"{mesh.object_id} {size} m, {len(mesh.faces)} faces", fontsize=6, loc="left")
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    with Image.open(path) as picture:
        small = picture.convert("L").quantize(24, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


def _scatter(axis: Any, points: Float32, color: str, size: float, axes: tuple[int, int]) -> None:
    axis.scatter(points[:, axes[0]], points[:, axes[1]], s=size, c=color, linewidths=0)


def sample_sheet(dataset: CompletionDataset, path: Path, count: int = 16) -> None:
    """Truth (grey) and partial cloud (red) of the first samples, from above and from the side, as one PNG."""
    plt = _pyplot()
    columns = 4
    rows = -(-count // columns)
    figure, axes = plt.subplots(rows, 2 * columns, figsize=(4 * columns, 2.2 * rows), squeeze=False)
    for number in range(count):
        sample = dataset[number]
        row, column = divmod(number, columns)
        for part, view in enumerate(((0, 1), (0, 2))):
            axis = axes[row, 2 * column + part]
            _scatter(axis, sample.truth[:3000], "0.75", 1.0, view)
            _scatter(axis, sample.partial, "tab:red", 2.0, view)
            axis.set_aspect("equal")
            axis.tick_params(labelsize=5)
        axes[row, 2 * column].set_title(f"{sample.object_id}, {len(sample.partial)} points", fontsize=6, loc="left")
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write sheets of samples; returns the exit code. Those of objects: ``rfconstruct-train objects sheet``."""
    from train.dataset import CompletionDataset, DatasetSettings
    from train.perturb import PerturbSettings

    parser = argparse.ArgumentParser(prog="python -m train.contact_sheet", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for the PNG files")
    parser.add_argument("--count", type=int, default=16, help="samples of a sheet")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    settings = DatasetSettings.default()
    sample_sheet(CompletionDataset("train", settings, 0), options.out / "samples_train.png", options.count)
    paper = DatasetSettings.default(perturbation=PerturbSettings.paper(), box_frame=True)
    sample_sheet(CompletionDataset("val", paper, 0), options.out / "samples_paper.png", options.count)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
