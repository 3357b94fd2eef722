# SPDX-License-Identifier: Apache-2.0
"""The appliance's state and the reasons for it, from counters and ages; knows no clock but the times it is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from edge.frames import RadarId
from edge.service.shedding import Step
from edge.stream.messages import LEVELS, Reason, State

SILENT_S = 1.0
"""A radar or a pose source that gave nothing for so long is silent."""
HOLD_S = 5.0
"""How long a reason stands after what caused it."""
STUCK_S = 5.0
"""A stage that works on one item for so long hangs."""


class Code(StrEnum):
    """Reasons beside the causes of loss, which are reasons of their own names."""

    NO_FRAMES = "NO_FRAMES"
    """No radar gives frames."""
    RADAR_SILENT = "RADAR_SILENT"
    """One of two radars gives no frames: nothing can be paired."""
    POSES_SILENT = "POSES_SILENT"
    """No poses come: nothing can be fused."""
    NO_SHAPES = "NO_SHAPES"
    """Shapes are not made at all; the detail says why."""
    SHED_VIEWER = "SHED_VIEWER"
    SHED_HALF_SHAPES = "SHED_HALF_SHAPES"
    SHED_HALF_PAIRS = "SHED_HALF_PAIRS"
    SHED_DETECTIONS_ONLY = "SHED_DETECTIONS_ONLY"
    SOURCE_FAILED = "SOURCE_FAILED"
    """The source ended with an error."""
    STREAM_CLOSED = "STREAM_CLOSED"
    """Part of the stream had to be closed: the authenticator of subscribers from other machines died."""
    RECORDING_ENDED = "RECORDING_ENDED"
    """The disk ended the recording of the run; the run goes on."""
    STAGE_STUCK = "STAGE_STUCK"
    """A stage does not come back from one item."""


SHED_CODES = {
    Step.VIEWER: (Code.SHED_VIEWER, "no heatmaps, every fourth frame's detections"),
    Step.HALF_SHAPES: (Code.SHED_HALF_SHAPES, "shapes half as often"),
    Step.HALF_PAIRS: (Code.SHED_HALF_PAIRS, "every second frame pair"),
    Step.DETECTIONS_ONLY: (Code.SHED_DETECTIONS_ONLY, "detections only"),
}


@dataclass(frozen=True, slots=True)
class Facts:
    """What is known at one instant.

    Args:
        started: kernels are ready and the source has begun.
        ending: the source has ended or was told to.
        silent_s: radar id -> since its last frame, or since the start.
        poses_silent_s: since the last pose, or since the start; None: poses are not needed.
        counts: code -> events since the start; a count that grows is a reason for some seconds.
        shed: step of load shedding.
        no_shapes: why no shapes are made; empty: they are.
        source_error: why the source ended; empty: it did not.
        stream_closed: why part of the stream is closed; empty: it is not.
        recording_ended: why the recording ended before the run; empty: it goes on, or there is none.
        stuck: names of stages that hang.
        last_fault: newest fault in words.
    """

    started: bool = True
    ending: bool = False
    silent_s: Mapping[RadarId, float] = field(default_factory=dict)
    poses_silent_s: float | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    shed: Step = Step.NOTHING
    no_shapes: str = ""
    source_error: str = ""
    stream_closed: str = ""
    recording_ended: str = ""
    stuck: tuple[str, ...] = ()
    last_fault: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """State, level of ``LEVELS`` and reasons."""

    state: State = "INIT"
    level: int = LEVELS["OK"]
    reasons: tuple[Reason, ...] = ()


class StateMachine:
    """Judges facts; remembers since when each reason stands.

    Attributes:
        verdict: the newest.
    """

    def __init__(self) -> None:
        self.verdict = Verdict()
        self._counts: dict[str, tuple[int, int, int]] = {}
        """Code -> count, first and last instant at which it grew."""
        self._standing: dict[str, int] = {}
        """Code -> since when it stands without a break."""

    def update(self, now_ns: int, facts: Facts) -> Verdict:
        """The verdict at ``now_ns``, which never falls."""
        standing = self._conditions(facts)
        self._standing = {code: self._standing.get(code, now_ns) for code in standing}
        reasons = [Reason(code, 1, self._standing[code], now_ns, detail) for code, detail in standing.items()]
        reasons += self._events(now_ns, facts)
        state = self._state(facts, {reason.code for reason in reasons})
        level = {"WAIT": "WARN", "DEGRADED": "WARN", "FAULT": "ERROR"}.get(state, "OK")
        self.verdict = Verdict(state, LEVELS[level], tuple(reasons))
        return self.verdict

    def _events(self, now_ns: int, facts: Facts) -> list[Reason]:
        """Counts that grew in the last seconds."""
        reasons = []
        for code, count in facts.counts.items():
            before = self._counts.get(code)
            if count and (before is None or count != before[0]):
                before = self._counts[code] = (count, before[1] if before else now_ns, now_ns)
            if before is not None and now_ns - before[2] <= HOLD_S * 1e9:
                reasons.append(Reason(code, *before, facts.last_fault))
        return reasons

    def _conditions(self, facts: Facts) -> dict[str, str]:
        """What stands now: code -> detail."""
        found: dict[str, str] = {}
        if facts.source_error:
            found[Code.SOURCE_FAILED] = facts.source_error
        if facts.stream_closed:
            found[Code.STREAM_CLOSED] = facts.stream_closed
        if facts.recording_ended:
            found[Code.RECORDING_ENDED] = facts.recording_ended
        if facts.stuck:
            found[Code.STAGE_STUCK] = f"no progress for {STUCK_S:g} s: {', '.join(facts.stuck)}"
        silent = {radar: age_s for radar, age_s in facts.silent_s.items() if age_s > SILENT_S}
        if silent:
            code = Code.NO_FRAMES if len(silent) == len(facts.silent_s) else Code.RADAR_SILENT
            found[code] = ", ".join(f"{radar} for {age_s:.0f} s" for radar, age_s in silent.items())
        if facts.poses_silent_s is not None and facts.poses_silent_s > SILENT_S:
            found[Code.POSES_SILENT] = f"no pose for {facts.poses_silent_s:.0f} s"
        if facts.no_shapes:
            found[Code.NO_SHAPES] = facts.no_shapes
        for step, (code, detail) in SHED_CODES.items():
            if facts.shed >= step:
                found[code] = detail
        return found

    def _state(self, facts: Facts, codes: set[str]) -> State:
        if facts.ending:
            return "STOP"
        if not facts.started:
            return "INIT"
        if codes & {Code.SOURCE_FAILED, Code.STREAM_CLOSED, Code.STAGE_STUCK}:
            return "FAULT"
        if Code.NO_FRAMES in codes:
            return "WAIT"
        return "DEGRADED" if codes else "RUN"
