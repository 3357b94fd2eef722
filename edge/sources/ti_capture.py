# SPDX-License-Identifier: Apache-2.0
"""Reads the folders that the cascade's capture board writes: four devices' files joined to one frame buffer.

Files are ``{master,slave1,slave2,slave3}_0000_{data,idx}.bin``; the board begins ``_0001`` after 2 GB. A data file is
whole frames of one device, int16 ``[loop, slot, sample, rx, (I, Q)]``. Every sample is copied exactly once, from the
file into its place in the frame.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.errors import CaptureError
from edge.frames import Layout, LossCause, Pose, RadarFrame, RadarId
from edge.rig import Radar, Rig
from edge.sources.base import Loss, file_size, loops_that_fit, open_raw, read_into
from edge.sources.ti_index import GAP_TOLERANCE, CaptureIndex, Gap, describe_indexes, find_gaps, gap_notes, read_index

DEVICES = ("master", "slave1", "slave2", "slave3")
SAME_FRAME_NS = 1_000_000
"""Four devices stamp one frame this close together; in real files the stamps are equal."""
_FILE = re.compile(r"(master|slave[123])_(\d{4})_(data|idx)\.bin")


@dataclass(frozen=True, slots=True)
class _Segment:
    """Files of one number: ``whole`` frames that every device has, then ``cut`` (0 or 1) that is not complete."""

    data: tuple[Path, ...]
    whole: int
    cut: int
    t_ns: NDArray[np.int64] | None


class CaptureFolder:
    """One radar's capture as a source of frames.

    Args:
        path: folder with the files of all devices.
        rig: rig the capture was made with.
        radar: which of its radars.
        t_start_ns: instant of frame 0; None keeps the board's own clock (0 when there is no index).
    Attributes:
        gaps: places where the board's time stamps are more than 10 % further apart than the frame period.
        notes: what a reader of the results should know, in sentences.
        board_start_ns: the board's own stamp of the first frame; None: there is no index.
    Raises:
        CaptureError: no capture; a device's file is missing or not expected; size, count, loops or time contradict the
            schedule or each other.
    """

    def __init__(self, path: Path | str, rig: Rig, radar: RadarId, t_start_ns: int | None = None) -> None:
        self.path, self.radar = Path(path), radar
        schedule = _radar_of(rig, radar, self.path).schedule
        self.layout: Layout = schedule.layout
        if self.layout.kind != "cascade" or schedule.packed_12_bit:
            raise CaptureError(
                f"{self.path}: rig {rig.name} does not capture this radar as 16-bit files of a cascade",
                value="packed 12 bit" if schedule.packed_12_bit else self.layout.kind,
                allowed="cascade, 16 bit",
                action="load the rig the capture was made with; record without 12-bit packing",
            )
        self.notes: list[str] = []
        self._segments = self._find_segments()
        self._t_ns, self._numbers = self._clock(schedule.frame_period_s, t_start_ns)
        self._closed = False

    @property
    def total_frames(self) -> int:
        """Frames and cut frames in the folder."""
        return sum(segment.whole + segment.cut for segment in self._segments)

    def __iter__(self) -> Iterator[RadarFrame | Pose | Loss]:
        """Frames in the board's order; a cut last frame is a loss of cause TRUNCATED."""
        index = 0
        for segment in self._segments:
            with ExitStack() as stack:
                files = [stack.enter_context(open_raw(path)) for path in segment.data]
                for k in range(segment.whole + segment.cut):
                    if self._closed:
                        return
                    number, t_ns = int(self._numbers[index]), int(self._t_ns[index])
                    adc = None if k >= segment.whole else _read_frame(files, self.layout, k)
                    if adc is None:
                        detail = f"{segment.data[0].parent}: frame {k} of {segment.data[0].name} is cut"
                        yield Loss(self.radar, number, LossCause.TRUNCATED, detail, t_ns)
                    else:
                        yield RadarFrame(self.radar, number, t_ns, adc, self.layout)
                    index += 1

    def close(self) -> None:
        """End any iteration; nothing else is held open."""
        self._closed = True

    def dead_channels(self) -> tuple[str, ...]:
        """Receivers that are zero through the whole capture, for example ("slave2 RX3",).

        Reads until every receiver has shown a sample that is not zero: one frame of a healthy capture.
        """
        silent = np.ones((self.layout.devices, self.layout.rx), dtype=np.bool_)
        for item in self:
            if isinstance(item, RadarFrame):
                silent &= ~item.adc.any(axis=(1, 2, 3, 5))
            if not silent.any():
                break
        return tuple(f"{DEVICES[device]} RX{rx + 1}" for device, rx in np.argwhere(silent))

    def _find_segments(self) -> list[_Segment]:
        found: dict[int, dict[str, set[str]]] = {}
        try:
            names = sorted(os.listdir(self.path))
        except OSError as error:
            raise CaptureError(f"{self.path}: no capture folder", value=error.strerror) from error
        for name in names:
            match = _FILE.fullmatch(name)
            if match:
                found.setdefault(int(match[2]), {"data": set(), "idx": set()})[match[3]].add(match[1])
        if not found:
            raise CaptureError(
                f"{self.path}: no capture in this folder",
                value=names[:4],
                allowed="master_0000_data.bin and its like",
                action="give the folder the board wrote, with the files of all devices",
            )
        expected = set(DEVICES[: self.layout.devices])
        for number in range(max(found) + 1):
            have = found.get(number, {"data": set(), "idx": set()})
            if have["data"] != expected:
                raise self._wrong_devices(number, have["data"], expected)
        segments = [self._segment(number, found[number]["idx"]) for number in sorted(found)]
        if not any(segment.whole for segment in segments):
            raise CaptureError(f"{self.path}: not one whole frame", action="reboot the board and record again")
        return segments

    def _wrong_devices(self, number: int, have: set[str], expected: set[str]) -> CaptureError:
        absent = sorted(expected - have)
        name = absent[0] if absent else sorted(have - expected)[0]
        return CaptureError(
            f"{self.path / f'{name}_{number:04d}_data.bin'} {'is missing' if absent else 'has no place in this rig'}",
            value=sorted(have),
            allowed=f"{len(expected)} devices: {', '.join(sorted(expected))}",
            action="copy the files of all devices from the board" if absent else "load the rig of this capture",
        )

    def _segment(self, number: int, indexed: set[str]) -> _Segment:
        names = DEVICES[: self.layout.devices]
        data = tuple(self.path / f"{name}_{number:04d}_data.bin" for name in names)
        indexes = [
            read_index(self.path / f"{name}_{number:04d}_idx.bin") if name in indexed else None for name in names
        ]
        counts = [_count(path, index, self.layout) for path, index in zip(data, indexes, strict=True)]
        begun, whole = max(begun for begun, _ in counts), min(whole for _, whole in counts)
        if begun - whole > 1 or any(index is not None and len(index) != begun for index in indexes):
            text = ", ".join(f"{name} {n}" for name, (n, _) in zip(names, counts, strict=True))
            raise CaptureError(
                f"{self.path}: the devices of segment {number:04d} hold different numbers of frames",
                value=text,
                allowed="the same number, the last one may be cut",
                action="copy the files again; if they are the board's own, record again",
            )
        present = [index for index in indexes if index is not None]
        for expected, index in enumerate(indexes):
            if index is not None and len(index) and index.device != expected:
                raise CaptureError(
                    f"{index.path}: written by another device", value=DEVICES[index.device], allowed=DEVICES[expected]
                )
            if index is not None and np.any(np.abs(index.t_ns - present[0].t_ns) > SAME_FRAME_NS):
                raise CaptureError(
                    f"{index.path}: frames of other times than in {present[0].path.name}",
                    allowed=f"within {SAME_FRAME_NS / 1e6:g} ms",
                    action="put only the files of one capture into a folder",
                )
        return _Segment(data, whole, begun - whole, present[0].t_ns if present else None)

    def _clock(self, period_s: float, t_start_ns: int | None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Instants and numbers of all frames: a number is skipped where the board's clock skipped a period."""
        total = self.total_frames
        self.gaps: list[Gap] = []
        self.board_start_ns: int | None = None
        stamps = [segment.t_ns for segment in self._segments if segment.t_ns is not None]
        if len(stamps) < len(self._segments):
            self.notes.append("no index files: times are frame number times the schedule's period, gaps are unknown")
            numbers = np.arange(total, dtype=np.int64)
            return (t_start_ns or 0) + np.round(numbers * (period_s * 1e9)).astype(np.int64), numbers
        t_ns = np.concatenate(stamps)
        self.board_start_ns = int(t_ns[0])
        steps_s = np.diff(t_ns) / 1e9
        measured_s = float(np.median(steps_s)) if len(steps_s) else period_s
        if abs(measured_s - period_s) > GAP_TOLERANCE * period_s:
            self.notes.append(f"frames came every {1e3 * measured_s:.2f} ms, the schedule says {1e3 * period_s:.2f} ms")
            period_s = measured_s if measured_s > 0 else period_s
        self.gaps = find_gaps(t_ns, period_s)
        self.notes += gap_notes(self.gaps)
        advance = np.ones(total, dtype=np.int64)
        advance[0] = 0
        for gap in self.gaps:
            advance[gap.after + 1] += gap.missing
        return t_ns if t_start_ns is None else t_ns - t_ns[0] + t_start_ns, np.cumsum(advance)


def describe_capture(folder: Path) -> dict[str, object]:
    """What the files of a capture folder say without a rig: devices, bytes of their data, frames, period, gaps.

    Returns:
        Plain values for JSON; empty when the folder holds no file of the capture board.
    Raises:
        CaptureError: an index that cannot be read.
    """
    names = [path.name for path in sorted(folder.iterdir())] if folder.is_dir() else []
    files = [match for match in map(_FILE.fullmatch, names) if match]
    if not files:
        return {}
    data = {match[0]: file_size(folder / match[0]) for match in files if match[3] == "data"}
    found: dict[str, object] = {
        "capture": str(folder),
        "devices": [device for device in DEVICES if any(match[1] == device for match in files)],
    }
    if data:
        found["data_bytes"] = data
    if any(match[1] == DEVICES[0] and match[3] == "idx" for match in files):
        return found | describe_indexes(folder)
    return found | {"frames": "unknown without index files: their size follows from the rig"}


def _radar_of(rig: Rig, radar: RadarId, path: Path) -> Radar:
    if radar not in rig.radars:
        raise CaptureError(f"{path}: rig {rig.name} has no such radar", value=radar, allowed=", ".join(rig.radars))
    return rig.radars[radar]


def _count(path: Path, index: CaptureIndex | None, layout: Layout) -> tuple[int, int]:
    """Frames begun and frames complete in one data file; CaptureError when size and index contradict the layout."""
    loop_bytes = layout.slots * layout.samples * layout.rx * 4
    frame_bytes, size = loop_bytes * layout.loops, file_size(path)
    whole, rest = divmod(size, frame_bytes)
    if index is None:
        if rest and size % loop_bytes == 0:
            raise _wrong_loops(path, size, layout, loops_that_fit(size, loop_bytes))
        return whole + (rest > 0), whole
    if len(index) and not (index.size == frame_bytes).all():
        entry = int(index.size[index.size != frame_bytes][0])
        fit = (entry // loop_bytes,) if entry % loop_bytes == 0 else ()
        raise _wrong_loops(index.path, entry, layout, fit)
    if whole < len(index) - 1 or size > len(index) * frame_bytes:
        raise CaptureError(
            f"{path}: size contradicts {index.path.name}",
            value=f"{size} bytes",
            allowed=f"{len(index)} frames of {frame_bytes} bytes: {len(index) * frame_bytes}",
            action="copy both files from the board again",
        )
    return len(index), whole


def _wrong_loops(path: Path, nbytes: int, layout: Layout, fit: Sequence[int]) -> CaptureError:
    return CaptureError(
        f"{path}: frames do not have the schedule's {layout.loops} loops",
        value=f"{nbytes} bytes",
        allowed=f"whole frames of {layout.loops} x {layout.slots} x {layout.samples} x {layout.rx} x 4 bytes",
        action=f"loops that fit: {', '.join(map(str, fit)) or 'none, so samples or slots differ'}; set schedule.loops",
    )


def _read_frame(files: Sequence[FileIO], layout: Layout, index: int) -> NDArray[np.int16] | None:
    """Frame ``index`` of a segment, freshly allocated; None when a file ends before it."""
    adc = np.empty(layout.shape, dtype=np.int16)
    for device, file in enumerate(files):
        file.seek(index * adc[device].nbytes)
        if not read_into(file, adc[device]):
            return None
    return adc
