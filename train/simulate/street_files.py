# SPDX-License-Identifier: Apache-2.0
"""What the showcase leaves behind: pictures of the street and of every object, and PLY files of both with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge.best_shapes import class_text
from edge.frames import Float32, Float64
from edge.odometry.transforms import transform_points
from edge.pipeline import FrameResult, WindowResult
from edge.plot.collector import PictureCollector
from edge.plot.figure import BOTH, COARSE, HORIZONTAL, INK, INPUT, MUTED, VERTICAL, dress, new_figure, write
from edge.plot.shapes import shape_picture
from edge.recording.point_files import write_points
from train.simulate.street import Street
from train.simulate.street_report import Finding, name

COLOURS = {"car": HORIZONTAL, "bicycle": BOTH, "motorcycle": VERTICAL, "pedestrian": COARSE}
"""By class of the shape."""
TRUTH = "#c3c9d1"
SHOWN_POINTS = 6000
"""Of a shape in the picture of the street."""


class RoadPictures:
    """A sink that keeps the fullest frame's heatmaps and the largest window for their pictures.

    Args:
        folder, subtitle, fov_deg: of ``PictureCollector``, whose pictures of shapes ``write_pictures`` replaces.
    """

    def __init__(self, folder: Path, subtitle: str, fov_deg: float) -> None:
        self._collector = PictureCollector(folder, subtitle, None, fov_deg)

    def frame(self, result: FrameResult) -> None:
        """As ``PictureCollector.frame``."""
        self._collector.frame(result)

    def window(self, result: WindowResult) -> None:
        """As ``PictureCollector.window``."""
        self._collector.window(result)

    def write(self) -> list[Path]:
        """Both pictures, those that there is something for."""
        return self._collector.write()


def remove_old(folder: Path) -> None:
    """Remove what an earlier run left: an object that this one does not find must not seem to be there."""
    for pattern in ("object_*.png", "object_*.ply", "street.png", "heatmaps.png", "fused_cloud.png"):
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)


def stems(findings: Sequence[Finding]) -> list[str]:
    """Names of the objects' files, without suffix: identity and class, numbered when an identity came twice."""
    names: list[str] = []
    for one in findings:
        stem = f"object_{one.shape.identity}_{one.shape.class_name}"
        again = sum(known.split(".")[0] == stem for known in names)
        names.append(f"{stem}.{again + 1}" if again else stem)
    return names


def write_ply(folder: Path, street: Street, findings: Sequence[Finding]) -> list[Path]:
    """Shape, radar points and true surface of every object, in the odometry frame: they open together as a street.

    Args:
        folder: exists.
        street: names of the users.
        findings: the objects.
    Raises:
        RecordingError: a file cannot be written.
    """
    paths = []
    for stem, one in zip(stems(findings), findings, strict=True):
        parts = {"shape": one.shape.fine_m, "points": one.shape.input.xyz_m, "truth": one.truth_m}
        facts = {
            "frame": "odom",
            "object": one.shape.identity,
            "class": one.shape.class_name,
            "confidence": f"{one.shape.confidence:.3f}",
            "nearest": name(street, one.nearest),
            "data": "simulated",
        }
        for part, points_m in parts.items():
            placed_m = _placed(one, points_m).astype(np.float32)
            path = folder / f"{stem}_{part}.ply"
            write_points(path, dict(zip("xyz", placed_m.T, strict=True)), {**facts, "part": part})
            paths.append(path)
    return paths


def write_pictures(folder: Path, street: Street, findings: Sequence[Finding], subtitle: str) -> list[Path]:
    """The street, and every object from above and from three quarters, with its radar points and the truth.

    Args:
        folder: exists.
        street: the truth.
        findings: the objects.
        subtitle: one line.
    Raises:
        DependencyError: matplotlib is not installed.
    """
    paths = [street_picture(folder / "street.png", street, findings, subtitle)]
    for stem, one in zip(stems(findings), findings, strict=True):
        whose = "nobody there; nearest is" if not one.users else "truth:"
        line = f"{whose} the {name(street, one.nearest)}, Chamfer distance {one.shape_cm:.1f} cm; {subtitle}"
        paths.append(shape_picture(folder / f"{stem}.png", one.shape, line, one.truth_m))
    return paths


def street_picture(path: Path, street: Street, findings: Sequence[Finding], subtitle: str) -> Path:
    """The whole street: radar points from the road, shapes from the road and from above, all on the true surfaces.

    Args:
        path: of the PNG.
        street, findings, subtitle: as in ``write_pictures``.
    """
    rng = np.random.default_rng(0)
    truths = [user.points_m(SHOWN_POINTS, rng) for user in street.users]
    lows, highs = np.min([t.min(axis=0) for t in truths], axis=0), np.max([t.max(axis=0) for t in truths], axis=0)
    across, up = (float(lows[1]) - 0.9, float(highs[1]) + 0.5), (0.0, float(highs[2]) + 1.0)
    way_m = [float(street.drive.true_pose(t_ns).position_m[0]) for t_ns in street.drive.span_ns]
    along = (min(way_m[0], float(lows[0])) - 0.3, max(way_m[1], float(highs[0])) + 0.3)
    unit_in = 12.2 / (along[1] - along[0])
    heights = (up[1], up[1], across[1] - across[0])
    figure = new_figure(13.0, 2.7 + unit_in * sum(heights), "A street, as the radars pass it", subtitle)
    points, shapes, above = figure.subplots(3, 1, height_ratios=heights)
    for axes, axis, title, limits in (
        (points, 2, "Radar points, seen from the road", up),
        (shapes, 2, "Completed shapes, seen from the road: class, confidence, Chamfer distance to the truth", up),
        (above, 1, "Completed shapes from above", across),
    ):
        _panel(axes, findings, truths, axis, points_only=axes is points)
        dress(axes, title, "along the street  x (m)" if axes is above else "", "up  z (m)" if axis == 2 else "y (m)")
        axes.set(xlim=along, ylim=limits, aspect="equal")
    way = {"arrowstyle": "->", "color": INK, "linewidth": 1.4}
    above.annotate("", (way_m[1], across[0] + 0.15), (way_m[0], across[0] + 0.15), arrowprops=way)
    above.text(way_m[0] + 0.1, across[0] + 0.25, "the radars drive at y = 0", fontsize=8, color=INK)
    _names(shapes, findings, up[1])
    return write(figure, path)


def _panel(axes: Any, findings: Sequence[Finding], truths: Sequence[Float32], up: int, points_only: bool) -> None:
    """True surfaces in light grey below, then radar points, or shapes in the colour of their class."""
    for truth in truths:
        axes.scatter(truth[:, 0], truth[:, up], s=1.0, c=TRUTH, linewidths=0)
    for one in findings:
        if points_only:
            placed = _placed(one, one.shape.input.xyz_m)
            axes.scatter(placed[:, 0], placed[:, up], s=5.0, c=INPUT, alpha=0.6, linewidths=0)
        else:
            placed = _placed(one, one.shape.fine_m[:: max(1, len(one.shape.fine_m) // SHOWN_POINTS)])
            axes.scatter(placed[:, 0], placed[:, up], s=1.2, c=_colour(one), alpha=0.5, linewidths=0)


def _colour(one: Finding) -> str:
    """Of the class, or of the most likely one when the network is not sure."""
    return next((colour for kind, colour in COLOURS.items() if kind in class_text(one.shape)), MUTED)


def _names(axes: Any, findings: Sequence[Finding], tall: float) -> None:
    """What the network says of every object, above it; neighbours at three heights."""
    centres = [float(_placed(one, one.shape.fine_m)[:, 0].mean()) for one in findings]
    for rank, index in enumerate(np.argsort(centres)):
        one = findings[int(index)]
        text = f"{one.shape.identity}: {class_text(one.shape)} {one.shape.confidence:.2f}, {one.shape_cm:.1f} cm"
        height = tall - 0.1 - 0.27 * (rank % 3)
        axes.text(centres[int(index)], height, text, fontsize=8, color=_colour(one), ha="center", va="top")


def _placed(one: Finding, points_m: Float32) -> Float64:
    """Points of the object's frame in the odometry frame."""
    return transform_points(one.shape.input.pose, np.asarray(points_m, dtype=np.float64))
