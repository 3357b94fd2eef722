# SPDX-License-Identifier: Apache-2.0
"""Threads of the virtual rig: calls that are due later, and bursts at their period; all end within a stated time."""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

JOIN_S = 5.0
"""No thread of the rig needs longer to end; one that does is reported, not waited for."""


def join(thread: threading.Thread) -> bool:
    """Wait for a thread to end; whether it did. A thread that waits for itself counts as ended."""
    if thread.ident is not None and thread is not threading.current_thread():
        thread.join(JOIN_S)
    return not thread.is_alive() or thread is threading.current_thread()


class Later:
    """Calls functions after a delay, one after the other, on a thread of its own that starts when it is needed.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name, self._calls, self._order = name, list[tuple[float, int, Callable[..., None], Any]](), 0
        self._change, self._closed = threading.Condition(), False
        self._thread: threading.Thread | None = None

    def call(self, delay_s: float, function: Callable[..., None], *arguments: Any) -> None:
        """Call ``function(*arguments)`` after ``delay_s``; calls of one instant in the order they came; none after
        ``close``."""
        with self._change:
            if self._closed:
                return
            self._order += 1
            heapq.heappush(self._calls, (time.monotonic() + delay_s, self._order, function, arguments))
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
                self._thread.start()
            self._change.notify()

    def close(self) -> bool:
        """Forget what is still due and end the thread; whether it ended."""
        with self._change:
            self._closed = True
            self._calls.clear()
            self._change.notify()
            thread = self._thread
        return thread is None or join(thread)

    def _run(self) -> None:
        while True:
            with self._change:
                while not self._closed and (not self._calls or self._calls[0][0] > time.monotonic()):
                    self._change.wait(self._calls[0][0] - time.monotonic() if self._calls else None)
                if self._closed:
                    return
                _, _, function, arguments = heapq.heappop(self._calls)
            function(*arguments)


def wait_until(t_s: float, stop: threading.Event) -> bool:
    """Sleep until the monotonic clock shows ``t_s``; False: stopped before."""
    rest_s = t_s - time.monotonic()
    return not (stop.wait(rest_s) if rest_s > 0 else stop.is_set())


class Bursts:
    """Calls ``deliver(k)`` for burst k = 0, 1, ... at its instant.

    Args:
        deliver: makes and sends a burst; called on the thread of this object.
        period_s: burst to burst on the wall clock; 0: as fast as they are delivered.
        count: bursts; 0: until stopped.
        first_s: from start to burst 0.
        ended: called after the last burst when ``count`` was reached.
        triggered: bursts wait for ``pulse`` instead of the clock.
    """

    def __init__(
        self,
        deliver: Callable[[int], None],
        period_s: float,
        count: int,
        first_s: float = 0.0,
        ended: Callable[[], None] | None = None,
        triggered: bool = False,
    ) -> None:
        self._deliver, self._period_s, self._count, self._first_s = deliver, period_s, count, first_s
        self._ended, self._pulses = ended, threading.Semaphore(0) if triggered else None
        self.late = 0
        """Bursts that began more than half a period after their instant."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bursts", daemon=True)

    @property
    def alive(self) -> bool:
        """More bursts will come."""
        return self._thread.is_alive() and not self._stop.is_set()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def pulse(self) -> None:
        """One trigger pulse."""
        if self._pulses is not None:
            self._pulses.release()

    def halt(self) -> None:
        """No burst begins after this; does not wait."""
        self._stop.set()
        self.pulse()

    def stop(self) -> bool:
        """``halt``, and wait; whether the thread ended."""
        self.halt()
        return join(self._thread)

    def _run(self) -> None:
        start_s = time.monotonic() + self._first_s
        for k in itertools.count():
            if self._count and k >= self._count:
                if self._ended is not None:
                    self._ended()
                return
            if self._pulses is not None:
                self._pulses.acquire()
            elif self._period_s > 0 and not wait_until(start_s + k * self._period_s, self._stop):
                return
            if self._stop.is_set():
                return
            if self._pulses is None and self._period_s > 0:
                self.late += time.monotonic() > start_s + (k + 0.5) * self._period_s
            self._deliver(k)
