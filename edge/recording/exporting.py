# SPDX-License-Identifier: Apache-2.0
"""Writes results as point files: one for everything, or one for each item in a folder."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sized
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from edge.errors import RecordingError
from edge.recording.placing import FrameName, Placed
from edge.recording.point_files import write_points
from edge.stream.messages import CloudMessage, DetectionsMessage, PoseMessage, ShapeMessage

What = Literal["shapes", "objects", "clouds", "detections"]
WHATS: tuple[What, ...] = ("shapes", "objects", "clouds", "detections")
"""Completed shapes; the radar points that they were made of; fused windows; 3-D points of single frames."""
UNITS = {"odometry": "fixed to the ground, z up", "vehicle": "base_link: x forward, y left, z up",
         "object": "axes of odometry, origin at the object's centre on the ground"}  # fmt: skip


@dataclass(slots=True)
class ExportReport:
    """What was written.

    Args:
        files: paths.
        items: kind -> shapes, clouds, frames.
        points: in all.
        unplaced: items left out because their pose is not known.
    """

    files: list[Path] = field(default_factory=list)
    items: Counter[str] = field(default_factory=Counter)
    points: int = 0
    unplaced: int = 0

    def count(self, what: What, item: Sized) -> None:
        """One more item was written."""
        self.items[what] += 1
        self.points += len(item)


@dataclass(frozen=True, slots=True)
class _Item:
    """Points with columns, and what is known of them as a whole."""

    columns: dict[str, NDArray[Any]]
    facts: dict[str, object]
    key: str

    def __len__(self) -> int:
        return len(self.columns["x"])


def export_points(
    placed: Iterable[Placed | PoseMessage], out: Path, suffix: str, what: What, frame: FrameName, every: bool
) -> ExportReport:
    """Write one kind of results.

    Args:
        placed: results in order, of ``Placer``.
        out: file, or folder (made when it has no suffix of a format).
        suffix: ``.ply``, ``.pcd`` or ``.npz``.
        what: which results.
        frame: that ``placed`` are in.
        every: all shapes of an object; False: its most trusted one.
    Raises:
        RecordingError: nothing to write, or a file cannot be written.
    """
    report = ExportReport()
    items = _items(placed, what, frame, every, report)
    if out.suffix == suffix:
        kept = list(items)
        if kept:
            _write_together(out, kept)
            report.files.append(out)
        for item in kept:
            report.count(what, item)
    else:
        for item in items:
            _make_folder(out)
            path = out / f"{what}_{report.items[what]:06d}_{item.key}{suffix}"
            write_points(path, item.columns, item.facts)
            report.files.append(path)
            report.count(what, item)
    if not report.items[what]:
        why = f"{report.unplaced} have no known pose" if report.unplaced else "the recording holds none"
        action = (
            "another --frame, or a recording with poses" if report.unplaced else "see what it holds: rfconstruct info"
        )
        raise RecordingError(f"no {what} to export: {why}", action=action)
    return report


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be made ({error.strerror})", action="choose another name") from error


def _write_together(out: Path, items: list[_Item]) -> None:
    """All items in one file; NPZ says for every point which item it is of, and everything about each item."""
    columns = {name: np.concatenate([item.columns[name] for item in items]) for name in items[0].columns}
    counts = np.array([len(item) for item in items])
    facts = dict(items[0].facts) if len(items) == 1 else {"frame": items[0].facts["frame"], "items": len(items)}
    tables: dict[str, NDArray[Any]] = {"item": np.repeat(np.arange(len(items), dtype=np.int32), counts)}
    tables |= {f"item_{name}": np.array([item.facts[name] for item in items]) for name in items[0].facts}
    write_points(out, columns, facts, {**tables, "item_points": counts})


def _items(
    placed: Iterable[Placed | PoseMessage], what: What, frame: FrameName, every: bool, report: ExportReport
) -> Iterator[_Item]:
    """Items of the kind, in order; shapes of which only the best is wanted come last, when all are known."""
    best: dict[int, Placed] = {}
    for one in placed:
        if isinstance(one, PoseMessage) or not _is(one, what):
            continue
        if one.pose is None:
            report.unplaced += 1
            continue
        message = one.message
        if isinstance(message, ShapeMessage) and not every:
            known = best.get(message.identity)
            old = known.message if known is not None else None
            if not isinstance(old, ShapeMessage) or message.confidence >= old.confidence:
                best[message.identity] = one
            continue
        yield _item(one, what, frame)
    for _, one in sorted(best.items()):
        yield _item(one, what, frame)


def _is(one: Placed, what: What) -> bool:
    message = one.message
    match what:
        case "shapes":
            return isinstance(message, ShapeMessage)
        case "objects":
            return isinstance(message, ShapeMessage) and message.input_m is not None
        case "clouds":
            return isinstance(message, CloudMessage)
        case "detections":
            return isinstance(message, DetectionsMessage) and message.points is not None


def _item(one: Placed, what: What, frame: FrameName) -> _Item:
    message = one.message
    facts: dict[str, object] = {"frame": f"{frame}, metres, {UNITS[frame]}", "t_ns": message.header.t_ns}
    match message:
        case ShapeMessage():
            cloud_m = message.fine_m if what == "shapes" or message.input_m is None else message.input_m
            facts |= {"identity": message.identity, "class": message.class_name,
                      "confidence": round(message.confidence, 6), "model": message.model,
                      "position_m": _numbers(message.pose.position_m, 6),
                      "quaternion_xyzw": _numbers(message.pose.quaternion_xyzw, 9)}  # fmt: skip
            columns = _xyz(one.points(cloud_m))
            columns["object"] = np.full(len(cloud_m), message.identity, np.uint32)
            columns["confidence"] = np.full(len(cloud_m), message.confidence, np.float32)
            kind = re.sub(r"[^A-Za-z0-9-]", "-", message.class_name)[:40]
            return _Item(columns, facts, f"{kind}_{message.identity}")
        case CloudMessage():
            cloud = message.cloud
            facts |= {"frames": cloud.frames, "travel_m": round(cloud.travel_m, 6)}
            columns = _xyz(one.points(cloud.xyz_m)) | {"intensity": cloud.power_db}
            columns["frame_number"] = cloud.frame_number.astype(np.uint32)
            return _Item(columns, facts, f"{message.header.t_ns}")
        case DetectionsMessage():
            points = message.points
            assert points is not None, "it was asked before"
            facts |= {"number": message.number}
            columns = _xyz(one.points(points.xyz_m)) | {"intensity": points.power_db}
            columns["frame_number"] = np.full(len(points), message.number % 2**32, np.uint32)
            return _Item(columns, facts, f"{message.number}")


def _xyz(points_m: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
    return dict(zip("xyz", np.ascontiguousarray(points_m.T, np.float32), strict=True))


def _numbers(values: NDArray[np.float64], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
