# SPDX-License-Identifier: Apache-2.0
"""Picture of one frame: each radar's heatmap in its own plane, with the detections on it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from edge.frames import Detections, Float32, Heatmap, RadarId
from edge.plot.figure import INK, MUTED, dress, new_figure, write

DYNAMIC_RANGE_DB = 50.0
SHOWN_COSINE = np.sin(np.radians(70.0))
NEAREST_LIMIT_M, FARTHEST_LIMIT_M = 5.0, 15.0
VERTICAL_MARGIN = 1.06
"""Heights are drawn up to somewhat more than the field of view."""


def heatmap_picture(
    path: Path,
    heatmaps: Mapping[RadarId, Heatmap],
    detections: Mapping[RadarId, Detections],
    subtitle: str,
    fov_deg: float,
) -> Path:
    """Write the heatmaps of one frame: the horizontal radar from above, the vertical one from the side.

    Args:
        path: of the PNG.
        heatmaps, detections: radar id -> data of the same frame.
        subtitle: what was recorded, in one line.
        fov_deg: field of view of the association along each array, drawn as two rays.
    """
    number = next(iter(heatmaps.values())).number
    limit_m = range_limit_m(detections)
    size_in = (7.4, 5.8) if len(heatmaps) == 1 else (12.6, 6.6)
    figure = new_figure(*size_in, f"Range-angle heatmaps and CFAR detections, frame {number}", subtitle)
    for axes, (radar, heatmap) in zip(_row(figure, len(heatmaps)), heatmaps.items(), strict=True):
        heatmap_panel(figure, axes, heatmap, detections[radar], limit_m, np.radians(fov_deg))
    return write(figure, path)


def range_limit_m(detections: Mapping[RadarId, Detections]) -> float:
    """Range up to which cells are drawn: somewhat beyond nearly all detections."""
    ranges = np.concatenate([found.range_m for found in detections.values()])
    reach_m = 1.5 * float(np.percentile(ranges, 90)) if len(ranges) else FARTHEST_LIMIT_M
    return float(np.clip(reach_m, NEAREST_LIMIT_M, FARTHEST_LIMIT_M))


def _row(figure: Any, count: int) -> list[Any]:
    ratios = [1.88, 1.0][:count]
    return list(np.atleast_1d(figure.subplots(1, count, width_ratios=ratios)).ravel())


def heatmap_panel(
    figure: Any,
    axes: Any,
    heatmap: Heatmap,
    found: Detections,
    limit_m: float,
    fov_rad: float,
    span_db: float = DYNAMIC_RANGE_DB,
) -> None:
    """One radar's heatmap and detections up to ``limit_m`` into ``axes``, with a colour bar of ``figure``."""
    from_above = heatmap.radar == "horizontal"
    power_db, along_m, forward_m = _cartesian(heatmap, limit_m)
    top_db = float(power_db[:, heatmap.range_m[: power_db.shape[1]] > 1.0].max())
    shown = (found.range_m <= limit_m) & (np.abs(found.direction_cosine) <= SHOWN_COSINE)
    r, u = found.range_m[shown], found.direction_cosine[shown]
    edge_m, ahead_m = limit_m * float(np.sin(fov_rad)), limit_m * float(np.cos(fov_rad))
    corners, spots = (along_m, forward_m), (r * u, r * np.sqrt(1 - u**2))
    rays = [((0.0, side * edge_m), (0.0, ahead_m)) for side in (-1.0, 1.0)]
    if not from_above:
        corners, spots, rays = corners[::-1], spots[::-1], [ray[::-1] for ray in rays]
    mesh = axes.pcolormesh(
        *(*corners, power_db),
        cmap="magma",
        vmin=top_db - span_db,
        vmax=top_db,
        shading="flat",
        rasterized=True,
    )
    axes.scatter(*spots, s=26, facecolors="none", edgecolors="#7ef0ff", linewidths=1.0)
    for ray in rays:
        axes.plot(*ray, color="white", linewidth=0.7, linestyle=":", alpha=0.7)
    name = "Horizontal radar, from above" if from_above else "Vertical radar, from the side"
    labels = ("left  y (m)", "forward  x (m)") if from_above else ("forward  x (m)", "up  z (m)")
    dress(axes, f"{name}\n{int(shown.sum())} of {len(found)} detections in the picture", *labels)
    axes.grid(False)
    axes.set_aspect("equal")
    if from_above:
        axes.invert_xaxis()
    else:
        axes.set_ylim(-VERTICAL_MARGIN * edge_m, VERTICAL_MARGIN * edge_m)
    bar = figure.colorbar(mesh, ax=axes, shrink=0.7, pad=0.02, location="bottom")
    bar.set_label("power (dB over 1 LSB²)", fontsize=9, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=INK)


def _cartesian(heatmap: Heatmap, max_range_m: float) -> tuple[Float32, Float32, Float32]:
    """Power of every shown cell in dB, [angle, range], and the cells' corners, [angle + 1, range + 1] each."""
    angle = np.abs(heatmap.direction_cosine) <= SHOWN_COSINE
    last = max(2, int(np.searchsorted(heatmap.range_m, max_range_m)))
    power_db = 10.0 * np.log10(np.maximum(heatmap.power[angle, :last], 1e-6))
    u = np.clip(_edges(heatmap.direction_cosine[angle]), -1.0, 1.0)[:, None]
    r = np.maximum(_edges(heatmap.range_m[:last]), 0.0)[None, :]
    return power_db.astype(np.float32), r * u, (r * np.sqrt(1.0 - u**2)).astype(np.float32)


def _edges(centres: Float32) -> Float32:
    """Borders between equally spaced cells."""
    half = 0.5 * (centres[1] - centres[0])
    return np.append(centres - half, centres[-1] + half).astype(np.float32)
