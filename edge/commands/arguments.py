# SPDX-License-Identifier: Apache-2.0
"""Types of command line values: what is refused is refused by argparse, with exit code 2 and what is allowed."""

from __future__ import annotations

import argparse

SLOWEST, FASTEST = 0.01, 1000.0
LONGEST_S = 1e6


def speed(text: str) -> float:
    """``max`` is 0: no waiting.

    Raises:
        argparse.ArgumentTypeError: neither ``max`` nor a number from 0.01 to 1000.
    """
    return 0.0 if text == "max" else _number(text, SLOWEST, FASTEST, f"max, or {SLOWEST:g}..{FASTEST:g}")


def seconds(text: str) -> float:
    """A time; argparse.ArgumentTypeError when it is not positive or longer than eleven days."""
    return _number(text, 1e-3, LONGEST_S, f"0.001..{LONGEST_S:g} seconds")


def moment(text: str) -> float:
    """Seconds since a beginning; argparse.ArgumentTypeError when negative or longer than eleven days."""
    return _number(text, 0.0, LONGEST_S, f"0..{LONGEST_S:g} seconds")


def passes(text: str) -> int:
    """How often, 0 meaning without end; argparse.ArgumentTypeError when it is no whole number."""
    if not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise argparse.ArgumentTypeError(f"got {text!r}; allowed: a whole number, 0 = for ever")
    return int(text)


def count(text: str) -> int:
    """A number of things; argparse.ArgumentTypeError when it is not whole and positive."""
    if not (text.isascii() and text.isdigit() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"got {text!r}; allowed: a whole number, 1 or more")
    return int(text)


def _number(text: str, low: float, high: float, allowed: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not low <= number <= high:
        raise argparse.ArgumentTypeError(f"got {text!r}; allowed: {allowed}")
    return number
