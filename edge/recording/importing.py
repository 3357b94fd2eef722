# SPDX-License-Identifier: Apache-2.0
"""Turns captures of the boards' own tools, and trajectories of other programs, into recordings."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from edge.constraints import start_offset_s
from edge.errors import CaptureError, PoseError
from edge.frames import LossCause, Pose, RadarFrame, RadarId
from edge.odometry.recorded import read_poses
from edge.recording.writer import RecordingWriter
from edge.rig import Rig
from edge.sources.base import Loss
from edge.sources.dca1000_file import Dca1000File
from edge.sources.loop_sum import LoopSum
from edge.sources.ti_capture import CaptureFolder

CaptureFile = CaptureFolder | Dca1000File | LoopSum
TRAJECTORY_SUFFIXES = (".tum", ".txt")


@dataclass(slots=True)
class ImportReport:
    """What an import found; ``frames_in = frames_ok + sum(lost)`` for every radar.

    Args:
        frames_in: radar -> frames in the capture, the cut ones and those its clock skipped included.
        frames_ok: radar -> frames recorded.
        lost: radar -> cause -> frames not recorded.
        poses: poses recorded.
        notes: what a reader of the results should know: time gaps, dead channels.
    """

    frames_in: dict[RadarId, int] = field(default_factory=dict)
    frames_ok: dict[RadarId, int] = field(default_factory=dict)
    lost: dict[RadarId, Counter[LossCause]] = field(default_factory=dict)
    poses: int = 0
    notes: list[str] = field(default_factory=list)


def open_captures(
    captures: Path | Mapping[RadarId, Path], rig: Rig, t_start_ns: int | None = None
) -> dict[RadarId, CaptureFile]:
    """One source for each radar of the rig.

    Two boards' clocks have nothing in common: in a rig of two radars their first frames are taken for one pair, and the
    vertical radar's time is the horizontal one's plus ``constraints.start_offset_s``, half a period for equal bursts.

    Args:
        captures: radar -> TI capture folder or ``adc_data.bin``; a single path is the capture of a rig of one radar, or
            a folder that holds ``horizontal`` and ``vertical``.
        rig: rig the captures were made with.
        t_start_ns: instant of the horizontal (or only) radar's first chirp; None keeps a board's own clock in a rig of
            one radar, 0 where the capture has none, and is 0 in a rig of two.
    Raises:
        CaptureError: a radar of the rig has no capture, or as CaptureFolder and Dca1000File.
    """
    if isinstance(captures, Path):
        one = next(iter(rig.radars))
        captures = {one: captures} if len(rig.radars) == 1 else {radar: captures / radar for radar in rig.radars}
    if set(captures) != set(rig.radars):
        raise CaptureError(
            f"captures do not match the radars of rig {rig.name}",
            value=", ".join(sorted(captures)),
            allowed=", ".join(rig.radars),
            action="give one capture for each radar of the rig",
        )
    starts_ns: dict[RadarId, int | None] = dict.fromkeys(captures, t_start_ns)
    if len(captures) > 1:
        horizontal_ns = t_start_ns or 0
        starts_ns = {"horizontal": horizontal_ns, "vertical": horizontal_ns + _offset_ns(rig)}
    return {radar: _open(path, rig, radar, starts_ns[radar]) for radar, path in captures.items()}


def import_capture(
    captures: Path | Mapping[RadarId, Path],
    rig: Rig,
    out_path: Path,
    poses: Iterable[Pose] = (),
    progress: Callable[[int, int], None] | None = None,
    t_start_ns: int | None = None,
) -> ImportReport:
    """Write captures and poses to one recording, in time order.

    Args:
        captures, rig, t_start_ns: as for ``open_captures``. The notes of the report are stored with the recording.
        out_path: recording to make; must not exist.
        poses: of the rig, ascending in time, on the clock of the frames, which ``t_start_ns`` sets.
        progress: called with frames done and frames in all.
    Raises:
        CaptureError: as ``open_captures``.
        RecordingError: the recording cannot be written.
        PoseError: ``poses`` yields no poses.
    """
    sources = open_captures(captures, rig, t_start_ns)
    report = ImportReport()
    for radar, source in sources.items():
        report.frames_in[radar] = report.frames_ok[radar] = 0
        report.lost[radar] = Counter()
        if isinstance(source, CaptureFolder | LoopSum):
            report.notes += [f"{radar}: {note}" for note in source.notes]
        if isinstance(source, CaptureFolder):
            report.notes += [f"{radar}: {name} is dead" for name in source.dead_channels()]
    if len(sources) > 1:
        report.notes.append(
            f"assumed, not measured: the captures begin with frames of one number, the vertical radar's"
            f" {_offset_ns(rig) / 1e6:.3f} ms after the horizontal one's at {t_start_ns or 0} ns"
        )
    writer = RecordingWriter(out_path, rig, report.notes)
    try:
        with writer:
            _copy(sources, poses, writer, report, progress)
    except BaseException:
        out_path.unlink(missing_ok=True)  # half an import would pass for a whole one
        raise
    return report


def import_poses(path: Path) -> list[Pose]:
    """Poses of a file: our own CSV or JSON lines, or a TUM trajectory (``.tum``, ``.txt``).

    A TUM line is ``time_s x y z qx qy qz qw``, separated by blanks; times are read to the nanosecond.

    Raises:
        PoseError: unreadable, a line that is no pose, or time that does not ascend; names the line.
    """
    if path.suffix not in TRAJECTORY_SUFFIXES:
        return list(read_poses(path))
    poses: list[Pose] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PoseError(f"{path}: cannot be read", value=str(error), action="check the path") from error
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        pose = _tum_pose(line, f"{path}, line {number}")
        if poses and pose.t_ns <= poses[-1].t_ns:
            raise PoseError(f"{path}, line {number}: time does not advance", value=pose.t_ns, allowed="ascending")
        poses.append(pose)
    return poses


def _copy(
    sources: Mapping[RadarId, CaptureFile],
    poses: Iterable[Pose],
    writer: RecordingWriter,
    report: ImportReport,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Merge all sources by time into the recording, counting."""
    total, done, expected = sum(source.total_frames for source in sources.values()), 0, dict.fromkeys(sources, 0)
    for item in heapq.merge(*sources.values(), poses, key=_instant):
        if isinstance(item, Pose):
            writer.pose(item)
            report.poses += 1
            continue
        _count(report, item, expected)
        if isinstance(item, RadarFrame):
            writer.frame(item)
        done += 1
        if progress is not None:
            progress(done, total)


def _offset_ns(rig: Rig) -> int:
    return round(1e9 * start_offset_s(rig.radars["horizontal"].schedule, rig.radars["vertical"].schedule))


def _open(path: Path, rig: Rig, radar: RadarId, t_start_ns: int | None) -> CaptureFile:
    if LoopSum.is_at(path):
        return LoopSum(path, rig, radar, t_start_ns or 0)
    if rig.radars[radar].schedule.layout.kind == "cascade":
        return CaptureFolder(path, rig, radar, t_start_ns)
    paths = sorted(path.glob("*.bin"), key=_card_order) if path.is_dir() else [path]
    return Dca1000File(paths, rig, radar, t_start_ns or 0)


def _card_order(path: Path) -> tuple[int, str]:
    """The card counts its files up at the end of the name: ``adc_data_Raw_10.bin`` comes after ``..._9.bin``."""
    count = path.stem.rpartition("_")[2]
    return (int(count) if count.isascii() and count.isdigit() else -1, path.name)


def _instant(item: RadarFrame | Pose | Loss) -> int:
    return item.t_first_chirp_ns if isinstance(item, RadarFrame) else item.t_ns


def _count(report: ImportReport, item: RadarFrame | Loss, expected: dict[RadarId, int]) -> None:
    """Account for a frame or a loss, and for the numbers skipped before it."""
    skipped = item.number - expected[item.radar]
    count = item.count if isinstance(item, Loss) else 1
    expected[item.radar] = item.number + count
    report.frames_in[item.radar] += skipped + count
    if skipped:
        report.lost[item.radar][LossCause.GAP] += skipped
    if isinstance(item, Loss):
        report.lost[item.radar][item.cause] += count
    else:
        report.frames_ok[item.radar] += 1


def _tum_pose(line: str, where: str) -> Pose:
    parts = line.split()
    seconds, point, fraction = parts[0].partition(".")
    try:
        if len(parts) != 8 or not seconds.isdigit() or (point and not fraction.isdigit()):
            raise ValueError("eight numbers, the time without exponent or sign")
        t_ns = int(seconds) * 10**9 + int((fraction + "000000000")[:9])
        values = [float(part) for part in parts[1:]]
        return Pose(t_ns, np.array(values[:3]), np.array(values[3:]))
    except ValueError as error:
        allowed = "time_s x y z qx qy qz qw"
        raise PoseError(f"{where}: no pose ({error})", value=line[:120], allowed=allowed) from error
    except PoseError as error:
        raise PoseError(f"{where}: {error.what}", value=error.value, allowed=error.allowed) from error
