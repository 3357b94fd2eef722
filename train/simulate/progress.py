# SPDX-License-Identifier: Apache-2.0
"""Progress of a long run: a bar with rate and time left on a terminal, a line a minute elsewhere."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from train.simulate.shards import Cloud

LINE_S = 60.0


class Progress:
    """Counts clouds and failures.

    Args:
        stream: where it is shown; None = nowhere.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream
        self._bar: Any = None
        self.total = self.done = self.first = self.failed = 0
        self._start_s = self._line_s = 0.0

    def begin(self, total: int, done: int) -> None:
        """So many in all, of which so many were there before."""
        self.total, self.done, self.first = total, done, done
        self._start_s = self._line_s = time.monotonic()
        if self._stream is not None and self._stream.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=total, initial=done, unit="cloud", smoothing=0.02, file=self._stream)

    def step(self, cloud: Cloud) -> None:
        """One more; failures are named at once."""
        self.done += 1
        if cloud.error:
            self.failed += 1
            self._say(f"failed: {cloud.object} {cloud.kind} {cloud.variation}: {cloud.error}")
        if self._bar is not None:
            self._bar.update()
        elif time.monotonic() - self._line_s >= LINE_S:
            self._line_s = time.monotonic()
            self._say(self.line())

    def line(self) -> str:
        """Where it stands."""
        spent_s = time.monotonic() - self._start_s
        rate = (self.done - self.first) / max(spent_s, 1e-9)
        left = f"{(self.total - self.done) / rate / 60:.0f} min left" if rate > 0 else "time left unknown"
        return f"{self.done}/{self.total} clouds, {rate:.2f}/s, {left}, {self.failed} failed"

    def end(self) -> None:
        """Leave the terminal tidy."""
        if self._bar is not None:
            self._bar.close()
        elif self.done > self.first:
            self._say(self.line())

    def _say(self, text: str) -> None:
        if self._bar is not None:
            self._bar.write(text, file=self._stream)
        elif self._stream is not None:
            print(text, file=self._stream, flush=True)
