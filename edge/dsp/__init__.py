# SPDX-License-Identifier: Apache-2.0
"""Numba kernels and stages from raw samples to detections."""

from edge import numba_cache

numba_cache.enable()
