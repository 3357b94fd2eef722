# SPDX-License-Identifier: Apache-2.0
"""Poses from a text file, CSV or JSON lines: every line a pose, every bad line named.

CSV: ``t_ns,x,y,z,qx,qy,qz,qw`` (that header line may come first). JSON lines: one object a line with these eight keys.
Times are integer nanoseconds, strictly ascending; positions metres; the quaternion rotates rig vectors into the
odometry frame. Empty lines and lines that begin with ``#`` are skipped.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from edge.errors import PoseError
from edge.frames import Pose

COLUMNS = ("t_ns", "x", "y", "z", "qx", "qy", "qz", "qw")
LONGEST_LINE = 1024
_FORMAT = f"{','.join(COLUMNS)} or a JSON object with these keys"
_INT64 = range(-(2**63), 2**63)


def read_poses(path: Path) -> Iterator[Pose]:
    """Poses of a file, in order, read as they are asked for.

    Args:
        path: CSV or JSON lines, told apart line by line.
    Raises:
        PoseError: the file cannot be read, or a line is no pose or not later than the one before; names file and line.
    """
    try:
        with path.open("rb") as file:
            yield from parse_poses(iter(lambda: file.readline(LONGEST_LINE + 1), b""), str(path))
    except OSError as error:
        raise PoseError(f"pose file {path} cannot be read", value=error.strerror, action="check the path") from error


def parse_poses(lines: Iterable[bytes], name: str) -> Iterator[Pose]:
    """Poses of text lines; as ``read_poses``, with ``name`` in the errors."""
    last_ns: int | None = None
    header_allowed = True
    for number, raw in enumerate(lines, start=1):
        where = f"{name}, line {number}"
        text = _text(raw, where)
        if not text or text.startswith("#"):
            continue
        if header_allowed and tuple(part.strip() for part in text.split(",")) == COLUMNS:
            header_allowed = False
            continue
        header_allowed = False
        pose = _pose(text, where)
        if last_ns is not None and pose.t_ns <= last_ns:
            raise PoseError(
                f"{where}: time does not advance",
                value=pose.t_ns,
                allowed=f"> {last_ns} ns",
                action="sort the poses by time and remove duplicates",
            )
        last_ns = pose.t_ns
        yield pose


def _text(raw: bytes, where: str) -> str:
    """The line without its end; PoseError for bytes that are no line of text."""
    if len(raw) > LONGEST_LINE:
        raise PoseError(f"{where}: too long for a pose", allowed=f"at most {LONGEST_LINE} bytes: {_FORMAT}")
    try:
        return raw.decode("utf-8").strip()
    except UnicodeDecodeError as error:
        raise PoseError(f"{where}: no text", value=raw[:40], allowed=_FORMAT) from error


def _pose(text: str, where: str) -> Pose:
    """Pose of one line; PoseError naming it otherwise."""
    try:
        t_ns, numbers = _json_values(text) if text.startswith("{") else _csv_values(text)
        if t_ns not in _INT64:
            raise ValueError("t_ns beyond 64 bits")
        return Pose(t_ns, np.array(numbers[:3], np.float64), np.array(numbers[3:], np.float64))
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise PoseError(f"{where}: no pose ({reason})", value=text[:120], allowed=_FORMAT) from error
    except PoseError as error:
        raise PoseError(
            f"{where}: {error.what}", value=error.value, allowed=error.allowed, action=error.action
        ) from error


def _csv_values(text: str) -> tuple[int, list[float]]:
    parts = text.split(",")
    if len(parts) != len(COLUMNS):
        raise ValueError(f"{len(parts)} columns instead of {len(COLUMNS)}")
    if "_" in text or not text.isascii():  # Python's own digits: 1_000 and other scripts
        raise ValueError("not plain decimal numbers")
    return int(parts[0]), [float(part) for part in parts[1:]]


def _json_values(text: str) -> tuple[int, list[float]]:
    values = json.loads(text)
    extra = set(values) - set(COLUMNS)
    if extra:
        raise ValueError(f"unknown key {min(extra)!r}")
    numbers = [values[key] for key in COLUMNS]
    if any(isinstance(number, bool) or not isinstance(number, int | float) for number in numbers):
        raise TypeError("a value is not a number")
    if not isinstance(numbers[0], int):
        raise TypeError("t_ns is not an integer")
    return numbers[0], [float(number) for number in numbers[1:]]
