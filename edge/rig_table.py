# SPDX-License-Identifier: Apache-2.0
"""Derived figures of the shipped rigs as a Markdown table: ``python -m edge.rig_table``."""

from __future__ import annotations

from edge.rig import Rig, known_rigs, load_rig

COLUMNS = (
    *("rig", "radars", "row", "burst ms", "frames/s", "range bin cm", "usable range m"),
    *("max speed m/s", "speed bin m/s", "MB/s a radar", "ramp GHz"),
)


def rig_row(rig: Rig) -> list[str]:
    """One rig's cells, in the order of ``COLUMNS``; both radars of a shipped rig run one schedule."""
    radar = next(iter(rig.radars.values()))
    schedule, profile = radar.schedule, radar.schedule.profile
    return [
        f"`{rig.name}`",
        f"{len(rig.radars)} x {profile.device}",
        str(radar.array.count),
        f"{1e3 * schedule.burst_s:.2f}",
        f"{1.0 / schedule.frame_period_s_actual:.4g}",
        f"{100.0 * profile.range_bin_m:.2f}",
        f"{profile.usable_range_m:.1f}",
        f"{schedule.max_speed_m_s:.2f}",
        f"{schedule.speed_bin_m_s:.2f}",
        f"{schedule.data_rate_bytes_s / 1e6:.1f}",
        f"{profile.start_frequency_hz_actual / 1e9:.2f}-{profile.end_frequency_hz / 1e9:.2f}",
    ]


def rig_table() -> str:
    """All shipped rigs, one a line."""
    rows = [list(COLUMNS), ["---"] * len(COLUMNS), *(rig_row(load_rig(name)) for name in known_rigs())]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


if __name__ == "__main__":
    print(rig_table())
