# SPDX-License-Identifier: Apache-2.0
"""Texts of the page's panels as HTML; whatever came over the network is escaped."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from edge.stream.messages import Status
from edge.view.colours import CLASS_COLOURS, Rgb
from edge.view.health import Banner

_LEVEL_COLOURS = {"ok": "#1f7a4d", "warn": "#9a6a10", "error": "#a12d2d"}
LONGEST_TEXT = 120
_SMALL = "font-size:0.8em;line-height:1.45"


def banner_html(banner: Banner) -> str:
    """State, what it means, and why."""
    colour = _LEVEL_COLOURS[banner.level]
    lines = "".join(
        f"<div style='margin-top:0.25em'><b>{_short(reason.code)}</b> &times; {reason.count}"
        f"{': ' + _short(reason.detail) if reason.detail else ''}</div>"
        for reason in banner.reasons
    )
    return (
        f"<div style='background:{colour};color:white;padding:0.55em 0.8em;border-radius:6px;margin:0.4em 0.6em'>"
        f"<span style='font-size:1.25em;font-weight:700'>{_short(banner.state)}</span>"
        f"<span style='font-size:0.85em;margin-left:0.6em'>{_short(banner.text)}</span>"
        f"<div style='{_SMALL}'>{lines}</div></div>"
    )


def account_html(status: Status | None, figures: Mapping[str, str]) -> str:
    """Frames of every radar, and figures of the viewer itself.

    Args:
        status: of the appliance, None before the first.
        figures: name -> value.
    """
    rows = [_row(("radar", "in", "ok", "lost", "frames/s"), "th")]
    for name, radar in (status.radars if status is not None else {}).items():
        lost = sum(radar.lost.values())
        rows.append(_row((name, str(radar.frames_in), str(radar.frames_ok), str(lost), f"{radar.fps:.1f}")))
    causes = sorted({cause for radar in (status.radars if status else {}).values() for cause in radar.lost})
    note = f"<div>lost because: {_short(', '.join(causes))}</div>" if causes else ""
    plain = "".join(f"<div>{_short(name)}: <b>{_short(value)}</b></div>" for name, value in figures.items())
    return (
        f"<div style='{_SMALL};margin:0.2em 0.9em'>"
        f"<table style='width:100%;border-collapse:collapse'>{''.join(rows)}</table>{note}"
        f"<div style='margin-top:0.4em'>{plain}</div></div>"
    )


def classes_html() -> str:
    """Key of the class colours."""
    parts = [f"<span style='margin-right:0.8em'>{_dot(colour)} {name}</span>" for name, colour in CLASS_COLOURS.items()]
    return f"<div style='{_SMALL};margin:0.2em 0.9em'>{' '.join(parts)}</div>"


def _dot(colour: Rgb) -> str:
    return f"<span style='color:rgb{colour}'>&#9679;</span>"


def _row(cells: tuple[str, ...], tag: str = "td") -> str:
    style = "text-align:right;font-weight:400;opacity:0.65" if tag == "th" else "text-align:right"
    first = style.replace("right", "left")
    inner = "".join(f"<{tag} style='{first if k == 0 else style}'>{_short(c)}</{tag}>" for k, c in enumerate(cells))
    return f"<tr>{inner}</tr>"


def _short(text: str) -> str:
    return escape(text if len(text) <= LONGEST_TEXT else text[: LONGEST_TEXT - 1] + "…")
