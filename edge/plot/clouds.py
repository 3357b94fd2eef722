# SPDX-License-Identifier: Apache-2.0
"""Picture of a fused window from three sides: the horizontal radar alone, the vertical one alone, and both together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.frames import Float32, FusedCloud
from edge.plot.figure import BOTH, HORIZONTAL, VERTICAL, dress, new_figure, write

SIDES = (("from above", 1, 0), ("from the radar", 1, 2), ("from the side", 0, 2))
AXIS_LABEL = ("forward  x (m)", "left  y (m)", "up  z (m)")


@dataclass(frozen=True, slots=True)
class Layer:
    """One row of the picture.

    Args:
        title: which radar, and what it cannot know.
        colour: of its points.
        xyz_m: float32 [n, 3] in the window frame.
        weight: float32 [n], 0..1, drawn as opacity.
    """

    title: str
    colour: str
    xyz_m: Float32
    weight: Float32


def cloud_picture(path: Path, cloud: FusedCloud, horizontal: Float32, vertical: Float32, subtitle: str) -> Path:
    """Write three rows (horizontal, vertical, both) of three views each.

    Args:
        path: of the PNG.
        cloud: the window, of both radars together.
        horizontal: float32 [n, 4] x, y, z, power dB of the horizontal radar's detections in the window frame; their
            elevation is unknown, they lie in the plane of the array.
        vertical: likewise; their azimuth is unknown.
        subtitle: one line.
    """
    both = np.column_stack((cloud.xyz_m, cloud.power_db)).astype(np.float32)
    layers = (
        _layer("Horizontal radar alone (no elevation: drawn at the radar's height)", HORIZONTAL, horizontal),
        _layer("Vertical radar alone (no azimuth: drawn straight ahead)", VERTICAL, vertical),
        _layer("Both, associated", BOTH, both),
    )
    limits = _limits([layer.xyz_m for layer in layers])
    spans = [high - low for low, high in limits]
    row_in = 1.0 + 10.5 * max(spans[0], spans[2]) / (2.0 * spans[1] + spans[0])
    figure = new_figure(13.0, min(0.9 + 3.0 * row_in, 14.0), "Fused window of travel, three sides", subtitle)
    rows = figure.subfigures(len(layers), 1)
    for row, layer in zip(rows, layers, strict=True):
        row.suptitle(layer.title, x=0.01, ha="left", fontsize=10, color=layer.colour, fontweight="bold")
        views = row.subplots(1, len(SIDES), width_ratios=[spans[across] for _, across, _ in SIDES])
        for axes, side in zip(views, SIDES, strict=True):
            _view(axes, layer, side, limits)
    return write(figure, path)


def _layer(title: str, colour: str, points: Float32) -> Layer:
    power_db = points[:, 3]
    top_db = float(power_db.max()) if len(power_db) else 0.0
    weight = np.clip(1.0 + (power_db - top_db) / 40.0, 0.12, 1.0).astype(np.float32)
    return Layer(f"{title}: {len(points)} points", colour, points[:, :3], weight)


def _limits(clouds: Sequence[Float32]) -> list[tuple[float, float]]:
    """Common limits of x, y, z over all layers, without the outermost few percent."""
    together = np.concatenate([c for c in clouds if len(c)] or [np.zeros((1, 3), dtype=np.float32)])
    low, high = np.percentile(together, (2.0, 98.0), axis=0)
    return [(float(a) - 0.4, float(b) + 0.4) for a, b in zip(low, high, strict=True)]


def _view(axes: Any, layer: Layer, side: tuple[str, int, int], limits: list[tuple[float, float]]) -> None:
    name, across, up = side
    axes.scatter(
        *(layer.xyz_m[:, across], layer.xyz_m[:, up]),
        s=5,
        c=layer.colour,
        alpha=layer.weight if len(layer.weight) else None,
        linewidths=0,
    )
    dress(axes, name, AXIS_LABEL[across], AXIS_LABEL[up])
    axes.set_xlim(*limits[across])
    axes.set_ylim(*limits[up])
    axes.set_aspect("equal")
    if across == 1:
        axes.invert_xaxis()
