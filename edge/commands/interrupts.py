# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM as a request to end a run in order; the second one ends it at once."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType, TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
TOLD = b"\nending the run; once more ends it at once\n"


class Interrupts:
    """While it is entered, the first SIGINT or SIGTERM is only remembered; the second raises KeyboardInterrupt.

    Outside the main thread, which alone can take signals, nothing changes.
    """

    def __init__(self) -> None:
        self.received: signal.Signals | None = None
        self._before: dict[signal.Signals, Any] = {}

    def asked(self) -> bool:
        """Whether to end."""
        return self.received is not None

    @property
    def exit_code(self) -> int:
        """128 + number of the signal, as a shell has it: 130 after Ctrl-C, 143 after SIGTERM; 0 without."""
        return 0 if self.received is None else 128 + self.received

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._receive) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._before = {}

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = signal.Signals(number)
        os.write(2, TOLD)
