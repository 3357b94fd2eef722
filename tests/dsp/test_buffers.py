# SPDX-License-Identifier: Apache-2.0
"""Buffers begin on cache lines whatever their shape and kind."""

from __future__ import annotations

import numpy as np
import pytest

from edge.dsp.buffers import LINE_BYTES, aligned, plane, zeros


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.complex64, np.float64, np.complex128])
@pytest.mark.parametrize("shape", [1, 7, (3, 5), (2, 86, 256)])
def test_zeros_begin_on_a_line(shape, dtype):
    made = zeros(shape, dtype)
    assert made.shape == ((shape,) if isinstance(shape, int) else shape)
    assert made.dtype == dtype
    assert made.flags.c_contiguous
    assert made.ctypes.data % LINE_BYTES == 0
    assert not made.any()


def test_every_row_of_a_plane_begins_on_a_line():
    made = plane(5, 17)
    assert made.shape == (5, 32)
    assert made.strides[0] % LINE_BYTES == 0
    assert made.ctypes.data % LINE_BYTES == 0


def test_a_copy_keeps_the_values():
    values = np.arange(30, dtype=np.float32).reshape(5, 6)
    copy = aligned(values)
    np.testing.assert_array_equal(copy, values)
    assert copy.ctypes.data % LINE_BYTES == 0
