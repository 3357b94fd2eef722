# SPDX-License-Identifier: Apache-2.0
"""How ``run`` gets its frames: segments of cascades, or the live samples of capture cards; what each reports."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from edge.board_settings import CascadeBoard
from edge.calibration_temperature import temperature_notes
from edge.commands.hardware import configure
from edge.commands.session import Session
from edge.drivers.fetch import fetcher_for
from edge.drivers.single_chip import SingleChipDriver
from edge.drivers.tda2.cascade import CascadeDriver
from edge.errors import DeviceError
from edge.frames import RadarId
from edge.rig import Rig
from edge.sources.live_cards import CardSource
from edge.sources.pose_feed import PoseFeed
from edge.sources.segments import Item, SegmentSource

LAST_POSE_S = 0.3
"""After the last frame poses are taken for so long: one later than it, or the frame would have none."""


@dataclass(frozen=True, slots=True)
class Limits:
    """When a run ends by itself.

    Args:
        frames: of each radar; None: never.
        segments: of cascades; None: as many as the frames need.
    """

    frames: int | None
    segments: int | None

    def frames_of(self, most: int) -> int:
        """Frames of a segment, at most ``most``, so that equal segments give what was asked for."""
        return most if self.frames is None else -(-self.frames // -(-self.frames // most))

    def segments_of(self, frames: int) -> int | None:
        """Segments of so many frames that give what was asked for."""
        needed = None if self.frames is None else -(-self.frames // frames)
        counts = [count for count in (needed, self.segments) if count is not None]
        return min(counts) if counts else None


class Road(Protocol):
    """From boards to items.

    Attributes:
        faults: what degrades the run, in words.
        total_frames: of all radars; None: endless.
    """

    faults: list[str]

    @property
    def total_frames(self) -> int | None:
        """Of all radars; None: endless."""

    def prepare(self) -> None:
        """Connect and configure the boards. DeviceError."""

    def items(self) -> Iterator[Item]:
        """Frames, losses, poses and events. DeviceError, RfconstructError."""

    def finish(self) -> list[str]:
        """After the last item: notes for the report."""

    def figures(self) -> dict[str, Any]:
        """For the report: offset and drift, counters."""


class SegmentRoad:
    """Cascades.

    Args:
        rig: whose boards they are.
        boards: not connected.
        limits: of the run.
        folder: for copies.
        keep: recordings and copies.
        poses: None: there are none.
        live: the session, for messages.
    """

    def __init__(
        self,
        rig: Rig,
        boards: Mapping[RadarId, CascadeDriver],
        limits: Limits,
        folder: Path,
        keep: bool,
        poses: PoseFeed | None,
        live: Session,
    ) -> None:
        self.faults: list[str] = []
        self._rig, self._boards, self._live, self._poses = rig, boards, live, poses
        settings = {r: board for r, board in rig.boards.items() if isinstance(board, CascadeBoard)}
        self._fetchers = {radar: fetcher_for(board) for radar, board in settings.items()}
        frames = limits.frames_of(min(board.segment_frames for board in settings.values()))
        self._source = SegmentSource(
            rig,
            boards,
            self._fetchers,
            frames=frames,
            segments=limits.segments_of(frames),
            folder=folder,
            poses=poses,
            keep=keep,
            stopped=live.stopped,
            say=live.say,
        )

    @property
    def total_frames(self) -> int | None:
        """As ``Road.total_frames``."""
        return self._source.total_frames

    def prepare(self) -> None:
        """As ``Road.prepare``; storage is looked at before the boards are, which takes longer."""
        for radar, fetcher in self._fetchers.items():
            self._live.say(f"{radar}: recordings through {fetcher.check()}")
        self._live.notes += configure(self._boards, self._live.say, self._live.stopped)

    def items(self) -> Iterator[Item]:
        """As ``Road.items``."""
        yield from self._source

    def finish(self) -> list[str]:
        """Temperatures of the chips, and whether the calibration suits them."""
        notes, hottest = list[str](), dict[RadarId, float]()
        for radar, board in self._boards.items():
            try:
                chips = board.temperatures()
            except DeviceError as error:
                self._live.say(f"{radar}: no temperatures: {error}")
                continue
            texts = [f"{chip} {min(all_.values())}..{max(all_.values())}" for chip, all_ in chips.items()]
            notes.append(f"{radar} temperatures in degrees Celsius: {', '.join(texts)}")
            hottest[radar] = max(max(all_.values()) for all_ in chips.values())
        for radar, now_c in hottest.items():
            notes += temperature_notes({radar: self._rig.radars[radar].calibration}, now_c)
        self.faults += [f"segment {report.number}: {report.text}" for report in self._source.reports if report.text]
        return notes + self.faults

    def figures(self) -> dict[str, Any]:
        """Offsets at each start, attempts, times of the copies."""
        reports = self._source.reports
        starts = [report.start for report in reports if report.start is not None]
        offsets = [f"{1e3 * start.offset_s:.2f} +- {500 * start.spread_s:.2f}" for start in starts]
        ppm = 1e6 * self._rig.interleave.drift_s_per_s
        drift_ms = 1e-3 * ppm * self._segment_s
        return {
            "segments": len(reports),
            "start offsets in ms": ", ".join(offsets) or "one radar",
            "start attempts": sum(start.attempts for start in starts),
            "drift within a segment": f"at most {drift_ms:.2f} ms at {ppm:g} ppm" if starts else "one radar",
            "fetched in seconds": ", ".join(f"{report.fetched_s:.1f}" for report in reports),
            **_pose_figures(self._poses),
        }

    @property
    def _segment_s(self) -> float:
        period_s = max(radar.schedule.frame_period_s_actual for radar in self._rig.radars.values())
        return self._source.frames * period_s


class CardRoad:
    """Single-chip radars on capture cards.

    Args:
        rig: whose boards they are.
        boards: not connected.
        limits: of the run.
        poses: None: there are none.
        live: the session, for messages.
    """

    def __init__(
        self,
        rig: Rig,
        boards: Mapping[RadarId, SingleChipDriver],
        limits: Limits,
        poses: PoseFeed | None,
        live: Session,
    ) -> None:
        self.faults: list[str] = []
        self._live, self._poses, self._boards = live, poses, boards
        self._source = CardSource(
            rig, boards, frames=limits.frames or 0, poses=poses, stopped=live.stopped, say=live.say
        )

    @property
    def total_frames(self) -> int | None:
        """As ``Road.total_frames``."""
        return self._source.total_frames

    def prepare(self) -> None:
        """As ``Road.prepare``."""
        self._live.notes += configure(self._boards, self._live.say, self._live.stopped)

    def items(self) -> Iterator[Item]:
        """As ``Road.items``."""
        yield from self._source
        if self._poses is not None and not self._live.stopped():
            time.sleep(LAST_POSE_S)
            yield from self._poses.take()

    def finish(self) -> list[str]:
        """What the source has to say."""
        source = self._source
        if source.restarts:
            self.faults.append(f"boards were set up anew {source.restarts} times")
        if source.watch is not None and source.watch.overlaps:
            self.faults.append(f"bursts of the two radars met, seen {source.watch.overlaps} times")
        return list(self.faults)

    def figures(self) -> dict[str, Any]:
        """Offset and drift, re-arms, what the receiver repaired."""
        source = self._source
        last = source.watch.last if source.watch is not None else None
        return {
            "interleave": last.text() if last is not None else "not measured",
            "re-arms": source.rearms,
            "restarts": source.restarts,
            "frames repaired": dict(source.repaired),
            "frames of one radar alone": dict(source.alone),
            **_pose_figures(self._poses),
        }


def _pose_figures(feed: PoseFeed | None) -> dict[str, Any]:
    if feed is None:
        return {"poses": "none"}
    health = feed.health
    text = f"{health.poses} from {feed.name}, lost {health.lost}, refused {health.refused}, restarts {health.restarts}"
    return {"poses": text}
