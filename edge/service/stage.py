# SPDX-License-Identifier: Apache-2.0
"""One thread of the live pipeline: takes work from a queue, survives what the work raises, says how long it is busy."""

from __future__ import annotations

import ctypes
import logging
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")
POLL_S = 0.1
PR_SET_NAME = 15
_LIBC = ctypes.CDLL(None)
_LOG = logging.getLogger(__name__)


class Stage(threading.Thread, Generic[T]):
    """A daemon thread.

    Args:
        name: of the thread; the kernel shows its first 15 characters.
        take: waits at most so many seconds for the next item; None: there was none.
        work: does one item.
        failed: told when ``work`` raised.
        idle: called when there was nothing to do, at least every ``poll_s``.
        poll_s: longest wait for an item.
    Attributes:
        handled: items done, failed ones included.
        failures: items whose work raised.
        cpu_s: processor time of the thread up to its last item.
    """

    def __init__(
        self,
        name: str,
        take: Callable[[float], T | None],
        work: Callable[[T], None],
        failed: Callable[[T, Exception], None],
        idle: Callable[[], None] | None = None,
        poll_s: float = POLL_S,
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._take_next, self._work, self._failed, self._idle = take, work, failed, idle
        self._poll_s, self._ending = poll_s, threading.Event()
        self.handled = self.failures = 0
        self.cpu_s = 0.0
        self._busy_since_s: float | None = None

    @property
    def busy_s(self) -> float:
        """How long it has been at its current item; 0 when it waits for one."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def end(self, timeout_s: float) -> bool:
        """Let it empty its queue and end; False: it was still busy after so long."""
        self._ending.set()
        if self.ident is not None:
            self.join(timeout_s)
        return not self.is_alive()

    def run(self) -> None:
        """The thread."""
        name_thread(self.name)
        while True:
            ending = self._ending.is_set()  # asked before the queue is: nothing put before ``end`` is left in it
            item = self._take_next(0.0 if ending else self._poll_s)
            if item is not None:
                self._do(item)
            elif ending:
                return
            elif self._idle is not None:
                self._guard(self._idle)

    def _do(self, item: T) -> None:
        self._busy_since_s = time.monotonic()
        try:
            self._work(item)
        except Exception as error:
            self.failures += 1
            reason = error
            self._guard(lambda: self._failed(item, reason))
        finally:
            self._busy_since_s = None
            self.handled += 1
            self.cpu_s = time.thread_time()

    def _guard(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception:
            self.failures += 1
            _LOG.exception("stage %s", self.name)


def name_thread(name: str) -> None:
    """Give the calling thread a name in the kernel, as ``top -H`` shows it (prctl(2), at most 15 bytes)."""
    if hasattr(_LIBC, "prctl"):
        _LIBC.prctl(PR_SET_NAME, ctypes.c_char_p(name.encode("ascii", "replace")[:15]), 0, 0, 0)
