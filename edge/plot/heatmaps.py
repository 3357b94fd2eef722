# SPDX-License-Identifier: Apache-2.0
"""Picture of one frame: each radar's heatmap in its own plane, with the detections on it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from edge.frames import Detections, Float32, Heatmap, RadarId
from edge.plot.figure import INK, MUTED, dress, new_figure, write

DYNAMIC_RANGE_DB = 45.0
SHOWN_COSINE = np.sin(np.radians(70.0))
FIELD_OF_VIEW_COSINE = np.sin(np.radians(45.0))
PLANE = {
    "horizontal": ("Horizontal radar", "left  y (m)", "forward  x (m)"),
    "vertical": ("Vertical radar", "up  z (m)", "forward  x (m)"),
}


def heatmap_picture(
    path: Path,
    heatmaps: Mapping[RadarId, Heatmap],
    detections: Mapping[RadarId, Detections],
    subtitle: str,
    max_range_m: float = 12.0,
) -> Path:
    """Write the heatmaps of one frame side by side.

    Args:
        path: of the PNG.
        heatmaps, detections: radar id -> data of the same frame.
        subtitle: what was recorded, in one line.
        max_range_m: farther cells are not drawn.
    """
    number = next(iter(heatmaps.values())).number
    figure = new_figure(6.6 * len(heatmaps), 6.4, f"Range-angle heatmaps and CFAR detections, frame {number}", subtitle)
    for axes, (radar, heatmap) in zip(_row(figure, len(heatmaps)), heatmaps.items(), strict=True):
        _panel(figure, axes, heatmap, detections[radar], max_range_m)
    return write(figure, path)


def _row(figure: Any, count: int) -> list[Any]:
    return list(np.atleast_1d(figure.subplots(1, count)).ravel())


def _panel(figure: Any, axes: Any, heatmap: Heatmap, found: Detections, max_range_m: float) -> None:
    name, lateral, forward = PLANE[heatmap.radar]
    power_db, along_m, forward_m = _cartesian(heatmap, max_range_m)
    top_db = float(power_db[:, heatmap.range_m[: power_db.shape[1]] > 1.0].max())
    mesh = axes.pcolormesh(
        *(along_m, forward_m, power_db),
        cmap="magma", vmin=top_db - DYNAMIC_RANGE_DB, vmax=top_db, shading="nearest", rasterized=True,
    )
    shown = (found.range_m <= max_range_m) & (np.abs(found.direction_cosine) <= SHOWN_COSINE)
    r, u = found.range_m[shown], found.direction_cosine[shown]
    axes.scatter(r * u, r * np.sqrt(1 - u**2), s=26, facecolors="none", edgecolors="#7ef0ff", linewidths=1.0)
    for side in (-1.0, 1.0):
        edge = max_range_m * side * FIELD_OF_VIEW_COSINE
        axes.plot([0, edge], [0, abs(edge)], color="white", linewidth=0.7, linestyle=":", alpha=0.7)
    dress(axes, f"{name}: {int(shown.sum())} detections shown, {len(found)} in all", lateral, forward)
    axes.grid(False)
    axes.set_aspect("equal")
    if heatmap.radar == "horizontal":
        axes.invert_xaxis()
    bar = figure.colorbar(mesh, ax=axes, shrink=0.8, pad=0.01)
    bar.set_label("power (dB over 1 LSB²)", fontsize=9, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=INK)


def _cartesian(heatmap: Heatmap, max_range_m: float) -> tuple[Float32, Float32, Float32]:
    """Power in dB and the position of every shown cell, [angle, range] each."""
    angle = np.abs(heatmap.direction_cosine) <= SHOWN_COSINE
    last = max(2, int(np.searchsorted(heatmap.range_m, max_range_m)))
    power_db = 10.0 * np.log10(np.maximum(heatmap.power[angle, :last], 1e-6))
    u, r = heatmap.direction_cosine[angle][:, None], np.maximum(heatmap.range_m[None, :last], 0.0)
    return power_db, r * u, r * np.sqrt(1.0 - u**2)
