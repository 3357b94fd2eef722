# SPDX-License-Identifier: Apache-2.0
"""Tells when boards run at another temperature than they were calibrated at."""

from __future__ import annotations

from collections.abc import Mapping

from edge.calibration import Calibration

LARGEST_DIFFERENCE_C = 20.0
"""Chips re-tune themselves while they run, cables and boards drift on: a choice, to be narrowed by measurement."""


def temperature_notes(calibrations: Mapping[str, Calibration], now_c: float | None) -> list[str]:
    """One sentence for every calibration that does not suit the temperature.

    Args:
        calibrations: radar -> the calibration in use; the identity (never measured) is left out.
        now_c: board temperature at run time; None: unknown.
    """
    notes = []
    for radar, calibration in calibrations.items():
        then_c = calibration.temperature_c
        if calibration.made_with is None:
            continue
        if then_c is None:
            notes.append(f"{radar}: the calibration does not say at which temperature it was made (--temperature)")
        elif now_c is not None and abs(now_c - then_c) > LARGEST_DIFFERENCE_C:
            notes.append(
                f"{radar}: calibrated at {then_c:g} degrees Celsius, now {now_c:g}: more than "
                f"{LARGEST_DIFFERENCE_C:g} apart; calibrate again at this temperature"
            )
    return notes
