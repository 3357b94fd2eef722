# SPDX-License-Identifier: Apache-2.0
"""Buffers of the kernels: they begin on a cache line, so that no vector straddles two."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from edge.frames import Float32

LINE_BYTES = 64
"""Of the cache, and of the widest vector."""


def zeros(shape: int | tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Zeros, C-contiguous, the first on a cache line."""
    kind, count = np.dtype(dtype), int(np.prod(shape))
    flat = np.zeros(count + LINE_BYTES // kind.itemsize, dtype=kind)
    begin = -flat.ctypes.data % LINE_BYTES // kind.itemsize
    return flat[begin : begin + count].reshape(shape)


def aligned(values: NDArray[Any]) -> NDArray[Any]:
    """Copy of ``values`` whose first is on a cache line."""
    copy = zeros(values.shape, values.dtype)
    copy[...] = values
    return copy


def plane(rows: int, width: int) -> Float32:
    """Zeros [rows, at least width]; every row begins on a cache line."""
    count = LINE_BYTES // 4
    return zeros((rows, -(-width // count) * count))
