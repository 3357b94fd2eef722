# SPDX-License-Identifier: Apache-2.0
"""Timing of several calls that compete in one process: interleaved, so that a busy moment hits all of them."""

from __future__ import annotations

import gc
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True, slots=True)
class Timing:
    """Of one call.

    Args:
        median_ms, p99_ms: over the repetitions.
        repetitions: how many.
    """

    median_ms: float
    p99_ms: float
    repetitions: int


def measure(calls: Mapping[str, Callable[[], object]], budget_s: float, most: int = 400) -> dict[str, Timing]:
    """Time every call again and again, in turn, until the budget is spent; at least five rounds.

    Args:
        calls: name -> call without arguments; each is run once before the clock starts.
        budget_s: time for all of them together.
        most: rounds at most.
    """
    for call in calls.values():
        call()
    spent: dict[str, list[int]] = {name: [] for name in calls}
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        end_ns = time.perf_counter_ns() + round(budget_s * 1e9)
        for turn in range(most):
            for name, call in calls.items():
                start_ns = time.perf_counter_ns()
                call()
                spent[name].append(time.perf_counter_ns() - start_ns)
            if turn >= 4 and time.perf_counter_ns() > end_ns:
                break
    finally:
        if was_enabled:
            gc.enable()
    return {
        name: Timing(float(np.median(ns)) / 1e6, float(np.percentile(ns, 99)) / 1e6, len(ns))
        for name, ns in spent.items()
    }


def processor() -> str:
    """Name of the CPU as the kernel gives it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
