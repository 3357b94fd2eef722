# SPDX-License-Identifier: Apache-2.0
"""A recording's progress, on a terminal only."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

from edge.recording.recorder import Recorder


class Progress:
    """Bytes so far and how fast they come.

    Args:
        hidden: stdout is for a machine.
        recorder: asked for its figures.
    """

    def __init__(self, hidden: bool, recorder: Recorder) -> None:
        from tqdm import tqdm

        hidden = hidden or sys.stderr is None or not sys.stderr.isatty()
        self._recorder = recorder
        self._bar: Any = tqdm(unit="B", unit_scale=True, desc="recording", disable=hidden, leave=False)

    def update(self) -> None:
        """Show the present figures."""
        self._bar.update(self._recorder.bytes_written - self._bar.n)
        dropped = sum(self._recorder.dropped.values())
        if dropped:
            self._bar.set_postfix_str(f"dropped {dropped}", refresh=False)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()
