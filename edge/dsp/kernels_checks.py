# SPDX-License-Identifier: Apache-2.0
"""Kernels that look at raw samples before they are used: all zero, channels that never change."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import boolean, int32, int64, njit, types, uint8

from edge.kernels_arrays import Int32, Int64, UInt8

RAW = types.Array(int32, 1, "C", readonly=True)
# A microsecond each: to give the interpreter's lock away and wait for it again could take longer.
OPTIONS: dict[str, Any] = {"error_model": "numpy", "boundscheck": False, "cache": True}


@njit(boolean(RAW), **OPTIONS)
def all_zero(adc: Int32) -> bool:
    """True when every value of ``adc`` [values / 2] is zero; stops at the first that is not."""
    for x in range(len(adc)):  # noqa: SIM110 - a kernel
        if adc[x] != 0:
            return False
    return True


@njit(int64(RAW, int64[:, ::1], int64, int64, int64, uint8[:, ::1]), **OPTIONS)
def dead_channels(adc: Int32, start: Int64, samples: int, step: int, word: int, dead: UInt8) -> int:
    """Mark the channels whose first chirp is constant; stops at each channel's first change.

    Args:
        adc: int32 [values / 2], two int16 in one word.
        start: int64 [slots, receivers], word of each channel's first sample.
        samples: words of one channel's chirp.
        step: words between units (cascade: receivers of a device; DCA1000: 2 words for 2 samples; 1, real samples).
        word: words that make the repeated unit (cascade 1: one sample; DCA1000 2: two samples; 1, two real samples).
        dead: uint8 [slots, receivers], set to 1 where the channel is constant.
    Returns:
        Channels that are constant.
    """
    count = 0
    for s in range(start.shape[0]):
        for r in range(start.shape[1]):
            first = start[s, r]
            constant = True
            for w in range(word):
                value = adc[first + w]
                if word == step and np.int16(value) != np.int16(value >> 16):
                    constant = False
                n = 0
                while constant and n < samples // word:
                    constant = adc[first + w + n * step] == value
                    n += 1
            dead[s, r] = constant
            count += constant
    return count
