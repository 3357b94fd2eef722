# SPDX-License-Identifier: Apache-2.0
"""Runs one call in this thread and another in a second one; kernels release the GIL, so both cores work.

A thread that spins for work instead of sleeping was tried and gains nothing: it must wait for the GIL all the same,
which the first thread holds while it begins its own call.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from types import TracebackType


class TwoCores:
    """A thread that waits for work; use as a context manager or ``close`` it.

    An exception of either call is raised by ``both``.
    """

    def __init__(self) -> None:
        self._work: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._done: SimpleQueue[tuple[object, BaseException | None]] = SimpleQueue()
        self._thread = threading.Thread(target=self._serve, name="second core", daemon=True)
        self._thread.start()

    def both(self, here: Callable[[], object], there: Callable[[], object]) -> tuple[object, object]:
        """Results of both calls.

        Raises:
            RuntimeError: closed before.
        """
        if not self._thread.is_alive():
            raise RuntimeError("the second core's thread has been closed")
        self._work.put(there)
        try:
            mine = here()
        finally:
            other, error = self._done.get()
        if error is not None:
            raise error
        return mine, other

    def close(self) -> None:
        """End the thread."""
        self._work.put(None)
        self._thread.join()

    def _serve(self) -> None:
        while (call := self._work.get()) is not None:
            try:
                self._done.put((call(), None))
            except BaseException as error:  # it is raised where the caller waits
                self._done.put((None, error))

    def __enter__(self) -> TwoCores:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
