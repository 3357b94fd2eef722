# SPDX-License-Identifier: Apache-2.0
"""State, latency and losses as the viewer shows them: what the appliance says, and what the viewer itself notices."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from edge.stream.messages import HeartbeatMessage, Reason, State, Status, StatusMessage

STALE_S = 1.0
"""Silence after which the stream counts as stale: ten heartbeats."""
HISTORY = 180
"""Status messages kept for the strips: three minutes."""
SHOWN_REASONS = 6


@dataclass(frozen=True, slots=True)
class Banner:
    """The line at the top.

    Args:
        state: WAITING (nothing came yet), STALE (it fell silent), REFUSED (the viewer is not let in), or the
            appliance's own state.
        level: "ok", "warn" or "error".
        text: what it means.
        reasons: newest first.
    """

    state: str
    level: str
    text: str
    reasons: Sequence[Reason] = ()


@dataclass(frozen=True, slots=True)
class Sample:
    """One status message's figures for the strips.

    Args:
        wall_s: when it came.
        latency_ms: stage -> 99th percentile.
        lost: frames lost in all since the start of the publisher.
        rates_hz: radar -> frames a second.
    """

    wall_s: float
    latency_ms: dict[str, float]
    lost: int
    rates_hz: dict[str, float]


@dataclass(slots=True)
class Health:
    """What is known about the publisher.

    Args:
        status: the newest.
        state: of the newest status or heartbeat.
        heard_s: when the last message came.
        stopped_s: when the publisher said that it ends; None: it has not. Time stands still from then on.
        history: for the strips.
    """

    status: Status | None = None
    state: State | None = None
    heard_s: float | None = None
    stopped_s: float | None = None
    history: deque[Sample] = field(default_factory=lambda: deque(maxlen=HISTORY))

    def hear(self, wall_s: float) -> None:
        """Any message came."""
        self.heard_s = wall_s

    def add(self, message: StatusMessage | HeartbeatMessage, wall_s: float) -> None:
        """Take a status or a heartbeat."""
        self.state = message.state if isinstance(message, HeartbeatMessage) else message.status.state
        self.stopped_s = (self.stopped_s or wall_s) if self.state == "STOP" else None
        if isinstance(message, HeartbeatMessage):
            return
        self.status = status = message.status
        lost = sum(sum(radar.lost.values()) for radar in status.radars.values())
        latency_ms = {stage: values[1] / 1e3 for stage, values in status.latency_us.items()}
        self.history.append(Sample(wall_s, latency_ms, lost, {name: r.fps for name, r in status.radars.items()}))

    def silence_s(self, wall_s: float) -> float | None:
        """Since the last message; None: there was none."""
        return None if self.heard_s is None else max(0.0, wall_s - self.heard_s)

    def banner(self, wall_s: float, endpoint: str, stale_s: float | None = STALE_S) -> Banner:
        """What to show at ``wall_s``.

        Args:
            wall_s: now.
            endpoint: whom the viewer listens to, for the text.
            stale_s: silence that makes the stream stale; None: never (a recording).
        """
        silence_s = self.silence_s(wall_s)
        if silence_s is None:
            return Banner("WAITING", "warn", f"nothing came from {endpoint} yet")
        reasons = self._reasons()
        if self.state == "STOP":
            return Banner("STOP", "warn", "the publisher has ended its run", reasons)
        if stale_s is not None and silence_s > stale_s:
            return Banner("STALE", "error", f"silent for {silence_s:.0f} s: what is shown is old", reasons)
        level = {"RUN": "ok", "DEGRADED": "warn", "FAULT": "error"}.get(self.state or "", "warn")
        if level == "ok" and self.status is not None and self.status.level > 0:
            level = "warn"
        return Banner(self.state or "UNKNOWN", level, _MEANING.get(self.state or "", "no status yet"), reasons)

    def _reasons(self) -> Sequence[Reason]:
        if self.status is None:
            return ()
        return sorted(self.status.reasons, key=lambda reason: -reason.last_ns)[:SHOWN_REASONS]


_MEANING: dict[str, str] = {
    "INIT": "starting: kernels are compiled or loaded",
    "WAIT": "waiting for frames or poses",
    "RUN": "frames come in, shapes go out",
    "DEGRADED": "running with less than it should have",
    "FAULT": "not running",
}
