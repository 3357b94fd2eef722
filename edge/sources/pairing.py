# SPDX-License-Identifier: Apache-2.0
"""Puts the two radars' frames of one number together and closes the account of every frame that stays alone.

Rules, for each radar by itself:

* a number larger than the expected one: the numbers between are lost by GAP;
* a number not larger than the one before (duplicate, reordered) or more than 36,000 larger (ten minutes at 60 frames/s:
  no gap but a wrong number), or a time not later than that of the frame before: the frame is lost by BACKWARDS_TIME;
* the partner can no longer come, since the other radar is already past that number, or ``depth`` frames wait: UNPAIRED.

The first frame of a radar sets its numbering; what was before it is nobody's loss. After 30 refused numbers in a row
the board must have restarted: the next frame sets the numbering anew, and no frame that waits will be paired any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from edge.accounting import FrameLedger
from edge.errors import CaptureError
from edge.frames import LossCause, RadarFrame, RadarId
from edge.sources.base import Loss

MAX_GAP_FRAMES = 36_000
"""Largest step of the numbers that is taken for missing frames: ten minutes at 60 frames/s."""
REFUSED_NUMBERS = 30
"""Refused in a row before the numbering counts as restarted: one absurd number must not end a radar, nor a reboot."""


@dataclass(frozen=True, slots=True)
class FramePair:
    """Frames of one number.

    Args:
        number: of both.
        horizontal, vertical: None for the radar that the rig does not have.
    """

    number: int
    horizontal: RadarFrame | None
    vertical: RadarFrame | None

    @property
    def frames(self) -> dict[RadarId, RadarFrame]:
        """The one or two frames by radar, the horizontal one first."""
        return {frame.radar: frame for frame in (self.horizontal, self.vertical) if frame is not None}

    @property
    def t_ns(self) -> int:
        """First chirp of the horizontal radar's burst; of the only radar's burst in a rig of one."""
        return next(iter(self.frames.values())).t_first_chirp_ns


@dataclass(slots=True)
class _Lane:
    ledger: FrameLedger
    last_number: int | None = None
    last_t_ns: int | None = None
    refused_in_a_row: int = 0
    waiting: dict[int, RadarFrame] = field(default_factory=dict)

    def refuses(self, number: int) -> str:
        """Why a number does not continue this lane's numbering; empty: it does."""
        if self.last_number is None:
            return ""
        if number <= self.last_number:
            return f"number {number} came after {self.last_number}: duplicate or reordered"
        if number - self.last_number > MAX_GAP_FRAMES:
            return f"number {number} came after {self.last_number}: too far ahead to be a gap"
        return ""


class FramePairer:
    """Pairs frames by number; every frame that enters leaves in exactly one pair or one loss.

    The pairer keeps the ledgers up to date: it counts frames in, and every loss that it returns is counted already.
    Whoever takes a pair owes the ledgers one ``ok`` or ``lost`` for each of its frames.

    Args:
        radars: radars of the rig, one or two.
        ledgers: one for each radar; None: own ones.
        depth: frames of one radar that may wait for the other.
    """

    def __init__(
        self, radars: Iterable[RadarId], ledgers: Mapping[RadarId, FrameLedger] | None = None, depth: int = 8
    ) -> None:
        names = tuple(radars)
        if not 1 <= len(names) <= 2 or len(set(names)) != len(names) or depth < 1:
            raise CaptureError("frames cannot be paired", value=(names, depth), allowed="1 or 2 radars, depth >= 1")
        self.ledgers: dict[RadarId, FrameLedger] = {n: ledgers[n] if ledgers else FrameLedger(n) for n in names}
        self._lanes: dict[RadarId, _Lane] = {n: _Lane(self.ledgers[n]) for n in names}
        self._depth = depth

    def add(self, item: RadarFrame | Loss) -> tuple[list[FramePair], list[Loss]]:
        """Take one frame or one loss of the source.

        Returns:
            Pairs that became complete, by number, and losses that became certain, ``item`` among them when it is one.
        Raises:
            CaptureError: a radar that the rig does not have.
        """
        lane = self._lanes.get(item.radar)
        if lane is None:
            raise CaptureError(
                "frame of a radar that the rig does not have",
                value=item.radar,
                allowed=", ".join(self._lanes),
                action="load the rig that the data were taken with",
            )
        losses: list[Loss] = []
        if isinstance(item, Loss):
            self._add_loss(lane, item, losses)
        elif not self._refuse(lane, item, losses):
            self._gap(lane, item.radar, item.number, item.t_first_chirp_ns, losses)
            lane.ledger.frame_in()
            lane.last_number = item.number
            lane.last_t_ns = item.t_first_chirp_ns
            lane.refused_in_a_row = 0
            lane.waiting[item.number] = item
        return self._settle(item.radar, losses), losses

    def flush(self) -> list[Loss]:
        """End of the source: every waiting frame is lost by UNPAIRED."""
        losses: list[Loss] = []
        self._drop_all("the source ended before the other radar's frame came", losses)
        return losses

    def _add_loss(self, lane: _Lane, loss: Loss, losses: list[Loss]) -> None:
        """What the source lost is counted as it says; a number far ahead moves nothing."""
        if lane.last_number is None or loss.number - lane.last_number <= MAX_GAP_FRAMES:
            self._gap(lane, loss.radar, loss.number, loss.t_ns, losses)
            lane.last_number = max(_or(lane.last_number, -1), loss.number + loss.count - 1)
        lane.ledger.missing(loss.cause, loss.count)
        losses.append(loss)

    def _refuse(self, lane: _Lane, frame: RadarFrame, losses: list[Loss]) -> bool:
        """Lose a frame whose number or time is out of order; restart the numbering after too many in a row."""
        detail, t_ns = lane.refuses(frame.number), lane.last_t_ns
        if detail:
            lane.refused_in_a_row += 1
        elif t_ns is not None and frame.t_first_chirp_ns <= t_ns:
            detail = f"time stamp {(t_ns - frame.t_first_chirp_ns) / 1e6:.3f} ms before that of the frame before"
            self._gap(lane, frame.radar, frame.number, frame.t_first_chirp_ns, losses)
            lane.last_number = frame.number
            lane.last_t_ns = frame.t_first_chirp_ns
            lane.refused_in_a_row = 0
        else:
            return False
        lane.ledger.missing(LossCause.BACKWARDS_TIME)
        losses.append(Loss(frame.radar, frame.number, LossCause.BACKWARDS_TIME, detail, frame.t_first_chirp_ns))
        if lane.refused_in_a_row >= REFUSED_NUMBERS:
            lane.last_number, lane.last_t_ns, lane.refused_in_a_row = None, None, 0
            self._drop_all(f"the {frame.radar} radar's numbering restarted", losses)
        return True

    def _gap(self, lane: _Lane, radar: RadarId, number: int, t_ns: int, losses: list[Loss]) -> None:
        expected = number if lane.last_number is None else lane.last_number + 1
        if number > expected:
            count = number - expected
            lane.ledger.missing(LossCause.GAP, count)
            detail = f"numbers {expected}..{number - 1} never came"
            losses.append(Loss(radar, expected, LossCause.GAP, detail, t_ns, count))
            lane.last_number = number - 1

    def _settle(self, radar: RadarId, losses: list[Loss]) -> list[FramePair]:
        """Pairs and losses that the latest item of ``radar`` decided."""
        if len(self._lanes) == 1:
            alone = list(self._lanes[radar].waiting.values())
            self._lanes[radar].waiting.clear()
            return [FramePair(f.number, *((f, None) if radar == "horizontal" else (None, f))) for f in alone]
        pairs: list[FramePair] = []
        horizontal, vertical = self._lanes["horizontal"], self._lanes["vertical"]
        reached = min(_or(horizontal.last_number, -1), _or(vertical.last_number, -1))
        decided = sorted(n for n in {*horizontal.waiting, *vertical.waiting} if n <= reached)
        for number in decided:
            if number in horizontal.waiting and number in vertical.waiting:
                pairs.append(FramePair(number, horizontal.waiting.pop(number), vertical.waiting.pop(number)))
            else:
                single: RadarId = "horizontal" if number in horizontal.waiting else "vertical"
                self._drop_oldest(single, "the other radar has no frame of this number", losses)
        while len(self._lanes[radar].waiting) > self._depth:
            self._drop_oldest(radar, f"the other radar is more than {self._depth} frames behind", losses)
        return pairs

    def _drop_all(self, detail: str, losses: list[Loss]) -> None:
        for radar, lane in self._lanes.items():
            while lane.waiting:
                self._drop_oldest(radar, detail, losses)

    def _drop_oldest(self, radar: RadarId, detail: str, losses: list[Loss]) -> None:
        lane = self._lanes[radar]
        frame = lane.waiting.pop(next(iter(lane.waiting)))
        lane.ledger.lost(LossCause.UNPAIRED)
        losses.append(Loss(radar, frame.number, LossCause.UNPAIRED, detail, frame.t_first_chirp_ns))


def _or(value: int | None, default: int) -> int:
    return default if value is None else value
