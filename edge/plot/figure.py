# SPDX-License-Identifier: Apache-2.0
"""The look that all pictures share, and how they are written."""

from __future__ import annotations

import importlib
import os
import warnings
from pathlib import Path
from typing import Any

from edge.errors import DependencyError, RfconstructError

INK, MUTED, GRID = "#1b1f24", "#6b7280", "#d9dde3"
HORIZONTAL, VERTICAL, BOTH, INPUT, COARSE = "#1f6fb4", "#c8641b", "#1a7f5a", "#c0392b", "#7a4fb0"
DPI = 130
HEAD_IN = 0.7


def new_figure(width_in: float, height_in: float, title: str, subtitle: str = "") -> Any:
    """An empty figure with a title at its top left.

    Args:
        width_in, height_in: size in inches.
        title: what it shows.
        subtitle: one muted line below it; both are drawn as they are, whatever characters a file name has.
    Raises:
        DependencyError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    below_head = ConstrainedLayoutEngine(rect=(0.0, 0.0, 1.0, 1.0 - HEAD_IN / height_in))
    figure = Figure(figsize=(width_in, height_in), layout=below_head, facecolor="white")
    looks: tuple[dict[str, Any], ...] = (
        {"fontsize": 13, "color": INK, "fontweight": "bold"},
        {"fontsize": 9, "color": MUTED},
    )
    for text, below_in, look in zip((title, subtitle), (0.24, 0.48), looks, strict=True):
        y = 1.0 - below_in / height_in
        figure.text(0.01, y, drawable(text), ha="left", va="center", parse_math=False, **look)
    return figure


def drawable(text: str) -> str:
    """One line that can be drawn: bytes of a file name that are no UTF-8 as escapes, control characters as "?"."""
    escaped = text.encode("utf-8", "backslashreplace").decode("utf-8")
    return "".join(letter if letter.isprintable() else "?" for letter in escaped)


def require_matplotlib() -> None:
    """Raise DependencyError unless matplotlib is installed."""
    try:
        importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise DependencyError("pictures need matplotlib", action="pip install 'rfconstruct[plot]'") from error


def prepare_folder(folder: Path) -> None:
    """Make the folder of pictures, before the work whose pictures go there.

    Raises:
        DependencyError: matplotlib is not installed.
        RfconstructError: the folder cannot be made or written.
    """
    require_matplotlib()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK | os.X_OK)
    except OSError:
        writable = False
    if not writable:
        raise RfconstructError("pictures cannot be written", value=str(folder), allowed="a writable folder")


def dress(axes: Any, title: str, x_label: str, y_label: str) -> None:
    """Equal scales, light grid, quiet frame."""
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.set_xlabel(x_label, fontsize=9, color=MUTED)
    axes.set_ylabel(y_label, fontsize=9, color=MUTED)
    axes.tick_params(labelsize=8, colors=MUTED)
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GRID)


def write(figure: Any, path: Path, dpi: int = DPI) -> Path:
    """Write a PNG; a letter that the font lacks is an empty box.

    Args:
        figure: of ``new_figure``.
        path: of the PNG.
        dpi: pixels per inch.
    Returns:
        ``path``.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(path, dpi=dpi)
    return path
