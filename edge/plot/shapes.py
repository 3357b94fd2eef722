# SPDX-License-Identifier: Apache-2.0
"""Picture of one completed object: radar points, coarse and fine shape, side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from edge.best_shapes import class_text
from edge.frames import Float32, Shape
from edge.plot.figure import BOTH, COARSE, GRID, INK, INPUT, MUTED, new_figure, write

TOP_DEG = 90.0
VIEWS = (("three-quarter view", 22.0, -55.0), ("from above", TOP_DEG, -90.0))


def shape_picture(path: Path, shape: Shape, subtitle: str, truth_m: Float32 | None = None) -> Path:
    """Write two rows of views: radar points, coarse shape, fine shape and, when it is known, the truth.

    Args:
        path: of the PNG.
        shape: in the object frame.
        subtitle: one line.
        truth_m: float32 [n, 3], points of the true object in the object frame; only a simulated scene has them.
    """
    columns: list[tuple[str, str, Float32, float]] = [
        (f"radar points ({len(shape.input)})", INPUT, shape.input.xyz_m, 6.0),
        (f"coarse ({len(shape.coarse_m)})", COARSE, shape.coarse_m, 4.0),
        (f"fine ({len(shape.fine_m)})", BOTH, shape.fine_m, 0.7),
    ]
    if truth_m is not None:
        columns.append((f"truth ({len(truth_m)})", INK, truth_m, 0.7))
    title = f"Object {shape.identity}: {class_text(shape)} (confidence {shape.confidence:.2f})"
    figure = new_figure(4.1 * len(columns), 7.6, title, subtitle)
    together = np.concatenate([points for _, _, points, _ in columns])
    low, high = together.min(axis=0), together.max(axis=0)
    for index, (name, colour, points, size) in enumerate(columns):
        for row, (view, elevation, azimuth) in enumerate(VIEWS):
            axes = figure.add_subplot(2, len(columns), row * len(columns) + index + 1, projection="3d")
            axes.scatter(*points.T, s=size, c=colour, alpha=0.8, linewidths=0)
            _box(axes, low, high)
            axes.view_init(elevation, azimuth)
            if elevation == TOP_DEG:
                axes.set_zticks([])
                axes.set_zlabel("")
            axes.set_title(name if row == 0 else view, fontsize=10, color=INK if row == 0 else MUTED)
    return write(figure, path)


def _box(axes: Any, low: Float32, high: Float32) -> None:
    """Equal scales on all axes."""
    extent = np.maximum(high - low, 0.2)
    for name, a, b in zip("xyz", low, high, strict=True):
        getattr(axes, f"set_{name}lim")(a, max(b, a + 0.2))
        getattr(axes, f"set_{name}label")(f"{name} (m)", fontsize=8, color=MUTED)
        getattr(axes, f"{name}axis").pane.set_edgecolor(GRID)
        getattr(axes, f"{name}axis").pane.set_facecolor("white")
    axes.set_box_aspect(tuple(extent))
    axes.tick_params(labelsize=7, colors=MUTED)
    axes.locator_params(nbins=5)
