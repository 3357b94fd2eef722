# SPDX-License-Identifier: Apache-2.0
"""A recorded drive without end: every pass goes on where the last one ended, in number, time and place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from edge.errors import RecordingError
from edge.frames import Float64, Pose, RadarFrame
from edge.recording.reader import RecordingReader
from edge.sources.base import Loss

Item = RadarFrame | Pose | Loss


@dataclass(slots=True)
class _Pass:
    """What one pass covered, as it was recorded."""

    numbers: list[int] = field(default_factory=list)
    frames_ns: list[int] = field(default_factory=list)
    first_pose: Pose | None = None
    last_pose: Pose | None = None

    def add(self, item: Item) -> None:
        """The leading radar's frames set number and time; a straight and even drive is assumed of the poses."""
        if isinstance(item, Pose):
            self.first_pose, self.last_pose = self.first_pose or item, item
        elif isinstance(item, RadarFrame) and item.radar == "horizontal":
            self.numbers.append(item.number)
            self.frames_ns.append(item.t_first_chirp_ns)

    def step(self) -> tuple[int, int, Float64]:
        """By how much the next pass is later in number, nanoseconds and metres."""
        first, last = self.first_pose, self.last_pose
        if len(self.numbers) < 2 or first is None or last is None or first.t_ns == last.t_ns:
            raise RecordingError("a drive needs two frames and two poses to go on", value=len(self.numbers))
        numbers = self.numbers[-1] - self.numbers[0] + 1
        span_ns = self.frames_ns[-1] - self.frames_ns[0]
        duration_ns = round(span_ns * numbers / (numbers - 1))
        velocity = (last.position_m - first.position_m) / (last.t_ns - first.t_ns)
        return numbers, duration_ns, velocity * duration_ns


class EndlessDrive:
    """A source of frames and poses in order of time.

    Args:
        path: MCAP recording of two radars and their poses, one straight and even drive.
        seconds: recorded time to give.
    Attributes:
        passes: begun so far.
    """

    def __init__(self, path: Path, seconds: float) -> None:
        self._path, self._seconds = path, seconds
        self.passes = 0

    def __iter__(self) -> Iterator[Item]:
        """Until the time is over.

        Raises:
            RecordingError: the recording cannot be read or is no drive.
        """
        end_ns: int | None = None
        last_pose_ns = -1
        numbers, shift_ns, shift_m = 0, 0, np.zeros(3)
        while True:
            self.passes += 1
            covered = _Pass()
            with RecordingReader(self._path) as reader:
                for item in reader:
                    covered.add(item)
                    moved = _moved(item, numbers, shift_ns, shift_m)
                    t_ns = moved.t_first_chirp_ns if isinstance(moved, RadarFrame) else moved.t_ns
                    end_ns = t_ns + round(self._seconds * 1e9) if end_ns is None else end_ns
                    if t_ns >= end_ns:
                        return
                    if isinstance(moved, Pose):
                        if t_ns <= last_pose_ns:
                            continue  # recorded before the first frame: the pass before had poses there
                        last_pose_ns = t_ns
                    yield moved
            step, step_ns, step_m = covered.step()
            numbers, shift_ns, shift_m = numbers + step, shift_ns + step_ns, shift_m + step_m


def _moved(item: Item, numbers: int, shift_ns: int, shift_m: Float64) -> Item:
    if isinstance(item, Pose):
        return replace(item, t_ns=item.t_ns + shift_ns, position_m=item.position_m + shift_m)
    if isinstance(item, Loss):
        return replace(item, number=item.number + numbers, t_ns=item.t_ns + shift_ns)
    return replace(item, number=item.number + numbers, t_first_chirp_ns=item.t_first_chirp_ns + shift_ns)
