# SPDX-License-Identifier: Apache-2.0
"""Small pictures for the page's panels: heatmaps in metres with their detections, strips of latency and losses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge.errors import DependencyError
from edge.frames import Detections, RadarId
from edge.stream.messages import HeatmapMessage
from edge.view.colours import HEAT, RAMP, Rgb, class_colour
from edge.view.health import Sample

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

Picture = NDArray[np.uint8]

WIDTH = 720
"""Pixels; the panels show them at about half of that, so that they stay sharp on dense screens."""
SPAN_DB = 40.0
"""Heatmaps show so much below their peak."""
FONT_PX, SMALL_PX = 23, 20
PAPER: Rgb = (28, 30, 38)
INK: Rgb = (222, 226, 232)
MUTED: Rgb = (140, 147, 160)
LINE: Rgb = (66, 71, 84)
MARK: Rgb = (255, 255, 255)
LOSS: Rgb = (255, 96, 96)
_LEFT, _TOP, _BOTTOM, _RIGHT = 66, 46, 62, 20
TICKS_M = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


@dataclass(frozen=True, slots=True)
class Sheet:
    """Where metres lie in a heatmap's picture; one scale for both axes.

    Args:
        radar: horizontal: seen from above, forward is up; vertical: from the side, forward is right.
        reach_m: farthest range.
    """

    radar: RadarId
    reach_m: float

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Left, top, width and height of the plot in pixels."""
        width = WIDTH - _LEFT - _RIGHT
        return _LEFT, _TOP, width, round(width * (0.62 if self.radar == "horizontal" else 0.5))

    @property
    def scale(self) -> float:
        """Pixels a metre."""
        _, _, width, height = self.box
        return (height if self.radar == "horizontal" else width) / self.reach_m

    @property
    def height(self) -> int:
        """Of the whole picture."""
        return self.box[3] + _TOP + _BOTTOM

    def pixel(self, forward_m: Any, across_m: Any) -> tuple[Any, Any]:
        """Column and row of a place: forward along the boresight, across along the radar's array (left or up)."""
        left, top, width, height = self.box
        if self.radar == "horizontal":
            return left + width / 2 - across_m * self.scale, top + height - forward_m * self.scale
        return left + forward_m * self.scale, top + height / 2 - across_m * self.scale

    def place(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Forward and across, metres [rows, columns], of the middle of every pixel of the plot."""
        _, _, width, height = self.box
        rows, columns = np.mgrid[0:height, 0:width].astype(np.float32) + 0.5
        if self.radar == "horizontal":
            return (height - rows) / self.scale, (width / 2 - columns) / self.scale
        return columns / self.scale, (height / 2 - rows) / self.scale


class HeatmapPainter:
    """Heatmaps of one radar as pictures; where every pixel comes from is computed once for an axis pair."""

    def __init__(self) -> None:
        self._key: tuple[object, ...] = ()
        self._cells = np.empty((0, 0), np.intp)
        self._inside = np.empty((0, 0), np.bool_)

    def paint(self, heatmap: HeatmapMessage, found: Detections | None) -> Picture:
        """Picture uint8 [height, 720, 3].

        Args:
            heatmap: of any radar.
            found: its detections, or None.
        """
        sheet = Sheet(heatmap.radar, float(heatmap.range_m[-1]))
        left, top = sheet.box[:2]
        self._prepare(sheet, heatmap)
        peak_db = float(heatmap.power_db.max())
        levels = (heatmap.power_db - (peak_db - SPAN_DB)) * (255.0 / SPAN_DB)
        shades = HEAT[np.clip(levels, 0, 255).astype(np.intp)].reshape(-1, 3)
        image, draw = blank(sheet.height)
        plot = np.where(self._inside[..., None], shades[self._cells], np.array(PAPER, np.uint8))
        image.paste(_from_array(plot), (left, top))
        _axes(draw, sheet)
        seen = 0
        if found is not None:
            seen = _marks(draw, sheet, found)
        title = "Horizontal radar, from above" if sheet.radar == "horizontal" else "Vertical radar, from the side"
        text(draw, (left, 10), title, INK)
        text(draw, (WIDTH - _RIGHT, 12), f"{seen} detection{'s' if seen != 1 else ''}", MUTED, SMALL_PX, "ra")
        text(draw, (left, sheet.height - 26), f"peak {peak_db:.0f} dB, {SPAN_DB:.0f} dB shown", MUTED, SMALL_PX)
        axis = "left / right, m" if sheet.radar == "horizontal" else "forward, m"
        text(draw, (WIDTH - _RIGHT, sheet.height - 26), axis, MUTED, SMALL_PX, "ra")
        return np.asarray(image)

    def _prepare(self, sheet: Sheet, heatmap: HeatmapMessage) -> None:
        cosines, ranges = heatmap.direction_cosine, heatmap.range_m
        key = (sheet, cosines.shape, ranges.shape, float(cosines[0]), float(cosines[-1]), float(ranges[0]))
        if key == self._key:
            return
        forward_m, across_m = sheet.place()
        range_m = np.hypot(forward_m, across_m)
        cosine = across_m / np.maximum(range_m, np.float32(1e-6))
        column = _nearest(range_m, ranges)
        row = _nearest(cosine, cosines)
        self._inside = (row >= 0) & (row < len(cosines)) & (column >= 0) & (column < len(ranges))
        self._cells = np.where(self._inside, row * len(ranges) + column, 0)
        self._key = key


def strip(samples: Sequence[Sample], wall_s: float, span_s: float = 60.0) -> Picture:
    """Latency of every stage (99th percentile) and frames lost, over the last minute, uint8 [height, 720, 3]."""
    image, draw = blank(408)  # room for four rows of three stages
    recent = [sample for sample in samples if wall_s - sample.wall_s <= span_s]
    stages = list(recent[-1].latency_ms) if recent else []
    top_ms = _round_up(max((value for s in recent for value in s.latency_ms.values()), default=1.0))
    left, right, top, bottom = _LEFT, WIDTH - _RIGHT, 46, 186
    text(draw, (left, 10), "Latency of the stages, 99th percentile", INK)
    _frame(draw, left, top, right, bottom, f"{top_ms:g}", "ms")
    for number, stage in enumerate(stages):
        line = [
            (right - (wall_s - s.wall_s) / span_s * (right - left), bottom - s.latency_ms[stage] / top_ms * 140)
            for s in recent
            if stage in s.latency_ms
        ]
        colour = class_colour(("car", "bicycle", "motorcycle", "pedestrian", "unknown", "a", "b")[number % 7])
        if len(line) > 1:
            draw.line(line, fill=colour, width=4)
        column, row = number % 3, number // 3
        label = f"{stage} {recent[-1].latency_ms[stage]:.1f} ms"
        text(draw, (left + column * 212, bottom + 10 + row * 26), label, colour, SMALL_PX)
    _losses(draw, recent, wall_s, span_s, (left, right, 338, 384))
    return np.asarray(image)


def legend(title: str, low: str, high: str) -> Picture:
    """The ramp with its ends, uint8 [height, 720, 3]."""
    image, draw = blank(74)
    text(draw, (20, 8), title, INK, SMALL_PX)
    left, right = 110, WIDTH - 110
    bar = np.broadcast_to(RAMP[np.linspace(0, 255, right - left).astype(np.intp)], (18, right - left, 3))
    image.paste(_from_array(bar), (left, 44))
    text(draw, (left - 10, 53), low, MUTED, SMALL_PX, "rm")
    text(draw, (right + 10, 53), high, MUTED, SMALL_PX, "lm")
    return np.asarray(image)


def blank(height: int) -> tuple[Any, ImageDraw]:
    """An empty picture 720 pixels wide, and its pen."""
    try:
        from PIL import Image, ImageDraw
    except ImportError as error:
        raise DependencyError("the viewer needs Pillow", action="pip install 'rfconstruct[view]'") from error
    image = Image.new("RGB", (WIDTH, height), PAPER)
    return image, ImageDraw.Draw(image)


def text(
    draw: ImageDraw, place: tuple[float, float], words: str, colour: Rgb, size: int = FONT_PX, anchor: str = "la"
) -> None:
    """Write one line; the font comes with Pillow."""
    from PIL import ImageFont

    draw.text(place, words, fill=colour, font=ImageFont.load_default(size), anchor=anchor)


def _from_array(pixels: Picture) -> Any:
    from PIL import Image

    return Image.fromarray(np.ascontiguousarray(pixels))


def _nearest(values: NDArray[np.floating], axis: NDArray[np.float32]) -> NDArray[np.intp]:
    """Index of the element of a uniform axis; out of bounds for values beyond it."""
    step = (float(axis[-1]) - float(axis[0])) / max(len(axis) - 1, 1)
    nearest: NDArray[np.intp] = np.rint((values - float(axis[0])) / (step or 1.0)).astype(np.intp)
    return nearest


def _axes(draw: ImageDraw, sheet: Sheet) -> None:
    """Rings of equal range and ticks, in metres."""
    left, top, width, height = sheet.box
    step = next((tick for tick in TICKS_M if sheet.reach_m / tick <= 5), TICKS_M[-1])
    distances = np.arange(step, sheet.reach_m * 1.001, step)
    angles = np.radians(np.linspace(-89, 89, 90))
    for distance in distances:
        columns, rows = sheet.pixel(distance * np.cos(angles), distance * np.sin(angles))
        seen = (columns >= left) & (columns <= left + width) & (rows >= top) & (rows <= top + height)
        points = list(zip(columns[seen].tolist(), rows[seen].tolist(), strict=True))
        if len(points) > 1 and (sheet.radar == "vertical" or distance < sheet.reach_m):
            draw.line(_longest(points), fill=(*LINE,), width=1)
    draw.rectangle((left, top, left + width, top + height), outline=LINE)
    for distance in (0.0, *distances.tolist()):
        column, row = sheet.pixel(distance, 0.0)
        if sheet.radar == "horizontal":
            text(draw, (left - 8, row), f"{distance:g}", MUTED, SMALL_PX, "rm")
            for side in (-1, 1) if distance else (1,):
                column = sheet.pixel(0.0, side * distance)[0]
                if left <= column <= left + width:
                    text(draw, (column, top + height + 6), f"{side * distance:g}", MUTED, SMALL_PX, "ma")
        else:
            text(draw, (column, top + height + 6), f"{distance:g}", MUTED, SMALL_PX, "ma")
    if sheet.radar == "vertical":
        step = next((tick for tick in TICKS_M if height / sheet.scale / tick <= 6), TICKS_M[-1])
        for up in np.arange(-20 * step, 20.5 * step, step):
            row = sheet.pixel(0.0, up)[1]
            if top <= row <= top + height:
                text(draw, (left - 8, row), f"{up:g}", MUTED, SMALL_PX, "rm")


def _longest(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The longest run of neighbours: a ring that leaves the plot is not closed across it."""
    runs: list[list[tuple[float, float]]] = [[]]
    for point in points:
        if runs[-1] and abs(point[0] - runs[-1][-1][0]) + abs(point[1] - runs[-1][-1][1]) > 60:
            runs.append([])
        runs[-1].append(point)
    return max(runs, key=len)


def _marks(draw: ImageDraw, sheet: Sheet, found: Detections) -> int:
    """A ring around every detection inside the plot; how many."""
    across_m = found.range_m * found.direction_cosine
    forward_m = found.range_m * np.sqrt(np.maximum(0.0, 1.0 - found.direction_cosine**2))
    left, top, width, height = sheet.box
    columns, rows = sheet.pixel(forward_m, across_m)
    for column, row in zip(columns.tolist(), rows.tolist(), strict=True):
        if left <= column <= left + width and top <= row <= top + height:
            draw.ellipse((column - 5, row - 5, column + 5, row + 5), outline=MARK, width=2)
    return len(found)


def _frame(draw: ImageDraw, left: float, top: float, right: float, bottom: float, high: str, unit: str) -> None:
    draw.rectangle((left, top, right, bottom), outline=LINE)
    text(draw, (left - 8, top), high, MUTED, SMALL_PX, "rm")
    text(draw, (left - 8, bottom), "0", MUTED, SMALL_PX, "rm")
    text(draw, (left - 8, (top + bottom) / 2), unit, MUTED, SMALL_PX, "rm")


def _losses(
    draw: ImageDraw, recent: Sequence[Sample], wall_s: float, span_s: float, box: tuple[int, int, int, int]
) -> None:
    """Bars: frames lost between two status messages."""
    left, right, top, bottom = box
    steps = [(b.wall_s, max(0, b.lost - a.lost)) for a, b in itertools.pairwise(recent)]
    most = max((lost for _, lost in steps), default=0)
    text(draw, (left, top - 16), "Frames lost", INK, SMALL_PX, "lm")
    total = recent[-1].lost if recent else 0
    text(draw, (right, top - 16), f"{total} in all, last {span_s:.0f} s shown", MUTED, SMALL_PX, "rm")
    _frame(draw, left, top, right, bottom, str(max(most, 1)), "")
    for when_s, lost in steps:
        if lost:
            column = right - (wall_s - when_s) / span_s * (right - left)
            draw.rectangle((column - 3, bottom - lost / most * (bottom - top), column + 3, bottom), fill=LOSS)


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, 20, ..."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-3)))
    return float(next(factor * power for factor in (1, 2, 5, 10) if factor * power >= value * 0.999))
