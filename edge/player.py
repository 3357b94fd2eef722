# SPDX-License-Identifier: Apache-2.0
"""Plays a source through the pipeline at a chosen speed, with a progress bar on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

from edge.frames import Pose, RadarFrame
from edge.pipeline import Pipeline
from edge.sources.base import Loss

LONGEST_SLEEP_S = 60.0
"""A jump of the recorded clock beyond this, either way, is not waited for."""
LONGEST_NAP_S = 0.05
"""Sleep is cut into naps of this length, so that a sign of life can be given in between."""


class Pace:
    """Waits until an item is due.

    Args:
        speed: recorded seconds per second; 0 plays as fast as it goes.
        idle: called again and again while it waits.
        stopped: True ends the wait.
    """

    def __init__(
        self, speed: float, idle: Callable[[], None] | None = None, stopped: Callable[[], bool] | None = None
    ) -> None:
        self._speed, self._idle, self._stopped = speed, idle, stopped
        self._start: tuple[int, int] | None = None
        self._last_ns = 0

    def wait(self, t_ns: int) -> None:
        """Sleep until recorded instant ``t_ns`` is due, or until ``stopped``."""
        if self._speed <= 0:
            return
        now_ns = time.monotonic_ns()
        if self._start is None or abs(t_ns - self._last_ns) > LONGEST_SLEEP_S * self._speed * 1e9:
            self._start = (t_ns, now_ns)
        self._last_ns = t_ns
        due_ns = self._start[1] + round((t_ns - self._start[0]) / self._speed)
        while (ahead_ns := due_ns - time.monotonic_ns()) > 0:
            time.sleep(min(ahead_ns / 1e9, LONGEST_NAP_S))
            if self._idle is not None:
                self._idle()
            if self._stopped is not None and self._stopped():
                return


def play(
    source: Iterable[RadarFrame | Pose | Loss],
    pipeline: Pipeline,
    speed: float,
    total: int | None = None,
    show_progress: bool = True,
    idle: Callable[[], None] | None = None,
    stopped: Callable[[], bool] | None = None,
) -> None:
    """Feed everything a source has, or what it has until ``stopped``, then finish the pipeline.

    Args:
        source: frames, poses and losses in time order.
        pipeline: where they go.
        speed: recorded seconds per second; 0 plays as fast as it goes.
        total: radar frames and losses the source will give, when it knows.
        show_progress: draw a bar when stderr is a terminal.
        idle: called again and again while the next item is not due.
        stopped: asked before every item; True leaves the rest of the source.
    """
    pace = Pace(speed, idle, stopped)
    with progress(total, show_progress) as bar:
        for item in source:
            if not isinstance(item, Loss):
                pace.wait(item.t_ns if isinstance(item, Pose) else item.t_first_chirp_ns)
            if stopped is not None and stopped():
                break
            pipeline.feed(item)
            if not isinstance(item, Pose):
                bar.update(item.count if isinstance(item, Loss) else 1)
        pipeline.finish()


def progress(total: int | None, wanted: bool) -> Any:
    """A bar of frames on a terminal's stderr; hidden elsewhere."""
    from tqdm import tqdm

    hidden = not wanted or sys.stderr is None or not sys.stderr.isatty()
    return tqdm(total=total, unit="frame", desc="playing", disable=hidden, leave=False, dynamic_ncols=True)
