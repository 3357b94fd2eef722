# SPDX-License-Identifier: Apache-2.0
"""Where every channel of a radar stands in its virtual row, and which of them are doubled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge.frames import Float64

if TYPE_CHECKING:
    from edge.rig import Radar


@dataclass(frozen=True, slots=True)
class RowGeometry:
    """Where every channel stands in the virtual row of one radar.

    Args:
        element: int64 [slots, receivers], index in the row, ascending along the rig axis; -1: not in the row.
        count: elements of the row.
        multiplicity: int64 [count], channels of each element.
        transmit_m, receive_m: [slots], [receivers] offsets from the phase centre along the rig axis.
        pitch: element spacing in wavelengths, two-way phase 2 pi pitch u per element.
    """

    element: NDArray[np.int64]
    count: int
    multiplicity: NDArray[np.int64]
    transmit_m: Float64
    receive_m: Float64
    pitch: float

    @classmethod
    def of(cls, radar: Radar) -> RowGeometry:
        """Geometry of ``radar``'s row, turned into the rig axis by the mounting's array sign."""
        position = np.asarray(radar.array.position, dtype=np.int64)
        inside = position >= 0
        element = position - position[inside].min()
        count = int(element[inside].max()) + 1
        sign = radar.mounting.array_sign
        element = np.where(inside, element if sign > 0 else count - 1 - element, -1)
        transmit_m, receive_m = (
            sign * np.asarray(offset, dtype=np.float64) for offset in radar.array.element_offsets_m()
        )
        multiplicity = np.bincount(element[inside], minlength=count)
        pitch = float(radar.array.pitch_wavelengths(radar.schedule.profile.center_frequency_hz))
        return cls(element, count, multiplicity, transmit_m, receive_m, pitch)

    def channel_weight(self, taper: Float64) -> Float64:
        """Weight of every channel [slots, receivers]: the element's taper shared by its channels; 0 outside the row."""
        per_element = taper / np.maximum(self.multiplicity, 1)
        return np.where(self.element >= 0, per_element[self.element], 0.0)

    def channels(self) -> RowChannels:
        """The row's channels one after the other, slot by slot."""
        slot, receiver = (np.ascontiguousarray(index) for index in np.nonzero(self.element >= 0))
        element = self.element[slot, receiver]
        pairs = []
        for e in np.flatnonzero(self.multiplicity > 1):
            same = np.flatnonzero(element == e)
            pairs += [(same[0], other) for other in same[1:] if slot[other] != slot[same[0]]]
        pair = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        distance, index = np.unique(slot[pair[:, 1]] - slot[pair[:, 0]], return_inverse=True)
        return RowChannels(slot, receiver, element, np.c_[pair, index].astype(np.int64), distance)


@dataclass(frozen=True, slots=True)
class RowChannels:
    """Channels of the row as columns.

    Args:
        slot, receiver, element: int64 [channel].
        pairs: int64 [pair, 3]: two channels at one element, the earlier slot first, and the index of their distance.
        distance: int64 [distances], different distances of pairs in slots, ascending.
    """

    slot: NDArray[np.int64]
    receiver: NDArray[np.int64]
    element: NDArray[np.int64]
    pairs: NDArray[np.int64]
    distance: NDArray[np.int64]

    def index(self, slots: int, receivers: int) -> NDArray[np.int64]:
        """int64 [slots, receivers], place of each channel in the columns; -1: not in the row."""
        index = np.full((slots, receivers), -1, dtype=np.int64)
        index[self.slot, self.receiver] = np.arange(len(self.slot))
        return index
