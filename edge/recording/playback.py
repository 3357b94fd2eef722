# SPDX-License-Identifier: Apache-2.0
"""A recording from here to there, once or again and again; numbers and times go on rising from pass to pass."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from edge.errors import ConfigError, RecordingError
from edge.frames import RADARS, Pose, RadarFrame, RadarId
from edge.recording.reader import RecordingReader

NS_PER_S = 1_000_000_000
POSE_MARGIN_NS = NS_PER_S // 2
"""Poses so long before the first and after the last frame are played too: both frames need one on either side."""
PASS_GAP_NS = NS_PER_S
"""Between two passes; longer than any pose gap that is bridged, so that no window spans the jump back."""


@dataclass(frozen=True, slots=True)
class Part:
    """What to play of a recording.

    Args:
        start_s, end_s: seconds after the first log time; None: to the end.
        loops: passes; 0: without end.
    Raises:
        ConfigError: an end that is not later than the start.
    """

    start_s: float = 0.0
    end_s: float | None = None
    loops: int = 1

    def __post_init__(self) -> None:
        if self.start_s < 0 or (self.end_s is not None and self.end_s <= self.start_s):
            raise ConfigError("nothing lies between start and end", value=(self.start_s, self.end_s),
                              allowed="0 <= start < end, seconds since the recording's first message")  # fmt: skip

    @property
    def whole(self) -> bool:
        """Whether it is the recording from end to end."""
        return self.start_s == 0 and self.end_s is None

    def span_ns(self, recording_ns: tuple[int, int]) -> tuple[int, int]:
        """First and last log time to play.

        Raises:
            RecordingError: the recording is shorter than ``start_s``.
        """
        first_ns, last_ns = recording_ns
        start_ns = first_ns + round(self.start_s * NS_PER_S)
        if start_ns > last_ns:
            raise RecordingError(
                "the recording ends before the start that was asked for",
                value=f"{self.start_s:g} s",
                allowed=f"0..{(last_ns - first_ns) / NS_PER_S:.3f} s",
            )
        end_ns = last_ns if self.end_s is None else min(last_ns, first_ns + round(self.end_s * NS_PER_S))
        return start_ns, end_ns


class Playback:
    """Frames and poses of a part of a recording: a ``FrameSource``.

    The part begins and ends with frames of the first radar; the other radar gives those of the same numbers.

    Args:
        reader: open; stays open.
        part: what to play.
    Raises:
        RecordingError: as ``Part.span_ns``.
    """

    def __init__(self, reader: RecordingReader, part: Part) -> None:
        self._reader, self._part = reader, part
        self._span_ns = part.span_ns(reader.span_ns)
        self.passes = 0
        """Complete passes so far."""

    @property
    def total_frames(self) -> int | None:
        """Of all radars and passes; None: not known before, or endless."""
        return self._reader.total_frames * self._part.loops or None if self._part.whole else None

    def __iter__(self) -> Iterator[RadarFrame | Pose]:
        shift_ns = shift = 0
        while not self._part.loops or self.passes < self._part.loops:
            reach = _Reach()
            for item in self._pass():
                reach.add(item)
                yield _shifted(item, shift, shift_ns)
            if reach.last_number is None:
                return  # nothing to play: no loop would ever end
            shift_ns += reach.duration_ns + PASS_GAP_NS
            shift += reach.numbers
            self.passes += 1

    def close(self) -> None:
        """Close the recording; iteration ends."""
        self._reader.close()

    def _pass(self) -> Iterator[RadarFrame | Pose]:
        """Items of one pass as they were recorded."""
        start_ns, end_ns = self._span_ns
        wide = None if self._part.whole else (max(0, start_ns - POSE_MARGIN_NS), end_ns + POSE_MARGIN_NS)
        lead: RadarId | None = None
        numbers: list[int] = []
        """First and last number of the leading radar."""
        for item in self._reader.items(wide):
            if isinstance(item, Pose) or wide is None:
                yield item
                continue
            lead = lead or (RADARS[0] if self._reader.frames_of(RADARS[0]) else item.radar)
            if item.radar == lead:
                inside = start_ns <= item.t_first_chirp_ns <= end_ns
                if inside:
                    numbers = [numbers[0] if numbers else item.number, item.number]
            else:
                inside = bool(numbers) and numbers[0] <= item.number <= numbers[-1]
            if inside:
                yield item


class _Reach:
    """How far one pass reached in time and numbers."""

    def __init__(self) -> None:
        self._times_ns: tuple[int, int] | None = None
        self.first_number: int | None = None
        self.last_number: int | None = None

    def add(self, item: RadarFrame | Pose) -> None:
        t_ns = item.t_ns if isinstance(item, Pose) else item.t_first_chirp_ns
        low_ns, high_ns = self._times_ns or (t_ns, t_ns)
        self._times_ns = min(low_ns, t_ns), max(high_ns, t_ns)
        if isinstance(item, RadarFrame):
            self.first_number = item.number if self.first_number is None else min(self.first_number, item.number)
            self.last_number = item.number if self.last_number is None else max(self.last_number, item.number)

    @property
    def duration_ns(self) -> int:
        return self._times_ns[1] - self._times_ns[0] if self._times_ns else 0

    @property
    def numbers(self) -> int:
        first, last = self.first_number, self.last_number
        return 0 if first is None or last is None else last - first + 1


def _shifted(item: RadarFrame | Pose, shift: int, shift_ns: int) -> RadarFrame | Pose:
    if not shift_ns:
        return item
    if isinstance(item, Pose):
        return replace(item, t_ns=item.t_ns + shift_ns)
    return replace(item, number=item.number + shift, t_first_chirp_ns=item.t_first_chirp_ns + shift_ns)
