# SPDX-License-Identifier: Apache-2.0
"""The benchmark's result as Markdown, which a terminal shows as well: what was measured, beside whom, where we lose."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from edge.bench.cases import NEAR_M, REFLECTORS
from edge.bench.suite import COLD_S, KERNELS_MB, SPREAD, WARM_S

Result = dict[str, Any]
QUIET = 0.5
SLACK = 1.05
"""Figures within 5 % of each other are not told apart."""


def lines(result: Result) -> Iterator[str]:
    """All tables."""
    yield from _head(result["machine"])
    yield from _frames(result["frames"])
    yield from _peers(result["frames"])
    yield from _misses(result)
    yield from _stages(result["stages"])
    yield from _limits(result)
    yield from _starts(result["starts"])
    yield from _differences(result["frames"])


def document(result: Result, command: str) -> str:
    """The content of docs/benchmarks.md."""
    needs = "The peers come with `pip install 'rfconstruct[peers]'`; mmwcore needs Python 3.12."
    head = ["# Benchmarks", "", "Written by one command; do not edit:", "", "```", command, "```", "", needs, ""]
    return "\n".join([*head, *lines(result)]) + "\n"


def table(names: list[str], rows: list[list[str]]) -> Iterator[str]:
    """Markdown table with columns as wide as their contents, numbers to the right."""
    widths = [max(len(row[n]) for row in [names, *rows]) for n in range(len(names))]
    yield "| " + " | ".join(name.ljust(width) for name, width in zip(names, widths, strict=True)) + " |"
    yield (
        "|" + "|".join("-" * (width + 2) if n == 0 else "-" * (width + 1) + ":" for n, width in enumerate(widths)) + "|"
    )
    for row in rows:
        cells = [
            cell.ljust(w) if n == 0 else cell.rjust(w) for n, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        yield "| " + " | ".join(cells) + " |"
    yield ""


def _ms(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if value >= 10 else f"{value:.3f}"


def _head(machine: dict[str, Any]) -> Iterator[str]:
    yield (
        f"{machine['processor']}, {machine['cores']} cores; Python {machine['python']}, NumPy {machine['numpy']}, "
        f"Numba {machine['numba']}, SciPy {machine['scipy']}. "
        f"Rig {machine['rig']}: {machine['frame']} per radar and loop; the chirps of all transmitters are read and "
        "transformed, those of the elevation rows too."
    )
    yield ""
    yield (
        "Everything ran in one process with one thread, except where two cores are named; every call got the same "
        "time, in bursts of five, spread over the whole measurement. The goals are for a core of the Sapphire Rapids "
        f"class; on another machine the ratios count. The scene is simulated: {REFLECTORS} point reflectors; one with "
        f"a point within {NEAR_M:g} m counts as found. Load of the machine when the run began: {machine['load']:.1f}"
        + (
            f"; above {QUIET:g} other processes lengthen what is measured by the wall clock."
            if machine["load"] > QUIET
            else "."
        )
    )
    yield ""


def _frames(frames: list[Result]) -> Iterator[str]:
    yield "## The whole two-radar frame: raw int16 to associated 3-D points"
    yield ""
    rows = [
        [
            f["name"],
            _ms(f["median_ms"]),
            _ms(f["goal_ms"]),
            _ms(f["p99_ms"]),
            f"{f['p99_ms'] / f['median_ms']:.2f}",
            _ms(f["after_others_ms"]),
            _ms(f["wall_ms"]),
            f"{f['found']} of {f['points']}",
        ]
        for f in frames
    ]
    yield from table(
        ["case", "median ms", "goal ms", "p99 ms", "p99/median", "after others ms", "wall ms", "found of points"],
        rows,
    )
    yield (
        "Times are CPU time of the thread, so that other processes of a shared machine do not count; those of two "
        "cores are by the wall clock. *After others*: first repetitions of the bursts, when another call has just "
        "filled the caches; p99 is that of all other repetitions. *Wall*: median by the wall clock."
    )
    yield ""


def _peers(frames: list[Result]) -> Iterator[str]:
    yield "## Peers, same process, same input"
    yield ""
    rows = [
        [
            f"{f['name']}: {p['name']}",
            _ms(p["median_ms"]),
            f"{p['ratio']:.1f}",
            "" if p["goal_ratio"] is None else f"{p['goal_ratio']:.0f}",
            f"{p['covered']} of {p['ours']}",
            str(p["detections"]),
            f"{p['found']} of {p['points']}",
        ]
        for f in frames
        for p in f["peers"]
    ]
    yield from table(
        ["case: peer", "median ms", "we are faster by", "goal", "has of ours", "its detections", "found of points"],
        rows,
    )
    yield (
        "*Has of ours*: our detections, both radars together, that the peer has within one bin; its others are mostly "
        "sidelobes, which we leave out. No peer reads a cascade or associates two radars: reading, virtual row, local "
        "maxima (NumPy) and association (ours) are the same in all of them and are part of their times."
    )
    yield ""


def _misses(result: Result) -> Iterator[str]:
    yield "## Where we lose or miss a goal"
    yield ""
    found = list(misses(result))
    yield from (f"* {text}" for text in found or ["Nowhere in this run."])
    yield from (f"* Not measured: {name}: {why}" for name, why in result["not_measured"].items())
    yield ""


def misses(result: Result) -> Iterator[str]:
    """Every figure that falls behind its goal or behind a peer."""
    for f in result["frames"]:
        if f["goal_ms"] is not None and f["median_ms"] > f["goal_ms"]:
            yield f"{f['name']}: {_ms(f['median_ms'])} ms, goal {_ms(f['goal_ms'])} ms."
        if f["p99_ms"] > SPREAD * f["median_ms"]:
            yield f"{f['name']}: p99 is {f['p99_ms'] / f['median_ms']:.1f} times the median, goal {SPREAD:g}."
    for part in [*result["frames"], *result["stages"]]:
        for p in part["peers"]:
            if p["goal_ratio"] is not None and p["ratio"] < p["goal_ratio"]:
                yield f"{part['name']}: {p['ratio']:.1f} times faster than {p['name']}, goal {p['goal_ratio']:.0f}."
            if p["ratio"] * SLACK < 1.0:
                yield f"{part['name']}: {p['name']} is {1 / p['ratio']:.1f} times faster than we are."
            if p["found"] is not None and p["found"] > part["found"]:
                yield f"{part['name']}: {p['name']} finds {p['found']} reflectors, we find {part['found']}."
    for s in result["starts"]:
        limit_s = COLD_S if s["cold"] else WARM_S
        if s["part"] == "pipeline" and s["seconds"] > limit_s:
            yield f"{_start_name(s)}: ready after {s['seconds']:.1f} s ({s['cpu_s']:.1f} s of CPU), goal {limit_s:g} s."
        if s["part"] == "kernels" and s["resident_mb"] > KERNELS_MB:
            yield f"{_start_name(s)}: {s['resident_mb']:.0f} MB, goal {KERNELS_MB:.0f} MB."


def _stages(stages: list[Result]) -> Iterator[str]:
    yield "## Stages of one radar, one loop"
    yield ""
    rows = []
    for s in stages:
        best = min(s["peers"], key=lambda p: p["median_ms"], default=None)
        rows.append(
            [
                s["name"],
                *(_ms(s[key]) for key in ("median_ms", "p99_ms", "after_others_ms")),
                "" if best is None else f"{best['name']} {_ms(best['median_ms'])}",
                "" if best is None else f"{best['ratio']:.1f}",
            ]
        )
    yield from table(
        ["stage", "median ms", "p99 ms", "after others ms", "best array peer ms", "we are faster by"], rows
    )


def _limits(result: Result) -> Iterator[str]:
    top = result["ceilings"]
    yield "## Against what the machine allows"
    yield ""
    yield (
        f"One core copies {top['cache_gb_s']:.0f} GB/s in cache and {top['memory_gb_s']:.0f} GB/s in memory (read and "
        f"write counted), and multiplies float32 matrices at {top['gflop_s']:.0f} GFLOP/s. Every array counts once, an "
        f"FFT as 5 n log2 n. Handing a call to the second core and back takes {result['hand_off_us']:.0f} us."
    )
    yield ""
    rows = [
        [
            w["stage"],
            f"{w['megabytes']:.2f}",
            f"{w['gb_s']:.1f}",
            f"{100 * w['share_of_copy']:.0f} %",
            f"{w['megaflop']:.1f}",
            f"{w['gflop_s']:.1f}",
            f"{100 * w['share_of_peak']:.0f} %",
        ]
        for w in result["work"]
    ]
    yield from table(["stage", "MB", "GB/s", "of the copy", "MFLOP", "GFLOP/s", "of the product"], rows)


def _start_name(entry: Result) -> str:
    what = "kernels alone" if entry["part"] == "kernels" else "whole pipeline with ONNX Runtime"
    return f"{what}, {'no compiled kernels' if entry['cold'] else 'compiled kernels on disk'}"


def _starts(starts: list[Result]) -> Iterator[str]:
    yield "## Start"
    yield ""
    rows = [[_start_name(s), f"{s['seconds']:.2f}", f"{s['cpu_s']:.2f}", f"{s['resident_mb']:.0f}"] for s in starts]
    yield from table(["process", "ready after s", "CPU s", "resident MB"], rows)
    yield (
        f"Interpreter, imports, tables and the first frames included. Goals: {WARM_S:g} s with compiled kernels, "
        f"{COLD_S:g} s without, {KERNELS_MB:.0f} MB for the kernels."
    )
    yield ""


def _differences(frames: list[Result]) -> Iterator[str]:
    yield "## What the peers compute otherwise"
    yield ""
    told: dict[str, None] = {}
    for f in frames:
        told |= dict.fromkeys(f"* {p['name']} ({f['name']}): {p['differences']}." for p in f["peers"])
    yield from told
