# SPDX-License-Identifier: Apache-2.0
"""What every source of radar frames gives: frames, poses and named losses, in time order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from edge.errors import CaptureError
from edge.frames import Int16, LossCause, Pose, RadarFrame, RadarId

MAX_LOOPS = 255
"""Most loops a frame of these chips can have (frame configuration message, 8 bits)."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Frames that did not come as frames.

    Args:
        radar: whose.
        number: frame number of the first one.
        cause: why.
        detail: one sentence for the log: file, bytes, times.
        t_ns: instant at which it was noticed: first chirp of the lost frame, or of the frame after a gap.
        count: frames lost, with consecutive numbers.
    """

    radar: RadarId
    number: int
    cause: LossCause
    detail: str
    t_ns: int
    count: int = 1


@runtime_checkable
class FrameSource(Protocol):
    """Anything frames come from."""

    @property
    def total_frames(self) -> int | None:
        """Frames and losses of all radars that iteration will give, for a progress bar; None: unknown or endless."""

    def __iter__(self) -> Iterator[RadarFrame | Pose | Loss]:
        """Frames, poses and losses in time order."""

    def close(self) -> None:
        """Release files and sockets; iteration ends."""


def loops_that_fit(nbytes: int, loop_bytes: int) -> tuple[int, ...]:
    """Loops per frame with which ``nbytes`` are a whole number of frames.

    Args:
        nbytes: size of a data file.
        loop_bytes: bytes of one loop in that file.
    Returns:
        Ascending, at most 255; empty when the size is not even a whole number of loops.
    """
    if loop_bytes <= 0 or nbytes <= 0 or nbytes % loop_bytes:
        return ()
    total = nbytes // loop_bytes
    return tuple(loops for loops in range(1, MAX_LOOPS + 1) if total % loops == 0)


def file_size(path: Path) -> int:
    """Bytes of a capture file; CaptureError when it cannot be looked at."""
    try:
        return path.stat().st_size
    except OSError as error:
        raise _unreadable(path, error) from error


def open_raw(path: Path) -> FileIO:
    """The file for reading without a buffer; CaptureError when it cannot be opened."""
    try:
        return FileIO(path, "rb")
    except OSError as error:
        raise _unreadable(path, error) from error


def read_into(file: FileIO, samples: Int16 | NDArray[np.uint8]) -> bool:
    """Fill a C-contiguous array from where the file stands, without a copy in between.

    Returns:
        False when the file ends before.
    """
    rest = samples.reshape(-1).view(np.uint8)
    while rest.size:
        count = file.readinto(rest.data)
        if not count:
            return False
        rest = rest[count:]
    return True


def _unreadable(path: Path, error: OSError) -> CaptureError:
    return CaptureError(f"{path} cannot be read", value=error.strerror, action="check the path and its rights")
