# SPDX-License-Identifier: Apache-2.0
"""What a verb of ``rfconstruct-train`` prints: lines for people, or with ``--json`` one document for machines."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np


def add_json(verb: argparse.ArgumentParser) -> None:
    """The option."""
    verb.add_argument("--json", action="store_true", help="machine-readable output on stdout")


def on_a_screen(verb: argparse.ArgumentParser, what: str) -> None:
    """Help of a verb with many options in forty lines: a short usage, and options beside their text.

    Args:
        verb: its parser.
        what: positional arguments, for the usage.
    """
    verb.usage = f"%(prog)s {what} [options]"
    verb.formatter_class = partial(argparse.HelpFormatter, max_help_position=34, width=119)


def emit(options: argparse.Namespace, content: object, lines: Iterable[str]) -> None:
    """Print the result once.

    Args:
        options: parsed, with ``json``.
        content: of plain values; NaN and infinity become null.
        lines: for people; not asked for with ``--json``.
    """
    if options.json:
        print(json.dumps(_plain(content), indent=2, allow_nan=False))
        return
    for line in lines:
        print(line, flush=True)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
