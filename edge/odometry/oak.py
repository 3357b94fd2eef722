# SPDX-License-Identifier: Apache-2.0
"""Poses of a Luxonis OAK: a process of its own holds the camera and its library, and is started again when it dies.

The library aborts, faults or hangs now and then, takes 140 MB, and would call home if it were let; none of that touches
this process. What runs over there is ``edge/odometry/oak_child.py``.
"""

from __future__ import annotations

import importlib.util
import math
import sys
import time
from collections import deque
from collections.abc import Sequence

import numpy as np

from edge.board_settings import PoseSettings
from edge.config import RigGeometry
from edge.errors import DependencyError, DeviceError, PoseError
from edge.frames import Pose
from edge.odometry.child import Child, exit_text
from edge.odometry.oak_child import EXIT_NO_DEVICE, EXIT_NO_PACKAGE, OFFLINE
from edge.odometry.oak_record import Kind, PoseFlag, PoseRecord, Record, TextRecord
from edge.odometry.source import (
    NS_PER_S,
    EventKind,
    Meter,
    Placement,
    PoseEvent,
    PoseHealth,
    quaternion_turn_rad,
)

START_LIMIT_S = 40.0
"""From the start to the first pose: 2 s import, 11.5 s search for the device, its boot, settling of the filter."""
STOP_LIMIT_S = 4.0
"""The child gives itself 3 s to stop the device; a camera whose process was killed is not found for seconds."""
BACKOFF_S = (0.2, 0.6, 1.8, 5.4, 16.2, 30.0)
"""Pauses before restarts that follow each other."""
HEALTHY_S = 10.0
"""Poses for so long: the next pause is the first one again."""
MOST_RESTARTS, RESTART_WINDOW_S = 5, 60.0
OLDEST_S = 5.0
"""A pose older than this at its arrival has a wrong time."""
TRUST_AFTER_S = 0.5
"""The odometry counts as doubtful until so long after the vehicle turned too fast."""
TURN_SPAN_S = 0.2
"""Without a gyroscope the turn rate is that of the poses over so long."""
LONGEST_WAIT_S = 0.1


class OakSource:
    """Supervises the process and turns its records into poses of the rig. Nothing happens between polls.

    Args:
        settings: of the rig.
        geometry: of the rig.
        command: of the process, without the options that are added here; for another interpreter.
    """

    def __init__(self, settings: PoseSettings, geometry: RigGeometry, command: Sequence[str] = ()) -> None:
        self._settings, self._own_command = settings, not command
        self._command = [*(command or (sys.executable, "-m", "edge.odometry.oak_child")), *_options(settings)]
        self._placement = Placement(settings, geometry, from_start=True)
        self._meter = Meter(settings.timeout_s)
        self._child: Child | None = None
        self._limit_rad_s = math.radians(settings.max_turn_rate_deg_s)
        self._starts: deque[float] = deque(maxlen=MOST_RESTARTS + 1)
        self._attempt, self._resume_s, self._quiet_s = 0, math.inf, math.inf
        self._first_pose_s: float | None = None
        self._again = False
        self._doubtful_until_ns: int | None = None
        self._last: Pose | None = None
        self._sequence: int | None = None
        self._what = ""
        self._garbage_bytes = 0
        self._items: list[Pose | PoseEvent] = []

    @property
    def name(self) -> str:
        """For messages: with versions and device, once they are known."""
        return f"oak ({self._what or self._settings.device_id or 'any device'})"

    @property
    def health(self) -> PoseHealth:
        """Counters and state now."""
        return self._meter.health()

    @property
    def pid(self) -> int | None:
        """Of the process; None while there is none."""
        return None if self._child is None else self._child.pid

    @property
    def garbage_bytes(self) -> int:
        """Bytes from the process that were no record."""
        return self._garbage_bytes + (0 if self._child is None else self._child.garbage_bytes)

    def start(self) -> None:
        """Start the process; poses come seconds later.

        Raises:
            DependencyError: the camera's library is not installed.
            DeviceError: the process cannot be started.
        """
        if self._meter.state != "idle":
            return
        if self._own_command and importlib.util.find_spec("depthai") is None:
            raise DependencyError("poses of an OAK need depthai", action="pip install 'rfconstruct[oak]'")
        self._spawn()

    def poll(self, timeout_s: float) -> list[Pose | PoseEvent]:
        """What came; waits at most ``timeout_s`` for it."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            self._step(min(LONGEST_WAIT_S, max(0.0, deadline_s - time.monotonic())))
            if self._items or time.monotonic() >= deadline_s:
                items, self._items = self._items, []
                return items

    def close(self) -> None:
        """Stop the process, by force after ``STOP_LIMIT_S``."""
        self._meter.state, self._resume_s = "ended", math.inf
        self._drop_child()

    def _step(self, wait_s: float) -> None:
        """Read, restart or wait, once."""
        if self._child is None:
            now_s = time.monotonic()
            if now_s >= self._resume_s:
                self._restart()
            else:
                time.sleep(min(wait_s, self._resume_s - now_s))
            return
        code = self._child.exit_code()  # asked before the last records are read, so that none is lost
        for record in self._child.read(0.0 if code is not None else wait_s):
            if not self._child.stopping:  # said to be silent: what still comes is too late
                self._take(record)
        if code is not None:
            self._died(code)
        elif not self._child.stopping and time.monotonic() > self._quiet_s:
            self._silent()

    def _spawn(self) -> None:
        self._child = Child(self._command, OFFLINE)
        now_s = time.monotonic()
        self._starts.append(now_s)
        self._quiet_s, self._resume_s = now_s + START_LIMIT_S, math.inf
        self._first_pose_s = self._sequence = self._last = None
        self._meter.state = "starting"

    def _restart(self) -> None:
        try:
            self._spawn()
        except DeviceError as error:
            self._event("died", str(error))
            self._pause()

    def _take(self, record: Record) -> None:
        if self._sequence is not None:
            self._meter.lost += (record.sequence - self._sequence - 1) & 0xFFFFFFFF
        self._sequence = record.sequence
        if isinstance(record, PoseRecord):
            self._take_pose(record)
        elif isinstance(record, TextRecord) and record.kind in (Kind.HELLO, Kind.ERROR):
            self._what = record.text

    def _take_pose(self, record: PoseRecord) -> None:
        try:
            pose = Pose(record.t_ns, np.array(record.position_m), np.array(record.quaternion_xyzw))
            current = record.arrival_ns - record.t_ns <= OLDEST_S * NS_PER_S
        except PoseError:
            current = False
        if not current:
            self._meter.refused += 1
            return
        if not self._meter.accept(pose):
            return
        now_s = time.monotonic()
        self._quiet_s = now_s + self._settings.timeout_s
        if self._first_pose_s is None:
            self._first_pose_s, self._meter.state = now_s, "running"
            self._event("started", f"{self.name}: first pose", new_frame=self._again)
            self._again = True
        if now_s - self._first_pose_s > HEALTHY_S:
            self._attempt = 0
        self._meter.time_guessed += bool(record.flags & PoseFlag.TIME_GUESSED)
        self._guard(pose, record.turn_rate_rad_s)
        self._items.append(self._placement.rig(pose))

    def _guard(self, pose: Pose, turn_rate_rad_s: float) -> None:
        """Mark the odometry as doubtful while the vehicle turns too fast for it."""
        span_ns = 0 if self._last is None else pose.t_ns - self._last.t_ns
        if self._last is None or span_ns >= TURN_SPAN_S * NS_PER_S:
            if self._last is not None and not math.isfinite(turn_rate_rad_s):
                turn_rate_rad_s = quaternion_turn_rad(self._last, pose) * NS_PER_S / span_ns
            self._last = pose
        if turn_rate_rad_s > self._limit_rad_s:
            if self._doubtful_until_ns is None:
                text = (
                    f"turns at {math.degrees(turn_rate_rad_s):.0f} deg/s, limit {self._settings.max_turn_rate_deg_s:g}"
                )
                self._event("doubtful", text)
            self._doubtful_until_ns = pose.t_ns + round(TRUST_AFTER_S * NS_PER_S)
        elif self._doubtful_until_ns is not None and pose.t_ns > self._doubtful_until_ns:
            self._doubtful_until_ns = None
            self._event("trusted", "turns slowly again")
        self._meter.doubtful += self._doubtful_until_ns is not None

    def _silent(self) -> None:
        assert self._child is not None
        before = self._first_pose_s is None
        text = f"no pose for {START_LIMIT_S if before else self._settings.timeout_s:g} s" + " since its start" * before
        self._meter.state = "silent"
        self._event("silent", f"{self.name}: {text}; it is stopped")
        self._child.ask_to_stop(STOP_LIMIT_S)

    def _died(self, code: int) -> None:
        assert self._child is not None
        reason = exit_text(code)
        if code > 0 and self._what:
            reason += f", {self._what}"
        elif self._child.last_words:
            reason += f", {self._child.last_words[-200:]}"
        if code == EXIT_NO_DEVICE:
            reason += "; check its USB 3 cable and power, that nothing else uses it, and the udev rules of systemd/udev"
        self._drop_child()
        self._event("died", reason)
        if code == EXIT_NO_PACKAGE:
            self._meter.state = "ended"
            self._event("ended", "depthai is not installed over there: pip install 'rfconstruct[oak]'")
        else:
            self._pause()

    def _pause(self) -> None:
        """Restart later: after a growing pause, and never more than ``MOST_RESTARTS`` times in the window."""
        now_s = time.monotonic()
        wait_s = BACKOFF_S[min(self._attempt, len(BACKOFF_S) - 1)]
        if len(self._starts) > MOST_RESTARTS:
            wait_s = max(wait_s, self._starts[1] + RESTART_WINDOW_S - now_s)
        self._attempt += 1
        self._resume_s = now_s + wait_s
        self._meter.restarts += 1
        self._meter.state, self._doubtful_until_ns = "restarting", None
        self._meter.pause()
        self._event("restarting", f"in {wait_s:.1f} s, restart {self._meter.restarts}")

    def _drop_child(self) -> None:
        if self._child is not None:
            child, self._child = self._child, None
            child.close(STOP_LIMIT_S)
            self._garbage_bytes += child.garbage_bytes

    def _event(self, kind: EventKind, detail: str, new_frame: bool = False) -> None:
        self._items.append(PoseEvent(kind, time.monotonic_ns(), detail, new_frame))


def _options(settings: PoseSettings) -> list[str]:
    return [
        *(("--device", settings.device_id) if settings.device_id else ()),
        *("--rate", f"{settings.rate_hz:g}", "--imu-rate", f"{settings.imu_rate_hz:g}", "--vio", settings.vio),
    ]
