# SPDX-License-Identifier: Apache-2.0
"""Figures of the machine and this process that the status and the metrics show."""

from __future__ import annotations

import os
from pathlib import Path

_THERMAL = Path("/sys/class/thermal")
_PLAUSIBLE_C = (-50.0, 200.0)


def rss_bytes() -> int:
    """Resident memory of this process now (proc(5), statm), 0 where the kernel does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return 0


def temperature_c(folder: Path = _THERMAL) -> float | None:
    """The hottest thermal zone in degrees Celsius; None without a plausible sensor."""
    found = []
    for path in folder.glob("thermal_zone*/temp"):
        try:
            found.append(int(path.read_text(encoding="ascii")) / 1e3)
        except (OSError, ValueError):
            continue
    low, high = _PLAUSIBLE_C
    return max((t for t in found if low < t < high), default=None)
