# SPDX-License-Identifier: Apache-2.0
"""Turn the published loop sum of a cascade capture back into int16 loops that sum to it exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.errors import CaptureError

RX_PER_DEVICE = 4


def split_loop_sum(adc_loop_sum: NDArray[np.integer], loops: int) -> NDArray[np.int16]:
    """Distribute a sum over loops evenly: every loop gets the quotient, the first ones one more for the remainder.

    Slot s of the result fires TX ``slots - s`` (TX1 is last), devices are master, slave 1, slave 2, slave 3.

    Args:
        adc_loop_sum: integer [TX, RX, sample, (I, Q)], TX in the order TX1.., RX in file order.
        loops: loops of the result.
    Returns:
        int16 [device, loop, slot, sample, rx, (I, Q)], the cascade layout; its sum over loops is exactly the input.
    Raises:
        CaptureError: wrong shape, or a loop would leave the int16 range.
    """
    shape = adc_loop_sum.shape
    if len(shape) != 4 or shape[1] % RX_PER_DEVICE or shape[3] != 2 or loops < 1:
        raise CaptureError(
            "loop sum has no cascade shape",
            value=(shape, loops),
            allowed=f"[TX, RX (a multiple of {RX_PER_DEVICE}), sample, 2] and at least one loop",
        )
    total = adc_loop_sum.astype(np.int64)[::-1]
    slots, receivers, samples, _ = shape
    by_device = total.reshape(slots, receivers // RX_PER_DEVICE, RX_PER_DEVICE, samples, 2).transpose(1, 0, 3, 2, 4)
    quotient, remainder = np.divmod(by_device, loops)
    if quotient.min() < -32768 or (quotient + (remainder > 0)).max() > 32767:
        raise CaptureError(
            f"the sum does not fit into {loops} int16 loops",
            value=int(np.abs(total).max()),
            allowed=f"at most {32767 * loops}",
            action="give the number of loops that were summed",
        )
    extra = np.arange(loops)[None, :, None, None, None, None] < remainder[:, None]
    return np.ascontiguousarray(quotient[:, None] + extra, dtype=np.int16)
