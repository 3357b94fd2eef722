# SPDX-License-Identifier: Apache-2.0
"""A published sum over loops of one cascade frame, turned back into the raw frame it can have come from.

Some public captures keep only the mean over loops that TI's calibration script stores. The sum does not say how the
loops differed: they are made equal but for the remainder, and add up exactly. It is one frame of one radar.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edge.errors import CaptureError
from edge.frames import Pose, RadarFrame, RadarId
from edge.reference.repack import split_loop_sum
from edge.rig import Rig
from edge.sources.base import Loss
from edge.sources.ti_index import gap_notes, indexed_gaps

FILE_NAME = "adc_loop_sum.npz"
ARRAY = "adc_loop_sum"
SLOPE_TOLERANCE = 1e-3
NOTE = "the loops were re-packed from their published sum: they add up exactly but are not independent"


class LoopSum:
    """Source of the one frame.

    Args:
        path: folder with ``adc_loop_sum.npz``: ``adc_loop_sum`` integer [TX, RX, sample, (I, Q)], ``loops``,
            ``slope_hz_per_s``, ``sample_rate_hz``.
        rig: rig it was captured with.
        radar: which of its radars.
        t_start_ns: instant of the frame.
    Attributes:
        notes: what a reader of the results should know: the re-packing, and gaps of the capture when its index files
            lie beside.
    Raises:
        CaptureError: not such a file, it contradicts the schedule, or an index file that cannot be read.
    """

    def __init__(self, path: Path, rig: Rig, radar: RadarId, t_start_ns: int = 0) -> None:
        schedule = rig.radars[radar].schedule
        file = path / FILE_NAME
        try:
            with np.load(file, allow_pickle=False) as stored:
                total, loops = stored[ARRAY], int(stored["loops"])
                slope, rate = float(stored["slope_hz_per_s"]), float(stored["sample_rate_hz"])
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise CaptureError(
                f"{file}: not a sum over loops ({error})", allowed=f"{ARRAY}, loops, slope_hz_per_s, sample_rate_hz"
            ) from error
        profile, layout = schedule.profile, schedule.layout
        found = (loops, *total.shape, round(slope / 1e9), round(rate / 1e3))
        slope_agrees = abs(slope / profile.slope_hz_per_s_actual - 1.0) < SLOPE_TOLERANCE
        expected_slope = found[5] if len(found) == 7 and slope_agrees else round(profile.slope_hz_per_s_actual / 1e9)
        shape = (layout.slots, layout.devices * layout.rx, layout.samples, 2)
        expected = (layout.loops, *shape, expected_slope, round(profile.sample_rate_hz / 1e3))
        if found != expected:
            raise CaptureError(
                f"{file} was not captured with rig {rig.name}",
                value=found,
                allowed=f"{expected}: loops, TX, RX, samples, I and Q, slope in MHz/ms, sample rate in kHz",
                action="give the rig it was captured with (--rig)",
            )
        self._frame = RadarFrame(radar, 0, t_start_ns, split_loop_sum(total, loops), layout)
        self.notes = [NOTE, *(f"the capture it is from has {note}" for note in gap_notes(indexed_gaps(path)))]

    @staticmethod
    def is_at(path: Path) -> bool:
        """Whether a folder holds a sum over loops."""
        return (path / FILE_NAME).is_file()

    @property
    def total_frames(self) -> int:
        """One."""
        return 1

    def __iter__(self) -> Iterator[RadarFrame | Pose | Loss]:
        """The frame."""
        yield self._frame

    def close(self) -> None:
        """Nothing is held open."""
