# SPDX-License-Identifier: Apache-2.0
"""The radar simulator: surfaces to point scatterers, scatterers to the raw frames that a board would send."""

from edge import numba_cache

numba_cache.enable()
