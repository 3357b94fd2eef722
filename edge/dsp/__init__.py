# SPDX-License-Identifier: Apache-2.0
"""Numba kernels and stages from raw samples to detections."""
