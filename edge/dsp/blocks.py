# SPDX-License-Identifier: Apache-2.0
"""Where the chirps of every slot and device lie in a raw frame, and what their receivers are in the virtual row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.dsp.row import RowGeometry
from edge.frames import Float32, Layout

Int64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Blocks:
    """A block is one slot of one device; those of the row come first, then those beside it if they are read.

    Args:
        pairs: slot and device of every block.
        row: blocks of the row.
        loop_stride: int32 words from loop to loop.
        start: int64 [block], word of its first chirp.
        slot: int64 [block of the row].
        element: int64 [block of the row, rx], place in the row; -1: none.
        channel: the same, place among the row's channels.
        channel_start: int64 [slots, receivers], word of the first sample of every channel.
        channel_samples, channel_step, channel_word: as ``kernels_checks.dead_channels`` takes them.
    """

    pairs: list[tuple[int, int]]
    row: int
    loop_stride: int
    start: Int64
    slot: Int64
    element: Int64
    channel: Int64
    channel_start: Int64
    channel_samples: int
    channel_step: int
    channel_word: int

    @classmethod
    def of(cls, layout: Layout, geometry: RowGeometry, read_elevation: bool) -> Blocks:
        """Blocks of a layout; those beside the row only with ``read_elevation``."""
        shape = layout.slots, layout.devices, layout.rx
        element = geometry.element.reshape(shape)
        every = [(s, d) for d in range(layout.devices) for s in range(layout.slots)]
        row = [(s, d) for s, d in every if (element[s, d] >= 0).any()]
        beside = [pair for pair in every if pair not in row] if read_elevation else []
        words = layout.samples * layout.parts // 2
        chirp = words * layout.rx
        loop_stride = layout.slots * chirp
        interleaved = layout.kind == "cascade"
        slot, receiver = np.indices((layout.slots, layout.devices * layout.rx))
        device, rx = receiver // layout.rx, receiver % layout.rx
        first = device * layout.loops * loop_stride + slot * chirp + rx * (1 if interleaved else words)
        channel = geometry.channels().index(layout.slots, layout.devices * layout.rx).reshape(shape)
        return cls(
            pairs=row + beside,
            row=len(row),
            loop_stride=loop_stride,
            start=np.array([d * layout.loops * loop_stride + s * chirp for s, d in row + beside], dtype=np.int64),
            slot=np.array([s for s, _ in row], dtype=np.int64),
            element=np.ascontiguousarray([element[s, d] for s, d in row], dtype=np.int64),
            channel=np.ascontiguousarray([channel[s, d] for s, d in row]),
            channel_start=np.ascontiguousarray(first, dtype=np.int64),
            channel_samples=words,
            channel_step=layout.rx if interleaved else layout.parts,
            channel_word=1 if interleaved else layout.parts,
        )

    def tabulate(self, values: NDArray[np.inexact], table: Float32) -> None:
        """Fill ``table`` [block, (re, im), n * rx or more] from complex ``values`` [slots, receivers, n]."""
        rx = self.element.shape[1]
        for line, (s, d) in zip(table, self.pairs, strict=False):
            of_block = values[s, d * rx : (d + 1) * rx].T.reshape(-1)
            line[0, : len(of_block)] = of_block.real
            line[1, : len(of_block)] = of_block.imag
