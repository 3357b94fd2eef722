# SPDX-License-Identifier: Apache-2.0
"""One thing that the doctor looked at: what was found, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from edge.errors import RfconstructError

Outcome = Literal["ok", "note", "fails"]
NAME_WIDTH = 27


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at.

    Args:
        name: what.
        outcome: "ok"; "note": works, but the reader should know; "fails": something will not run.
        found: what was found.
        action: what to do; empty when nothing needs doing.
    """

    name: str
    outcome: Outcome
    found: str
    action: str = ""


def failure(name: str, error: RfconstructError, action: str = "") -> Check:
    """A check that failed with an error.

    Args:
        name: of the check.
        error: what it raised.
        action: when the error has none.
    """
    allowed = f"; allowed: {error.allowed}" if error.allowed else ""
    value = "" if error.value is None else f": {error.value}"
    return Check(name, "fails", f"{error.what}{value}{allowed}", error.action or action)


def lines(check: Check, width: int = NAME_WIDTH) -> Iterator[str]:
    """For people."""
    yield f"{check.outcome:<6}{check.name:<{width}}{check.found}"
    if check.action:
        yield f"{'':<{6 + width}}-> {check.action}"
