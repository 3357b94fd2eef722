# SPDX-License-Identifier: Apache-2.0
"""Pictures of held-out answers, row by row, and of the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge.errors import DependencyError
from edge.frames import Float32
from train.calibration import Reliability, RiskCoverage
from train.dataset import CLASSES
from train.held_out import Case

Column = tuple[str, Float32]
_POINTS = 4096
_VIEW_DEG = (35.0, 20.0)
_COLORS = 48
_ASPECT = 0.75


def drawn(labels: Sequence[int], count: int, seed: int) -> list[int]:
    """Positions of random cases, classes in turn as far as they last: nobody chose them.

    Args:
        labels: class of every case. count: how many. seed: of the draw.
    """
    queues: dict[int, list[int]] = {label: [] for label in range(len(CLASSES))}
    for position in np.random.default_rng(seed).permutation(len(labels)).tolist():
        queues[labels[position]].append(position)
    longest = max(len(queue) for queue in queues.values())
    turns = [queue[turn] for turn in range(longest) for queue in queues.values() if turn < len(queue)]
    return turns[:count]


def gallery(rows: Sequence[tuple[str, Sequence[Column]]], path: Path) -> None:
    """One picture: a row a case, a column a cloud, seen from behind the sensor's shoulder, near points darker.

    Args:
        rows: (label, columns of (title, points [n, 3] in metres)); all clouds of a row share frame and scale, the
            last one (the truth) decides what is in the picture.
        path: PNG to write.
    Raises:
        DependencyError: no matplotlib.
    """
    plt = _pyplot()
    columns = max(len(clouds) for _, clouds in rows)
    figure, axes = plt.subplots(len(rows), columns, figsize=(2.1 * columns, 1.65 * len(rows)), squeeze=False)
    for axis in axes.ravel():
        axis.set_axis_off()
    for number, (label, clouds) in enumerate(rows):
        seen = [_projected(cloud) for _, cloud in clouds]
        low, high = seen[-1][:, :2].min(axis=0), seen[-1][:, :2].max(axis=0)
        middle, half = (low + high) / 2, 0.6 * max(float(((high - low) * (1, 1 / _ASPECT)).max()), 0.5)
        for axis, (title, _), flat in zip(axes[number], clouds, seen, strict=False):
            order = np.argsort(-flat[:, 2])
            size = 3.0 if len(flat) < 1500 else 1.0
            axis.scatter(*flat[order, :2].T, s=size, c=flat[order, 2], cmap="viridis", linewidths=0)
            axis.set_xlim(middle[0] - half, middle[0] + half)
            axis.set_ylim(middle[1] - _ASPECT * half, middle[1] + _ASPECT * half)
            axis.set_aspect("equal")
            axis.set_title(title, fontsize=6, pad=2)
        axes[number, 0].set_title(f"{label}\n{clouds[0][0]}", fontsize=6, pad=2)
    _save(plt, figure, path)


def case_row(case: Case, columns: Sequence[Column]) -> tuple[str, list[Column]]:
    """A row: input, the given answers, truth."""
    first = (f"input, {len(case.sample.partial)} points", case.sample.partial)
    return case.sample.object_id, [first, *columns, ("truth", case.sample.truth)]


def calibration_picture(
    diagrams: Sequence[tuple[str, Reliability]], curves: Sequence[tuple[str, RiskCoverage]], path: Path
) -> None:
    """Reliability diagram and risk-coverage curves side by side.

    Args:
        diagrams: (name, reliability). curves: (name, curve), risk in cm. path: PNG to write.
    Raises:
        DependencyError: no matplotlib.
    """
    plt = _pyplot()
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.4))
    left.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for name, one in diagrams:
        left.plot(one.promised, one.kept, marker="o", markersize=3, label=f"{name}: ECE {one.error:.3f}")
    left.set(xlabel="promised", ylabel="kept", xlim=(0, 1), ylim=(0, 1.02))
    for name, curve in curves:
        right.plot(curve.coverage, curve.risk, label=f"{name}: area {curve.area:.1f} cm")
    right.set(xlabel="share kept, most trusted first", ylabel="mean Chamfer distance, cm", xlim=(0, 1))
    right.set_ylim(bottom=0)
    for axis in (left, right):
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    figure.tight_layout()
    _save(plt, figure, path)


def _projected(cloud: Float32) -> np.ndarray:
    """Right, up and depth of at most 4096 points, seen obliquely from above, x roughly away from the eye."""
    points = cloud[:: -(-len(cloud) // _POINTS)].astype(float)
    azimuth, elevation = np.radians(_VIEW_DEG)
    x, y, z = points.T
    right = -y * np.cos(azimuth) + x * np.sin(azimuth)
    away = x * np.cos(azimuth) + y * np.sin(azimuth)
    up = z * np.cos(elevation) + away * np.sin(elevation)
    return np.stack([right, up, away * np.cos(elevation) - z * np.sin(elevation)], axis=1)


def _pyplot() -> Any:
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise DependencyError("pictures need matplotlib", action="pip install 'rfconstruct[plot]'") from error
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    return plt


def _save(plt: Any, figure: Any, path: Path) -> None:
    """A PNG of few colours; it weighs a third."""
    from PIL import Image  # comes with matplotlib

    path.parent.mkdir(parents=True, exist_ok=True)
    figure.tight_layout(pad=0.3)
    figure.savefig(path, dpi=100)
    plt.close(figure)
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(_COLORS, dither=Image.Dither.NONE)
    small.save(path, optimize=True)
