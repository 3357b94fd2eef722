# SPDX-License-Identifier: Apache-2.0
"""The simulator benchmark's result as Markdown, which a terminal shows as well."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from edge.bench.report import table

Result = dict[str, Any]
QUIET = 0.5
MEMORY_GROWTH_MB = 5.0


def lines(result: Result) -> Iterator[str]:
    """All tables."""
    machine = result["machine"]
    yield (
        f"{machine['processor']}, {machine['cores']} cores; Python {machine['python']}, NumPy {machine['numpy']}. "
        f"Rig {machine['rig']}. One process, one thread; CPU time of the thread, so that other processes do not count"
        + (f" (load {machine['load']:.1f} when the run began)." if machine["load"] > QUIET else ".")
    )
    yield ""
    yield from _speed(result)
    yield from _errors(result["errors"])
    yield from _memory(result["memory"])
    if "drive" in result:
        yield from _drive(result["drive"])
    yield "## Where a goal is missed"
    yield ""
    yield from (f"* {text}" for text in list(misses(result)) or ["Nowhere in this run."])


def document(result: Result, command: str) -> str:
    """The content of docs/benchmarks_simulation.md."""
    head = ["# Benchmarks of the simulator", "", "Written by one command; do not edit:", "", "```", command, "```", ""]
    return "\n".join([*head, *lines(result)]) + "\n"


def misses(result: Result) -> Iterator[str]:
    """Every figure that falls behind its goal."""
    for case in result["cases"]:
        if case["goal_ms"] is not None and case["median_ms"] > case["goal_ms"]:
            yield f"{case['name']}: {_ms(case['median_ms'])} ms, goal {_ms(case['goal_ms'])} ms."
    for row in result["errors"]:
        for key in ("rms_db", "largest_db"):
            if row[key] > row["goal_db"]:
                yield f"{row['scene']}, width {row['width']}: {row[key]:.0f} dB, goal {row['goal_db']:.0f} dB."
    for memory in [result["memory"], *([result["drive"]["memory"]] if "drive" in result else [])]:
        if memory["after_mb"] - memory["before_mb"] > MEMORY_GROWTH_MB:
            yield f"Memory grows from {memory['before_mb']:.0f} to {memory['after_mb']:.0f} MB."


def _ms(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if value >= 10 else f"{value:.2f}"


def _speed(result: Result) -> Iterator[str]:
    yield "## Scatterers to int16 frames in the order of the capture, noise and all default faults included"
    yield ""
    peer = result["peer"]
    rows = [
        [case["name"], *(_ms(case[key]) for key in ("median_ms", "goal_ms", "p99_ms", "after_others_ms")), ""]
        for case in result["cases"]
    ]
    rows[0][-1] = "1"
    name = f"{peer['name']}, {result['cases'][0]['name']}"
    times = [_ms(peer["median_ms"]), "", _ms(peer["p99_ms"]), _ms(peer["after_others_ms"])]
    rows.append([name, *times, f"{peer['ratio']:.0f}"])
    yield from table(["case", "median ms", "goal ms", "p99 ms", "after others ms", "times ours"], rows)
    yield (
        "*Moving*: the scene passes at 0.5 m/s, as a drive-by sees it; every loop is gridded by itself. *After "
        "others*: when another call has just filled the caches. HawkEye's method, restated in NumPy as they did it: "
        "delays of every point to every antenna, one exponential per sample; it is exact "
        f"({peer['error_db']:.0f} dB)."
    )
    yield ""


def _errors(errors: list[Result]) -> Iterator[str]:
    yield "## Error against the direct sum in float64"
    yield ""
    rows = [
        [row["scene"], str(row["width"]), f"{row['rms_db']:.1f}", f"{row['largest_db']:.1f}", f"{row['goal_db']:.0f}"]
        for row in errors
    ]
    yield from table(["scatterers", "cells to either side", "power dB", "largest sample dB", "goal dB"], rows)
    yield (
        "*Power*: of the difference over the signal's. *Largest sample*: largest difference over the largest sample. "
        "Rounding to int16 and noise come on top."
    )
    yield ""


def _memory(memory: Result) -> Iterator[str]:
    yield "## Memory"
    yield ""
    yield (
        f"Resident before and after {memory['frames']} frames: {memory['before_mb']:.0f} MB and "
        f"{memory['after_mb']:.0f} MB."
    )
    yield ""


def _drive(drive: Result) -> Iterator[str]:
    yield f"## A drive-by of {drive['frames']} frames, stage by stage"
    yield ""
    for name, key in (("all frames", "stages"), ("every third frame", "third")):
        rows = [[r["stage"], str(r["calls"]), _ms(r["call_ms"]), f"{r['total_ms']:.0f}"] for r in drive[key]]
        yield from table([f"one loop, {name}", "calls", "mean ms", "together ms"], rows)
    memory = drive["memory"]
    yield (
        "A parametric car, a neighbour and the ground with default settings; scene and surfaces are made anew in each "
        "drive-by. *The street*: four objects passed at 1.5 m/s (`rig --scene street`), "
        f"{drive['scatterers']:.0f} scatterers a burst on average, optics included. Resident before and after "
        f"{memory['drives']} drive-bys, after some others: {memory['before_mb']:.0f} and {memory['after_mb']:.0f} MB."
    )
    yield ""
