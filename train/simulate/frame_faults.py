# SPDX-License-Identifier: Apache-2.0
"""Faults of frames: lost, doubled, swapped, late, and samples that are stuck, dead, saturated or flipped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.frames import Int16, Layout, RadarFrame, RadarId
from train.simulate.faults import Fault, Faults

RAIL = 32767


class FrameFaults:
    """What becomes of the frames of one radar, channel ``<radar>/frames``.

    Args:
        faults: rules; None: the frames are left alone.
        radar: which.
    """

    def __init__(self, faults: Faults | None, radar: RadarId) -> None:
        self._faults, self.where = faults, f"{radar}/frames"
        self._held: RadarFrame | None = None

    def late_s(self) -> float:
        """By how much the bursts begin later; asked once for each start."""
        hit = self._faults.hit(Fault.LATE, self.where) if self._faults is not None else None
        return hit.value if hit else 0.0

    def of(self, frame: RadarFrame) -> list[RadarFrame]:
        """What takes this frame's place, in order: nothing, it, it twice, or it after the next one."""
        faults = self._faults
        if faults is None or (self._held is None and faults.quiet(self.where)):
            return [frame]
        if faults.hit(Fault.DROP, self.where):
            return self._release()
        frame = self._samples(frame, faults)
        frames = [frame, frame] if faults.hit(Fault.DUPLICATE, self.where) else [frame]
        if self._held is None and faults.hit(Fault.REORDER, self.where):
            self._held = frame
            return []
        return frames + self._release()

    def flush(self) -> list[RadarFrame]:
        """A frame that waits to be overtaken when no other comes."""
        return self._release()

    def _release(self) -> list[RadarFrame]:
        held, self._held = self._held, None
        return [] if held is None else [held]

    def _samples(self, frame: RadarFrame, faults: Faults) -> RadarFrame:
        dead, stuck = faults.hits(Fault.DEAD, self.where), faults.hits(Fault.STUCK, self.where)
        rails, flips = faults.hit(Fault.SATURATE, self.where), faults.hit(Fault.GARBLE, self.where)
        if not (dead or stuck or rails or flips):
            return frame
        adc = frame.adc.copy()
        for hit in dead:
            receiver(adc, frame.layout, int(hit.value))[...] = 0
        for hit in stuck:
            channel = receiver(adc, frame.layout, int(hit.value))
            channel[...] = channel[0, 0, 0].copy()
        flat = adc.reshape(-1)
        if rails:
            places = rails.rng.random(flat.size) < rails.value
            flat[places] = np.where(flat[places] < 0, -RAIL - 1, RAIL)
        if flips:
            bytes_ = flat.view(np.uint8)
            for place in flips.rng.choice(8 * bytes_.size, size=int(flips.value), replace=False):
                bytes_[place >> 3] ^= np.uint8(1 << (place & 7))
        return replace(frame, adc=adc)


def receiver(adc: Int16, layout: Layout, index: int) -> Int16:
    """View of one physical receiver's samples, [loop, slot, sample or pair of samples, I and Q].

    Args:
        adc: in ``layout``.
        layout: of the capture.
        index: device * rx + receiver of the device; modulo those there are.
    """
    device, rx = divmod(index % (layout.devices * layout.rx), layout.rx)
    return adc[device, :, :, :, rx] if layout.kind == "cascade" else adc[:, :, rx]
