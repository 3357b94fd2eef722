# SPDX-License-Identifier: Apache-2.0
"""Reads the ``*_idx.bin`` files that the cascade's capture board writes beside its data: sizes, offsets, time stamps.

Layout (little endian), confirmed on four real files of one capture: header of 24 bytes, tag ``bckt``, u32 version 1,
u32 flags, u32 number of frames, u64 bytes of the data file; then 48 bytes a frame: u16 tag, u16 version, u32 flags
(second byte: device), u16 width, u16 height, 4 u32, u32 size, u64 time stamp in microseconds, u64 offset.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.errors import CaptureError

HEADER = struct.Struct("<4sIIIQ")
FILE_TAG = b"bckt"
FRAME_TAG = 0x6469
LARGEST_FILE_BYTES = 1 << 26
GAP_TOLERANCE = 0.1
"""Share of the period by which two stamps may be further apart before it is called a gap."""

ENTRY = np.dtype(
    [
        ("tag", "<u2"),
        ("version", "<u2"),
        ("flags", "<u4"),
        ("width", "<u2"),
        ("height", "<u2"),
        ("pitch", "<u4", 4),
        ("size", "<u4"),
        ("t_us", "<u8"),
        ("offset", "<u8"),
    ]
)


@dataclass(frozen=True, slots=True)
class CaptureIndex:
    """One device's index of one segment.

    Args:
        path: of the file.
        device: 0 master, 1..3 slaves, as the entries say.
        data_bytes: size of the data file as the header says; 0 when the board never closed the index.
        size: int64 [n], bytes of each frame.
        offset: int64 [n], where each begins in the data file.
        t_ns: int64 [n], the board's clock when it took the frame; which instant of the burst is not documented.
    """

    path: Path
    device: int
    data_bytes: int
    size: NDArray[np.int64]
    offset: NDArray[np.int64]
    t_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True, slots=True)
class Gap:
    """Two consecutive frames further apart than the period allows.

    Args:
        after: index of the frame before the gap.
        duration_s: from that frame to the next.
        missing: whole periods that have no frame; 0: a frame was only late.
    """

    after: int
    duration_s: float
    missing: int


def read_index(path: Path) -> CaptureIndex:
    """Parse one index file.

    Raises:
        CaptureError: unreadable, foreign, cut, or its own numbers contradict each other.
    """
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise _refuse(path, "too large for an index", path.stat().st_size, f"at most {LARGEST_FILE_BYTES} bytes")
        content = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path} cannot be read", value=error.strerror) from error
    if len(content) < HEADER.size or content[:4] != FILE_TAG:
        raise _refuse(
            path, "not an index file", content[:4], f"{HEADER.size} bytes or more that begin with {FILE_TAG!r}"
        )
    _, version, _, count, data_bytes = HEADER.unpack_from(content)
    if version != 1:
        raise _refuse(path, "unknown version", version, "1")
    whole, rest = divmod(len(content) - HEADER.size, ENTRY.itemsize)
    if rest or (count != whole and count != 0):
        raise _refuse(path, "cut or still being written", f"{whole} entries and {rest} bytes", f"{count} whole entries")
    entries = np.frombuffer(content, ENTRY, whole, HEADER.size)
    return _checked(path, entries, data_bytes)


def find_gaps(t_ns: Sequence[int] | NDArray[np.int64], period_s: float) -> list[Gap]:
    """Places where consecutive time stamps are more than 10 % further apart than the period.

    Args:
        t_ns: [n], instants of consecutive frames.
        period_s: nominal frame period.
    """
    steps_s: list[float] = (np.diff(np.asarray(t_ns, dtype=np.int64)) / 1e9).tolist()
    allowed_s = (1.0 + GAP_TOLERANCE) * period_s
    return [Gap(i, s, max(0, round(s / period_s) - 1)) for i, s in enumerate(steps_s) if s > allowed_s]


def gap_notes(gaps: Sequence[Gap]) -> list[str]:
    """One phrase a gap: "124.65 ms between frames 6 and 7"."""
    return [f"{1e3 * gap.duration_s:.2f} ms between frames {gap.after} and {gap.after + 1}" for gap in gaps]


def indexed_gaps(folder: Path) -> list[Gap]:
    """Gaps against the median period that the master's index files of a folder show; none without index.

    Raises:
        CaptureError: an index that cannot be read.
    """
    _, t_ns = _master_indexes(folder)
    period_s = _median_period_s(t_ns)
    return find_gaps(t_ns, period_s) if period_s > 0 else []


def describe_indexes(folder: Path) -> dict[str, object]:
    """What the index files of a capture folder say, with or without the data files beside them.

    Returns:
        Plain values for JSON: frames, bytes of one device's frame, median period, duration, and every gap.
    Raises:
        CaptureError: no index there, or one that cannot be read.
    """
    indexes, t_ns = _master_indexes(folder)
    if not indexes:
        raise CaptureError(f"{folder} holds no master_0000_idx.bin", action="give the folder the board wrote")
    size = np.concatenate([index.size for index in indexes])
    period_s, gaps = _median_period_s(t_ns), indexed_gaps(folder)
    return {
        "frames": len(t_ns),
        "device_frame_bytes": sorted(set(size.tolist())),
        "period_s": period_s,
        "duration_s": float(t_ns[-1] - t_ns[0]) / 1e9 if len(t_ns) else 0.0,
        "gaps": [{"after_frame": g.after, "duration_s": g.duration_s, "frames_missing": g.missing} for g in gaps],
    }


def _master_indexes(folder: Path) -> tuple[list[CaptureIndex], NDArray[np.int64]]:
    """The master's index of every segment, and all instants."""
    indexes = [read_index(path) for path in sorted(folder.glob("master_[0-9][0-9][0-9][0-9]_idx.bin"))]
    return indexes, np.concatenate([index.t_ns for index in indexes] or [np.zeros(0, dtype=np.int64)])


def _median_period_s(t_ns: NDArray[np.int64]) -> float:
    return float(np.median(np.diff(t_ns))) / 1e9 if len(t_ns) > 1 else 0.0


def _checked(path: Path, entries: NDArray[np.void], data_bytes: int) -> CaptureIndex:
    """Entries as columns; CaptureError when they contradict each other or the header."""
    if len(entries) and not (entries["tag"] == FRAME_TAG).all():
        raise _refuse(
            path, "entry without the frame tag", hex(entries["tag"][entries["tag"] != FRAME_TAG][0]), "0x6469"
        )
    devices = np.unique((entries["flags"] >> 8) & 0xFF)
    if len(devices) > 1 or (len(devices) and devices[0] > 3):
        raise _refuse(path, "entries of more than one device", devices.tolist(), "one of 0..3")
    if len(entries) and max(entries["t_us"].max(), entries["offset"].max()) > np.iinfo(np.int64).max // 1000:
        raise _refuse(path, "time stamp or offset beyond any board", int(entries["t_us"].max()), "below 2^53")
    size, offset = entries["size"].astype(np.int64), entries["offset"].astype(np.int64)
    expected = np.concatenate(([0], np.cumsum(size)[:-1])) if len(size) else size
    if not np.array_equal(offset, expected) or (data_bytes and data_bytes != int(size.sum())):
        raise _refuse(path, "frames do not follow one another", offset[:4].tolist(), f"{expected[:4].tolist()}")
    device = int(devices[0]) if len(devices) else 0
    return CaptureIndex(path, device, data_bytes, size, offset, entries["t_us"].astype(np.int64) * 1000)


def _refuse(path: Path, what: str, value: object, allowed: str) -> CaptureError:
    action = "copy the file from the board again, or remove all *_idx.bin to read by fixed frame size without times"
    return CaptureError(f"{path}: {what}", value=value, allowed=allowed, action=action)
