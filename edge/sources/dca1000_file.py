# SPDX-License-Identifier: Apache-2.0
"""Reads ``adc_data.bin`` of one single-chip radar with a DCA1000 capture card: frames without index or time stamps.

The card cuts long captures into several files at any byte; given in order they are read as one. The files hold no
times: frame k is at ``t_start_ns`` plus k frame periods of the schedule.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from edge.errors import CaptureError
from edge.frames import Int16, Layout, LossCause, Pose, RadarFrame, RadarId
from edge.rig import Rig
from edge.sources.base import Loss, file_size, loops_that_fit, open_raw, read_into


class Dca1000File:
    """One radar's recorded samples as a source of frames.

    Args:
        paths: the file, or the files of one capture in order.
        rig: rig the capture was made with; its I/Q order and loops are those of the file.
        radar: which of its radars.
        t_start_ns: instant of frame 0.
    Raises:
        CaptureError: unreadable, not one whole frame, or a size that other loops fit but the schedule's do not.
    """

    def __init__(self, paths: Path | str | Sequence[Path], rig: Rig, radar: RadarId, t_start_ns: int = 0) -> None:
        self.paths = (Path(paths),) if isinstance(paths, str | Path) else tuple(paths)
        self.radar = radar
        name = ", ".join(str(path) for path in self.paths)
        if radar not in rig.radars or not self.paths:
            raise CaptureError(f"{name}: rig {rig.name} has no such radar", value=radar, allowed=", ".join(rig.radars))
        schedule = rig.radars[radar].schedule
        self.layout: Layout = schedule.layout
        if self.layout.kind == "cascade":
            raise CaptureError(
                f"{name}: rig {rig.name} is not captured by a DCA1000",
                value=self.layout.kind,
                allowed="dca1000, dca1000_real",
            )
        self._t_start_ns, self._period_s, self._closed = t_start_ns, schedule.frame_period_s, False
        self._sizes = [file_size(path) for path in self.paths]
        self._whole, self._rest = divmod(sum(self._sizes), self.layout.nbytes)
        fit = loops_that_fit(sum(self._sizes), self.layout.nbytes // self.layout.loops)
        if not self._whole or (self._rest and fit):
            raise CaptureError(
                f"{name}: frames do not have the schedule's {self.layout.loops} loops",
                value=f"{sum(self._sizes)} bytes",
                allowed=f"whole frames of {self.layout.nbytes} bytes",
                action=f"loops that fit: {', '.join(map(str, fit)) or 'none, so samples or slots differ'}; "
                "set schedule.loops",
            )

    @property
    def total_frames(self) -> int:
        """Whole frames and the cut one."""
        return self._whole + (self._rest > 0)

    def __iter__(self) -> Iterator[RadarFrame | Pose | Loss]:
        """Frames in order; a cut last frame is a loss of cause TRUNCATED."""
        for number in range(self.total_frames):
            if self._closed:
                return
            t_ns = self._t_start_ns + round(number * self._period_s * 1e9)
            adc = self._read(number) if number < self._whole else None
            if adc is None:
                detail = f"{self.paths[-1]}: the last frame is cut after {self._rest} of {self.layout.nbytes} bytes"
                yield Loss(self.radar, number, LossCause.TRUNCATED, detail, t_ns)
            else:
                yield RadarFrame(self.radar, number, t_ns, adc, self.layout)

    def close(self) -> None:
        """End any iteration; nothing else is held open."""
        self._closed = True

    def _read(self, number: int) -> Int16 | None:
        """Frame ``number``, freshly allocated, from the one or more files it lies in; None: a file became shorter."""
        adc = np.empty(self.layout.shape, dtype=np.int16)
        rest, position = adc.reshape(-1).view(np.uint8), number * self.layout.nbytes
        for path, size in zip(self.paths, self._sizes, strict=True):
            if rest.size and position < size:
                part = rest[: size - position]
                with open_raw(path) as file:
                    file.seek(position)
                    if not read_into(file, part):
                        return None
                rest = rest[part.size :]
            position = max(0, position - size)
        return adc
