# SPDX-License-Identifier: Apache-2.0
"""From a source's frames, losses and poses to frame pairs that know their pose and velocity, every frame accounted for.

The gate computes nothing of the radar signal and blocks nowhere; it belongs to the thread that feeds it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from edge.accounting import FrameLedger
from edge.errors import CaptureError, PoseError
from edge.frames import RADARS, Float64, LossCause, Pose, RadarFrame, RadarId
from edge.odometry.track import PoseTrack
from edge.rig import Rig
from edge.sources.base import Loss
from edge.sources.pairing import FramePair, FramePairer

MAX_WAITING_PAIRS = 64
"""Frame pairs that wait for a later pose before the oldest is given up: about a second at 60 frames/s."""
FARTHEST_M = 1e8
"""Positions beyond are no odometry, whatever its origin; arithmetic with them would overflow."""
REFUSED_POSES = 30
"""Poses refused in a row before the pose clock counts as restarted: one stamp of the far future must not end all."""


@dataclass(slots=True)
class Faults:
    """What went wrong apart from lost frames, counted; ``last`` says the newest in words.

    Args:
        poses_refused: poses that were no poses or went backwards in time.
        shapes_withheld: objects whose completion was not finite or failed.
        dead_channels: radar id -> names of channels that gave constant values.
        last: newest message.
    """

    poses_refused: int = 0
    shapes_withheld: int = 0
    dead_channels: dict[RadarId, tuple[str, ...]] = field(default_factory=dict)
    last: str = ""


@dataclass(frozen=True, slots=True)
class ReadyPair:
    """A pair that can be imaged.

    Args:
        pair: the frames; whoever takes it owes the ledgers one ``ok`` or ``lost`` for each of them.
        pose: of the rig at the pair's instant; None in a rig of one radar that has no poses.
        velocity_m_s: float64 [3] of the rig in the rig frame at that instant; None likewise.
        epoch: number of the odometry frame: poses of different epochs do not belong together.
    """

    pair: FramePair
    pose: Pose | None
    velocity_m_s: Float64 | None
    epoch: int


class PairGate:
    """Pairs frames, keeps the poses, and lets a pair through once its velocity is known, or known never to come.

    Args:
        rig: radars, schedules, longest pose gap.
        faults: counts refused poses; its ``last`` is kept up to date.
        ahead_s: poses are continued this far after the newest one instead of waiting for the next; 0: not at all.
    Attributes:
        ledgers: radar id -> account of its frames.
        epoch: odometry frames that ended so far.
    """

    def __init__(self, rig: Rig, faults: Faults, ahead_s: float = 0.0) -> None:
        self._rig, self._faults = rig, faults
        self.radars: tuple[RadarId, ...] = tuple(radar for radar in RADARS if radar in rig.radars)
        self._pairer = FramePairer(self.radars)
        self.ledgers: dict[RadarId, FrameLedger] = self._pairer.ledgers
        self.epoch = 0
        self._track = PoseTrack(rig.settings.fusion.max_pose_gap_s, ahead_s=ahead_s)
        self._waiting: deque[FramePair] = deque()
        self._newest_pose_ns: int | None = None
        self._refused_in_a_row = 0

    @property
    def waiting(self) -> int:
        """Pairs that wait for a pose."""
        return len(self._waiting)

    def add(self, item: RadarFrame | Pose | Loss) -> None:
        """Take the next frame, pose or loss of a source, in the source's order.

        Raises:
            CaptureError: a radar that the rig does not have, or another layout than its schedule's; nothing was taken.
        """
        if isinstance(item, Pose):
            self._add_pose(item)
            return
        self._check_layout(item)
        pairs, losses = self._pairer.add(item)
        self._note(losses)
        self._waiting.extend(pairs)

    def ready(self, last: bool = False) -> Iterator[ReadyPair]:
        """Every waiting pair whose pose and velocity are known; those that will never know them are lost.

        One radar needs no pose, but uses it: while there are poses its frames wait for theirs, too.

        Args:
            last: nothing more will come.
        """
        pose_needed = len(self.radars) == len(RADARS)
        while self._waiting:
            pair = self._waiting[0]
            pose, velocity_m_s = self._track.at(pair.t_ns), self._track.velocity_rig_m_s(pair.t_ns)
            if velocity_m_s is None:
                newest_ns = self._newest_pose_ns
                due = pose_needed if newest_ns is None else pair.t_ns >= newest_ns
                if due and not last and len(self._waiting) <= MAX_WAITING_PAIRS:
                    return
            self._waiting.popleft()
            if velocity_m_s is None and pose_needed:
                self._give_up(pair)
            else:
                yield ReadyPair(pair, pose, velocity_m_s, self.epoch)

    def new_pose_frame(self) -> None:
        """Poses from now on are in another odometry frame: the track begins anew."""
        self._track.clear()
        self._newest_pose_ns, self._refused_in_a_row = None, 0
        self.epoch += 1

    def end(self) -> None:
        """The source has ended: frames that wait for the other radar are lost. ``ready(last=True)`` gives the rest."""
        self._note(self._pairer.flush())

    def lose(self, pair: FramePair, cause: LossCause, why: str) -> None:
        """Every frame of a pair is lost by one cause."""
        self._faults.last = why
        for radar in pair.frames:
            self.ledgers[radar].lost(cause)

    def _check_layout(self, item: RadarFrame | Loss) -> None:
        board = self._rig.radars.get(item.radar)
        if isinstance(item, RadarFrame) and board is not None and item.layout != board.schedule.layout:
            raise CaptureError(
                f"{item.radar} frame {item.number} has another layout than the schedule of rig {self._rig.name}",
                value=item.layout,
                allowed=str(board.schedule.layout),
                action="use the rig that the capture was made with",
            )

    def _add_pose(self, pose: Pose) -> None:
        """Refuse it, or restart the track after so many in a row that the clock or the sensor must have restarted."""
        try:
            if np.abs(pose.position_m).max() > FARTHEST_M:
                raise PoseError(f"pose at {pose.t_ns} ns", value=pose.position_m.tolist(), allowed=f"<= {FARTHEST_M} m")
            self._track.add(pose)
            self._newest_pose_ns, self._refused_in_a_row = pose.t_ns, 0
        except PoseError as error:
            self._faults.poses_refused += 1
            self._faults.last = str(error)
            self._refused_in_a_row += 1
            if self._refused_in_a_row >= REFUSED_POSES:
                self.new_pose_frame()

    def _note(self, losses: Sequence[Loss]) -> None:
        """Remember the newest loss in words; the pairer has counted it."""
        if losses:
            last = losses[-1]
            self._faults.last = f"{last.radar} frame {last.number}: {last.cause.value}: {last.detail}"

    def _give_up(self, pair: FramePair) -> None:
        """No pose for this pair."""
        why = self._track.why_none(pair.t_ns) or "no other pose near enough to know the velocity"
        self.lose(pair, LossCause.NO_POSE, f"frame {pair.number}: {why}")
